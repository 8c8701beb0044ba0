"""The benchmark `spill`: the change of parts that a painted picture does not show.

A picture of an object is painted in two ways: its right half with a hard edge, and a soft stroke that reaches
its outline. Colors are solved from this picture alone, once carried on over the whole region and once ending
where the picture ends. The objects are parts of the demo scenes. A named scene is label 1 and above of
SCENE_labels.npy beside it, or the whole scene.

    python -m benchmarks spill --scenes SCENE.ply
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch
from scipy import ndimage
from scipy.spatial import ConvexHull
from torch import Tensor
from torch.nn.functional import normalize

from progdf import demo_scenes
from progdf.camera import Camera, intrinsics, look_at
from progdf.color.oklab import smoothstep, srgb_to_oklab
from progdf.demo_scenes import DemoScene
from progdf.field.grade import band_offsets
from progdf.formats.scene_file import load_scene
from progdf.gaussians import Gaussians, pack
from progdf.io.images import write_image
from progdf.metrics.image import decibels
from progdf.rasterize.engines import render_depth
from progdf.region import Region, from_mask
from progdf.scene.up_axis import find_up
from progdf.sh import C0
from trainer.optimize.color_solver import choose_model, make_solver, split_solver
from trainer.optimize.color_views import add_bands, color_views
from trainer.optimize.ties import surface_ties
from trainer.regions.changed import changed_region
from trainer.regions.few_masks import connected_pieces
from trainer.regions.lift import HIDDEN, gather
from trainer.regions.surface import covered_rows
from trainer.store.run_folder import quantize_image
from trainer.views.crops import crop_scene
from trainer.views.view import (
    BACKGROUND,
    crop,
    make_view,
    region_sphere,
    render_colors,
    render_view,
    with_near_plane,
)

from .table import Table

BEAR_GAUSSIANS = 24_000
ROOM_GAUSSIANS = 40_000
ROOM_PARTS = ("vase", "stool", "ball")
"""Painted parts of the room."""

SIZE = 400
"""Side of the painted picture, pixels."""
COMPARED_SIZE = 240
"""Side of the compared pictures, pixels."""
STEPS = 60
"""Maximum number of conjugate gradient steps."""
ELEVATION_DEG = 12.0
"""Elevation of all cameras."""
BEHIND_DEG = (110.0, 145.0, 180.0, 215.0, 250.0)
"""Angles from the painted view at which parts are compared that the picture does not show."""
NEAR_DEG = (-30.0, 30.0)
"""Angles at which the paint is compared with the picture, projected onto the surface."""
AWAY_DEG = 100.0
"""Angle between a surface's normal and the painted view above which the picture cannot show it."""
CHANGED_COLOR = 0.06
"""Largest channel difference that does not count as a change."""

NOTE = (
    f"The painted picture has {SIZE} pixels a side. Shares are of all pixels of a view of {COMPARED_SIZE} "
    f"pixels a side that changed by more than {CHANGED_COLOR:g}. Behind: pixels of surfaces that face more "
    f"than {AWAY_DEG:g}° away from the painted view, mean / worst of views at 110, 145, 180, 215 and 250°. "
    "Islands: changed parts without a connection to a part that the picture shows. Off hue: outside the hull "
    "of the original and the painted hues. ±30°: against the paint projected onto the surface, the worse of "
    "two."
)
PAINT = torch.tensor([0.05, 0.62, 0.60])
_PAINT_OPACITY = 0.8
_HUE_TOLERANCE = 0.03  # distance from the hull in OKLab's a and b
_DISTANCE_RADII = 3.4  # distance of the cameras from the object, in its radii
_NORMAL_SIGMA_PX = 2.0  # smoothing of the depth from which normals are taken
_FOV_DEG = 40.0
_OBJECT_SHARE = 0.6  # share of a pixel by the object from which it is painted
_ISLAND_SHARE = 0.25  # share of a pixel by islands from which it shows one
_SURFACE_ALPHA = 0.5  # opacity from which a pixel shows a surface
_SAME_DEPTH_SHARE = 0.01  # largest difference in depth of one surface point in two views, as a share of it
_PAINTED_COLOR = 2 / 255  # color difference above which a pixel is painted
_HULL_STRIDE = 7  # one of this many pixels makes the hull of hues


@dataclass(frozen=True)
class Subject:
    """An object to paint."""

    name: str
    scene: Gaussians
    member: Tensor  # Gaussians of the object. [N] bool
    up: Tensor  # up direction. [3]
    front_deg: float = 0.0  # azimuth of the painted view


