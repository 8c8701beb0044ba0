"""The bear in the viewer matches the golden pictures in tests/screenshots."""

from __future__ import annotations

from collections.abc import Callable

import moderngl
import numpy as np
import pytest
from PIL import Image

from tests.helpers.goldens import LEVELS, SCREENSHOTS, difference
from tests.helpers.stacks import Stack, view_of
from viewer.render.engine import ViewEngine

Compare = Callable[[str, np.ndarray], None]


@pytest.mark.gl
@pytest.mark.usefixtures("software_gpu")
def test_goldens_are_compared_on_a_software_renderer(ctx: moderngl.Context) -> None:
    assert "llvmpipe" in str(ctx.info["GL_RENDERER"])


@pytest.mark.gl
@pytest.mark.usefixtures("software_gpu")
@pytest.mark.parametrize("strength", [0.0, 0.5, 1.0])
def test_bear_matches_its_goldens(
    gl_engine: ViewEngine, stack: Stack, screenshot: Compare, strength: float
) -> None:
    screenshot(f"scene_bear_{strength:g}", gl_engine.image(view_of(stack, strength, strength), (240, 180)))


@pytest.mark.gl
@pytest.mark.usefixtures("software_gpu")
def test_wrong_golden_is_detected(
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


@pytest.mark.parametrize("name", ["scene_bear_0.5", "ui_main", "ui_training"])
def test_golden_tolerates_rounding_but_not_visible_changes(name: str) -> None:
    golden = np.asarray(Image.open(SCREENSHOTS / f"{name}.png").convert("RGB"))
    rng = np.random.default_rng(0)
    steps = (rng.random(golden.shape[:2]) < 1e-3)[..., None] * rng.integers(-LEVELS, LEVELS + 1, golden.shape)
    assert not difference(golden, (golden + steps).clip(0, 255).astype(np.uint8))
    for axis in (0, 1):
        assert "pixels differ by more than 2/255" in difference(golden, np.roll(golden, 1, axis)), "shifted"
    brighter = golden + (golden < 255).astype(np.uint8)
    assert "pixels differ by more than 0/255" in difference(golden, brighter), "by one step"


def test_missing_detail_of_one_pixel_is_detected() -> None:
    golden = np.asarray(Image.open(SCREENSHOTS / "ui_main.png").convert("RGB"))
    detail = np.abs(np.diff(golden.astype(int), axis=0)).max(axis=-1) > LEVELS
    for y, x in np.random.default_rng(0).choice(np.argwhere(detail), 20):
        bare = golden.copy()
        bare[y + 1, x] = bare[y, x]  # removes a dot of one pixel
        assert difference(golden, bare).startswith("1 pixels differ")
