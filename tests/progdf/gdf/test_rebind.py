"""Tests of `progdf rebind`: an edit on the same scene in another file, order or precision."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from progdf.__main__ import main
from progdf.cli.rebind import match_scenes, rebind_edit
from progdf.compose.reference import Layer, compose_layers
from progdf.formats.ply import save_ply
from progdf.formats.scene_file import load_scene, rotate_about_x
from progdf.gaussians import Gaussians
from progdf.gdf.file import load_gdf
from progdf.rasterize import render
from progdf.region import from_mask, whole_scene
from progdf.tidy import Step, mirror, similarity, tidy
from tests.helpers.scene_files import write_compressed_ply, write_scene
from tests.helpers.stacks import Stack, bear_stack
from viewer.camera.view_camera import first_camera, to_camera


@pytest.fixture(scope="module")
def stack() -> Stack:
    return bear_stack(2000)


def shuffled(scene: Gaussians, seed: int = 3) -> tuple[Gaussians, torch.Tensor]:
    """Return the scene with shuffled rows and every other quaternion negated, which is the same rotation."""
    order = torch.randperm(len(scene), generator=torch.Generator().manual_seed(seed))
    other = scene[order]
    signs = torch.where(torch.arange(len(scene)) % 2 == 0, 1.0, -1.0)
    return replace(other, quats=other.quats * signs[:, None]), order


def psnr(a: Gaussians, b: Gaussians, stack: Stack) -> float:
    camera = to_camera(first_camera(stack.scene, stack.demo.cameras), 96, 72)
    return -10 * float((render(a, camera).image - render(b, camera).image).square().mean().log10())


def test_shuffled_rows_keep_their_own_offsets(stack: Stack) -> None:
    other, order = shuffled(stack.scene)
    match = match_scenes(stack.scene, other)
    assert np.array_equal(match.rows, order.numpy())
    assert (match.matched, match.once, match.p95) == (1.0, 1.0, 0.0)
    for gdf in stack.gdfs:
        found = compose_layers(other, [Layer(rebind_edit(gdf, stack.scene, other, match), 0.6)])
        expected = compose_layers(stack.scene, [Layer(gdf, 0.6)])[order]
        for name in ("means", "log_scales", "logit_opacities", "sh0"):
            assert torch.equal(getattr(found, name), getattr(expected, name)), name


def test_rebound_move_still_carries_other_layers(stack: Stack) -> None:
    scene = stack.scene
    half = from_mask("half", scene.means[:, 0] > 0)
    steps = [
        Step("transform", half, similarity(turn=(0.0, 1.0, 0.0))),
        Step("transform", whole_scene(scene), mirror(1)),
    ]
    gdfs = [stack.gdfs[0], tidy(scene, steps, "move")]
    other, order = shuffled(scene)
    match = match_scenes(scene, other)
    rebound = [rebind_edit(gdf, scene, other, match) for gdf in gdfs]
    found = compose_layers(other, [Layer(gdf, 0.6) for gdf in rebound])
    expected = compose_layers(scene, [Layer(gdf, 0.6) for gdf in gdfs])[order]
    for name in ("means", "log_scales", "logit_opacities", "sh0"):
        torch.testing.assert_close(getattr(found, name), getattr(expected, name), atol=1e-5, rtol=1e-5)


def test_negated_quaternion_rotates_the_same_way(stack: Stack) -> None:
    gdf = stack.gdfs[0]
    scene = stack.scene
    bases = gdf.field.attributes["sh0"]
    width = torch.zeros(len(gdf.region), 4)
    turning = replace(
        bases,
        end_offset=width + torch.tensor([0.0, 0.5, -0.2, 0.1]),
        residual_basis=torch.zeros(
            bases.residual_basis.shape[0], len(gdf.region), 4, dtype=bases.residual_basis.dtype
        ),
        scale=torch.ones(bases.scale.shape[0], 4),
    )
    gdf = replace(gdf, field=replace(gdf.field, attributes={"quats": turning}))
    other, order = shuffled(scene)
    found = compose_layers(other, [Layer(rebind_edit(gdf, scene, other, match_scenes(scene, other)), 1.0)])
    expected = compose_layers(scene, [Layer(gdf, 1.0)])[order]
    same = (found.unit_quats * expected.unit_quats).sum(dim=1).abs()
    torch.testing.assert_close(same, torch.ones(len(scene)))


def test_each_gaussian_is_matched_once_while_others_are_free(stack: Stack) -> None:
    """Match pairs at one position, which differ only in color."""
    twice = stack.scene[torch.arange(400).repeat_interleave(2)]
    sh0 = twice.sh0.clone()
    sh0[1::2] = -sh0[1::2]
    a = replace(twice, sh0=sh0)
    other, _ = shuffled(a)
    match = match_scenes(a, replace(other, means=other.means + 1e-4))
    assert match.once == 1.0
    assert float((a.sh0[torch.from_numpy(match.rows)] - other.sh0).abs().max()) == 0.0


@pytest.mark.parametrize("file", ["b.sog", "b.spz", "b.ply"])
def test_edit_is_carried_to_another_format(
    stack: Stack, tmp_path: Path, file: str, capsys: pytest.CaptureFixture[str]
) -> None:
    a, edit, *_ = stack.save(tmp_path)
    b = tmp_path / file
    (write_compressed_ply if file == "b.ply" else write_scene)(b, stack.scene)
    assert main(["render", str(b), str(edit), "-o", str(tmp_path / "no.png")]) == 2
    assert "progdf rebind scarf.gdf --from SCENE" in capsys.readouterr().err
    new = tmp_path / "new.gdf"
    assert main(["rebind", str(edit), "--from", str(a), "--to", str(b), "-o", str(new)]) == 0
    assert "matched: " in capsys.readouterr().out
    scene = load_scene(b)
    gdf = load_gdf(new, scene)
    assert gdf.report["rebound"]["matched"] > 0.99
    # the edit loses no more than the format itself
    before = psnr(scene, stack.scene, stack)
    after = psnr(
        compose_layers(scene, [Layer(gdf, 1.0)]),
        compose_layers(stack.scene, [Layer(stack.gdfs[0], 1.0)]),
        stack,
    )
    assert after > before - 1.0


def test_other_scene_is_refused_and_a_half_turn_is_named(
    stack: Stack, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    a, edit, *_ = stack.save(tmp_path)
    moved = replace(stack.scene, means=stack.scene.means + torch.tensor([0.3, 0.0, 0.0]))
    for scene, message in (
        (moved, "is another scene"),
        (rotate_about_x(stack.scene), "rotated by 180° about x"),
    ):
        save_ply(tmp_path / "other.ply", scene)
        words = ["--from", str(a), "--to", str(tmp_path / "other.ply"), "-o", str(tmp_path / "new.gdf")]
        assert main(["rebind", str(edit), *words]) == 2
        assert message in capsys.readouterr().err
    assert not (tmp_path / "new.gdf").exists()


def test_rebind_never_overwrites_its_inputs(
    stack: Stack, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    a, edit, *_ = stack.save(tmp_path)
    (tmp_path / "link.gdf").symlink_to(edit)
    before = edit.read_bytes()
    for out in (edit, tmp_path / "link.gdf", edit.parent / "." / edit.name):
        assert main(["rebind", str(edit), "--from", str(a), "--to", str(a), "-o", str(out)]) == 2
        assert "is one of the files to read; choose another name" in capsys.readouterr().err
    assert edit.read_bytes() == before
