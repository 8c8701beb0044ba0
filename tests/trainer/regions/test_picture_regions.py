"""Regions from pictures: folders of masks, and text prompts through GroundingDINO and SAM."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import ExifTags, Image
from torch import Tensor

from progdf.camera import Camera, Lens
from progdf.errors import ProgdfError
from progdf.gaussians import Gaussians
from progdf.io.cameras import load_cameras, save_cameras
from progdf.io.images import write_image
from progdf.io.picture_files import PictureFolder
from progdf.region import Region
from progdf.scene.orbit_rig import orbit_rig
from progdf.scene.regions import parse_region
from tests.helpers.demo_scenes import bear
from tests.helpers.tiny_segmenters import tiny_detector, tiny_sam
from tests.helpers.trained import label_mask, quick_options, train, write_bear
from trainer.editors.pictures import FolderEditor
from trainer.options import RegionOptions, TrainingViewOptions, with_values
from trainer.regions.from_pictures import RegionRequest, read_masks, region_kinds
from trainer.regions.segment import SEGMENTERS, normalize_prompt
from trainer.views.view import View

SIZE = 96
VIEWS = 6
DEMO = bear(1500)
SCENE = DEMO.gaussians
SCARF = DEMO.labels == DEMO.label_names.index("scarf")


def six_cameras() -> list[Camera]:
    return orbit_rig(SCENE, VIEWS, SIZE, SIZE)


@pytest.fixture
def masks(tmp_path: Path) -> Path:
    """Write masks of the scarf and their cameras to a folder; return the folder."""
    folder = tmp_path / "masks"
    for camera in six_cameras():
        mask = label_mask(SCENE, SCARF, camera).float()
        write_image(folder / f"{camera.name}.png", mask[..., None].expand(-1, -1, 3))
    save_cameras(folder / "cameras.json", six_cameras())
    return folder


def settings(
    tmp_path: Path,
    cameras: Path | None = None,
    options: RegionOptions | None = None,
    say: Callable[[str], None] | None = None,
) -> RegionRequest:
    views = TrainingViewOptions(cameras, views=VIEWS)
    return RegionRequest(options or RegionOptions(""), views, lambda: tmp_path / "segmented", True, say)


def region_of(spec: str, told: RegionRequest, scene: Gaussians = SCENE) -> Region:
    return parse_region(spec, scene, kinds=region_kinds(told))


def refusal(spec: str, told: RegionRequest) -> str:
    with pytest.raises(ProgdfError, match="; ") as caught:
        region_of(spec, told)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def overlap(region: Region, expected: Tensor) -> float:
    found = torch.zeros_like(expected).index_fill(0, region.members, True)
    return float((found & expected).sum() / (found | expected).sum())


# -------------------------------------------------------------------------------------- folders of masks


def test_folder_of_masks_with_cameras_is_a_region(masks: Path, tmp_path: Path) -> None:
    region = region_of(f"masks:{masks}", settings(tmp_path))
    assert overlap(region, SCARF) > 0.6  # 1500 Gaussians at 96 pixels; see test_lift for real sizes


def test_masks_without_cameras_use_the_given_cameras(masks: Path, tmp_path: Path) -> None:
    own = region_of(f"masks:{masks}", settings(tmp_path))
    given = (masks / "cameras.json").rename(tmp_path / "given.json")
    assert "give --cameras" in refusal(f"masks:{masks}", settings(tmp_path))
    found = region_of(f"masks:{masks}", settings(tmp_path, given))
    assert torch.equal(found.members, own.members)


def test_masks_combine_with_other_kinds_of_region(masks: Path, tmp_path: Path) -> None:
    alone = set(region_of(f"masks:{masks}", settings(tmp_path)).members.tolist())
    np.save(tmp_path / "l.npy", DEMO.labels.numpy())
    head = DEMO.label_names.index("head")
    labeled = set((DEMO.labels == head).nonzero()[:, 0].tolist())
    both = region_of(f"masks:{masks} + labels:{tmp_path}/l.npy:{head}", settings(tmp_path))
    assert set(both.members.tolist()) == alone | labeled
    rest = region_of(f"all - masks:{masks}", settings(tmp_path))
    assert set(rest.members.tolist()) == set(range(len(SCENE))) - alone


def test_masks_are_scaled_and_transparent_pixels_are_outside(masks: Path, tmp_path: Path) -> None:
    original = read_masks(masks, six_cameras())
    for path in masks.glob("*.png"):
        with Image.open(path) as picture:
            alpha = picture.convert("L").resize((4 * SIZE, 4 * SIZE), Image.Resampling.NEAREST)
        cutout = Image.new("RGBA", alpha.size, "white")
        cutout.putalpha(alpha)
        cutout.save(path)
    assert all(torch.equal(a, b) for a, b in zip(original, read_masks(masks, six_cameras()), strict=True))


def test_masks_of_photographs_are_undistorted(tmp_path: Path) -> None:
    camera = replace(six_cameras()[0], lens=Lens(k1=-0.2))
    ramp = torch.linspace(0, 1, SIZE).expand(SIZE, SIZE)
    write_image(tmp_path / f"{camera.name}.png", ramp[..., None].expand(-1, -1, 3))
    straight = read_masks(tmp_path, [camera])[0]
    unbent = read_masks(tmp_path, [camera], bent=True)[0]
    assert torch.allclose(straight, ramp, atol=1 / 255)
    # undistorting a barrel distortion crops the ramp at the edges
    assert float(unbent[SIZE // 2, -1]) < float(straight[SIZE // 2, -1]) - 0.02
    assert float(unbent[SIZE // 2, SIZE // 2]) == pytest.approx(0.5, abs=0.02)


def test_exif_rotation_is_applied_but_refused_for_known_cameras(
    tmp_path: Path,
) -> None:
    camera = six_cameras()[0]
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = 3
    ramp = np.linspace(255, 0, SIZE).astype(np.uint8)[None].repeat(SIZE, axis=0)
    Image.fromarray(ramp).save(tmp_path / f"{camera.name}.png", exif=exif)
    mask = read_masks(tmp_path, [camera])[0]
    assert mask is not None
    assert mask[0, 0] < 0.1 < 0.9 < mask[-1, -1]
    with pytest.raises(ProgdfError, match=r"stored rotated \(EXIF orientation 3\)"):
        read_masks(tmp_path, [camera], bent=True)
    black = torch.zeros(SIZE, SIZE, 3)
    view = View(camera, black, mask, black, (0, 0, SIZE, SIZE))
    turned = FolderEditor({1.0: PictureFolder(tmp_path)}, (1.0,)).edit(view, 1.0)
    assert torch.equal(turned[..., 0], mask)
    with pytest.raises(ProgdfError, match=r"stored rotated \(EXIF orientation 3\)"):
        FolderEditor({1.0: PictureFolder(tmp_path)}, (1.0,), bent=True).edit(view, 1.0)


def test_unsuitable_masks_are_a_one_line_error(masks: Path, tmp_path: Path) -> None:
    told = settings(tmp_path)
    given = settings(tmp_path, masks / "cameras.json")
    name = six_cameras()[2].name
    assert "needs a folder" in refusal("masks:", told)
    assert "is not a folder" in refusal(f"masks:{tmp_path}/nowhere", given)
    (masks / f"{name}.png").rename(masks / "other.png")
    Image.new("L", (SIZE, SIZE // 2)).save(masks / f"{name}.png")
    assert "96x48 pixels, its view 96x96" in refusal(f"masks:{masks}", told)
    (masks / f"{name}.png").write_bytes(b"no picture")
    assert "cannot be read as a picture" in refusal(f"masks:{masks}", told)


def test_cameras_without_masks_are_skipped_and_no_mask_is_an_error(masks: Path, tmp_path: Path) -> None:
    whole = set(region_of(f"masks:{masks}", settings(tmp_path)).members.tolist())
    names = [camera.name for camera in load_cameras(masks / "cameras.json")]
    (masks / f"{names[0]}.png").unlink()
    messages: list[str] = []
    fewer = set(region_of(f"masks:{masks}", settings(tmp_path, say=messages.append)).members.tolist())
    assert len(whole & fewer) > 0.8 * len(whole | fewer)
    assert "5 of 6 cameras have a mask; the others are ignored" in messages
    for name in names[1:]:
        (masks / f"{name}.png").unlink()
    assert f"no mask for any of the 6 cameras; name each as its view, as {names[0]}.png" in refusal(
        f"masks:{masks}", settings(tmp_path)
    )


def test_masks_that_select_nothing_report_the_highest_score(masks: Path, tmp_path: Path) -> None:
    for path in masks.glob("*.png"):
        Image.new("L", (SIZE, SIZE)).save(path)
    assert "none of the 6 masks" in refusal(f"masks:{masks}", settings(tmp_path))
    for path in masks.glob("*.png"):
        Image.fromarray(np.pad(np.full((1, 1), 255, np.uint8), (0, SIZE - 1))).save(path)
    assert "highest score is 0" in refusal(f"masks:{masks}", settings(tmp_path))


# ------------------------------------------------------------------------------------------- text prompts


Asked = list[str]


@pytest.fixture
def reddish(monkeypatch: pytest.MonkeyPatch) -> Asked:
    """Replace the networks by a segmenter of red pixels; return the list of its prompts."""
    asked: Asked = []

    def segment(image: Tensor, prompt: str) -> Tensor:
        asked.append(prompt)
        if "unicorn" in prompt:
            return torch.zeros(image.shape[:2], dtype=torch.bool)
        red, green, blue = image.unbind(2)
        return (red > green + 0.15) & (red > blue + 0.15)

    kinds: dict[str, Callable[[RegionOptions], object]] = {"text": lambda _: segment}
    monkeypatch.setattr("trainer.regions.segment.SEGMENTERS", kinds)
    monkeypatch.setattr("trainer.regions.from_pictures.SEGMENTERS", kinds)
    monkeypatch.setattr("trainer.regions.from_pictures.SEGMENTER_CHECKS", {"text": lambda settings: None})
    return asked


def test_prompt_is_segmented_once_and_cached(reddish: Asked, tmp_path: Path) -> None:
    told = settings(tmp_path)
    first = region_of('text:"the Red scarf"', told)
    assert reddish == ["the Red scarf"] * (2 * VIEWS)  # around the scene, then close to the found region
    again = region_of('text:"the Red scarf"', told)
    assert len(reddish) == 2 * VIEWS
    assert torch.equal(first.members, again.members)
    assert torch.equal(first.score, again.score)
    region_of('text:"the Red scarf"', replace(told, options=RegionOptions("", box_threshold=0.5)))
    assert len(reddish) == 4 * VIEWS


def test_masks_of_a_prompt_can_be_used_as_a_mask_folder(reddish: Asked, tmp_path: Path) -> None:
    found = region_of('text:"scarf"', settings(tmp_path))
    kept = region_of(f"masks:{tmp_path}/segmented/scarf", settings(tmp_path))
    assert torch.equal(found.members, kept.members)


def test_prompts_combine_with_other_kinds_of_region(reddish: Asked, tmp_path: Path) -> None:
    scarf = set(region_of("text:scarf", settings(tmp_path)).members.tolist())
    rest = region_of('all - text:"scarf"', settings(tmp_path))
    assert set(rest.members.tolist()) == set(range(len(SCENE))) - scarf


def test_given_cameras_are_thinned_out_evenly(reddish: Asked, tmp_path: Path) -> None:
    save_cameras(tmp_path / "many.json", orbit_rig(SCENE, 20, SIZE, SIZE))
    region_of(
        "text:scarf", replace(settings(tmp_path), views=TrainingViewOptions(tmp_path / "many.json", views=4))
    )
    kept = sorted(path.stem for path in (tmp_path / "segmented" / "scarf").glob("*.png"))
    assert kept == ["orbit_002", "orbit_007", "orbit_012", "orbit_017"]


def test_prompt_without_a_match_is_a_one_line_error(reddish: Asked, tmp_path: Path) -> None:
    assert "found in none of 6 views" in refusal('text:"a unicorn"', settings(tmp_path))
    assert "needs a prompt" in refusal('text:""', settings(tmp_path))


def test_prompt_does_not_touch_a_folder_that_is_no_run(reddish: Asked, tmp_path: Path) -> None:
    write_bear(tmp_path)
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "thesis.txt").write_text("important")
    with pytest.raises(ProgdfError, match="neither empty nor a run of progdf train"):
        train(with_values(quick_options(tmp_path), region="text:scarf"), quiet=True)
    assert [path.name for path in (tmp_path / "run").iterdir()] == ["thesis.txt"]
    assert reddish == []


def test_another_prompt_can_follow_a_prompt_without_a_match(reddish: Asked, tmp_path: Path) -> None:
    write_bear(tmp_path)
    options = quick_options(tmp_path, steps=8, stages=1, views=5)
    with pytest.raises(ProgdfError, match="found in none"):
        train(with_values(options, region="text:unicorn"), quiet=True)
    done = train(with_values(options, region="text:scarf"), quiet=True)
    assert done.gdf.is_file()
    assert len(list((done.folder.segment_masks / "scarf").glob("*.png"))) == 10


def test_prompts_are_normalized_for_the_detector() -> None:
    assert normalize_prompt("  The man's  Shirt ") == "the man's shirt."
    assert normalize_prompt("a cat. a dog.") == "a cat. a dog."


# --------------------------------------------------------------------------------------- the real networks


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> RegionOptions:
    """Save a tiny detector and a tiny SAM of the real classes; return options that name them."""
    pytest.importorskip("transformers")
    folder = tmp_path_factory.mktemp("models")
    return RegionOptions(
        "",
        detector=str(tiny_detector(folder / "dino")),
        sam_model=str(tiny_sam(folder / "sam")),
        box_threshold=0.01,
    )


def test_networks_return_a_mask_of_the_picture_size(tiny: RegionOptions) -> None:
    segment = SEGMENTERS["text"](tiny)
    image = torch.rand(60, 90, 3, generator=torch.Generator().manual_seed(0))
    mask = segment(image, "The scarf")
    assert (mask.shape, mask.dtype) == ((60, 90), torch.bool)
    assert 0 < int(mask.sum()) < mask.numel()
    assert torch.equal(mask, segment(image, "the scarf."))
    nothing = SEGMENTERS["text"](replace(tiny, box_threshold=0.999))(image, "the scarf")
    assert not bool(nothing.any())


def test_boxes_are_in_pixels_of_the_picture(tiny: RegionOptions) -> None:
    from trainer.regions.segment import grounded_sam

    picture = Image.new("RGB", (300, 100), "white")
    boxes = grounded_sam(tiny).boxes(picture, "scarf")
    assert boxes.shape[1] == 4
    assert bool((boxes[:, 0::2] <= 300).all())
    assert bool((boxes[:, 1::2] <= 100).all())
    assert float(boxes[:, 2].max()) > 100  # scaled by the width, not by the height


@pytest.mark.slow
def test_run_trains_a_region_from_a_prompt(tiny: RegionOptions, tmp_path: Path) -> None:
    write_bear(tmp_path, 800)
    options = with_values(
        quick_options(tmp_path, steps=8, stages=1, views=3),
        region='text:"the scarf" - sphere:9,9,9,0.1',
        detector=tiny.detector,
        sam_model=tiny.sam_model,
        box_threshold=tiny.box_threshold,
        lift_threshold=0.05,
    )
    done = train(options, quiet=True)
    assert done.gdf.is_file()
    assert len(list((done.folder.segment_masks / "the-scarf").glob("*.png"))) == 6


def test_missing_weights_error_names_the_remedy(
    tiny: RegionOptions, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HF_HUB_CACHE", str(tmp_path / "empty"))
    absent = settings(tmp_path, options=replace(tiny, detector="someone/no-such-detector"))
    assert "hf download someone/no-such-detector" in refusal("text:scarf", absent)
    absent = settings(tmp_path, options=replace(tiny, sam_model=str(tmp_path / "nowhere")))
    assert "give --sam-model" in refusal("text:scarf", absent)
    (tmp_path / "broken").mkdir()
    for file in Path(tiny.sam_model).iterdir():
        (tmp_path / "broken" / file.name).write_bytes(file.read_bytes())
    (tmp_path / "broken" / "model.safetensors").write_bytes(b"half")
    broken = settings(tmp_path, options=replace(tiny, sam_model=str(tmp_path / "broken")))
    assert "not hold a complete model with safetensors weights" in refusal("text:scarf", broken)


def test_model_of_another_kind_is_a_one_line_error(tiny: RegionOptions, tmp_path: Path) -> None:
    swapped = RegionOptions("", detector=tiny.sam_model, sam_model=tiny.detector)
    assert "is a sam model, not grounding-dino; give --detector" in refusal(
        "text:scarf", settings(tmp_path, options=swapped)
    )


def test_missing_package_is_reported_with_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "transformers", None)
    assert "pip install 'progdf-studio[segment]'" in refusal("text:scarf", settings(tmp_path))
