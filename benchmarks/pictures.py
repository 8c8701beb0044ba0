"""The benchmark `pictures`: color edits solved from one, two and four pictures, evaluated in the other views.

The truth is painted in 3D, so that every picture of the edit is known. A small number of a rig's pictures are
given and all others are compared. The region is label 1 of SCENE_labels.npy beside the scene, or the whole
scene.

    python -m benchmarks pictures --scenes SCENE.ply
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import torch
from torch.nn.functional import normalize

from progdf.errors import ProgdfError
from progdf.field.grade import band_offsets
from progdf.formats.scene_file import load_scene
from progdf.gaussians import pack
from progdf.metrics.image import decibels
from progdf.region import from_mask
from progdf.scene.regions import parse_region
from progdf.scene.up_axis import find_up
from trainer.editors import make_editor
from trainer.optimize.color_solver import choose_model, make_solver, split_solver
from trainer.optimize.color_views import add_bands, color_views
from trainer.optimize.ties import surface_ties
from trainer.options import EditorOptions
from trainer.store.run_folder import quantize_image
from trainer.views.crops import crop_scene
from trainer.views.view import (
    BACKGROUND,
    crop,
    make_view,
    name_cameras,
    region_rig,
    render_view,
    with_near_plane,
)

from .table import Table, mean_worst

EDITS = (
    ("stripes:#20a040", "all"),
    ("recolor:#3060d0", "all"),
    ("recolor:#3060d0", "right half"),
    ("recolor:#3060d0", "upper half"),
)
"""Editor and painted part of the region."""

RIG = 36  # cameras
SIZE = 256  # pixels of the compared pictures
LARGE = 512  # pixels of the given pictures
STEPS = 100  # steps of conjugate gradients
GIVEN = ((0,), (9,), (0, 18), (0, 9, 18, 27))
"""Sets of given pictures, by their index in the rig; 0 is the front."""

DEGREES = (0, 30, 75, 120, 180)  # limits of the angle to the nearest given picture

NOTE = (
    f"A rig of {RIG} cameras around the region. The given pictures have {LARGE} pixels. The other views, of "
    f"{SIZE} pixels, are evaluated: PSNR over the pixels that show the region, by degrees from the nearest "
    "given picture, mean / worst. Seconds: processor time of the solver."
)


def tables(scenes: Sequence[Path] = ()) -> list[Table]:
    """Measure each edit from each set of pictures.

    Raises:
        ProgdfError: no scene is named, or one cannot be read.
    """
    if not scenes:
        raise ProgdfError("pictures need a scene; name one with --scenes")
    rows = [row for path in scenes for edit, part in EDITS for row in _rows(path, edit, part)]
    degrees = (f"{begin + (begin > 0)}-{end}°, dB" for begin, end in pairwise(DEGREES))
    columns = ("scene, edit", "pictures", *degrees, "s")
    return [Table("pictures", "Edits from one picture and from a few", columns, tuple(rows), NOTE)]


def _rows(path: Path, edit: str, part: str) -> list[tuple[str, ...]]:
    scene = load_scene(path)
    labels = path.with_name(f"{path.stem}_labels.npy")
    region = parse_region(f"labels:{labels}:1" if labels.is_file() else "all", scene)
    up = find_up(scene, (), "auto").direction
    background = torch.tensor(BACKGROUND)
    cameras = with_near_plane(name_cameras(region_rig(scene, region, RIG, SIZE, up)), scene)
    views = [make_view(scene, region, camera, background) for camera in cameras]
    center = scene.means[region.members].mean(dim=0)
    toward = normalize(torch.stack([camera.position - center for camera in cameras]), dim=1)
    sides = {"right half": torch.linalg.cross(up, toward[0]), "upper half": up}
    side = (scene.means - center) @ sides.get(part, up) > (0.0 if part in sides else -math.inf)
    painted = from_mask(part, region.mask & side)
    canvases = [make_view(scene, painted, camera, background) for camera in cameras]
    editor = make_editor(EditorOptions(edit), scene, painted, canvases)
    original = pack(scene[region.members], with_shN=scene.sh_degree > 0)
    truth = [editor.edit(view, 1.0) for view in canvases]
    rows = []
    for given in GIVEN:
        large_cameras = [cameras[i].resize(LARGE, LARGE) for i in given]
        large = [make_view(scene, painted, large_camera, background) for large_camera in large_cameras]
        edited = [quantize_image(editor.edit(view, 1.0)) for view in large]
        large = [make_view(scene, region, large_camera, background) for large_camera in large_cameras]
        large = [view.widen([picture]) for view, picture in zip(large, edited, strict=True)]
        began = time.process_time()
        crops = [crop_scene(scene, region.members, v.camera, v.box, background, True) for v in large]
        ties = surface_ties(scene, region.members, [view.camera for view in large])
        solver = make_solver(color_views(crops, original), original, ties)
        targets = [crop(picture, view.box) for view, picture in zip(large, edited, strict=True)]
        trial = split_solver(solver, targets)
        solver, model = choose_model(solver, trial, targets, STEPS, 1)
        change = add_bands(solver.fit_map(model.degree, targets)[1], model.residual)
        offsets = band_offsets(change, original.shape[1])
        seconds = time.process_time() - began
        solved = scene.replace_rows(region.members, original + offsets)
        psnrs: dict[int, list[float]] = {end: [] for end in DEGREES[1:]}
        for i, view in enumerate(views):
            evaluated = view.mask > 0.05
            if i in given or not bool(evaluated.any()):
                continue
            rendered = render_view(solved, view.camera, background).clamp(0.0, 1.0)
            error = decibels(float((rendered - truth[i])[evaluated].square().mean()))
            angle = math.degrees(math.acos(min(1.0, max(float(toward[i] @ toward[k]) for k in given))))
            psnrs[next(end for end in DEGREES[1:] if angle <= end)].append(error)
        numbers = ", ".join(str(i) for i in given)
        edit_name = edit if part == "all" else f"{edit}, {part}"
        rows.append(
            (f"{path.stem}, {edit_name}", numbers, *map(mean_worst, psnrs.values()), f"{seconds:.1f}")
        )
    return rows
