"""Tests of removing, moving and copying regions: exact ends, intermediate strengths and the command."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from progdf.__main__ import main
from progdf.camera import Camera
from progdf.compose.reference import Layer, compose_layers
from progdf.formats.ply import load_ply, save_ply
from progdf.gaussians import ATTRIBUTES, Gaussians, pack
from progdf.gdf.file import Gdf, load_gdf, save_gdf
from progdf.pull.course import Handle, pull
from progdf.quaternions import rotation_matrices, turn_quats
from progdf.rasterize import render
from progdf.rasterize.engines import ALPHA_MIN
from progdf.region import Region, from_mask, whole_scene
from progdf.scene.bounds import scene_sphere
from progdf.similarity import AffineMotion
from progdf.tidy import Step, bake, similarity, tidy
from tests.helpers.scenes import front_camera, orbit_camera, random_gaussians

BLACK = (0.0, 0.0, 0.0)
WHITE = (1.0, 1.0, 1.0)
TURN = (0.3, -1.1, 0.4)
ROUNDING = 1 / 255
"""One 8-bit step. Ends are stored in 16 bits of the longest path, intermediate offsets to 1/1000."""


COUNT = 384
"""Divisible by every processor's vector width. Remainders are activated by another loop, 1 ulp off."""


def scene_of(degree: int = 2) -> Gaussians:
    scene = random_gaussians(COUNT, seed=4, sh_degree=degree, spread=0.5, scale=0.08)
    return replace(scene, means=scene.means + torch.tensor([0.0, 0.0, 3.0]))


def left_half(scene: Gaussians) -> Region:
    return from_mask("left", scene.means[:, 0] < 0)


def outside(scene: Gaussians, region: Region) -> Tensor:
    mask = torch.ones(len(scene), dtype=torch.bool)
    mask[region.members] = False
    return mask


def at(scene: Gaussians, gdf: Gdf, s: float) -> Gaussians:
    return compose_layers(scene, [Layer(gdf, s)])


def picture(scene: Gaussians, background: tuple[float, float, float], camera: Camera) -> Tensor:
    with torch.no_grad():
        return render(scene, camera, background).image


def checker(scene: Gaussians) -> Gaussians:
    """Return the scene with a wall of black and white tiles behind it."""
    x, y = torch.meshgrid(torch.arange(-6, 7), torch.arange(-6, 7), indexing="ij")
    count = x.numel()
    tone = ((x + y) % 2).float().flatten()[:, None].expand(-1, 3)
    wall = Gaussians(
        torch.stack([x.flatten() * 0.4, y.flatten() * 0.4, torch.full((count,), 6.0)], dim=1),
        torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(count, 4),
        torch.log(torch.tensor([0.2, 0.2, 0.01])).expand(count, 3),
        torch.full((count,), 5.0),
        (tone - 0.5) / 0.28209479,
        torch.zeros(count, scene.shN.shape[1], 3),
    )
    joined = {name: torch.cat([getattr(scene, name), getattr(wall, name)]) for name in ATTRIBUTES}
    return Gaussians(**joined)


def test_removed_region_is_gone_before_any_background() -> None:
    scene = checker(scene_of())
    region = left_half(scene)
    region = Region("left", region.members[region.members < COUNT], region.score)
    removed = at(scene, tidy(scene, [Step("remove", region)], "gone"), 1.0)
    without = scene[outside(scene, region)]
    for background in (WHITE, BLACK):
        for camera in (front_camera(96, 64, 60.0), orbit_camera(96, 64, azimuth=2.0)):
            original = picture(scene, background, camera)
            gone = picture(removed, background, camera)
            reference = picture(without, background, camera)
            assert float((original - reference).abs().max()) > 0.1
            # the last rows of a tensor are activated by another loop, 1 ulp off
            assert float((gone - reference).abs().max()) < 1e-5


def test_removal_is_linear_in_opacity_and_ends_below_the_cutoff() -> None:
    scene = scene_of()
    region = left_half(scene)
    gdf = tidy(scene, [Step("remove", region)], "gone")
    before = scene.opacities[region.members]
    for s in torch.linspace(0.0, 1.0, 41).tolist():
        sum_share = float(at(scene, gdf, s).opacities[region.members].sum() / before.sum())
        assert sum_share == pytest.approx(1.0 - s, abs=0.02)
    assert bool((at(scene, gdf, 1.0).opacities[region.members] < ALPHA_MIN).all())


