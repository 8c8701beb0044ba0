"""Tests of scene formats: each returns the written scene within its quantization."""

from __future__ import annotations

import gzip
import json
import subprocess
import sys
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from progdf.__main__ import main
from progdf.cli.info import kind_of
from progdf.errors import ProgdfError
from progdf.formats import scene_file as formats
from progdf.formats.ply import load_ply, save_ply
from progdf.formats.scene_file import (
    load_scene,
    load_scene_with_report,
    morton_order,
    rotate_about_x,
    save_frames,
    save_scene,
    scene_format,
)
from progdf.gaussians import ATTRIBUTES, Gaussians
from progdf.io import native_child
from progdf.quaternions import rotation_matrices
from progdf.rasterize import render
from progdf.sh import rgb_to_sh0, sh0_to_rgb, shade
from tests.helpers.refused import refusal
from tests.helpers.scene_files import write_compressed_ply, write_ksplat, write_scene, write_sog1, write_zip
from tests.helpers.scenes import orbit_camera, random_gaussians

Write = Callable[[Path, Gaussians], Path]


def scene_of(degree: int = 0, count: int = 300) -> Gaussians:
    """Return a scene with colors in 0 to 1, opacities that a byte holds, and unit quaternions."""
    scene = random_gaussians(count, seed=4, sh_degree=degree, scale=0.05)
    rng = torch.Generator().manual_seed(5)
    return replace(
        scene,
        quats=scene.unit_quats,
        log_scales=scene.log_scales.clamp(-8.0, 0.0),
        sh0=rgb_to_sh0(0.1 + 0.8 * torch.rand(count, 3, generator=rng)),
        shN=scene.shN.clamp(-0.9, 0.9),
    )


def saved(path: Path, scene: Gaussians) -> Path:
    """Write a scene with `save_scene`."""
    save_scene(path, scene)
    return path


def zipped(path: Path, scene: Gaussians) -> Path:
    """Write a .ply in a zip archive, as Luma exports it."""
    save_ply(path.with_suffix(".ply"), scene)
    content = path.with_suffix(".ply").read_bytes()
    return write_zip(path, {"luma/scene.ply": content, "__MACOSX/luma/._scene.ply": b"x", ".DS_Store": b"x"})


def gzipped(path: Path, scene: Gaussians) -> Path:
    """Write a scene with .gz after its name."""
    write_scene(path.with_suffix(""), scene)
    path.write_bytes(gzip.compress(path.with_suffix("").read_bytes()))
    return path


WRITERS: dict[str, tuple[Write, str, int]] = {
    "compressed": (write_compressed_ply, "scene.ply", 3),
    "compressed, older": (
        lambda path, scene: write_compressed_ply(path, scene, colors=False),
        "scene.ply",
        0,
    ),
    "ksplat 0": (lambda path, scene: write_ksplat(path, scene, 0), "scene.ksplat", 3),
    "ksplat 1": (lambda path, scene: write_ksplat(path, scene, 1), "scene.ksplat", 1),
    "ksplat 2": (lambda path, scene: write_ksplat(path, scene, 2), "scene.ksplat", 2),
    "splat": (write_scene, "scene.splat", 0),
    "spz 2": (lambda path, scene: write_scene(path, scene, 2), "scene.spz", 3),
    "spz 3": (lambda path, scene: write_scene(path, scene, 3), "scene.spz", 2),
    "spz 4": (lambda path, scene: write_scene(path, scene, 4), "scene.spz", 3),
    "sog": (write_scene, "scene.sog", 3),
    "sog 1": (write_sog1, "scene.sog", 2),
    "zip": (zipped, "scene.zip", 3),
    "gz": (gzipped, "scene.splat.gz", 0),
    "saved compressed": (saved, "scene.compressed.ply", 3),
    "saved splat": (saved, "scene.splat", 0),
    "saved spz": (saved, "scene.spz", 3),
    "saved sog": (saved, "scene.sog", 2),
    "saved glb": (saved, "scene.glb", 3),
}
"""Writer, file name and SH degree of each format."""

