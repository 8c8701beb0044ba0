"""Removal runs: `progdf train --editor remove`, and changed pictures that show the background."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy import ndimage
from torch import Tensor

from progdf.compose.reference import Layer, compose_layers
from progdf.errors import ProgdfError
from progdf.formats.ply import load_ply, save_ply
from progdf.gaussians import Gaussians, concatenate
from progdf.gdf.file import load_gdf
from progdf.io.images import to_picture
from progdf.io.picture_camera import camera_chunk
from progdf.metrics.image import decibels
from progdf.quaternions import matrix_quats
from progdf.rasterize import render
from progdf.region import Region, from_mask
from progdf.scene.strays import with_strays
from progdf.sh import rgb_to_sh0
from trainer.evaluate.command import evaluate
from trainer.fill.holes import Hole, fill_holes, find_hole, find_holes, place_discs, split_squares
from trainer.fill.membrane import membrane
from trainer.options import (
    EditorOptions,
    EvaluateOptions,
    RegionOptions,
    TrainingViewOptions,
    TrainOptions,
    with_values,
)
from trainer.run.resume import picture_digests
from trainer.run.run import train
from trainer.store.progress import RunLog
from trainer.views.setup import TrainingSetup, make_training_setup
from trainer.views.view import View, on_backgrounds, render_view

WHITE = torch.ones(3)
TABLE = "box:-9,-0.005,-9,9,9,9"
POST = f"all-{TABLE}"


def splats(means: Tensor, normals: Tensor, size: float, rgb: Tensor) -> Gaussians:
    """Return opaque discs on a surface."""
    axis = torch.nn.functional.normalize(
        torch.linalg.cross(normals, torch.eye(3)[normals.abs().argmin(1)]), dim=1
    )
    frames = torch.stack([axis, torch.linalg.cross(normals, axis), normals], dim=2)
    scales = torch.log(torch.tensor([size, size, size / 10])).repeat(len(means), 1)
    return Gaussians(
        means, matrix_quats(frames), scales, torch.full((len(means),), 4.0), rgb_to_sh0(rgb),
        torch.zeros(len(means), 0, 3),
    )  # fmt: skip


@cache
def table(hole: float) -> Gaussians:
    """Return a plane with a color gradient and a round hole of this radius in its center."""
    line = torch.linspace(-1.2, 1.2, 60)
    x, z = torch.meshgrid(line, line, indexing="ij")
    means = torch.stack([x.flatten(), torch.zeros(x.numel()), z.flatten()], dim=1)
    rgb = torch.stack(
        [0.5 + 0.2 * means[:, 0], 0.4 + 0.1 * means[:, 2], torch.full((len(means),), 0.3)], dim=1
    )
    up = torch.tensor([0.0, -1.0, 0.0]).repeat(len(means), 1)
    return splats(means, up, 0.03, rgb)[means.norm(dim=1) > hole]


@cache
def post() -> Gaussians:
    """Return a cylinder on the table, slightly wider than the hole."""
    at = torch.arange(2500)
    angle = at * math.pi * (3 - math.sqrt(5))
    height = -0.01 - 0.8 * at / len(at)
    out = torch.stack([angle.cos(), torch.zeros(len(at)), angle.sin()], dim=1)
    red, yellow = (torch.tensor([[0.9, g, 0.1]]).repeat(len(at), 1) for g in (0.2, 0.5))
    side = splats(torch.stack([0.34 * out[:, 0], height, 0.34 * out[:, 2]], dim=1), out, 0.03, red)
    near = out * (0.34 * ((at + 0.5) / len(at)).sqrt())[:, None] - torch.tensor([0.0, 0.81, 0.0])
    up = torch.tensor([0.0, -1.0, 0.0]).repeat(len(at), 1)
    return concatenate([side, splats(near, up, 0.03, yellow)])


@cache
def case(hole: float = 0.27) -> tuple[Gaussians, Gaussians, TrainingSetup]:
    """Return the post on the table, the table alone, and a setup with views that also show its surroundings,
    as in the runs of removals."""
    scene = concatenate([table(hole), post()])
    region = from_mask("post", torch.arange(len(scene)) >= len(table(hole)))
    return (
        scene,
        table(hole),
        make_training_setup(TrainingViewOptions(views=12, image_size=96, fills=False), scene, region),
    )


def test_membrane_continues_a_plane_and_is_flat_at_the_edge() -> None:
    y, x = torch.meshgrid(torch.arange(20.0), torch.arange(30.0), indexing="ij")
    plane = torch.stack([0.3 * x - 0.1 * y, torch.ones_like(x)], dim=2)
    hole = (x - 14).square() + (y - 9).square() < 36
    assert torch.allclose(membrane(torch.where(hole[..., None], 0.0, plane), hole), plane, atol=1e-4)
    edge = x > 25
    assert torch.allclose(
        membrane(torch.where(edge[..., None], 0.0, plane), edge)[..., 1], plane[..., 1], atol=1e-4
    )


def test_unseen_hole_is_closed_like_the_surface_around_it() -> None:
    scene, rest, setup = case()
    fill = fill_holes(find_holes(scene, rest, setup.train))
    assert fill.rows is not None
    assert fill.after < 0.05 * fill.before
    done = concatenate([rest, fill.rows])
    whole = table(-1.0)
    for view in setup.held_out:
        hole = find_hole(rest, view, []).mask
        pictures = [render_view(some, view.camera, WHITE).clamp(0, 1) for some in (rest, done, whole)]
        before, after = (decibels(float((one - pictures[2])[hole].square().mean())) for one in pictures[:2])
        assert before < 15.0
        assert after > 33.0  # at least 35 when written
        # no visible pixel is covered
        assert decibels(float((pictures[1] - pictures[0])[~hole].square().mean())) > 40.0


def test_progress_of_a_fill_counts_every_look_at_a_view() -> None:
    scene, rest, setup = case()
    looks = list[int]()
    opened = find_holes(scene, rest, setup.train, looked=lambda: looks.append(1))
    assert len(looks) == len(setup.train)
    fill = fill_holes(opened, looked=lambda: looks.append(2))
    assert fill.views <= looks.count(2) <= fill.views * len(setup.train)


@pytest.mark.parametrize(("depth", "behind_region", "is_hole"), [("inf", False, False), ("1", True, True)])
def test_hole_excludes_pixels_that_another_view_saw_through(
    depth: str, behind_region: bool, is_hole: bool
) -> None:
    _, rest, setup = case()
    view = setup.train[0]
    other = setup.train[1].camera
    front = torch.full((other.height, other.width), float(depth))
    assert find_hole(rest, view, []).pixels > 0
    seen = [(other, front, torch.full(front.shape, behind_region))]
    assert (find_hole(rest, view, seen).pixels > 0) == is_hole


@pytest.mark.parametrize("fine", [False, True])
def test_flat_parts_of_a_hole_need_few_rows(fine: bool) -> None:
    camera = case()[2].train[0].camera.resize(128, 128)
    mask = torch.zeros(128, 128, dtype=torch.bool)
    mask[10:110, 10:110] = True
    colors = fine * torch.rand(128, 128, 3, generator=torch.Generator().manual_seed(1))
    rows = place_discs(Hole(camera, mask, torch.full((128, 128), 0.5)), case()[1], colors)
    drawn = render(rows, camera, (1.0, 1.0, 1.0))
    assert float(drawn.transmittance[mask].mean()) < 0.02
    assert len(rows) == 10_000 if fine else len(rows) < 1000


def plain_split_squares(mask: Tensor, colors: Tensor) -> list[tuple[int, int, int]]:
    depth = ndimage.distance_transform_cdt(np.pad(mask.numpy(), 1), "chessboard")[1:-1, 1:-1]
    free = mask.numpy().copy()
    parts = []
    for side in (8, 4, 2, 1):
        for row in range(0, mask.shape[0] - side + 1, side):
            for column in range(0, mask.shape[1] - side + 1, side):
                part = slice(row, row + side), slice(column, column + side)
                is_inner = side == 1 or bool((depth[part] > side // 2).all())
                is_even = side == 1 or float(np.ptp(colors.numpy()[part], axis=(0, 1)).max()) <= 2 / 255
                if free[part].all() and is_inner and is_even:
                    free[part] = False
                    parts.append((row, column, side))
    return parts


def test_squares_of_a_hole_equal_those_of_plain_loops() -> None:
    y, x = torch.meshgrid(torch.arange(53), torch.arange(46), indexing="ij")
    mask = ((x - 24).square() + (y - 27).square() < 400) & ~((x > 30) & (y < 20))
    colors = torch.where(
        x[..., None] < 20, 0.5, torch.rand(53, 46, 3, generator=torch.Generator().manual_seed(2))
    )
    assert split_squares(mask, colors).tolist() == [list(part) for part in plain_split_squares(mask, colors)]


def test_object_before_an_empty_background_leaves_no_hole() -> None:
    scene, rest, _ = case()
    region = from_mask("table", torch.arange(len(scene)) < len(rest))
    setup = make_training_setup(TrainingViewOptions(views=12, image_size=96), scene, region)
    assert fill_holes(find_holes(scene, post(), setup.train)).rows is None
    solid, whole, around = case(-1.0)
    assert fill_holes(find_holes(solid, whole, around.train)).rows is None  # no hole


@pytest.fixture(scope="module")
def scene_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("removal") / "scene.ply"
    save_ply(path, case()[0])
    return path


def options_of(scene: Path, out: Path, editor: str = "remove", **more: object) -> TrainOptions:
    options = TrainOptions(scene, out, RegionOptions(POST), EditorOptions(editor))
    return with_values(options, threads=1, views=12, image_size=96, **more)


def members_of(scene: Gaussians) -> Region:
    return from_mask("post", torch.arange(len(scene)) >= len(case()[1]))


def test_removal_is_a_regular_run(scene_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "gone"
    steps = list[tuple[str, float]]()
    write = RunLog._write_state

    def record(log: RunLog, **changes: Any) -> None:
        write(log, **changes)
        steps.append((log._state["label"], log._state["share"]))

    monkeypatch.setattr(RunLog, "_write_state", record)
    monkeypatch.setattr("trainer.store.progress._FILE_INTERVAL_S", 0.0)
    result = train(options_of(scene_file, out), quiet=True)
    shares = [share for label, share in steps if label == "Filling the hole"]
    assert len(shares) > 36, "three looks at each of 12 views"  # equal while less time is left than foreseen
    assert shares[-1] > shares[0]
    assert shares == sorted(shares)
    assert max(shares) < 1.0
    named = list(dict.fromkeys(label for label, _ in steps))
    assert named[:3] == ["Choosing the views", "Filling the hole", "Continuing the texture around the hole"]
    scene = load_ply(scene_file)
    gdf = load_gdf(result.gdf, scene)
    report = json.loads((out / "report.json").read_text())
    assert gdf.added is not None
    assert report["removal"]["rows_added"] == len(gdf.added)
    assert report["removal"]["visible_change"]["0.5"] == pytest.approx(0.5, abs=0.05)
    assert min(report["edit"]["psnr_by_background"].values()) > 50.0
    assert report["removal"]["remaining_share"] < 0.01
    assert (out / "report.png").is_file()
    assert "shadows and reflections stay" in (out / "log.txt").read_text()
    again = train(replace(options_of(scene_file, out), resume=True), quiet=True)
    assert again.gdf == result.gdf
    with pytest.raises(ProgdfError, match="removals and decals have no trajectory"):
        evaluate(EvaluateOptions(out))


def test_removal_without_fill_adds_nothing(scene_file: Path, tmp_path: Path) -> None:
    result = train(options_of(scene_file, tmp_path / "gone", fill="none"), quiet=True)
    scene = load_ply(scene_file)
    gdf = load_gdf(result.gdf, scene)
    assert gdf.added is None
    removed = compose_layers(scene, [Layer(gdf, 1.0)])
    for view in case()[2].held_out:
        pairs = zip(on_backgrounds(removed, view.camera), on_backgrounds(case()[1], view.camera), strict=True)
        assert all(float((a - b).abs().max()) < 1e-5 for a, b in pairs)  # one ulp, see test_tidy.py


def paint(path: Path, image: Tensor, view: View) -> Path:
    to_picture(image).save(path, pnginfo=camera_chunk(view.camera))
    return path


@pytest.mark.slow
@pytest.mark.parametrize("removal", ["auto", "never"])
def test_picture_of_the_background_is_a_removal(scene_file: Path, tmp_path: Path, removal: str) -> None:
    _, rest, setup = case()
    view = setup.train[0]
    picture = paint(tmp_path / "A.png", render_view(rest, view.camera, WHITE).clamp(0, 1), view)
    out = tmp_path / "run"
    options = options_of(scene_file, out, f"pictures:{picture}", removal=removal, steps=40, stages=1)
    result = train(options, quiet=True)
    gdf = load_gdf(result.gdf, load_ply(scene_file))
    assert ("logit_opacities" in gdf.field.attributes) == (removal == "auto")
    assert ("the region is removed" in (out / "log.txt").read_text()) == (removal == "auto")


def test_recolored_picture_is_no_removal(scene_file: Path, tmp_path: Path) -> None:
    view = case()[2].train[0]
    blue = view.blend(torch.tensor([0.2, 0.3, 0.9]).expand_as(view.image))
    picture = paint(tmp_path / "A.png", blue, view)
    result = train(
        options_of(scene_file, tmp_path / "run", f"pictures:{picture}", steps=40, stages=1), quiet=True
    )
    assert "logit_opacities" not in load_gdf(result.gdf, load_ply(scene_file)).field.attributes


def test_painted_picture_colors_the_hole(scene_file: Path, tmp_path: Path) -> None:
    _, rest, setup = case()
    view = max(setup.train, key=lambda view: int(find_hole(rest, view, []).mask.sum()))
    hole = find_hole(rest, view, []).mask
    green = torch.tensor([0.1, 0.8, 0.2])
    drawn = render_view(rest, view.camera, WHITE).clamp(0, 1)
    picture = paint(tmp_path / "A.png", torch.where(hole[..., None], green, drawn), view)
    result = train(options_of(scene_file, tmp_path / "run", f"remove:{picture}"), quiet=True)
    scene = load_ply(scene_file)
    removed = compose_layers(scene, [Layer(load_gdf(result.gdf, scene), 1.0)])
    shown = render_view(removed, view.camera, WHITE).clamp(0, 1)[hole]
    assert float((shown.median(dim=0).values - green).abs().max()) < 0.03


def test_gaussians_left_floating_are_removed_with_the_region(scene_file: Path, tmp_path: Path) -> None:
    scene, rest, _ = case()
    at = torch.tensor([[0.4, -0.4, 0.0], [0.0, -0.5, 0.4]])  # beside the post, high above the table
    crumbs = splats(
        at, at * torch.tensor([1.0, 0.0, 1.0]), 0.01, torch.tensor([[0.9, 0.2, 0.1]]).repeat(2, 1)
    )
    far = splats(torch.tensor([[0.0, -9.0, 0.0]]), torch.tensor([[0.0, 1.0, 0.0]]), 0.01, torch.ones(1, 3))
    whole = concatenate([scene, crumbs, far])
    region = from_mask(
        "post", (torch.arange(len(whole)) >= len(rest)) & (torch.arange(len(whole)) < len(scene))
    )
    taken = with_strays(whole, region)
    assert taken.members.tolist() == [*region.members.tolist(), len(scene), len(scene) + 1]
    assert torch.equal(with_strays(scene, members_of(scene)).members, members_of(scene).members)
    # Gaussians that already float are no crumbs
    assert (
        len(with_strays(concatenate([rest, far]), from_mask("none", torch.zeros(len(rest) + 1).bool()))) == 0
    )


def test_missed_part_of_the_region_is_removed_with_it(tmp_path: Path) -> None:
    scene, rest, _ = case()
    labels = torch.arange(len(scene)) >= len(rest)
    labels[len(rest) :: 15] = False
    np.save(tmp_path / "labels.npy", labels.numpy().astype(np.uint8))
    save_ply(tmp_path / "scene.ply", scene)
    options = options_of(tmp_path / "scene.ply", tmp_path / "gone")
    options = replace(options, region=RegionOptions(f"labels:{tmp_path / 'labels.npy'}:1"))
    result = train(options, quiet=True)
    report = json.loads((tmp_path / "gone" / "report.json").read_text())
    assert report["removal"]["remaining_share"] < 0.25 * report["removal"]["remaining_share_of_named"]
    gdf = load_gdf(result.gdf, load_ply(tmp_path / "scene.ply"))
    missed = (~labels[len(rest) :]).nonzero()[:, 0] + len(rest)
    assert int(torch.isin(missed, gdf.region.members).sum()) > 0.95 * len(missed)
    assert int((gdf.region.members < len(rest)).sum()) == 0


def test_removal_with_another_picture_is_another_run(scene_file: Path, tmp_path: Path) -> None:
    setup = case()[2]
    picture = paint(
        tmp_path / "A.png", render_view(case()[1], setup.train[0].camera, WHITE).clamp(0, 1), setup.train[0]
    )
    options = options_of(scene_file, tmp_path / "run", f"remove:{picture}")
    before = picture_digests(options)
    paint(picture, render_view(case()[0], setup.train[0].camera, WHITE).clamp(0, 1), setup.train[0])
    assert list(before) == [str(picture.resolve())]
    assert picture_digests(options) != before


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"fill": "picture"}, "--fill picture needs a picture"),
        ({"removal": "always"}, "--removal does not apply to remove"),
        ({"editor": "recolor:#3060d0", "fill": "surface"}, "--fill does not apply to recolor"),
        ({"editor": "remove:nowhere.png"}, "does not exist"),
    ],
)
def test_invalid_removal_options_are_a_one_line_error(
    scene_file: Path, tmp_path: Path, values: dict[str, str], said: str
) -> None:
    with pytest.raises(ProgdfError, match=said) as caught:
        train(with_values(options_of(scene_file, tmp_path / "run"), **values), quiet=True)
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "run").exists()
