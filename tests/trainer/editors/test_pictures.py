"""`pictures:A.png`: rendered views, edited in any program and returned with their cameras."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import pytest
import torch
from PIL import Image
from torch import Tensor

from progdf.camera import Camera
from progdf.errors import ProgdfError
from progdf.gaussians import Gaussians
from progdf.io.images import to_picture
from progdf.io.picture_camera import camera_chunk
from progdf.rasterize import render
from progdf.region import whole_scene
from progdf.scene.orbit_rig import orbit_rig
from tests.helpers.scenes import ball
from trainer.editors import check_new_editor, make_editor
from trainer.editors.pictures import background_of, picture_paths
from trainer.options import EditorOptions
from trainer.store.run_folder import quantize_image
from trainer.views.picture_cameras import picture_cameras
from trainer.views.view import View, make_view, render_view

WHITE = torch.ones(3)


def looking(scene: Gaussians, count: int = 2) -> list[Camera]:
    return orbit_rig(scene, count, 64, 48, up=torch.tensor([0.0, -1.0, 0.0]))


def save(path: Path, image: Tensor, camera: Camera | None) -> Path:
    path.parent.mkdir(exist_ok=True)
    to_picture(image).save(path, pnginfo=camera_chunk(camera) if camera else None)
    return path


def views_of(scene: Gaussians, *paths: Path) -> list[View]:
    return [make_view(scene, whole_scene(scene), camera, WHITE) for camera in picture_cameras(paths, ())]


def test_picture_is_the_edit_of_its_view(tmp_path: Path) -> None:
    scene = ball()
    camera = looking(scene)[0]
    shown = render_view(scene, camera, WHITE).clamp(0, 1)  # clamped like a view
    path = save(tmp_path / "A.png", 1 - 0.5 * shown, camera)
    (view,) = views_of(scene, path)
    editor = make_editor(EditorOptions(f"pictures:{path}"), scene, whole_scene(scene), [view])
    assert editor.stages == ()  # the trainer interpolates intermediate strengths
    assert editor.kind == "color"
    assert torch.equal(editor.edit(view, 0.0), view.image)
    inside = view.mask > 0.99
    expected = 1 - 0.5 * view.image
    assert float((editor.edit(view, 1.0) - expected)[inside].abs().max()) < 0.01
    images = [editor.edit(view, k / 8) for k in range(9)]
    steps = [float((b - a)[inside].abs().mean()) for a, b in pairwise(images)]
    assert min(steps) > 0.6 * max(steps)  # 0.8 when written: straight in OKLab, not one jump


@pytest.mark.parametrize("color", [[0.0, 0.0, 0.0], [0.1, 0.3, 0.8]])
def test_background_of_another_color_is_found(color: list[float]) -> None:
    scene = ball()
    background = torch.tensor(color)
    drawn = render(scene, looking(scene)[0])
    picture = quantize_image(drawn.image + drawn.transmittance[..., None] * (background - 1))
    picture[:12] = torch.tensor([0.9, 0.1, 0.2])  # a quarter is painted over
    found = background_of(picture, drawn.image, drawn.transmittance[..., None], quantize_image)
    assert float((found - background).abs().max()) <= 0.51 / 255


def test_picture_without_background_has_the_background_of_the_run() -> None:
    picture = torch.rand(8, 8, 3, generator=torch.Generator().manual_seed(0))
    assert torch.equal(background_of(picture, picture.flip(0), torch.zeros(8, 8, 1), quantize_image), WHITE)


def test_subfolders_hold_intermediate_strengths(tmp_path: Path) -> None:
    scene = ball()
    cameras = looking(scene)
    paths = []
    for name, camera in zip("AB", cameras, strict=True):
        image = render_view(scene, camera, WHITE)
        paths.append(save(tmp_path / f"{name}.png", 0.5 * image, camera))
        save(tmp_path / "0.5" / f"{name}.png", 0.75 * image, None)
    (tmp_path / "2024").mkdir()  # an unrelated folder
    spec = f"pictures:{paths[0]},{paths[1]}"
    views = views_of(scene, *paths)
    editor = make_editor(EditorOptions(spec), scene, whole_scene(scene), views)
    assert editor.stages == tuple(k / 8 for k in range(1, 9))  # at least eight, including the given ones
    half = editor.edit(views[1], 0.5)
    assert float((half - 0.75 * views[1].image)[views[1].mask > 0.99].abs().max()) < 0.02
    (tmp_path / "0.5" / "B.png").unlink()
    with pytest.raises(ProgdfError, match=r"0\.5/B\.png is missing; every picture needs a file"):
        make_editor(EditorOptions(spec), scene, whole_scene(scene), views)
    (tmp_path / "0.5" / "A.png").rename(tmp_path / "2024" / "A.png")
    with pytest.raises(ProgdfError, match="not between 0 and 1; name it"):
        make_editor(EditorOptions(spec), scene, whole_scene(scene), views)


def test_picture_of_another_size_scales_its_camera(tmp_path: Path) -> None:
    scene = ball()
    camera = looking(scene)[0]
    path = save(tmp_path / "A.png", render_view(scene, camera.resize(128, 96), WHITE), camera)
    (found,) = picture_cameras([path], ())
    assert (found.width, found.height) == (128, 96)
    assert torch.allclose(found.K, camera.resize(128, 96).K)


def test_cropped_picture_is_refused(tmp_path: Path) -> None:
    camera = looking(ball())[0]
    path = save(tmp_path / "A.png", torch.ones(48, 48, 3), camera)
    with pytest.raises(ProgdfError, match="48x48 pixels, it was rendered with 64x48; keep the proportions"):
        picture_cameras([path], ())


def test_invalid_picture_list_is_a_one_line_error(tmp_path: Path) -> None:
    Image.new("RGB", (4, 4)).save(tmp_path / "A.png")
    (tmp_path / "B").mkdir()
    Image.new("RGB", (4, 4)).save(tmp_path / "B" / "A.jpg")
    for what, message in (
        ("", "name of a picture is missing; list"),
        (f"{tmp_path}/A.png,", "name of a picture is missing; list"),
        (f"{tmp_path}/C.png", "does not exist; list"),
        (f"{tmp_path}", "is a folder; list"),
        (f"{tmp_path}/A.png,{tmp_path}/B/A.jpg", "two pictures are named A; name"),
    ):
        with pytest.raises(ProgdfError, match=message):
            check_new_editor(EditorOptions(f"pictures:{what}"))
    with pytest.raises(ProgdfError) as refused:
        check_new_editor(EditorOptions(f"paint:{tmp_path}/C.png"))
    assert "pictures:" not in str(refused.value), "another editor was asked for"
    many = [tmp_path / f"{i}.png" for i in range(33)]
    for path in many:
        path.touch()
    with pytest.raises(ProgdfError, match="at most 32 pictures can be listed, not 33; give"):
        picture_paths(",".join(str(path) for path in many))


def test_comma_in_a_file_name_is_no_separator(tmp_path: Path) -> None:
    Image.new("RGB", (4, 4)).save(tmp_path / "a,b.png")
    assert picture_paths(f"{tmp_path}/a,b.png") == (tmp_path / "a,b.png",)


def test_shift_by_two_pixels_is_undone_before_training(tmp_path: Path) -> None:
    scene = ball()
    camera = looking(scene)[0]
    image = render_view(scene, camera, WHITE).clamp(0, 1)
    painted = image.clone()
    painted[20:26, 28:34] = torch.tensor([0.1, 0.2, 0.9])
    path = save(tmp_path / "A.png", painted.roll((-2, 1), (0, 1)), camera)
    (view,) = views_of(scene, path)
    edited = make_editor(EditorOptions(f"pictures:{path}"), scene, whole_scene(scene), [view]).edit(view, 1.0)
    assert float((edited - painted)[4:-4, 4:-4].abs().max()) < 0.01