MEANS = {"compressed": 4e-3, "compressed, older": 4e-3, "ksplat 1": 4e-4, "ksplat 2": 4e-4}
MEANS |= {"sog 1": 1e-4, "spz 2": 2e-4, "spz 3": 2e-4, "spz 4": 2e-4, "sog": 1e-3}
"""Largest error of a center: half a step over a cloud about 7 units wide. Other formats keep floats."""
SH = {"compressed": 0.017, "ksplat 1": 5e-4, "ksplat 2": 6e-3, "spz 2": 0.07, "spz 3": 0.07, "spz 4": 0.07}
SH |= {"sog": 0.03, "sog 1": 0.01}
for saved_one in ("compressed", "spz", "sog"):
    MEANS[f"saved {saved_one}"] = MEANS.get(saved_one, 2e-4)
    SH[f"saved {saved_one}"] = SH.get(saved_one, 0.07)
"""Largest error of an SH coefficient.

The formats use bytes of −4 to 4, halves, bytes of −1.5 to 1.5, 4 and 5 bits of −1 to 1, and a palette.
"""


@pytest.mark.parametrize("name", WRITERS)
def test_every_format_returns_the_written_scene(name: str, tmp_path: Path) -> None:
    writer, file, degree = WRITERS[name]
    scene = scene_of(degree, 200)
    path = writer(tmp_path / file, scene)
    assert kind_of(path) == "scene"
    found, report = load_scene_with_report(path)
    assert (report.file, report.count, report.sh_degree) == (file, len(scene), degree)
    assert report.file_bytes == path.stat().st_size
    if name in ("sog", "saved sog", "saved compressed"):  # reordered
        nearest = torch.cdist(found.means, scene.means).argmin(dim=1)
        assert len(nearest.unique()) == len(scene)
        scene = scene[nearest]
    assert float((found.means - scene.means).abs().max()) <= MEANS.get(name, 0.0)
    assert float((found.log_scales - scene.log_scales).abs().max()) <= 0.033  # SPZ: half of 1/16
    # SOG 1 keeps a byte of the logit
    assert float((found.opacities - scene.opacities).abs().max()) <= (0.01 if name == "sog 1" else 1.01 / 255)
    assert float((found.sh0 - scene.sh0).abs().max()) <= 0.0142  # a truncated byte of 0 to 1, in band 0
    angles = (found.quats * scene.quats).sum(dim=1).abs().clamp(max=1.0).acos() * 2
    # SPZ 2 keeps x, y and z as bytes, and derives w from them even near 0
    assert float(angles.rad2deg().max()) <= (10.0 if name == "spz 2" else 1.0)
    if degree:
        assert float((found.shN - scene.shN).abs().max()) <= SH.get(name, 1e-6)


@pytest.mark.parametrize(
    "name",
    ["ksplat 1", "spz 4", "sog", "compressed", "saved compressed", "saved spz", "saved sog", "saved glb"],
)
def test_every_format_looks_the_same_from_a_side(name: str, tmp_path: Path) -> None:
    """Render both scenes. A rotated axis, a swapped band or a wrong sign costs tens of dB."""
    writer, file, degree = WRITERS[name]
    scene = scene_of(degree)
    found = load_scene(writer(tmp_path / file, scene))
    camera = orbit_camera(60, 40)
    error = (render(found, camera).image - render(scene, camera).image).square().mean()
    assert -10 * float(error.log10()) > 32.0


def test_half_turn_about_x_rotates_the_appearance() -> None:
    """Check the signs of all bands against the basis: a color seen along d is then seen along d rotated."""
    scene = scene_of(3, 50)
    turned = rotate_about_x(scene)
    turn = torch.tensor([1.0, -1.0, -1.0])
    directions = torch.nn.functional.normalize(scene.sh0, dim=1)
    torch.testing.assert_close(shade(3, directions * turn, turned.sh), shade(3, directions, scene.sh))
    frames, expected = (rotation_matrices(s.quats) * s.scales[:, None] for s in (turned, scene))
    shapes = frames @ frames.mT
    shapes_before = expected @ expected.mT
    torch.testing.assert_close(shapes, shapes_before * turn * turn[:, None])
    assert torch.equal(turned.means, scene.means * turn)


