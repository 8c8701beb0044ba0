"""Build the examples of the start page: our own scenes as compressed .ply files, with edits trained on them.

usage: python assets/examples.py FOLDER      (trains in FOLDER, then writes viewer/examples/)
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import msgspec
from PIL import Image

sys.path.insert(0, str(Path(__file__).parents[1]))
from progdf.cli.edit import main as edit
from progdf.demo_scenes import DemoScene
from progdf.formats.packed.compressed_ply import morton_order, write_compressed_ply
from progdf.formats.scene_file import load_scene
from progdf.gdf.header import pack_file, unpack_file
from progdf.io.bundle import BUNDLE, write_bundle
from progdf.io.cameras import load_cameras
from progdf.io.session import SUFFIX
from trainer.run import demo
from viewer.camera.view_camera import Vec3, bounds_of, first_camera, from_camera
from viewer.files import document, session
from viewer.files.session import WindowSession
from viewer.files.user_files import THUMBNAIL_SIZE
from viewer.pictures.film import to_pixels
from viewer.render.engine import ViewEngine
from viewer.state.timeline import slider_film
from viewer.state.view_state import LayerState, ViewState

EXAMPLES = Path(__file__).parents[1] / "viewer" / "examples"
SIZES = {"bear": 24_000, "room": 30_000}
STRENGTHS = {"frost": 0.55, "scarf": 1.0, "dusk": 0.6, "rug": 1.0, "big head": 0.7, "twin": 1.0}
"""Initial strengths in an example, by name of the edit. Other edits start at 0."""


def light(make: Callable[[int, int], DemoScene], file: Path) -> Callable[[int, int], DemoScene]:
    """Return a scene maker whose scene went through a compressed .ply.

    The new maker writes the scene to `file` and returns it with the rounded values and row order of that
    file.
    """

    def make_light(size: int, seed: int) -> DemoScene:
        scene = make(size, seed)
        rows = morton_order(scene.gaussians.means)
        file.parent.mkdir(parents=True, exist_ok=True)
        write_compressed_ply(file, scene.gaussians[rows])
        return replace(scene, gaussians=load_scene(file), labels=scene.labels[rows])

    return make_light


def train(name: str, folder: Path) -> list[Path]:
    """Train the edits of one demo scene and return their files. Edits that exist already are reused."""
    show = demo.SHOWS[name]
    edits = [folder / edit.name / f"{edit.name}.gdf" for edit in show.edits]
    if not all(edit.is_file() for edit in edits):
        demo.SHOWS[name] = replace(show, make=light(show.make, folder / f"{name}.compressed.ply"))
        demo.main(["--scene", name, "--size", str(SIZES[name]), "--out", str(folder), "--no-window"])
    return edits


def tidy(folder: Path) -> list[Path]:
    """Make edits of the bear's shape with `progdf edit`, without training."""
    names = demo.SHOWS["bear"].make(2000, 0).label_names
    head, bear, scarf = (
        f"labels:{folder / 'labels.npy'}:" + ",".join(str(names.index(part)) for part in parts)
        for parts in (("head", "ears"), ("body", "head", "ears", "arms", "legs", "scarf"), ("scarf",))
    )
    words = {
        "big head": ("--scale", f"{head}:1.35", "--move", f"{head}:0,0.1,0"),
        "twin": ("--duplicate", f"{bear}:1.0,0,-0.35"),
        "no scarf": ("--delete", scarf),
    }
    files = [folder / f"{name}.gdf" for name in words]
    for file, options in zip(files, words.values(), strict=True):
        edit([str(folder / "bear.compressed.ply"), "-o", str(file), *options])
    return files


def without_folder(file: Path, folder: Path) -> Path:
    """Copy an edit beside the scene, without the path of the folder in which it was made."""
    header, tensors = unpack_file(file.read_bytes(), file.name)
    text = msgspec.json.encode(msgspec.structs.replace(header, sha256="")).replace(f"{folder}/".encode(), b"")
    (folder / "plain").mkdir(exist_ok=True)
    plain = folder / "plain" / file.name
    plain.write_bytes(pack_file(msgspec.json.decode(text, type=type(header)), tensors))
    return plain


def write(name: str, scene: Path, edits: Sequence[Path], background: Vec3, film: bool = False) -> None:
    """Write NAME.progdf.zip and NAME.jpg from a compressed scene and its edits.

    Args:
        film: add a timeline that moves all sliders in turn
    """
    opened = document.load(scene, [without_folder(file, scene.parent) for file in edits])
    layers = tuple(LayerState(i, gdf.name, STRENGTHS.get(gdf.name, 0.0)) for i, gdf in enumerate(opened.gdfs))
    camera = first_camera(opened.scene, up=opened.detected_up.direction)
    if name == "room":
        stands = load_cameras(scene.with_name("cameras.json"), opened.scene.origin)[0]
        camera = from_camera(camera, stands, bounds_of(opened.scene))
    view = ViewState(camera=camera, layers=layers, background=background, grid=False)
    if film:
        view = replace(view, timeline=slider_film(view, range(len(layers)), 24, 2.0))
    EXAMPLES.mkdir(exist_ok=True)
    file = scene.with_name(f"{name}{SUFFIX}")
    session.save(file, WindowSession(opened, view))
    write_bundle(EXAMPLES / f"{name}{BUNDLE}", file)
    pixels = to_pixels(ViewEngine(None, opened.scene, opened.gdfs).image(view, THUMBNAIL_SIZE))
    Image.fromarray(pixels).save(EXAMPLES / f"{name}.jpg", quality=88)


def main(folder: Path) -> None:
    """Build all examples."""
    for name in SIZES:
        edits = train(name, folder / name)
        scene = folder / name / f"{name}.compressed.ply"
        background = demo.SHOWS[name].make(2000, 0).background
        write(name, scene, edits, background)
        if name == "bear":
            write("play", scene, tidy(folder / name), background, film=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