@dataclass(frozen=True)
class Spill:
    """Measured change of an edit made from one picture."""

    behind: float  # share of the pixels beyond 100° that changed on surfaces that the picture does not show
    worst_behind: float  # largest such share of one view
    opposite: float  # share of all pixels at 180° that changed
    islands: float  # largest share of a view's pixels that changed without a connection to the paint
    off_hue: float  # largest share of a view's pixels that changed to a hue outside the hull
    own_db: float  # PSNR over the painted pixels of the picture
    near_db: float  # lowest PSNR at ±30° over the paint projected onto the surface


def half(object_pixels: Tensor) -> Tensor:
    """Return the paint's opacity: 1 in the right half of the object. [H,W] -> [H,W]"""
    columns = object_pixels.nonzero()[:, 1]
    middle = float(columns.float().median())
    return object_pixels.float() * (torch.arange(object_pixels.shape[1]) > middle)


def soft_stroke(object_pixels: Tensor) -> Tensor:
    """Return the paint's opacity: a soft round brush on the right of the object. [H,W] -> [H,W]"""
    rows, columns = object_pixels.nonzero().double().unbind(1)
    top = rows.quantile(0.05)
    bottom = rows.quantile(0.95)
    left = columns.quantile(0.05)
    right = columns.quantile(0.95)
    y, x = torch.meshgrid(*(torch.arange(n).double() for n in object_pixels.shape), indexing="ij")
    radius = 0.35 * torch.maximum(bottom - top, right - left)
    distance = ((y - 0.5 * (top + bottom)).square() + (x - (0.2 * left + 0.8 * right)).square()).sqrt()
    return object_pixels.float() * smoothstep(1.5 - 1.5 * distance / radius).float()


STROKES: dict[str, Callable[[Tensor], Tensor]] = {"half": half, "soft": soft_stroke}
"""Name and opacity of each paint."""


def paint_over(picture: Tensor, opacity: Tensor) -> Tensor:
    """Return the picture with teal paint that keeps its light. [H,W,3], [H,W] -> [H,W,3]"""
    light = (0.35 + picture.mean(dim=2, keepdim=True)).clamp(0.0, 1.3)
    share = _PAINT_OPACITY * opacity[..., None]
    return quantize_image((picture * (1.0 - share) + share * light * PAINT).clamp(0.0, 1.0))


def cameras_around(subject: Subject, degrees: Sequence[float], size: int) -> list[Camera]:
    """Return cameras at angles around the object, measured from the painted view."""
    scene = subject.scene
    region = from_mask(subject.name, subject.member)
    center, radius = region_sphere(scene, region)
    up = subject.up
    aside = torch.linalg.cross(up, torch.eye(3)[int(up.abs().argmin())])
    aside = aside / aside.norm()
    ahead = torch.linalg.cross(aside, up)
    tilt = math.radians(ELEVATION_DEG)
    K = intrinsics(math.radians(_FOV_DEG), size, size)
    cameras = []
    for angle in degrees:
        turn = math.radians(angle + subject.front_deg)
        direction = math.cos(tilt) * (math.cos(turn) * ahead + math.sin(turn) * aside) + math.sin(tilt) * up
        viewmat = look_at(center + _DISTANCE_RADII * radius * direction, center, up)
        cameras.append(Camera(viewmat, K, size, size, name=f"turn_{angle:+.0f}"))
    return with_near_plane(cameras, scene)


def solve_picture(
    scene: Gaussians, region: Region, camera: Camera, picture: Tensor, carries_on: bool
) -> Gaussians:
    """Return the scene with the colors of one picture."""
    background = torch.tensor(BACKGROUND)
    view = make_view(scene, region, camera, background).widen([picture])
    original = pack(scene[region.members], with_shN=scene.sh_degree > 0)
    crops = [crop_scene(scene, region.members, camera, view.box, background, True)]
    ties = surface_ties(scene, region.members, [camera])
    if not carries_on:
        ties, _ = ties.end_at_pictures(scene, region.members, [camera], [picture - view.image])
    solver = make_solver(color_views(crops, original), original, ties)
    targets = [crop(picture, view.box)]
    solver, model = choose_model(solver, split_solver(solver, targets), targets, STEPS, 1)
    change = add_bands(solver.fit_map(model.degree, targets)[1], model.residual)
    offsets = band_offsets(change, original.shape[1])
    return scene.replace_rows(region.members, original + offsets)


