"""Small files under the names that the documents use, for tests that run the documents' commands.

All scenes are one bear of the demo, so that cameras, pictures and labels fit each of them. All functions
write to the current folder.
"""

from __future__ import annotations

import importlib.util
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageDraw

from progdf.__main__ import main
from progdf.camera import Camera
from progdf.demo_scenes import DemoScene
from progdf.demo_scenes.bear import LABELS
from progdf.formats.cube import write_cube
from progdf.formats.ply import save_ply
from progdf.formats.scene_file import save_scene
from progdf.gaussians import Gaussians
from progdf.gdf.file import save_gdf
from progdf.io.cameras import load_cameras, save_cameras
from progdf.io.images import write_image
from progdf.io.picture_camera import camera_chunk, find_picture_camera
from progdf.scene.orbit_rig import orbit_rig
from tests.helpers.camera_tables import nerfstudio, written
from tests.helpers.demo_scenes import bear
from tests.helpers.edits import grade_of
from tests.helpers.paths import ROOT
from tests.helpers.trained import label_mask, quick_options, train
from viewer.camera.view_camera import first_camera
from viewer.files import document, session
from viewer.files.session import WindowSession
from viewer.state.view_state import Keyframe, LayerState, Timeline, ViewState

GAUSSIANS = 1000
SCENES = (
    *("robot", "scene", "room", "biker", "bear", "plant", "playbot_31k", "playbot_8k"),
    *("shoes/left", "demo/scene"),
)
EDITS = {
    "runs/blue/blue": "head",
    "runs/hand/hand": "ears",
    "shirt": "scarf",
    "demo/blue/blue": "head",
    "demo/scarf/scarf": "scarf",
}
"""Single .gdf files, and the part that each edits."""
RUNS = {"blue": "head", "hand": "ears", "body": "head", "scarf": "scarf"}
"""Folders of finished runs in runs/, and the part that each edits."""

CATALOGUE = """
[defaults]
views = 4
image-size = 48
steps = 24
stages = 2

[[scenes]]
path = "shoes/left.ply"

[[scenes.edits]]
name = "blue"
region = "labels:shoes/left_labels.npy:1"
editor = "recolor:#3060d0"
"""

METHOD = """
def slider(task):
    return lambda strength: task.scene
"""
"""Module with a method of the suite `sliders`."""


def write_documented_files() -> None:
    """Write scenes, labels, cameras, edits, pictures, a session and a catalogue."""
    demo = bear(GAUSSIANS)
    for folder in ("shoes", "demo", "runs", "assets", "shared"):
        Path(folder).mkdir()
    shutil.copytree(ROOT / "docs", "docs", ignore=shutil.ignore_patterns("*.ipynb"))
    _write_scenes(demo)
    _write_cameras(demo.gaussians)
    for path, part in EDITS.items():
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        edit = grade_of(demo.gaussians, demo.members(part), Path(path).name)
        save_gdf(f"{path}.gdf", edit)
    cleaned = demo.gaussians[torch.arange(GAUSSIANS - 10)]
    save_ply("cleaned.ply", cleaned)
    kept_members = demo.members("head")
    kept_members = kept_members[kept_members < len(cleaned)]
    save_gdf("blue_cleaned.gdf", grade_of(cleaned, kept_members, "blue"))
    write_cube("look.cube", 0.8 * identity_lattice(), "look")
    _write_pictures(demo)
    _write_session(demo.gaussians)
    Path("catalogue.toml").write_text(CATALOGUE, encoding="utf-8")
    Path("my_method.py").write_text(METHOD, encoding="utf-8")
    _write_program()


def train_documented_runs() -> None:
    """Replace the .gdf files in runs/ by finished runs of a few seconds."""
    for name, part in RUNS.items():
        out = Path("runs", name)
        shutil.rmtree(out, ignore_errors=True)
        options = quick_options(Path(), f"runs/{name}", part, steps=24, stages=2, views=10, image_size=48)
        region = replace(options.region, region=f"labels:demo/labels.npy:{LABELS.index(part)}")
        train(replace(options, region=region))


def identity_lattice(side: int = 5) -> torch.Tensor:
    """Return the colors of an identity table, red fastest. [side³,3]"""
    steps = torch.linspace(0.0, 1.0, side)
    blue, green, red = torch.meshgrid(steps, steps, steps, indexing="ij")
    return torch.stack([red, green, blue], dim=-1).reshape(-1, 3)


