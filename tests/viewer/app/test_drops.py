"""Files dropped on the window, on glfw's null platform without a screen."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
from PIL import Image

from progdf.compose.layers import Gains
from progdf.compose.picture_layers import find_layer_files
from progdf.field.baked import lattice_colors
from progdf.formats.cube import write_cube
from progdf.formats.ply import save_ply
from progdf.gdf.file import save_gdf
from progdf.io.picture_camera import camera_chunk, layers_in_picture
from tests.helpers.ui_rig import bear, first_view
from viewer.app import app as application
from viewer.camera.view_camera import to_camera
from viewer.files import exports
from viewer.pictures.film import to_pixels
from viewer.state import selection
from viewer.state.commands import Plain, ReplaceEdit


@pytest.fixture
def opened(tmp_path: Path) -> Iterator[application.App]:
    """Yield the application in a window of glfw's null platform, which lacks only a screen."""
    from viewer.ui.splash import Splash
    from viewer.ui.window import Window, glfw

    glfw.init_hint(glfw.PLATFORM, glfw.PLATFORM_NULL)
    if not glfw.init():
        pytest.skip("glfw has no null platform here")
    glfw.window_hint(glfw.CONTEXT_CREATION_API, glfw.EGL_CONTEXT_API)
    stack = bear()
    try:
        window = Window(Splash("test", (800, 600)))
    finally:
        glfw.init_hint(glfw.PLATFORM, glfw.ANY_PLATFORM)
    document = application.Document("bear.ply", stack.scene, stack.gdfs[:1])
    app = application.App(window, document, first_view(stack, 0.5))
    app.draw()
    yield app
    app.close()
    window.splash.close()


@pytest.mark.gl
def test_dropped_edit_becomes_the_top_layer_and_can_be_undone(
    opened: application.App, tmp_path: Path
) -> None:
    gdf = bear().gdfs[1]
    save_gdf(tmp_path / "ears.gdf", gdf)
    opened.parts.file_actions.open(tmp_path / "ears.gdf")
    opened.draw()
    layers = opened.main_view.work.view.layers
    assert [(layer.name, layer.strength) for layer in layers] == [("scarf", 0.5), ("ears", 1.0)]
    assert [row.count for row in opened.main_view.facts.rows] == [len(g.region) for g in bear().gdfs]
    assert len(opened.main_view.work.past.past) == 1
    assert opened.main_view.work.view.blend == "adjust", "two edits at 1 do not dull each other"


@pytest.mark.gl
def test_dropped_color_table_applies_to_selection_scene_or_region(
    opened: application.App, tmp_path: Path
) -> None:
    write_cube(tmp_path / "look.cube", lattice_colors(5).flip(1), "look")
    opened.parts.file_actions.open(tmp_path / "look.cube")
    view = opened.main_view.work.view
    mask = np.arange(len(opened.documents.get().scene)) % 4 == 0
    opened.main_view.store.change(replace(view, selection=selection.select(view.selection, mask)))
    opened.parts.file_actions.open(tmp_path / "look.cube")
    opened.draw()
    layers = opened.main_view.work.view.layers
    assert [layer.name for layer in layers] == ["scarf", "look", "look-2"]
    total = len(opened.documents.get().scene)
    some = int(mask.sum())
    assert [row.count for row in opened.main_view.facts.rows][1:] == [total, some]
    assert [row.region for row in opened.main_view.facts.rows][1:] == ["all", "selection"]
    opened.handle(ReplaceEdit(0, str(tmp_path / "look.cube")))
    assert opened.documents.get().gdfs[-1].region == opened.documents.get().gdfs[0].region


@pytest.mark.gl
def test_dropped_picture_fills_the_form_and_restores_its_camera(
    opened: application.App, tmp_path: Path
) -> None:
    main_view = opened.main_view
    before = main_view.work.view.camera
    image = np.zeros((300, 400, 3), np.uint8)
    taken = to_camera(replace(before, azimuth=before.azimuth + 20.0), 400, 300)
    picture = exports.picture(tmp_path, "helmet", image, camera_chunk(taken))
    opened.parts.file_actions.open(picture)
    opened.draw()
    assert main_view.work.form_open
    assert main_view.work.form.pictures == str(picture)
    assert main_view.work.view.camera.azimuth == pytest.approx(before.azimuth + 20.0, abs=1e-3)
    worn = exports.picture(tmp_path, "worn", image, camera_chunk(taken, ["scarf"]))
    opened.parts.file_actions.open(worn)
    assert main_view.work.message is not None
    assert "shows edits (scarf) without naming their files" in main_view.work.message.text
    assert main_view.work.form.pictures == str(picture)


