"""Safe frame: its inside is the picture of a film of the same shape."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from progdf.metrics.image import psnr
from tests.helpers.ui_rig import bear, first_view, rig
from viewer.camera.view_camera import SHAPES
from viewer.panel import panel
from viewer.pictures.film import to_pixels
from viewer.state.forms import SIDES, picture_size
from viewer.state.view_state import Comparison, ViewState
from viewer.ui.overlay import Area, safe_frame

WIDE = Area(720.0, 360.0)
TALL = Area(300.0, 600.0)


@pytest.mark.parametrize("area", [WIDE, TALL], ids=["wide", "tall"])
@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("covered", [0.0, 46.0])
def test_safe_frame_has_its_shape_fits_and_touches_an_edge(area: Area, shape: str, covered: float) -> None:
    frame = safe_frame(ViewState(safe_frame=shape), area, covered)
    assert frame is not None
    width, height = (int(side) for side in shape.split(":"))
    assert frame.width * height == pytest.approx(frame.height * width)
    spare = area.width - frame.width, area.height - 2 * covered - frame.height
    assert min(spare) == pytest.approx(0.0, abs=1e-9)


def test_safe_frame_is_hidden_beside_two_pictures_or_without_panel() -> None:
    for view in (ViewState(), ViewState(safe_frame="1:1", panel=False)):
        assert safe_frame(view, WIDE) is None
    assert safe_frame(ViewState(safe_frame="1:1", compare=Comparison("beside")), WIDE) is None
    assert safe_frame(ViewState(safe_frame="1:1", compare=Comparison("split")), WIDE) is not None


def test_film_size_has_the_chosen_shape() -> None:
    assert [picture_size(side, "16:9") for side in SIDES[:2]] == [(1280, 720), (1920, 1080)]
    assert picture_size(1080, "9:16") == (1080, 1920)
    assert picture_size(720, "1:1") == (720, 720)


@pytest.mark.gl
def test_inside_of_the_safe_frame_equals_the_film() -> None:
    area = Area(360.0, 480.0)
    with rig(first_view(bear(), 0.7, 0.5), (round(panel.WIDTH_PX) + 360, 480)) as hand:
        before = hand.picture()
        for shape in SHAPES:
            hand.key("Shift+T")
            view = hand.main_view.work.view
            frame = safe_frame(view, area)
            assert frame is not None
            wide = round(frame.width)
            tall = round(frame.height)
            left = round((360 - wide) / 2)
            top = round((480 - tall) / 2)
            film = hand.main_view.engine.image(view, (wide, tall))
            seen = hand.picture()[top : top + tall, left : left + wide] / np.float32(255.0)
            # leaves out the line and its name; half a pixel is lost where the frame's height is odd
            inside = (torch.from_numpy(image[24:-2, 2:-2]) for image in (seen, film))
            assert psnr(*inside) > 30.0, shape
            assert (view.camera, view.safe_frame) == (first_view(bear()).camera, shape)
        hand.key("Shift+T")
        assert np.array_equal(hand.picture(), before), "and after the last there is none"


@pytest.mark.gl
def test_pan_follows_the_mouse_and_saved_pictures_have_no_frame(tmp_path: Path) -> None:
    view = replace(first_view(bear(), 0.7, 0.5), safe_frame="16:9")
    with rig(view, (round(panel.WIDTH_PX) + 360, 480), pictures=tmp_path) as hand:
        hand.key("F2")
        (saved,) = tmp_path.glob("*.png")
        whole = to_pixels(hand.main_view.engine.image(view, (360, 480)))
        assert np.abs(np.asarray(Image.open(saved)).astype(int) - whole).max() <= 1
        before = hand.picture()[200:280, 140:220].astype(int)
        hand.drag((180.0, 240.0), (200.0, 240.0), button=1)
        after = hand.picture()[200:280].astype(int)
    error = [np.abs(after[:, 140 + by : 220 + by] - before).mean() for by in range(41)]
    assert np.argmin(error) == pytest.approx(20, abs=1), "what was under the cursor stays there"


@pytest.mark.gl
@pytest.mark.usefixtures("software_gpu")
def test_screenshot_of_the_safe_frame_over_the_timeline(
    screenshot: Callable[[str, np.ndarray], None],
) -> None:
    view = replace(first_view(bear(), 0.7, 0.5), safe_frame="16:9")
    with rig(view, (1024, 640)) as hand:
        hand.key("T")
        hand.frame(3)
        screenshot("ui_safe_frame", hand.image())
