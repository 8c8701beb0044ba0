"""The bear in the viewer looks as it did: pictures kept in tests/screenshots."""

from __future__ import annotations

from collections.abc import Callable

import moderngl
import numpy as np
import pytest

from tests.helpers.stacks import Stack, view_of
from viewer.render.engine import ViewEngine

Compare = Callable[[str, np.ndarray], None]


@pytest.mark.gl
@pytest.mark.usefixtures("software_gpu")
def test_the_goldens_are_compared_on_a_software_renderer(ctx: moderngl.Context) -> None:
    assert "llvmpipe" in str(ctx.info["GL_RENDERER"])


@pytest.mark.gl
@pytest.mark.usefixtures("software_gpu")
@pytest.mark.parametrize("strength", [0.0, 0.5, 1.0])
def test_the_bear_looks_as_it_did(
    gl_engine: ViewEngine, stack: Stack, screenshot: Compare, strength: float
) -> None:
    screenshot(f"scene_bear_{strength:g}", gl_engine.image(view_of(stack, strength, strength), (240, 180)))


@pytest.mark.gl
@pytest.mark.usefixtures("software_gpu")
def test_a_wrong_golden_is_noticed(
    gl_engine: ViewEngine, stack: Stack, screenshot: Compare, request: pytest.FixtureRequest
) -> None:
    """scene_wrong.png is scene_bear_1.png with one square 4/255 too bright."""
    if request.config.getoption("--regenerate-screenshots"):
        image = gl_engine.image(view_of(stack, 1.0, 1.0), (240, 180)).copy()
        image[60:70, 110:120] = np.clip(image[60:70, 110:120], 0.0, 0.9) + 4.0 / 255.0
        screenshot("scene_wrong", image)
        return
    with pytest.raises(pytest.fail.Exception, match="100 pixels differ by more than 2/255"):
        screenshot("scene_wrong", gl_engine.image(view_of(stack, 1.0, 1.0), (240, 180)))