def surface_points(scene: Gaussians, view: Camera, sigma_px: float = 0.0) -> tuple[Tensor, Tensor]:
    """Return the visible point of each pixel [H,W,3], in world space, and the pixels with a surface [H,W]."""
    with torch.no_grad():
        drawn = render_depth(scene, view)
    depth = drawn.depth
    if sigma_px:
        depth = torch.from_numpy(ndimage.gaussian_filter(depth.numpy(), sigma_px))
    y, x = torch.meshgrid(*(torch.arange(n) + 0.5 for n in depth.shape), indexing="ij")
    across = (x - view.K[0, 2]) / view.K[0, 0]
    below = (y - view.K[1, 2]) / view.K[1, 1]
    rays = torch.stack([across, below, torch.ones_like(x)], dim=2)
    return (rays * depth[..., None]) @ view.viewmat[:3, :3] + view.position, drawn.alpha > _SURFACE_ALPHA


def faces_away(scene: Gaussians, view: Camera, painted: Camera) -> Tensor:
    """Return the pixels of surfaces that face more than `AWAY_DEG` away from the painted view. [H,W] bool"""
    points, surface = surface_points(scene, view, _NORMAL_SIGMA_PX)
    down, right = torch.gradient(points, dim=(0, 1))
    normals = normalize(torch.linalg.cross(down, right), dim=2)
    normals = normals * (normals * (view.position - points)).sum(dim=2, keepdim=True).sign()
    cosine = (normals * normalize(painted.position - points, dim=2)).sum(dim=2)
    return (cosine < math.cos(math.radians(AWAY_DEG))) & surface


def project_picture(
    scene: Gaussians, picture: Tensor, painted: Tensor, camera: Camera, view: Camera
) -> tuple[Tensor, Tensor]:
    """Return a picture as another view of the surface shows it, and the pixels with its paint.

    Args:
        scene: the original
        picture: [H,W,3]
        painted: painted pixels of the picture. [H,W] bool
        camera: camera of the picture
        view: the other camera

    Returns:
        [h,w,3]; [h,w] bool
    """
    points, surface = surface_points(scene, view)
    seen = points @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    z = seen[..., 2].clamp_min(1e-6)
    column = (seen[..., 0] / z * camera.K[0, 0] + camera.K[0, 2]).long().clamp(0, camera.width - 1)
    row = (seen[..., 1] / z * camera.K[1, 1] + camera.K[1, 2]).long().clamp(0, camera.height - 1)
    with torch.no_grad():
        depth = render_depth(scene, camera).depth
    is_same = (depth[row, column] - z).abs() < _SAME_DEPTH_SHARE * z
    return picture[row, column], painted[row, column] & surface & is_same


def measure_spill(subject: Subject, edited: Gaussians, picture: Tensor, camera: Camera) -> Spill:
    """Measure an edit that was made from one picture of a camera."""
    scene = subject.scene
    background = torch.tensor(BACKGROUND)
    ones = torch.ones(camera.height, camera.width)
    visible = gather(scene, [camera], [ones]).clearness >= HIDDEN
    visible &= ~covered_rows(scene, [camera])
    original = render_view(scene, camera, background).clamp(0.0, 1.0)
    own = render_view(edited, camera, background).clamp(0.0, 1.0)
    painted = (picture - original).abs().amax(dim=2) > _PAINTED_COLOR
    own_db = decibels(float((own - picture)[painted].square().mean()))
    changed = ((edited.sh0 - scene.sh0).abs().amax(dim=1) * C0 > 0.5 * CHANGED_COLOR).nonzero()[:, 0]
    island = torch.zeros(len(scene))
    if len(changed):
        pieces = connected_pieces(scene[changed])
        is_rooted = np.bincount(pieces, visible[changed].numpy()) > 0
        island[changed] = 1.0 - torch.from_numpy(is_rooted[pieces]).float()
    hues = torch.cat([original.reshape(-1, 3)[::_HULL_STRIDE], picture.reshape(-1, 3)[::_HULL_STRIDE]])
    hull = ConvexHull(srgb_to_oklab(hues)[:, 1:].double().numpy())
    shares = []
    islands = []
    off_hues = []
    opposite = 0.0
    for angle, view in zip(BEHIND_DEG, cameras_around(subject, BEHIND_DEG, COMPARED_SIZE), strict=True):
        before = render_view(scene, view, background).clamp(0.0, 1.0)
        after = render_view(edited, view, background).clamp(0.0, 1.0)
        differs = (after - before).abs().amax(dim=2) > CHANGED_COLOR
        masks = torch.stack([island, island, island], dim=1)
        lone = render_colors(scene, masks, view, torch.zeros(3))[..., 0]
        shares.append(float((differs & faces_away(scene, view, camera)).float().mean()))
        islands.append(float((differs & (lone > _ISLAND_SHARE)).float().mean()))
        chroma = srgb_to_oklab(after[differs])[:, 1:].double().numpy()
        outside = (chroma @ hull.equations[:, :2].T + hull.equations[:, 2]).max(axis=1, initial=-1.0)
        off_hues.append(float((outside > _HUE_TOLERANCE).sum()) / differs.numel())
        if angle == 180.0:
            opposite = float(differs.float().mean())
    near = []
    for view in cameras_around(subject, NEAR_DEG, COMPARED_SIZE):
        expected, covered = project_picture(scene, picture, painted, camera, view)
        seen = render_view(edited, view, background).clamp(0.0, 1.0)
        near.append(decibels(float((seen - expected)[covered].square().mean())))
    return Spill(
        behind=sum(shares) / len(shares),
        worst_behind=max(shares),
        opposite=opposite,
        islands=max(islands),
        off_hue=max(off_hues),
        own_db=own_db,
        near_db=min(near),
    )


