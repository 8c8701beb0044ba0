"""Fixtures of the render tests: a small bear with two edits and an engine that draws it."""

from __future__ import annotations

from collections.abc import Iterator

import moderngl
import pytest

from tests.helpers.stacks import Stack, bear_stack
from viewer.render.engine import ViewEngine


@pytest.fixture(scope="module")
def stack() -> Stack:
    return bear_stack(1500)


@pytest.fixture
def gl_engine(ctx: moderngl.Context, stack: Stack) -> Iterator[ViewEngine]:
    """Yield an engine that draws with OpenGL."""
    engine = ViewEngine(ctx, stack.scene, stack.gdfs, draw="gl")
    yield engine
    engine.release()
