"""What the tests of the viewer's pictures share: a small bear with two edits, and an engine that draws it."""

from __future__ import annotations

from collections.abc import Iterator

import moderngl
import pytest

from tests.helpers.stacks import Stack, bear_stack
from viewer.render.engine import ViewEngine


@pytest.fixture(scope="module")
def stack() -> Stack:
    return bear_stack(1500)


@pytest.fixture(params=["cpu", "gpu"])
def gl_engine(request: pytest.FixtureRequest, ctx: moderngl.Context, stack: Stack) -> Iterator[ViewEngine]:
    """OpenGL, with what edits."""
    made = ViewEngine(ctx, stack.scene, stack.gdfs, draw="gl", edit_pass=request.param)
    yield made
    made.release()
