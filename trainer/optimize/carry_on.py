"""Decision on the parts of a region that no picture shows.

An edit from a few pictures either ends where the pictures end, or its color map is carried on over the whole
region. The second is a guess. It is judged in two steps:

1. Share of the visible change that one color map explains, on held-out tiles of the pictures. Below a half,
   the map is nearer to the original than to the picture, for example if only a part of a color was painted.
2. Views from behind, in which the map alone recolors the region. They are compared with the picture: no
   speckle of changed and unchanged pixels beyond that of the picture, and no chroma outside the hull of the
   original and the painted colors. If unseen members change almost nothing there, there is nothing to carry
   on.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import ConvexHull, QhullError
from torch import Tensor

from progdf.camera import Camera
from progdf.color.oklab import srgb_to_oklab
from progdf.field.baked import MONOMIALS
from progdf.field.grade import band_offsets, map_colors, member_bands
from progdf.gaussians import Gaussians, pack
from progdf.io.atomic import atomic_write
from progdf.io.images import to_picture
from progdf.io.picture_camera import camera_chunk
from progdf.quaternions import rotate_vectors
from trainer.options import CarryOn
from trainer.regions.from_pictures import CHANGED
from trainer.views.setup import TrainingSetup
from trainer.views.view import make_view, render_view

from .color_solver import Solver, make_solver, split_solver
from .color_views import ColorView
from .ties import surface_ties

MIN_EXPLAINED = 0.5
"""Minimum share of the visible change that the map explains: the map is nearer to the picture than to the
original."""

MAX_SPECKLE = 0.05
"""Maximum share of the region's pixels that may be speckle behind, beyond that of the picture.

It is about one odd pixel in every window of the median, from which speckle looks like a texture.
"""

MAX_NEW_COLORS = 0.01
"""Maximum share of the changed pixels behind that may have a new color.

As one patch, its side is a tenth of the region's: the smallest patch that is noticed as a spot.
"""

HULL_MARGIN = 1 / 3
"""Distance outside the hull up to which a color counts as known, as a share of the painted change.

Recolors of objects from one picture reach 0.30, because the other sides are brighter or darker.
"""

MIN_REACH = 0.1
"""Minimum number of pixels behind that unseen members change, as a share of the painted pixels.

