"""Members that no training view shows: in an edit of colors they follow the seen ones on their own surface.

Nothing pulls at a member that is out of every view's sight, so it keeps its old color: white spots in a room
at night, for whoever looks where no camera stood. Its neighbors along the surface, of the same color, know
what the edit does there (see `surface.surface_likeness`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from progdf.camera import Camera
from progdf.gaussians import Gaussians, attribute_slices
from progdf.rasterize import alpha_weights
from progdf.sh import basis
from trainer.options import OptimizeOptions
from trainer.regions.surface import surface_likeness
from trainer.setup import TrainingSetup
from trainer.views.choose import visible_area
from trainer.views.view import View

_SEEN = 3.0
"""Σ αT over all pixels and views, in pixels: a member of a sparse region with less got next to nothing."""

_SHARE = 0.01
"""Of the visible weight of a typical member. Where members are dense nearly all have less than `_SEEN`, and
their own pixels still tell them their colors (`color_solver`)."""

_SOURCES = 6


@dataclass(frozen=True)
class UnseenMembers:
    """Who follows whom, as places among the members."""

    places: Tensor  # the unseen members. [U] int64
    sources: Tensor  # seen members that each of them follows. [U,k] int64
    weights: Tensor  # how much it follows each, adding up to 1. [U,k]

    def propagate(self, offsets: Tensor) -> Tensor:
        """The offsets with the unseen members' colors moved as their sources' are. [M,C] -> [M,C]"""
        if not len(self.places):
            return offsets
        slices = attribute_slices(offsets.shape[1])
        led = offsets.clone()
        for name in ("sh0", "shN"):
            if name in slices:
                known = offsets[self.sources, slices[name]].float()
                led[self.places, slices[name]] = (self.weights[..., None] * known).sum(dim=1).to(led.dtype)
        return led


def unseen_members_of(setup: TrainingSetup, optimization: OptimizeOptions) -> UnseenMembers:
    """Those of a run; none unless the edit is one of colors alone."""
    if optimization.kind != "color":
        empty = torch.zeros(0, dtype=torch.int64)
        return UnseenMembers(empty, empty[:, None], torch.zeros(0, 1))
    return find_unseen_members(setup.scene, setup.region.members, setup.train)


def find_unseen_members(scene: Gaussians, members: Tensor, views: Sequence[View]) -> UnseenMembers:
    """The members that no view shows, and the nearest seen ones along the surface.

    A follower whose neighbors are all unseen follows what these follow; one from which no seen member can be
    reached stays as it is.

    Args:
        scene: the original
        members: rows of the region. [M] int64
        views: the training views
    """
    weight = torch.zeros(len(members))
    for view in views:
        camera = view.camera
        weight += alpha_weights(scene, camera, torch.ones_like(view.mask))[members, 2].float()
    return _find_sources(scene[members], weight >= least_visible(weight))


def least_visible(weight: Tensor) -> float:
    """Visible weight below which a member counts as unseen: a share of what the member behind an average
    visible pixel gets (Σ w² / Σ w, which members that hardly show do not change), at most `_SEEN`.

    Args:
        weight: Σ αT of each member over all pixels and views, in pixels. [M]
    """
    typical = float(weight.square().sum() / weight.sum().clamp_min(1e-12))
    return min(_SEEN, _SHARE * typical)


def _find_sources(region: Gaussians, seen: Tensor) -> UnseenMembers:
    """See `find_unseen_members`; `seen`: [M] bool"""
    unseen = (~seen).nonzero()[:, 0]
    k = min(_SOURCES, int(seen.sum()))
    sources = torch.zeros(len(seen), k, dtype=torch.int64)
    weights = torch.zeros(len(seen), k)
    if k == 0 or not len(unseen):
        return UnseenMembers(unseen[:0], sources[:0], weights[:0])
    sources[seen, 0], weights[seen, 0] = seen.nonzero()[:, 0], 1.0
    near, likeness = surface_likeness(region, unseen)
    decided = seen.clone()
    while True:  # from where views look, outwards
        open_rows = ~decided[unseen]
        known = likeness * decided[near] * open_rows[:, None]
        reached = known.sum(dim=1) > 1e-6
        if not bool(reached.any()):
            break
        likeliest = known[reached].topk(k, dim=1)
        through = near[reached].gather(1, likeliest.indices)
        best = weights[through].argmax(dim=2, keepdim=True)
        rows = unseen[reached]
        sources[rows] = sources[through].gather(2, best)[..., 0]
        weights[rows] = likeliest.values / likeliest.values.sum(dim=1, keepdim=True)
        decided[rows] = True
    unseen_members = unseen[decided[unseen]]
    return UnseenMembers(unseen_members, sources[unseen_members], weights[unseen_members])


NEEDED = 0.04
"""Color (0..1) by which a region's must change with the view for the bands to pay."""


def view_dependence(members: Gaussians, cameras: Sequence[Camera]) -> float:
    """How much the members' colors change between these cameras: the root mean square, in color 0..1.

    Each member counts as the area that it can cover.
    """
    bands = min(members.shN.shape[1], 15)
    if not bands or not len(members) or len(cameras) < 2:
        return 0.0
    degree = min(members.sh_degree, 3)
    seen = []
    for camera in cameras:
        directions = torch.nn.functional.normalize(members.means - camera.position, dim=1)
        seen.append((basis(degree, directions)[:, 1 : bands + 1, None] * members.shN[:, :bands]).sum(dim=1))
    colors = torch.stack(seen)
    change = (colors - colors.mean(dim=0)).square().mean(dim=(0, 2)).double()
    areas = visible_area(members)
    return float(((change * areas).sum() / areas.sum().clamp_min(1e-300)).sqrt())