@pytest.mark.parametrize("does", ["remove", "transform", "duplicate"])
def test_strength_zero_is_the_scene_and_other_rows_never_change(does: str) -> None:
    scene = scene_of()
    region, motion = left_half(scene), similarity((0.2, 0.1, 0.0), TURN, 1.3)
    gdf = {
        "remove": lambda: tidy(scene, [Step("remove", region)], "a"),
        "transform": lambda: tidy(scene, [Step("transform", region, motion)], "a"),
        "duplicate": lambda: tidy(scene, [Step("duplicate", region, motion)], "a"),
    }[does]()
    start = at(scene, gdf, 0.0)
    mask = outside(scene, region)
    for name in ATTRIBUTES:
        assert torch.equal(getattr(start, name)[: len(scene)], getattr(scene, name))
        for s in (0.3, 1.0):
            assert torch.equal(
                getattr(at(scene, gdf, s), name)[: len(scene)][mask], getattr(scene, name)[mask]
            )
    assert torch.equal(picture(start, WHITE, front_camera()), picture(scene, WHITE, front_camera()))


def moved_camera(camera: Camera, center: Tensor, motion: AffineMotion) -> Camera:
    """Return the camera that sees the moved scene as `camera` sees the original. `motion` must not scale."""
    turn = rotation_matrices(turn_quats(motion.turn[None]))[0]
    # x' = c + t + R (x − c), so that x = Rᵀ (x' − c − t) + c
    back = turn.T
    offset = center - turn.T @ (center + motion.shift)
    view = camera.viewmat.double().clone()
    view[:3, 3] = view[:3, :3] @ offset + view[:3, 3]
    view[:3, :3] = view[:3, :3] @ back
    return replace(camera, viewmat=view.float())


@pytest.mark.parametrize("share", [0.37, 1.0])
def test_scene_and_camera_moved_alike_give_the_same_picture(share: float) -> None:
    scene = scene_of(degree=3)
    motion = similarity((0.4, -0.2, 0.3), TURN)
    gdf = tidy(scene, [Step("transform", whole_scene(scene), motion)], "moved")
    part = replace(motion, shift=share * motion.shift, turn=share * motion.turn)
    camera = front_camera(64, 48, 50.0)
    seen = picture(at(scene, gdf, share), BLACK, moved_camera(camera, scene.means.double().mean(0), part))
    # without rotated SH, colors would be off by more than 0.1
    assert float((seen - picture(scene, BLACK, camera)).square().mean().sqrt()) < ROUNDING


def test_rotation_follows_an_arc_even_for_a_full_turn() -> None:
    scene = scene_of()
    region = left_half(scene)
    gdf = tidy(scene, [Step("transform", region, similarity(turn=(0.0, 2 * math.pi, 0.0)))], "round")
    means = scene.means[region.members]
    center = means.mean(dim=0)
    radius = (means - center)[:, [0, 2]].norm(dim=1)
    for s in (0.11, 0.25, 0.5, 0.77):
        now = at(scene, gdf, s).means[region.members] - center
        assert float((now[:, [0, 2]].norm(dim=1) - radius).abs().max()) < 0.01 * float(radius.max())
    half = at(scene, gdf, 0.5).means[region.members] - center
    assert torch.allclose(half[:, 0], -(means - center)[:, 0], atol=0.01)


def turn_by(degrees: float, **fields: object) -> AffineMotion:
    """Return a turn about the vertical axis; `fields`: further fields of the motion."""
    motion = similarity(turn=(0.0, math.radians(degrees), 0.0))
    return replace(motion, **{name: torch.as_tensor(value).double() for name, value in fields.items()})


ARCS = {
    "90 degrees": turn_by(90.0),
    "137 degrees": turn_by(137.0),
    "full turn": turn_by(360.0),
    "far away": turn_by(90.0, shift=(2000.0, 0.0, 0.0)),
    "about a far pivot": turn_by(137.0, pivot=(30.0, 0.0, 0.0)),
    "grown": similarity(turn=(0.0, 1.5, 0.0), scale=8.0),
    "stretched": turn_by(60.0, stretch=torch.diag(torch.tensor([1.0, 0.0, -0.5]))),
    "mirrored": replace(turn_by(60.0), mirror=0),
}


@pytest.mark.parametrize("name", ARCS)
def test_centers_stay_within_half_a_pixel_of_their_arc(name: str) -> None:
    scene = scene_of()
    step = Step("transform", whole_scene(scene), ARCS[name])
    gdf = tidy(scene, [step], "turned")
    rows = pack(scene, with_shN=True).double()
    extent = 2.0 * scene_sphere(scene)[1]
    for s in torch.linspace(0.0, 1.0, 83).tolist():
        centers = step.move(rows, s)[:, :3]
        size = max(extent, 2.0 * float((centers - centers.mean(dim=0)).norm(dim=1).max()))
        error = rows[:, :3] + gdf.field.offsets(s)[:, :3] - centers
        assert float(error.norm(dim=1).max()) < 0.5 * size / 512


