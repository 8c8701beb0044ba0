"""Several scenes in one view: merged export, values of layers, visibility, sessions and bundles."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from progdf.__main__ import main
from progdf.errors import ProgdfError
from progdf.formats.ply import load_ply, save_ply
from progdf.gaussians import ATTRIBUTES, ZERO, Gaussians, concatenate
from progdf.gdf.file import save_gdf
from progdf.gdf.placed import Placement, place_scene
from progdf.io.bundle import unpack_bundle
from tests.helpers.edits import curved_field, edit_of, growing, some_rows
from tests.helpers.scenes import random_gaussians
from viewer.files import document, session
from viewer.files.document import Document
from viewer.files.edited_scene import compose, save_bundle
from viewer.files.scenes import SceneFile
from viewer.files.session import WindowSession
from viewer.state.selection import NamedRegion, pack, unpack
from viewer.state.view_state import LayerState, SceneState, ViewState

PLACED = Placement((3.0, 0.0, 1.0), (0.0, 1.0, 0.5), 0.5)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Write two scenes of unlike SH degrees with an edit each; that of the second adds rows."""
    first = random_gaussians(60, 1, sh_degree=2)
    second = random_gaussians(40, 2)
    save_ply(tmp_path / "first.ply", first)
    save_ply(tmp_path / "second.ply", second)
    first = load_ply(tmp_path / "first.ply")
    second = load_ply(tmp_path / "second.ply")
    save_gdf(tmp_path / "shirt.gdf", edit_of(first, some_rows(first, 20), curved_field(20)))
    save_gdf(tmp_path / "hat.gdf", growing(second, some_rows(second, 15), 5, 3))
    return tmp_path


def opened(folder: Path, *states: SceneState) -> Document:
    """Open both scenes and their edits as two states list them."""
    gdfs = (folder / "shirt.gdf", folder / "hat.gdf")
    files = [document.load_file(folder / name) for name in ("first.ply", "second.ply")]
    both = document.load_stack(files, gdfs, owners=(0, 1))
    return both.arrange(states)


def states(visible: bool = True) -> tuple[SceneState, ...]:
    return (SceneState(0, "first"), SceneState(1, "second", visible, PLACED))


def stack(strength: float, *scenes: SceneState) -> ViewState:
    layers = (LayerState(0, "shirt", strength), LayerState(1, "hat", strength))
    return ViewState(layers=layers, scenes=scenes)


def rows(scene: Gaussians, first: int, last: int) -> list[bytes]:
    return [getattr(scene, name)[first:last].contiguous().numpy().tobytes() for name in ATTRIBUTES]


def test_merged_export_is_the_union_of_the_placed_exports(folder: Path) -> None:
    for strength in (0.0, 0.7):
        merged = compose(opened(folder, *states()), stack(strength, *states()))
        alone = document.load(folder / "first.ply", [folder / "shirt.gdf"])
        first = compose(alone, ViewState(layers=(LayerState(0, "shirt", strength),)))
        other = document.load(folder / "second.ply", [folder / "hat.gdf"])
        second = compose(other, ViewState(layers=(LayerState(0, "hat", strength),)))
        union = concatenate([first, place_scene(second, PLACED, ZERO, 8)])
        for name in ATTRIBUTES:
            assert torch.allclose(getattr(merged, name), getattr(union, name), atol=1e-5), name
        assert rows(merged, 0, len(first)) == rows(first, 0, len(first))


def test_layer_has_the_same_bits_with_and_without_a_second_scene(folder: Path) -> None:
    alone = document.load(folder / "first.ply", [folder / "shirt.gdf"])
    both = opened(folder, *states())
    removed = both.arrange((states()[0],))
    for strength in (0.0, 0.5, 1.0):
        layers = (LayerState(0, "shirt", strength),)
        expected = rows(compose(alone, ViewState(layers=layers)), 0, 60)
        for of in (both, opened(folder, *states(visible=False)), removed):
            assert rows(compose(of, ViewState(layers=layers, scenes=of.states)), 0, 60) == expected


def test_hidden_scene_is_not_exported_and_returns_unchanged(folder: Path) -> None:
    shown = opened(folder, *states())
    hidden = shown.arrange(states(visible=False))
    edited = compose(hidden, stack(1.0, *states(visible=False)))
    assert len(edited) == 60
    assert not bool((hidden.scene.logit_opacities[60:] > -1000.0).any())
    again = hidden.arrange(states())
    for strength in (0.0, 1.0):
        view = stack(strength, *states())
        assert rows(compose(again, view), 0, 200) == rows(compose(shown, view), 0, 200)