def with_files(opened: application.App, folder: Path) -> None:
    """Save the scene and its edit, and open them from these files."""
    document = opened.documents.get()
    save_ply(folder / "bear.ply", bear().scene)
    save_gdf(folder / "scarf.gdf", bear().gdfs[0])
    opened.documents.replace(replace(document, path=folder / "bear.ply", gdf_paths=(folder / "scarf.gdf",)))


@pytest.mark.gl
def test_painting_over_saves_the_visible_layers_and_their_strengths(
    opened: application.App, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    painted = list[Path]()
    with_files(opened, tmp_path)
    monkeypatch.setattr("viewer.app.parts.preview.open_in_program", lambda path: painted.append(path) or True)
    view = opened.main_view.work.view
    layers = (replace(view.layers[0], strength=0.6, gains=Gains(color=0.5)),)
    opened.main_view.store.change(replace(view, layers=layers))
    opened.handle(Plain("paint_view"))
    (path,) = painted
    found = layers_in_picture(path)
    assert found is not None
    assert (found.blend, str(found)) == (view.blend, "scarf 0.6")
    assert (found.layers[0].color, found.layers[0].geometry) == (0.5, 1.0)
    scene = opened.documents.get().path
    assert find_layer_files(found, path, scene) == [opened.documents.get().gdf_paths[0].resolve()]
    size = opened.main_view.picture_size
    shown = to_pixels(opened.main_view.canvas.image(opened.main_view.work.view, size))
    assert np.array_equal(np.asarray(Image.open(path).convert("RGB")), shown)
    Image.open(path).convert("RGB").save(path)  # a program that drops the metadata
    assert layers_in_picture(path) == found
    opened.parts.file_actions.open(path)
    assert opened.main_view.work.form.pictures == str(path)
    find_layer_files(found, path, scene)[0].write_bytes(b"retrained")
    opened.parts.file_actions.open(path)
    assert opened.main_view.work.message is not None
    assert "shows other versions of" in opened.main_view.work.message.text


@pytest.mark.gl
def test_layer_without_a_file_must_be_hidden_before_painting_over(
    opened: application.App, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "viewer.app.parts.preview.open_in_program", lambda _: pytest.fail("nothing was saved")
    )
    with_files(opened, tmp_path)
    opened.documents.replace(replace(opened.documents.get(), gdf_paths=()))
    opened.handle(Plain("paint_view"))
    assert opened.main_view.work.message is not None
    assert "scarf has no file yet; hide it" in opened.main_view.work.message.text


@pytest.mark.gl
def test_dropped_scene_replaces_the_old_one(opened: application.App, tmp_path: Path) -> None:
    save_ply(tmp_path / "half.ply", bear().scene[:700])
    opened.parts.file_actions.open(tmp_path / "half.ply")
    opened.draw()
    assert opened.main_view.facts.count == 700
    assert opened.main_view.work.view.layers == ()
    assert opened.main_view.facts.title == "half.ply"


@pytest.mark.gl
def test_broken_dropped_file_is_one_line_and_changes_nothing(opened: application.App, tmp_path: Path) -> None:
    before = opened.main_view.work.view
    other = replace(
        bear().gdfs[1], scene=msgspec.structs.replace(bear().gdfs[1].scene, means_sha256="0" * 64)
    )
    save_gdf(tmp_path / "other.gdf", other)
    (tmp_path / "torn.ply").write_bytes(b"ply\nformat")
    (tmp_path / "notes.txt").write_text("hello")
    for name in ("other.gdf", "torn.ply", "notes.txt", "absent.gdf"):
        opened.parts.file_actions.open(tmp_path / name)
        opened.draw()
        work = opened.main_view.work
        message = work.question if name == "other.gdf" else work.message
        assert message is not None
        assert message.error
        assert name in message.text
        assert "\n" not in message.text
        assert opened.main_view.work.view == before


@pytest.mark.gl
def test_glfw_delivers_dropped_files_to_the_next_loop_turn(opened: application.App, tmp_path: Path) -> None:
    from viewer.ui.window import glfw

    (tmp_path / "torn.ply").write_bytes(b"ply\nformat")
    drop = glfw.set_drop_callback(opened.window.handle, None)
    names = (ctypes.c_char_p * 1)(str(tmp_path / "torn.ply").encode())
    drop(opened.window.handle, len(names), names)
    assert opened.main_view.next_frame_delay() == 0.0, "the loop wakes"
    for path in opened.take_dropped():
        opened.parts.file_actions.open(path)
    opened.draw()
    assert opened.main_view.work.message is not None
    assert "torn.ply" in opened.main_view.work.message.text
    assert opened.take_dropped() == []