@pytest.mark.parametrize("blend", ["over", "adjust"])
def test_shift_takes_the_shapes_of_lower_layers_along(blend: str) -> None:
    scene = scene_of()
    everything = whole_scene(scene)
    scale = tidy(scene, [Step("transform", everything, similarity(turn=TURN, scale=0.7))], "scaled")
    shift = tidy(scene, [Step("transform", everything, similarity((0.5, 0.0, -0.2)))], "moved")
    below = compose_layers(scene, [Layer(scale)], blend)
    both = compose_layers(scene, [Layer(scale), Layer(shift, 0.5)], blend)
    assert torch.allclose(both.means, below.means + torch.tensor([0.25, 0.0, -0.1]), atol=1e-3)
    assert torch.equal(both.log_scales, below.log_scales)


@pytest.mark.parametrize("degree", [0, 2])
def test_copy_in_place_is_the_region_twice(degree: int) -> None:
    scene = scene_of(degree)
    region = left_half(scene)
    gdf = tidy(scene, [Step("duplicate", region, similarity())], "twice")
    end = at(scene, gdf, 1.0)
    assert len(end) == len(scene) + len(region)
    for name in ATTRIBUTES:
        added = getattr(end, name)[len(scene) :]
        original = getattr(scene, name)[region.members]
        assert (
            torch.allclose(added, original, atol=1e-3)
            if name == "logit_opacities"
            else torch.equal(added, original)
        )


def test_copies_go_where_the_motion_moves_the_region() -> None:
    scene = scene_of(degree=3)
    region = left_half(scene)
    motion = similarity((0.2, 0.1, 0.0), TURN, 1.3)
    copy = tidy(scene, [Step("duplicate", region, motion)], "copy").added
    assert copy is not None
    moved = bake(scene, [Step("transform", region, motion)])[region.members]
    assert torch.equal(copy.means, moved.means)
    assert torch.equal(copy.shN, moved.shN)


def test_baked_scene_is_the_slider_at_full_strength() -> None:
    scene = scene_of(degree=3)
    left = left_half(scene)
    low = from_mask("low", scene.means[:, 1] > 0.4)
    steps = [
        Step("transform", left, similarity(turn=TURN, scale=0.7)),
        Step("duplicate", left, similarity((0.0, 0.0, 1.0))),
        Step("remove", low),
    ]
    end = at(scene, tidy(scene, steps, "all"), 1.0)
    baked = bake(scene, steps)
    drawn = end[end.opacities >= ALPHA_MIN]
    expected = baked[baked.opacities >= ALPHA_MIN]
    assert len(drawn) == len(expected)
    assert torch.allclose(pack(drawn, True), pack(expected, True), atol=ROUNDING)


def test_edit_that_only_adds_is_saved_like_any_other(tmp_path: Path) -> None:
    scene = scene_of()
    gdf = tidy(scene, [Step("duplicate", left_half(scene), similarity((1.0, 0.0, 0.0)))], "copy")
    save_gdf(tmp_path / "copy.gdf", gdf)
    again = load_gdf(tmp_path / "copy.gdf", scene)
    for s in (0.0, 0.4, 1.0):
        assert torch.equal(pack(at(scene, again, s), True), pack(at(scene, gdf, s), True))


@pytest.fixture
def ply(tmp_path: Path) -> Path:
    save_ply(tmp_path / "scene.ply", scene_of())
    return tmp_path / "scene.ply"


LEFT = "box:-9,-9,-9,0,9,9"


def test_edit_command_deletes_and_copies_permanently(ply: Path, tmp_path: Path) -> None:
    scene = load_ply(ply)
    out = tmp_path / "out.ply"
    assert main(["edit", str(ply), "--delete", LEFT, "--duplicate", f"all-{LEFT}:2,0,0", "-o", str(out)]) == 0
    rest = scene[scene.means[:, 0] > 0]
    edited = load_ply(out)
    assert torch.equal(edited.means[: len(rest)], rest.means)
    assert torch.allclose(edited.means[len(rest) :], rest.means + torch.tensor([2.0, 0.0, 0.0]))