def test_opacity_bytes_of_0_and_255_are_no_damage(tmp_path: Path) -> None:
    logits = torch.full((300,), 15.0)
    logits[:100] = -30.0
    scene = replace(scene_of(), logit_opacities=logits)
    compressed = write_compressed_ply(tmp_path / "a.ply", scene)
    ksplat = write_ksplat(tmp_path / "a.ksplat", scene, 1)
    packed = [write_scene(tmp_path / f"a.{suffix}", scene) for suffix in ("spz", "sog", "splat")]
    for path in (compressed, ksplat, *packed):
        found, report = load_scene_with_report(path)
        assert bool(found.logit_opacities.isfinite().all()), path.name
        assert int((found.logit_opacities > 5.5).sum()) == 200, path.name
        assert int((found.logit_opacities < -5.5).sum()) == 100, path.name
        assert (report.opaque, report.transparent) == (0, 0), path.name


def test_formats_with_an_antialiased_flag_keep_it(tmp_path: Path) -> None:
    spz = write_scene(tmp_path / "a.spz", scene_of())
    content = bytearray(spz.read_bytes())
    content[14] |= 1
    spz.write_bytes(bytes(content))
    with zipfile.ZipFile(write_scene(tmp_path / "a.sog", scene_of())) as archive:
        archive.extractall(tmp_path / "sog")
    meta = tmp_path / "sog" / "meta.json"
    meta.write_text(json.dumps(json.loads(meta.read_text()) | {"model": "antialiased"}))
    ply = write_compressed_ply(tmp_path / "a.ply", scene_of(), "SplatRenderMode: mip")
    for path in (spz, meta, ply):
        scene, report = load_scene_with_report(path)
        assert scene.antialiased, path
        assert report.antialiased, path


def test_content_overrides_the_file_name(tmp_path: Path) -> None:
    scene = scene_of()
    for file, written in (("spz", "a.spz"), ("sog", "b.sog")):
        path = write_scene(tmp_path / written, scene).rename(tmp_path / f"{file}.dat")
        assert scene_format(path) == file
    (tmp_path / "c.splat").write_bytes(b'{"' + bytes(30))  # a first coordinate that reads as JSON
    assert kind_of(tmp_path / "c.splat") == "scene"
    (tmp_path / "cameras.spz").write_text('[{"id": 0}]')
    assert kind_of(tmp_path / "cameras.spz") == "cameras"