def _write_program() -> None:
    """Write a stand-in for ImageMagick that turns red, green and blue around by its last number."""
    program = Path("programs", "magick")
    program.parent.mkdir()
    program.write_text(
        f"#!{sys.executable}\n"
        "import sys\n"
        "from PIL import Image\n"
        "source, _, numbers, target = sys.argv[1:]\n"
        "picture = Image.open(source).convert('RGB')\n"
        "red, green, blue = picture.split()\n"
        "turned = Image.merge('RGB', (green, blue, red))\n"
        "Image.blend(picture, turned, float(numbers.split(',')[2]) / 100 - 1).save(target)\n",
        encoding="utf-8",
    )
    program.chmod(0o755)


def _write_scenes(demo: DemoScene) -> None:
    scene = demo.gaussians
    labels = demo.labels.numpy()
    for name in SCENES:
        save_ply(f"{name}.ply", scene)
        np.save(f"{name}_labels.npy", labels)
    np.save("demo/labels.npy", labels)
    np.save("jacket.region.npy", demo.members("scarf").numpy())
    save_scene(Path("robot.sog"), scene)
    save_scene(Path("koala_100k.splat"), scene)
    save_scene(Path("tarot.splat"), scene)
    parts = {
        "means": scene.means,
        "quats": scene.quats,
        "scales": scene.log_scales,
        "opacities": scene.logit_opacities,
    }
    splats = {**parts, "sh0": scene.sh0[:, None], "shN": scene.shN}
    torch.save({"step": 29999, "splats": splats}, "ckpt_29999_rank0.pt")
    named = {**parts, "features_dc": scene.sh0, "features_rest": scene.shN}
    named["opacities"] = scene.logit_opacities[:, None]
    pipeline = {f"_model.gauss_params.{name}": tensor for name, tensor in named.items()}
    torch.save({"step": 29999, "pipeline": pipeline}, "step-000029999.ckpt")


def _write_cameras(scene: Gaussians) -> None:
    cameras = orbit_rig(scene, 8, 64, 48)
    save_cameras("cameras.json", cameras)
    table = nerfstudio(cameras, w=64, h=48, cx=32.0, cy=24.0)
    written(Path("transforms.json"), table)
    if importlib.util.find_spec("pycolmap"):
        _write_colmap_model(Path("colmap/sparse/0"), cameras)


def _write_colmap_model(folder: Path, cameras: list[Camera]) -> None:
    import pycolmap

    model = pycolmap.Reconstruction()
    K = cameras[0].K
    numbers = [float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])]
    lens = pycolmap.Camera(camera_id=1, model="PINHOLE", width=64, height=48, params=numbers)
    model.add_camera_with_trivial_rig(lens)
    for index, camera in enumerate(cameras):
        image = pycolmap.Image(name=f"{camera.name}.jpg", camera_id=1, image_id=index + 1)
        pose = pycolmap.Rigid3d(camera.viewmat[:3].double().numpy())
        model.add_image_with_trivial_frame(image, pose)
    folder.mkdir(parents=True)
    model.write(folder)


def _write_pictures(demo: DemoScene) -> None:
    """Write view.png, A.png with a painted spot, LOGO.png, and V/ with views and masks of the head."""
    _run("render", "biker.ply", "--orbit", "30,15", "--size", "640x480", "-o", "view.png")
    _run("render", "robot.ply", "--orbit", "30,15", "--size", "160x120", "-o", "A.png")
    camera = find_picture_camera(Path("A.png"))
    with Image.open("A.png") as picture:
        painted = picture.convert("RGB")
    ImageDraw.Draw(painted).ellipse((66, 46, 94, 74), "#d02060")
    painted.save("A.png", pnginfo=camera_chunk(camera))
    Image.new("RGBA", (24, 24), "#d02060").save("LOGO.png")
    _run("views", "robot.ply", "--out", "V", "--views", "4", "--image-size", "64")
    is_head = torch.zeros(GAUSSIANS, dtype=torch.bool)
    is_head[demo.members("head")] = True
    for view in load_cameras("V/cameras.json"):
        mask = label_mask(demo.gaussians, is_head, view).float()
        write_image(Path("V", f"{view.name}.png"), mask[..., None].expand(-1, -1, 3))


def _write_session(scene: Gaussians) -> None:
    """Write work.session.json: robot.ply with one edit, whose slider moves over a film of five frames."""
    opened = document.load(Path("robot.ply"), [Path("runs/blue/blue.gdf")])
    keys = (Keyframe(0, ((0, 0.0),)), Keyframe(4, ((0, 1.0),)))
    view = ViewState(
        camera=first_camera(scene),
        layers=(LayerState(0, "blue", 0.5),),
        timeline=Timeline(keys, length=4),
    )
    session.save(Path("work.session.json"), WindowSession(opened, view))


def _run(*words: str) -> None:
    assert main(words) == 0, words