def test_edit_command_writes_a_slider(ply: Path, tmp_path: Path) -> None:
    out = tmp_path / "turned.gdf"
    arguments = ["--rotate", f"{LEFT}:y,90", "--scale", f"{LEFT}:2", "--move", f"{LEFT}:0,-1,0"]
    assert main(["edit", str(ply), *arguments, "-o", str(out)]) == 0
    scene = load_ply(ply)
    gdf = load_gdf(out, scene)
    means = at(scene, gdf, 1.0).means[gdf.region.members]
    rows = scene.means[gdf.region.members]
    arm = rows - rows.mean(dim=0)
    expected = (
        rows.mean(dim=0) + 2 * torch.stack([arm[:, 2], arm[:, 1], -arm[:, 0]], 1) + torch.tensor([0, -1.0, 0])
    )
    assert torch.allclose(means, expected, atol=ROUNDING)


@pytest.mark.parametrize("form", ["ply", "gdf"])
def test_edit_command_mirrors_and_scales_along_axes(ply: Path, tmp_path: Path, form: str) -> None:
    scene = load_ply(ply)
    out = tmp_path / f"mirrored.{form}"
    assert main(["edit", str(ply), "--mirror", "all:X", "--scale", "all:1,2,0.5", "-o", str(out)]) == 0
    edited = load_ply(out) if form == "ply" else at(scene, load_gdf(out, scene), 1.0)
    center = scene.means.mean(dim=0)
    expected = center + (scene.means - center) * torch.tensor([-1.0, 2.0, 0.5])
    assert torch.allclose(edited.means, expected, atol=1e-3)


@pytest.mark.parametrize("form", ["ply", "gdf"])
def test_edit_command_pulls_a_point(ply: Path, tmp_path: Path, form: str) -> None:
    out = tmp_path / f"pulled.{form}"
    scene = load_ply(ply)
    target = scene.means[scene.means[:, 0].argmax()]
    point = ",".join(str(value) for value in target.tolist())
    pull = f"all:{point},0.3,-0.1,0"
    assert main(["edit", str(ply), "--pull", pull, "--hold", LEFT, "-o", str(out)]) == 0
    edited = load_ply(out) if form == "ply" else at(scene, load_gdf(out, scene), 1.0)
    left = scene.means[:, 0] < 0
    row = int(scene.means[:, 0].argmax())
    assert torch.equal(edited.means[left], scene.means[left])
    assert torch.allclose(edited.means[row], target + torch.tensor([0.3, -0.1, 0.0]), atol=0.02)


def test_edit_command_cuts_a_region_off_from_a_pull(
    ply: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "cut.ply"
    scene = load_ply(ply)
    point = ",".join(str(value) for value in scene.means[scene.means[:, 0].argmax()].tolist())
    pull = ["--pull", f"all:{point},0.3,-0.1,0"]
    left = scene.means[:, 0] < 0
    assert main(["edit", str(ply), *pull, "-o", str(out)]) == 0
    assert not torch.equal(load_ply(out).means[left], scene.means[left])
    assert main(["edit", str(ply), *pull, "--cut", LEFT, "-o", str(out)]) == 0
    edited = load_ply(out)
    assert torch.equal(edited.means[left], scene.means[left])
    assert not torch.equal(edited.means[~left], scene.means[~left])
    assert "links cut" in capsys.readouterr().out
    assert main(["edit", str(ply), *pull, "--cut", "all", "-o", str(out)]) == 0
    assert "note: --cut all has no effect" in capsys.readouterr().out


def test_edit_command_turns_and_scales_a_pulled_point(ply: Path, tmp_path: Path) -> None:
    out = tmp_path / "turned.ply"
    scene = load_ply(ply)
    row = int(scene.means[:, 0].argmax())
    point = scene.means[row]
    numbers = ",".join(str(value) for value in point.tolist())
    spec = f"all:{numbers},0,0.1,0,turn=x,30,scale=1.25"
    assert main(["edit", str(ply), "--pull", spec, "--hold", LEFT, "-o", str(out)]) == 0
    edited = load_ply(out)
    assert torch.allclose(edited.means[row], point + torch.tensor([0.0, 0.1, 0.0]), atol=0.02)
    x, y, z = point.tolist()
    handle = Handle(
        whole_scene(scene), (x, y, z), (0.0, 0.1, 0.0), None, (math.radians(30.0), 0.0, 0.0), 1.25
    )
    course = pull(scene, [handle], from_mask("left", scene.means[:, 0] < 0))
    expected = bake(scene, [Step("pull", course.region, course=course)])
    assert torch.allclose(edited.means, expected.means, atol=1e-6)
    assert not torch.allclose(edited.log_scales, scene.log_scales, atol=0.05)


@pytest.mark.parametrize(
    "arguments",
    [
        [],
        ["--delete", ""],
        ["--delete", "nothing"],
        ["--delete", "box:5,5,5,6,6,6"],
        ["--delete", "all"],
        ["--move", "1,0,0"],
        ["--move", ":1,0,0"],
        ["--move", "all"],
        ["--move", "all:1,0"],
        ["--move", "all:nan,0,0"],
        ["--move", "all:1e30,0,0"],
        ["--move", "sphere:0,0,0,1"],
        ["--rotate", "all:w,90"],
        ["--rotate", "all:0,0,0,90"],
        ["--rotate", "all:y,1e9"],
        ["--rotate", "all:y"],
        ["--pull", "all:1,2,3"],
        ["--pull", "all:0,0,3,0,0,nan"],
        ["--pull", "all:0,0,3,0,0,0"],
        ["--pull", "all:0,0,3,0,0,1e6"],
        ["--pull", "all:0,0,3,1,0,0,0"],
        ["--pull", "all:50,0,3,1,0,0"],
        ["--pull", "sphere:90,0,0,1:0,0,3,1,0,0"],
        ["--pull", "all:0,0,3,1,0,0,turn=w,30"],
        ["--pull", "all:0,0,3,1,0,0,turn=x"],
        ["--pull", "all:0,0,3,1,0,0,turn=x,360"],
        ["--pull", "all:0,0,3,1,0,0,turn=x,30,turn=x,30"],
        ["--pull", "all:0,0,3,1,0,0,scale=0"],
        ["--pull", "all:0,0,3,1,0,0,scale=1e6"],
        ["--pull", "all:0,0,3,1,0,0,scale=nan"],
        ["--pull", "all:0,0,3,1,0,0,bend=2"],
        ["--pull", "all:0,0,3,1,0,0", "--hold", "all"],
        ["--hold", "all"],
        ["--cut", "all"],
        ["--pull", "all:0,0,3,1,0,0", "--cut", "nothing"],
        ["--scale", "all:0"],
        ["--scale", "all:1,2"],
        ["--scale", "all:1,2,0"],
        ["--mirror", "all:w"],
        ["--mirror", "all"],
        ["--scale", "all:-1"],
        ["--scale", "all:1e9"],
        ["--scale", "labels:x.npy:3"],
        ["--duplicate", "masks:nowhere:1,0,0"],
    ],
)
def test_impossible_edit_is_refused_and_writes_nothing(
    ply: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str]
) -> None:
    out = tmp_path / "out.ply"
    assert main(["edit", str(ply), *arguments, "-o", str(out)]) == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 1
    assert not out.exists()