Fewer are a border around the painted area, which the picture's own edit fades out over.
"""

BEHIND_DEG = (120.0, 180.0, 240.0)
"""Angles of the judged views around the region, degrees; the middle one is straight from behind."""

_CHANGED_COLOR = 0.06  # color difference from which a pixel counts as changed
_MEDIAN_PX = 5  # window of the median that removes speckle
_INSIDE = 0.5  # share of a pixel from which it belongs to the region


@dataclass(frozen=True)
class CarryRequest:
    """Request for the parts of a region that no picture shows."""

    choice: CarryOn = "auto"  # the option `--carry-on`
    region: str = ""  # the option `--region`


@dataclass(frozen=True)
class BehindJudgement:
    """Comparison of the carried edit from behind with the picture."""

    speckle: float  # share of the region's pixels that a median of the change flips, at most over the views
    speckle_in_picture: float  # the same in the pictures
    new_colors: float  # share of the changed pixels with a color outside the hull
    reach: float  # pixels that unseen members change, at most over the views, as a share of the painted ones

    @property
    def obstacle(self) -> str:
        """Reason against the carried edit; "" if there is none."""
        if self.reach < MIN_REACH:
            return "the map would change almost nothing from behind"
        if self.speckle > self.speckle_in_picture + MAX_SPECKLE:
            return (
                f"from behind {100 * self.speckle:.0f} % of the region would be speckled "
                f"({100 * self.speckle_in_picture:.0f} % in the picture)"
            )
        if self.new_colors > MAX_NEW_COLORS:
            return (
                f"from behind {100 * self.new_colors:.0f} % of the change would have colors that neither the "
                "original nor the picture has"
            )
        return ""


@dataclass(frozen=True)
class CarryDecision:
    """Decision on the parts that no picture shows, with its measures."""

    carries: bool
    explained: float  # share of the visible change that the map explains, 0 to 1
    behind: BehindJudgement | None  # None if the map does not explain enough
    shown: int  # members that a picture shows
    unseen: int  # the other members of the region
    reason: str

    @property
    def obstacle(self) -> str:
        """Reason why the map is not used for them; "" if there is none."""
        if self.explained < MIN_EXPLAINED:
            return f"less than {100 * MIN_EXPLAINED:.0f} % of the visible change is explained"
        return "" if self.behind is None else self.behind.obstacle

    @property
    def line(self) -> str:
        """Log line of the decision."""
        explained = f"one color map explains {100 * self.explained:.0f} % of the visible change"
        unseen = f"{self.unseen} of {self.shown + self.unseen} members that no picture shows"
        if self.carries:
            return f"{explained}; the {unseen} follow it, which is a guess ({self.reason})"
        return f"{explained}; the {unseen} keep their color ({self.reason})"

    def figures(self) -> dict[str, Any]:
        """Return the figures for report.json."""
        return {
            "carried": self.carries,
            "explained": round(self.explained, 3),
            "from_pictures": self.shown,
            "guessed": self.unseen if self.carries else 0,
            "unchanged": 0 if self.carries else self.unseen,
            "reason": self.reason,
            "behind": None if self.behind is None else asdict(self.behind),
            # the color map may be carried on, but is not
            "offered": not self.carries and not self.obstacle and self.unseen > 0,
        }


def is_found(region: str) -> bool:
    """Return True if a region is found from changed pictures, see `CHANGED`."""
    return re.match(rf"\s*{CHANGED}\b", region) is not None


def make_tied_solver(
    request: CarryRequest,
    setup: TrainingSetup,
    drawn: Sequence[ColorView],
    targets: Sequence[Tensor],
    edited: Sequence[Tensor],
    say: Callable[[str], None],
) -> tuple[Solver, CarryDecision]:
    """Return the solver for a few pictures, limited to the decided extent, and the decision.

    Args:
        request: see `CarryRequest`
        setup: scene, region and the views of the pictures
        drawn: these views as functions of the members' colors
        targets: finished edit in them
        edited: finished edit of the whole views. [H,W,3] each
        say: receives log lines
    """
    scene = setup.scene
    members = setup.region.members
    cameras = [view.camera for view in setup.train]
    original = pack(scene[members], with_shN=scene.sh_degree > 0)
    ties = surface_ties(scene, members, cameras)
    solver = make_solver(drawn, original, ties)
    decision = decide_carry_on(request, setup, solver, targets, edited)
    say(decision.line)
    if decision.carries:
        return solver, decision
    changes = [picture - view.image for view, picture in zip(setup.train, edited, strict=False)]
    ties, line = ties.end_at_pictures(scene, members, cameras, changes)
    say(line)
    return make_solver(drawn, original, ties), decision


def decide_carry_on(
    request: CarryRequest,
    setup: TrainingSetup,
    solver: Solver,
    targets: Sequence[Tensor],
    edited: Sequence[Tensor],
) -> CarryDecision:
    """Decide on the parts of the region that no picture shows.

    Args:
        request: see `CarryRequest`
        setup: scene, region and the views of the pictures
        solver: solver with ties that reach the whole region
        targets: finished edit in the solver's views
        edited: finished edit of the whole views. [H,W,3] each
    """
    explained, degree = _explained_share(solver, targets)
    behind = None
    ties = solver.ties
    assert ties is not None
    visible = ties.clear if ties.covered is None else ties.clear & ~ties.covered
    if explained >= MIN_EXPLAINED and degree:
        members = setup.region.members
        change = solver.fit_map(degree, targets)[1]
        hidden_change = change * ~visible[:, None, None]
        carried, hidden = (
            _with_colors(setup.scene, members, solver.original, each) for each in (change, hidden_change)
        )
        behind = _judge_behind(setup, carried, hidden, edited)
    shown = int(visible.sum())
    decision = CarryDecision(False, explained, behind, shown, len(visible) - shown, "")
    choice = request.choice
    if choice != "auto":
        return replace(decision, carries=choice == "always", reason=f"--carry-on {choice}")
    if is_found(request.region):
        reason = decision.obstacle or "the map passed the test, so --carry-on always can continue it"
        return replace(decision, reason=f"the region is found from the picture; {reason}")
    if decision.obstacle:
        return replace(decision, reason=decision.obstacle)
    return replace(decision, carries=True, reason="no speckle and no new colors from behind")


def _explained_share(solver: Solver, targets: Sequence[Tensor]) -> tuple[float, int]:
    """Return the share of the squared visible change that the best map explains, and its degree (0: none)."""
    trial, judge = split_solver(solver, targets)
    unedited = judge.error(torch.zeros_like(trial.sh))
    errors = {degree: judge.error(trial.fit_map(degree, targets)[1]) for degree in MONOMIALS}
    degree = min(errors, key=lambda one: errors[one])
    share = 1.0 - errors[degree] / unedited
    return (share, degree) if share > 0.0 else (0.0, 0)


def _with_colors(scene: Gaussians, members: Tensor, rows: Tensor, change: Tensor) -> Gaussians:
    """Return the scene with a change of the members' SH coefficients. [M], [M,C], [M,B,3]"""
    return scene.replace_rows(members, rows + band_offsets(change, rows.shape[1]))