def test_window_edit_of_placed_scene_belongs_to_its_file(folder: Path) -> None:
    both = opened(folder, *states())
    for i, gdf in enumerate(both.placed_edits):
        own, scene = both.own(gdf)
        assert scene == i
        assert own.scene == both.edits[i].scene
        assert torch.equal(own.region.members, both.edits[i].region.members)
        for name, bases in both.edits[i].field.attributes.items():
            assert torch.allclose(own.field.attributes[name].end, bases.end, atol=1e-5)
    with pytest.raises(ProgdfError, match="belongs to one scene"):
        both.scene_with(torch.tensor([3, 70]))
    assert both.scene_with(torch.tensor([70])) == 1
    assert both.arrange(states(visible=False)).scene_with(torch.tensor([]).long()) == 0


@pytest.mark.parametrize("bundled", [False, True])
def test_session_restores_scenes_with_their_layers(folder: Path, bundled: bool) -> None:
    both = opened(folder, *states())
    mask = torch.arange(len(both.scene)) % 7 == 0
    view = stack(0.5, *states())
    named = NamedRegion("part", folder / "part.region.npy", pack(mask.numpy()), int(mask.sum()))
    view = replace(view, selection=replace(view.selection, regions=(named,)))
    path = folder / "both.session.json"
    if bundled:
        save_bundle(folder / "both.progdf.zip", WindowSession(both, view))
        path = unpack_bundle(folder / "both.progdf.zip")
    else:
        session.save(path, WindowSession(both, view))
    again = session.open_session(path)
    assert again.view.scenes == states()
    assert again.document.owners == (0, 1)
    assert torch.equal(torch.tensor(unpack(again.view.selection.regions[0].members, len(mask))), mask)
    assert rows(compose(again.document, again.view), 0, 200) == rows(compose(both, view), 0, 200)


def test_session_names_a_missing_added_scene(folder: Path) -> None:
    path = folder / "both.session.json"
    session.save(path, WindowSession(opened(folder, *states()), stack(0.5, *states())))
    (folder / "second.ply").unlink()
    with pytest.raises(ProgdfError, match=r"second\.ply, which does not exist"):
        session.open_session(path)


def test_unlisted_scene_is_not_saved(folder: Path) -> None:
    both = opened(folder, *states())
    for index, name in ((0, "shirt"), (1, "hat")):
        listed = (states()[index],)
        arranged = both.arrange(listed)
        view = stack(0.5, *listed)
        path = folder / f"{name}.session.json"
        session.save(path, WindowSession(arranged, replace(view, layers=view.layers)))
        again = session.open_session(path)
        assert [layer.name for layer in again.view.layers] == [name]
        assert again.document.path == folder / ("first.ply", "second.ply")[index]
        expected = compose(arranged, replace(view, layers=view.layers[index : index + 1]))
        found = compose(again.document, again.view)
        bands = found.shN.shape[1]
        assert torch.equal(found.means, expected.means)
        assert torch.equal(found.shN, expected.shN[:, :bands])


def test_command_places_scenes_and_finds_the_scene_of_each_edit(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first, second = str(folder / "first.ply"), str(folder / "second.ply")
    edits = str(folder / "hat.gdf"), str(folder / "shirt.gdf")
    out = folder / "both.ply"
    place = ["--place", "second=3,0,1,0,90,0,0.5"]
    assert main(["export", first, *edits, second, *place, "-o", str(out)]) == 0
    turned = Placement((3.0, 0.0, 1.0), (0.0, math.pi / 2, 0.0), 0.5)
    listed = (SceneState(0, "first"), SceneState(1, "second", True, turned))
    expected = compose(opened(folder, *listed), stack(1.0, *listed))
    found = load_ply(out)
    for name in ("means", "unit_quats", "log_scales", "logit_opacities", "sh0", "shN"):
        assert torch.allclose(getattr(found, name), getattr(expected, name), atol=1e-5), name
    for text, problem in (("other=1,2,3", "no scene of that name"), ("second=1,2", "write NAME=X,Y,Z")):
        assert main(["export", first, second, "--place", text, "-o", str(out)]) == 2
        assert problem in capsys.readouterr().err


def test_equal_files_are_two_scenes(folder: Path) -> None:
    file = document.load_file(folder / "first.ply")
    listed = (SceneState(0, "first"), SceneState(1, "first-2", True, PLACED))
    twice = document.load(folder / "first.ply").with_scenes(file).arrange(listed)
    assert isinstance(twice.files[1], SceneFile)
    assert len(compose(twice, ViewState(scenes=listed))) == 120