@pytest.mark.parametrize("options", [["--clean", "-o", "a.gdf"], ["--delete", LEFT, "-o", "a.obj"]])
def test_unsuitable_output_name_is_refused(
    ply: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    options: list[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["edit", str(ply), *options]) == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 1


@pytest.mark.parametrize(
    ("option", "value", "forms"),
    [
        ("--mirror", "all:w", "write --mirror REGION:X, REGION:Y or REGION:Z"),
        ("--scale", "all:1,2", "write --scale REGION:FACTOR or REGION:FX,FY,FZ, 0.001 to 1000"),
        ("--scale", "all:-1", "write --scale REGION:FACTOR or REGION:FX,FY,FZ, 0.001 to 1000"),
    ],
)
def test_refused_transform_names_every_valid_form(
    option: str, value: str, forms: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    save_ply(tmp_path / "scene.ply", random_gaussians(20))
    arguments = ["edit", str(tmp_path / "scene.ply"), option, value, "-o", str(tmp_path / "out.ply")]
    assert main(arguments) == 2
    assert capsys.readouterr().err.strip().endswith(forms)
    assert not (tmp_path / "out.ply").exists()


@pytest.mark.parametrize(
    ("value", "fault"),
    [
        ("all:1,2,3", "6 or 7 finite numbers must follow the region"),
        (":0,0,3,1,0,0", "names no region"),
        ("all:0,0,3,1,0,0,-1", "the radius FALLOFF must be above 0, got -1"),
        ("all:0,0,3,1,0,0,bend=2", "bend is not an option of a pull"),
        ("all:0,0,3,1,0,0,turn=x,30,turn=x,30", "turn is given twice"),
        ("all:0,0,3,1,0,0,turn=w,30", "at most 360 degrees, got w,30"),
        ("all:0,0,3,1,0,0,scale=0", "scale must be one number above 0, got 0"),
    ],
)
def test_refused_pull_names_its_fault(
    ply: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], value: str, fault: str
) -> None:
    assert main(["edit", str(ply), "--pull", value, "-o", str(tmp_path / "out.ply")]) == 2
    line = capsys.readouterr().err.strip()
    assert f"{fault}; write --pull REGION:X,Y,Z,DX,DY,DZ[,FALLOFF]" in line