def draw_behind(setup: TrainingSetup, table: Tensor, degree: int, path: Path) -> None:
    """Write the picture from behind of the region under a color map, with its camera.

    Args:
        setup: scene, region and the views of the pictures
        table: the color map. [K,3]
        degree: its degree
        path: .png file
    """
    scene = setup.scene
    members = setup.region.members
    rows = pack(scene[members], with_shN=scene.sh_degree > 0)
    bands = member_bands(rows)
    change = map_colors(bands, table, degree) - bands
    camera = behind_cameras(setup)[len(BEHIND_DEG) // 2]
    image = render_view(_with_colors(scene, members, rows, change), camera, setup.background)
    chunk = camera_chunk(camera, origin=scene.origin)
    with atomic_write(path) as temporary_file:
        to_picture(image.clamp(0.0, 1.0)).save(temporary_file, "PNG", pnginfo=chunk)


def behind_cameras(setup: TrainingSetup) -> list[Camera]:
    """Return the first picture's camera, turned around the region by the angles of `BEHIND_DEG`."""
    camera = setup.train[0].camera
    center = setup.scene.means[setup.region.members].double().mean(dim=0)
    up = -camera.viewmat[1, :3].double() if setup.up is None else setup.up.direction.double()
    return [turn_camera(camera, center, up, degrees) for degrees in BEHIND_DEG]


def turn_camera(camera: Camera, pivot: Tensor, axis: Tensor, degrees: float) -> Camera:
    """Return a camera turned around an axis through a pivot. [3] float64 each"""
    pose = torch.linalg.inv(camera.viewmat.double())
    half = 0.5 * math.radians(degrees)
    turn = torch.cat([torch.tensor([math.cos(half)]).double(), math.sin(half) * axis / axis.norm()])
    turned = pose.clone()
    turned[:3, :3] = rotate_vectors(pose[:3, :3].T, turn[None]).T
    turned[:3, 3] = pivot + rotate_vectors((pose[:3, 3] - pivot)[None], turn[None])[0]
    return replace(camera, viewmat=torch.linalg.inv(turned).float(), name=f"behind{degrees:.0f}")


def _judge_behind(
    setup: TrainingSetup, carried: Gaussians, hidden: Gaussians, edited: Sequence[Tensor]
) -> BehindJudgement:
    """Judge the carried edit in views from behind, see the module docstring.

    Args:
        setup: scene, region and the views of the pictures
        carried: the scene under the map
        hidden: the scene under the map, where no picture shows the members
        edited: finished edit of the whole views. [H,W,3] each
    """
    known = list[NDArray[np.float64]]()
    sizes = list[NDArray[np.float64]]()
    in_picture = 0.0
    for view, picture in zip(setup.train, edited, strict=False):
        inside = view.mask > _INSIDE
        painted = inside & _is_changed(picture - view.image)
        known += [_chroma(picture, inside), _chroma(view.image, inside)]
        sizes.append(np.linalg.norm(_chroma(picture, painted) - _chroma(view.image, painted), axis=1))
        in_picture = max(in_picture, _speckle(picture - view.image, inside))
    change = np.concatenate(sizes)
    speckle = 0.0
    most = 0
    shown = list[NDArray[np.float64]]()
    for camera in behind_cameras(setup):
        view = make_view(setup.scene, setup.region, camera, setup.background)
        image = render_view(carried, camera, setup.background).clamp(0.0, 1.0)
        inside = view.mask > _INSIDE
        changed = inside & _is_changed(image - view.image)
        known.append(_chroma(view.image, inside))
        shown.append(_chroma(image, changed))
        reached = render_view(hidden, camera, setup.background).clamp(0.0, 1.0) - view.image
        most = max(most, int(_is_changed(reached).sum()))
        speckle = max(speckle, _speckle(image - view.image, inside))
    typical = float(np.median(change)) if len(change) else 0.0
    new_colors = _share_of_new_colors(np.concatenate(shown), np.concatenate(known), typical)
    reach = most / max(1, len(change))
    return BehindJudgement(round(speckle, 4), round(in_picture, 4), round(new_colors, 4), round(reach, 4))


def _is_changed(change: Tensor) -> Tensor:
    """Return the visibly changed pixels. [H,W,3] -> [H,W] bool"""
    return change.abs().amax(dim=2) > _CHANGED_COLOR


def _chroma(image: Tensor, pixels: Tensor) -> NDArray[np.float64]:
    """Return a and b in OKLab of some pixels. [H,W,3], [H,W] bool -> [P,2]"""
    chroma: NDArray[np.float64] = srgb_to_oklab(image[pixels].double())[:, 1:].numpy()
    return chroma


def _speckle(change: Tensor, inside: Tensor) -> float:
    """Return the share of the region's pixels in which a median flips changed and unchanged."""
    if not bool(inside.any()):
        return 0.0
    changed = (_is_changed(change) & inside).numpy()
    smooth = ndimage.median_filter(changed.astype(np.uint8), _MEDIAN_PX) > 0
    border = ndimage.binary_erosion(inside.numpy(), iterations=_MEDIAN_PX // 2)
    counted = border & inside.numpy()
    return float((changed != smooth)[counted].mean()) if counted.any() else 0.0


def _share_of_new_colors(colors: NDArray[np.float64], known: NDArray[np.float64], change: float) -> float:
    """Return the share of colors that lie outside the hull of the known ones. [P,2], [Q,2]

    Args:
        colors, known: a and b in OKLab
        change: typical size of the painted change; colors within `HULL_MARGIN` of it around the hull count as
            known
    """
    if not len(colors):
        return 0.0
    try:
        equations = ConvexHull(known).equations
    except (QhullError, ValueError):  # all known colors lie on one line
        return 0.0
    distances = (colors @ equations[:, :2].T + equations[:, 2]).max(axis=1)
    return float((distances > HULL_MARGIN * change).mean())
