"""`--region changed`: the members visible where pictures differ from the scene."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor

from progdf.camera import Camera, intrinsics, look_at
from progdf.errors import ProgdfError
from progdf.gaussians import Gaussians
from progdf.io.images import saving_loss, to_picture
from progdf.io.picture_camera import camera_chunk
from progdf.scene.orbit_rig import orbit_rig
from progdf.scene.regions import check_region, parse_region
from progdf.sh import rgb_to_sh0
from tests.helpers.demo_scenes import bear
from tests.helpers.scenes import random_gaussians
from tests.helpers.trained import edit_few, small
from trainer.editors import make_editor
from trainer.editors.pictures import read_change
from trainer.options import EditorOptions, RegionOptions, TrainingViewOptions
from trainer.regions.changed import find_change
from trainer.regions.from_pictures import RegionRequest, region_checks, region_kinds
from trainer.views.crops import crop_scene
from trainer.views.view import crop, make_view, render_view


def settings(pictures: list[Path], folder: Path) -> RegionRequest:
    return RegionRequest(
        RegionOptions("changed"), TrainingViewOptions(pictures=tuple(pictures)), lambda: folder
    )


@pytest.fixture(scope="module")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Write four views of the bear with a blue body as .png with their cameras; return the paths."""
    folder = tmp_path_factory.mktemp("pictures")
    case = small("body", count=6, image_size=160)
    editor = make_editor(EditorOptions("recolor:#3060d0"), case.scene, case.region, case.views)
    paths = []
    for i, view in enumerate(case.views[:4]):
        paths.append(folder / f"p{i}.png")
        to_picture(editor.edit(view, 1.0)).save(paths[-1], pnginfo=camera_chunk(view.camera))
    return paths


def test_filled_region_is_found_again(pictures: list[Path], tmp_path: Path) -> None:
    case = small("body", count=6, image_size=160)
    found = parse_region("changed", case.scene, kinds=region_kinds(settings(pictures, tmp_path)))
    truth = set(case.region.members.tolist())
    members = set(found.members.tolist())
    assert len(truth & members) > 0.4 * len(
        truth | members
    )  # 0.47 with few, large Gaussians; 0.94 to 0.99 on the robot
    named = "changed:" + ",".join(str(path) for path in pictures)
    again = parse_region(named, case.scene, kinds=region_kinds(settings([], tmp_path)))
    assert torch.equal(again.members, found.members)
    without = parse_region("all-changed", case.scene, kinds=region_kinds(settings(pictures, tmp_path)))
    assert len(without) == len(case.scene) - len(found)


def test_unchanged_pictures_are_a_one_line_error(tmp_path: Path) -> None:
    case = small("body", count=6, image_size=160)
    to_picture(case.views[0].image).save(tmp_path / "A.png", pnginfo=camera_chunk(case.views[0].camera))
    with pytest.raises(ProgdfError, match="do not differ from the scene; change them"):
        parse_region("changed", case.scene, kinds=region_kinds(settings([tmp_path / "A.png"], tmp_path)))


def test_changed_without_pictures_is_refused_before_the_scene_is_read(tmp_path: Path) -> None:
    with pytest.raises(ProgdfError, match="changed needs pictures: use it with --editor pictures"):
        check_region("changed", region_checks(settings([], tmp_path)))
    with pytest.raises(ProgdfError, match="unknown region 'changed'"):
        check_region("changed")


def test_picture_with_edits_is_refused_before_the_scene_is_read(tmp_path: Path) -> None:
    case = small("body", count=6, image_size=160)
    carried = camera_chunk(case.views[0].camera, ["jacket", "gold"])
    to_picture(case.views[0].image).save(tmp_path / "A.png", pnginfo=carried)
    with pytest.raises(ProgdfError, match=r"A.png shows edits \(jacket, gold\) without naming their files"):
        check_region("changed", region_checks(settings([tmp_path / "A.png"], tmp_path)))


def scene_picture() -> Tensor:
    """Return soft blobs on white, like a render."""
    rows, columns = np.mgrid[:120, :160]
    image = np.ones((120, 160, 3), np.float32)
    for y, x, color in ((40, 50, (0.8, 0.3, 0.1)), (70, 110, (0.2, 0.5, 0.3)), (90, 40, (0.3, 0.3, 0.7))):
        near = np.exp(-(((rows - y) / 14) ** 4 + ((columns - x) / 18) ** 4))[..., None]
        image = image * (1 - near) + near * np.array(color, np.float32)
    return torch.from_numpy(image.astype(np.float32))


def painted(image: Tensor) -> Tensor:
    changed = image.clone()
    changed[35:50, 40:60] = torch.tensor([0.1, 0.8, 0.9])
    return changed


def jpeg(image: Tensor) -> Tensor:
    file = io.BytesIO()
    to_picture(image).save(file, "JPEG", quality=75)
    return torch.from_numpy(np.asarray(Image.open(file), np.float32) / 255)


@pytest.mark.parametrize("how", ["as it is", "jpeg", "moved by two pixels", "moved and jpeg"])
def test_noise_and_a_shift_are_no_change(how: str) -> None:
    def saved(image: Tensor) -> Tensor:
        image = image.roll((2, -1), (0, 1)) if "moved" in how else image
        return jpeg(image) if "jpeg" in how else image

    original = scene_picture()
    assert not bool(find_change(original, saved(original)).any())
    found = find_change(original, saved(painted(original)))
    truth = torch.zeros_like(found)
    truth[35:50, 40:60] = True
    assert float((found & truth).sum() / (found | truth).sum()) > 0.45  # borders of one or two pixels differ
    assert bool(found[36:49, 41:59].all())


