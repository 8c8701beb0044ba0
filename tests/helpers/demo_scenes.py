"""Cached demo scenes. Building one takes a second, so each is built once and returned as a copy."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

from progdf import demo_scenes
from progdf.demo_scenes import DemoScene
from progdf.gaussians import ATTRIBUTES

_bear = cache(demo_scenes.bear)
_room = cache(demo_scenes.room)


def bear(size: int, seed: int = 0) -> DemoScene:
    """Return a copy of `progdf.demo_scenes.bear`."""
    return _copy(_bear(size, seed))


def room(size: int, seed: int = 0) -> DemoScene:
    """Return a copy of `progdf.demo_scenes.room`."""
    return _copy(_room(size, seed))


def _copy(demo: DemoScene) -> DemoScene:
    copies = {name: getattr(demo.gaussians, name).clone() for name in ATTRIBUTES}
    return replace(demo, gaussians=replace(demo.gaussians, **copies), labels=demo.labels.clone())