def test_info_and_export_name_the_source_format(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = write_scene(tmp_path / "a.spz", scene_of(1))
    assert main(["info", str(path)]) == 0
    assert ".spz 4, turned from y up to y down" in capsys.readouterr().out
    assert main(["export", str(path), "--out", str(tmp_path / "b.ply")]) == 0
    assert "a.spz is a .spz, this is a plain .ply" in capsys.readouterr().out
    assert torch.equal(load_ply(tmp_path / "b.ply").means, load_scene(path).means)


def test_reader_that_crashes_hangs_or_is_missing_is_reported_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write_scene(tmp_path / "a.spz", scene_of())
    script = tmp_path / "child.py"
    monkeypatch.setattr(native_child, "__file__", str(script))
    monkeypatch.setattr(formats, "TIME_LIMIT_S", (1, 0.0))
    for body, said in (
        ("import os; os.kill(os.getpid(), 11)", "crashed (SIGSEGV)"),
        ("import time; time.sleep(60)", "did not finish within 2 s"),
        ("raise SystemExit(3)", "reported nothing"),
        (
            "import sys; sys.stderr.write('bad \\x1b[2J\\nworse \\x1b]0;x\\x07'); sys.exit(3)",
            "reported: worse",
        ),
        ("pass", "reported nothing"),
        ("import sys; open(sys.argv[8], 'w').write('ply')", "returned no scene"),
    ):
        script.write_text(body)
        message = refusal(load_scene, path)
        assert said in message, message
        assert message.isprintable()
    monkeypatch.setattr(formats.importlib.util, "find_spec", lambda name: None)
    assert "pip install 'progdf-studio[formats]'" in refusal(load_scene, path)


@pytest.mark.parametrize(("name", "extra"), [("a.spz", "formats"), ("a.splat", "formats"), ("a.usdc", "usd")])
def test_missing_package_error_names_the_extra(
    tmp_path: Path, name: str, extra: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(formats.importlib.util, "find_spec", lambda module: None)
    path, scene = tmp_path / name, random_gaussians(3)
    for write in (lambda: save_scene(path, scene), lambda: save_frames(path, [scene, scene])):
        with pytest.raises(ProgdfError, match=rf"^[^\n]*\[{extra}\]'$") as caught:
            write()
        assert ".progdf-" not in str(caught.value)
    assert not list(tmp_path.iterdir())


def test_reader_memory_is_limited_by_the_need_of_the_file(tmp_path: Path) -> None:
    """Request 1 GB beyond the limit, which is refused in one line without allocating it."""
    script = tmp_path / "greedy.py"
    line = "    path = Path(source)\n"
    own = Path(native_child.__file__).read_text()
    script.write_text(own.replace(line, f"    bytes(1 << 30)\n{line}"))
    limits = map(str, (1 << 30, 1_000_000, 10))
    words = [sys.executable, "-P", str(script), *limits, "convert", "splat", "missing", "ply", "out"]
    ended = subprocess.run(words, capture_output=True, text=True, check=False)
    assert ended.returncode == 3
    assert ended.stderr.startswith("MemoryError")


def test_compressed_ply_is_the_scene_in_morton_order(tmp_path: Path) -> None:
    """Compare with the reference writer of the tests, which writes the same values one column at a time."""
    scene = replace(scene_of(3, 600), antialiased=True)
    ordered = scene[morton_order(scene.means)]
    save_scene(tmp_path / "a.compressed.ply", scene)
    ours = load_scene(tmp_path / "a.compressed.ply")
    plain = load_scene(write_compressed_ply(tmp_path / "b.ply", ordered))
    assert ours.antialiased
    for name in ATTRIBUTES:
        steps = {
            "means": 4e-3,
            "log_scales": 8e-3,
            "logit_opacities": 0.3,
            "sh0": 0.014,
            "shN": 0.04,
            "quats": 2.0,
        }
        assert float((getattr(ours, name) - getattr(plain, name)).abs().max()) <= steps[name], name
    step = (ordered.means[1:] - ordered.means[:-1]).norm(dim=1).mean()
    assert float(step) < 0.5 * float((scene.means[1:] - scene.means[:-1]).norm(dim=1).mean())


def test_usd_has_values_of_every_step_and_stores_constants_once(tmp_path: Path) -> None:
    Usd = pytest.importorskip("pxr.Usd", reason="pip install progdf-studio[usd]")
    scene = scene_of(2)
    steps = [scene, scene, replace(scene, sh0=scene.sh0 + 0.1), replace(scene, sh0=scene.sh0 + 0.2)]
    (path,) = save_frames(tmp_path / "a.usdc", iter(steps))
    stage = Usd.Stage.Open(str(path))
    prim = stage.GetPrimAtPath("/Gaussians")
    sh = prim.GetAttribute("radiance:sphericalHarmonicsCoefficients")
    assert prim.GetTypeName() == "ParticleField3DGaussianSplat"
    assert [prim.GetAttribute(n).GetNumTimeSamples() for n in ("positions", "scales", "opacities")] == [
        0,
        0,
        0,
    ]
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (0.0, 3.0)
    for time, step in enumerate(map(rotate_about_x, steps)):
        stored = torch.tensor(np.array(sh.Get(time))).reshape(len(step), -1, 3)
        assert torch.equal(stored, torch.cat([step.sh0[:, None], step.shN], dim=1))
    assert torch.equal(torch.tensor(np.array(prim.GetAttribute("positions").Get())), step.means)
    real = prim.GetAttribute("orientations").Get()[7].real
    imaginary = prim.GetAttribute("orientations").Get()[7].imaginary
    assert torch.allclose(torch.tensor([real, *imaginary]), step.unit_quats[7])


def checkpoints(scene: Gaussians) -> dict[str, object]:
    """Return checkpoints as gsplat and nerfstudio's splatfacto save them, with and without bands."""
    splats = {"means": scene.means, "quats": scene.quats, "scales": scene.log_scales}
    colors = {"features_dc": scene.sh0, "features_rest": scene.shN}
    model = splats | {"opacities": scene.logit_opacities[:, None]} | colors
    flat = model | {
        "features_dc": sh0_to_rgb(scene.sh0).logit(),
        "features_rest": torch.zeros(len(scene), 0, 3),
    }
    more = {"_model.camera_optimizer.pose_adjustment": torch.zeros(2, 6)}

    def nerfstudio(model: dict[str, torch.Tensor]) -> dict[str, object]:
        return {"step": 3, "pipeline": {f"_model.gauss_params.{n}": t for n, t in model.items()} | more}

    bands = {"sh0": scene.sh0[:, None], "shN": scene.shN}
    gsplat = {"step": 3, "splats": splats | {"opacities": scene.logit_opacities} | bands}
    return {"gsplat.pt": gsplat, "nerfstudio.ckpt": nerfstudio(model), "flat.ckpt": nerfstudio(flat)}


def test_checkpoints_open_as_scenes(tmp_path: Path) -> None:
    scene = scene_of(2)
    for name, content in checkpoints(scene).items():
        torch.save(content, tmp_path / name)
        assert kind_of(tmp_path / name) == "scene"
        found = load_scene(tmp_path / name)
        assert torch.allclose(found.sh0, scene.sh0, atol=0.0 if name != "flat.ckpt" else 1e-5), name
        assert found.sh_degree == (0 if name == "flat.ckpt" else 2)
        for part in ("means", "quats", "log_scales", "logit_opacities"):
            assert torch.equal(getattr(found, part), getattr(scene, part)), (name, part)


class Evil:
    """Object whose unpickling runs code."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[object, ...]:
        return Path.touch, (self.path,)


def test_checkpoint_runs_no_code_and_other_files_are_refused(tmp_path: Path) -> None:
    whole = checkpoints(scene_of(1))["gsplat.pt"]
    cases = {
        "code.pt": (
            {"splats": Evil(tmp_path / "touched")},
            "more than weights (it would run __builtin__.getattr",
        ),
        "other.ckpt": ({"pipeline": {"_model.field.weight": torch.zeros(3)}}, "it holds no means"),
        "list.pt": ([1, 2], "it holds no means"),
        "shape.pt": ({"splats": whole["splats"] | {"means": torch.zeros(5, 2)}}, "'means' of shape 5×2"),  # type: ignore[index]
    }
    for name, (content, said) in cases.items():
        torch.save(content, tmp_path / name)
        assert said in refusal(load_scene, tmp_path / name), name
    torch.save(whole, tmp_path / "cut.pt")
    (tmp_path / "cut.pt").write_bytes((tmp_path / "cut.pt").read_bytes()[:5000])
    assert "is damaged" in refusal(load_scene, tmp_path / "cut.pt")
    assert not (tmp_path / "touched").exists()


def test_frames_are_numbered_scenes(tmp_path: Path) -> None:
    scene = scene_of()
    paths = save_frames(tmp_path / "turn.compressed.ply", (scene[: 300 - n] for n in range(3)))
    assert [path.name for path in paths] == [f"turn_{n:03d}.compressed.ply" for n in range(3)]
    assert [len(load_scene(path)) for path in paths] == [300, 299, 298]


@pytest.mark.slow
@pytest.mark.parametrize("name", WRITERS)
def test_damaged_files_give_an_error_or_a_drawable_scene(name: str, tmp_path: Path) -> None:
    """Cut the file or flip bits: it gives one line with the file's name, or finite values."""
    writer, file, degree = WRITERS[name]
    whole = writer(tmp_path / file, scene_of(degree, 70)).read_bytes()
    rng = np.random.default_rng(6)
    own = name.startswith(("compressed", "ksplat", "saved glb"))  # our readers take a millisecond each
    refused = 0
    for trial in range(200 if own else 16):
        broken = bytearray(whole)
        if trial % 2:
            broken = broken[: int(rng.integers(0, len(whole)))]
        else:
            top = len(whole) if trial % 4 else min(4400, len(whole))  # mostly headers
            for at in rng.integers(0, top, 1 + trial % 7):
                broken[at] ^= 1 << int(rng.integers(0, 8))
        (tmp_path / file).write_bytes(bytes(broken))
        message, scene = _attempt(tmp_path / file)
        if scene is None:
            refused += 1
            assert message.isprintable(), (trial, message)
            assert file in message, (trial, message)
        else:
            for tensor in (scene.means, scene.log_scales, scene.logit_opacities, scene.sh0, scene.shN):
                assert bool(tensor.isfinite().all()), trial
    assert refused > 3


def _attempt(path: Path) -> tuple[str, Gaussians | None]:
    try:
        return "", load_scene_with_report(path)[0]
    except ProgdfError as error:
        return str(error), None