SIZES = ((256, 256), (511, 383), (980, 800), (1619, 1080), (2040, 1530))


def fine_scene(kind: str) -> Gaussians:
    """Return a scene with detail at every size: a bear, dots below a pixel, or soft blobs."""
    if kind == "bear":
        return bear(4000).gaussians
    return random_gaussians(6000, seed=3, sh_degree=2, spread=0.4, scale=0.004 if kind == "dots" else 0.04)


@pytest.mark.parametrize("background", [(255, 255, 255), (32, 64, 96)])
@pytest.mark.parametrize("kind", ["bear", "dots", "blobs"])
@pytest.mark.parametrize(
    "size",
    [size if size in SIZES[1:2] else pytest.param(size, marks=pytest.mark.slow) for size in SIZES],
)
def test_untouched_picture_has_no_change(
    tmp_path: Path, kind: str, size: tuple[int, int], background: tuple[int, int, int]
) -> None:
    scene = fine_scene(kind)
    camera = orbit_rig(scene, 5, *size, up=torch.tensor([0.0, 1.0, 0.0]))[1]
    rendered = to_picture(render_view(scene, camera, torch.tensor(background) / 255))
    for name, how in (("A.png", {}), ("A.jpg", {"quality": 90})):
        rendered.save(tmp_path / name, **how)
        original, picture = read_change(scene, tmp_path / name, camera)
        assert not bool(find_change(original, picture, saving_loss(tmp_path / name)).any()), name


def test_faint_tint_of_a_png_is_found(tmp_path: Path) -> None:
    scene = fine_scene("bear")
    camera = orbit_rig(scene, 5, 700, 600, up=torch.tensor([0.0, 1.0, 0.0]))[1]
    rendered = np.asarray(to_picture(render_view(scene, camera, torch.ones(3)))).copy()
    truth = np.zeros(rendered.shape[:2], bool)
    truth[150:350, 250:450] = True
    truth &= (rendered > 4).all(axis=2)
    rendered[truth] -= 4
    Image.fromarray(rendered).save(tmp_path / "A.png")
    found = find_change(
        *read_change(scene, tmp_path / "A.png", camera), saving_loss(tmp_path / "A.png")
    ).numpy()
    assert (found & truth).sum() > 0.95 * (found | truth).sum()


def two_sheets(gap: float, side: int = 26) -> Gaussians:
    """Return a square sheet of thin splats of one color at z = 0, and a second one `gap` behind it."""
    rng = np.random.default_rng(0)
    line = np.linspace(-0.75, 0.75, side)
    plan = np.stack(np.meshgrid(line, line), axis=2).reshape(-1, 2) + rng.normal(0, 0.004, (side**2, 2))
    means = np.concatenate([np.insert(plan, 2, z, axis=1) for z in (0.0, gap)])
    colors = np.array([0.6, 0.5, 0.4]) + rng.normal(0, 0.02, means.shape)
    count = len(means)
    return Gaussians(
        torch.from_numpy(means).float(),
        torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),
        torch.tensor([0.06, 0.06, 0.001]).log().repeat(count, 1),
        torch.full((count,), 6.0),
        rgb_to_sh0(torch.from_numpy(colors).float()),
        torch.zeros(count, 0, 3),
    )


def seen_from(z: float, size: int = 160) -> Camera:
    # straight on, because sorting by center depth mixes close sheets in an oblique view
    viewmat = look_at(torch.tensor([0.0, 0.0, z]), torch.zeros(3), torch.tensor([0.0, -1.0, 0.0]))
    return Camera(viewmat, intrinsics(0.6, size, size), size, size)


@pytest.mark.slow
@pytest.mark.parametrize("region", ["changed", "all"])
@pytest.mark.parametrize("gap", [0.01, 0.05, 0.2])
def test_paint_on_a_thin_sheet_is_invisible_from_behind(tmp_path: Path, gap: float, region: str) -> None:
    scene, camera = two_sheets(gap), seen_from(-3.0)
    painted = render_view(scene, camera, torch.ones(3)).clamp(0, 1)
    rows, columns = np.mgrid[:160, :160]
    patch = (abs(rows - 80) < 30) & (abs(columns - 80) < 30)
    painted[torch.from_numpy(patch & ((rows // 20 + columns // 20) % 2 == 0))] *= torch.tensor(
        [0.2, 0.4, 1.0]
    )
    path = tmp_path / "A.png"
    to_picture(painted).save(path, pnginfo=camera_chunk(camera))
    found = parse_region(region, scene, kinds=region_kinds(settings([path], tmp_path)))
    members = found.members
    view = make_view(scene, found, camera, torch.ones(3))
    crops = [crop_scene(scene, members, camera, view.box, torch.ones(3), still=True)]
    offsets = edit_few(scene, members, crops, [crop(painted, view.box)])
    edited = replace(scene, sh0=scene.sh0.index_add(0, members, offsets[:, 0]))

    def change(z: float) -> float:
        before, after = (render_view(some, seen_from(z), torch.ones(3)) for some in (scene, edited))
        return float((after - before).abs()[40:120, 40:120].max())  # the borders are soft

    assert change(-3.0) > 0.2
    assert change(3.0) < 1 / 255