def tables(scenes: Sequence[Path] = ()) -> list[Table]:
    """Measure each paint on each object, carried on and ended.

    Raises:
        ProgdfError: a scene cannot be read.
    """
    rows = [row for subject in _subjects(scenes) for row in _rows(subject)]
    columns = (
        "object, paint",
        "edit",
        "behind, %",
        "all at 180°, %",
        "islands, %",
        "off hue, %",
        "painted view, dB",
        "±30°, dB",
    )
    return [
        Table("spill", "Change of parts that a painted picture does not show", columns, tuple(rows), NOTE)
    ]


def _subjects(scenes: Sequence[Path]) -> Iterator[Subject]:
    """Yield the objects of the demo scenes, then those of the named scenes."""
    bear = demo_scenes.bear(BEAR_GAUSSIANS)
    yield _demo_subject("bear", bear, ("body", "head", "ears", "arms", "legs"), 90.0)
    yield _demo_subject("scarf", bear, ("scarf",), 90.0)
    for part in ROOM_PARTS:
        room = demo_scenes.room(ROOM_GAUSSIANS)
        thing = room.gaussians[room.members(part)]  # alone, as walls are in front of the cameras
        yield Subject(part, thing, torch.ones(len(thing), dtype=torch.bool), room.up)
    for path in scenes:
        scene = load_scene(path)
        labels = path.with_name(f"{path.stem}_labels.npy")
        member = torch.ones(len(scene), dtype=torch.bool)
        if labels.is_file():
            member = torch.from_numpy(np.load(labels) > 0)
        yield Subject(path.stem, scene, member, find_up(scene, (), "auto").direction)


def _demo_subject(name: str, demo: DemoScene, parts: Sequence[str], front_deg: float = 0.0) -> Subject:
    """Return parts of a demo scene as an object."""
    member = torch.zeros(len(demo.gaussians), dtype=torch.bool)
    member[demo.members(*parts)] = True
    return Subject(name, demo.gaussians, member, demo.up, front_deg)


def _rows(subject: Subject) -> list[tuple[str, ...]]:
    """Return the rows of one object."""
    scene = subject.scene
    (camera,) = cameras_around(subject, (0.0,), SIZE)
    original = quantize_image(render_view(scene, camera, torch.tensor(BACKGROUND)).clamp(0.0, 1.0))
    white = subject.member.float()[:, None].expand(-1, 3).contiguous()
    object_pixels = render_colors(scene, white, camera, torch.zeros(3))[..., 0] > _OBJECT_SHARE
    rows: list[tuple[str, ...]] = []
    for name, stroke in STROKES.items():
        picture = paint_over(original, stroke(object_pixels))
        with TemporaryDirectory() as folder:
            path = Path(folder) / "painted.png"
            write_image(path, picture)
            region = changed_region(scene, [path], [camera])
        for edit, carries_on in (("carried on", True), ("ended", False)):
            edited = solve_picture(scene, region, camera, picture, carries_on)
            spill = measure_spill(subject, edited, picture, camera)
            rows.append(
                (
                    f"{subject.name}, {name}",
                    edit,
                    f"{100 * spill.behind:.2f} / {100 * spill.worst_behind:.2f}",
                    f"{100 * spill.opposite:.2f}",
                    f"{100 * spill.islands:.2f}",
                    f"{100 * spill.off_hue:.2f}",
                    f"{spill.own_db:.1f}",
                    f"{spill.near_db:.1f}",
                )
            )
    return rows
