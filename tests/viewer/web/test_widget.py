"""Notebook widget: in a real Chromium with a stub of anywidget's model, and its Python side."""

from __future__ import annotations

import base64
import gzip
import io
import json
import operator
import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

import progdf
import viewer
from progdf.compose.layers import Layer
from progdf.errors import ProgdfError
from tests.helpers.ui_rig import bear

pytest.importorskip("anywidget", reason="anywidget is not installed")

from viewer.widget import Widget

SIZE = 660, 700

# Stub of the model that anywidget passes to `render`. `set` notifies listeners; saves are counted.
HOST = """async ([module, states]) => {
  class Model {
    constructor(values) {
      const bytes = Uint8Array.from(atob(values.scene), (c) => c.charCodeAt(0));
      const longer = new Uint8Array(bytes.length + 3);
      longer.set(bytes, 3);  // a view into the message it came in
      this.values = { ...values, scene: new DataView(longer.buffer, 3) };
      this.acts = {};
      this.saved = 0;
      this.sent = {};
    }
    get(name) { return this.values[name]; }
    set(name, value) { this.sent[name] = value; this.receive(name, value); }
    receive(name, value) { this.values[name] = value; for (const act of this.acts[name] ?? []) act(); }
    save_changes() { this.saved += 1; }
    on(event, act) { (this.acts[event.replace("change:", "")] ??= []).push(act); }
  }
  const url = URL.createObjectURL(new Blob([module], { type: "text/javascript" }));
  const { default: widget } = await import(url);
  globalThis.views = [];
  for (const state of states) {
    const model = new Model(state), el = document.createElement("div");
    document.body.append(el);
    const close = await widget.render({ model, el });
    const root = el.firstChild.shadowRoot;
    views.push({ model, el, close, root, canvas: root.querySelector("canvas") });
  }
}"""

KEPT = """
  Object.defineProperty(window, "devicePixelRatio", { value: 0.5 });  // a quarter of the pixels
  const context = HTMLCanvasElement.prototype.getContext;  // so that what was drawn can be read at any time
  HTMLCanvasElement.prototype.getContext = function (kind, options) {
    return context.call(this, kind, { ...options, preserveDrawingBuffer: true });
  };
"""


@dataclass
class Cells:
    """Widgets below one another on a page, with its console messages."""

    tab: Any
    complaints: list[str]

    def frames(self, count: int = 3) -> None:
        for _ in range(count):
            self.tab.evaluate("new Promise(requestAnimationFrame)")

    def rest(self, view: int = 0) -> None:
        """Wait until the picture is drawn at full resolution, which happens once it stops moving."""
        self.frames()
        self.tab.wait_for_function(f"views[{view}].canvas.closest('.page').classList.contains('sharp')")

    def model(self, values: str, view: int = 0) -> Any:
        return self.tab.evaluate(f"views[{view}].model.{values}")

    def receive(self, name: str, value: Any, view: int = 0) -> None:
        """Set a model value as if it arrived from Python."""
        self.tab.evaluate(f"([name, value]) => views[{view}].model.receive(name, value)", [name, value])
        self.rest(view)

    def picture(self, view: int = 0) -> np.ndarray:
        self.rest(view)
        address = self.tab.evaluate(f"views[{view}].canvas.toDataURL()")
        return np.asarray(Image.open(io.BytesIO(base64.b64decode(address.split(",")[1]))).convert("RGB"))


def state_of(widget: Widget) -> dict[str, Any]:
    """Return the state that a widget sends to the browser, as JSON."""
    names = "_markup", "strengths", "hidden", "blend", "camera", "height"
    return {
        "scene": base64.b64encode(widget.scene).decode(),
        **{name: getattr(widget, name) for name in names},
    }


@pytest.fixture
def show(browser: Any) -> Iterator[Any]:
    contexts = []

    def showing(*widgets: Widget) -> Cells:
        context = browser.new_context(viewport=dict(zip(("width", "height"), SIZE, strict=True)))
        contexts.append(context)
        cells = Cells(context.new_page(), [])
        cells.tab.on("pageerror", lambda error: cells.complaints.append(str(error)))
        cells.tab.on("console", lambda message: cells.complaints.append(message.text))
        cells.tab.add_init_script(KEPT)
        cells.tab.goto("about:blank")
        cells.tab.evaluate(HOST, [widgets[0]._esm, [state_of(widget) for widget in widgets]])
        cells.tab.evaluate("document.fonts.ready")
        cells.frames()
        return cells

    yield showing
    for context in contexts:
        context.close()


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    return float(10 * np.log10(255**2 / max(np.mean((a.astype(float) - b) ** 2), 1e-12)))


def bear_widget(*strengths: float, height: int = 300) -> Widget:
    layers = [Layer(gdf, s) for gdf, s in zip(bear().gdfs, strengths, strict=True)]
    return Widget(bear().scene, layers, height=height)


@pytest.mark.slow
def test_values_set_in_python_draw_like_the_cpu_engine(show: Any) -> None:
    widget = bear_widget(0.0, 0.0)
    cells = show(widget)
    cells.tab.locator("#fold").click()
    cells.frames()
    pictures = []
    for strengths, camera in (({}, {}), ({"scarf": 1.0}, {}), ({"ears": 0.3}, {"azimuth": 60.0})):
        widget.strengths = strengths
        widget.camera = camera
        cells.receive("strengths", widget.strengths)
        cells.receive("camera", widget.camera)
        pictures.append(cells.picture())
        height, width, _ = pictures[-1].shape
        assert (height, width > 300) == (150, True)
        assert psnr(pictures[-1], np.asarray(widget.snapshot(width, height))) >= 50
    assert all(psnr(a, b) < 40 for a, b in pairwise(pictures)), "each is another picture"
    cells.receive("hidden", ["scarf", "ears"])
    widget.strengths = {"scarf": 0.0, "ears": 0.0}
    assert psnr(cells.picture(), np.asarray(widget.snapshot(width, height))) >= 50
    assert cells.model("saved") == 0, "what came from Python does not go back"
    cells.receive("height", 200)
    assert cells.picture().shape[0] == 100
    assert cells.complaints == []


def test_drag_is_sent_to_python_once_per_frame(show: Any) -> None:
    widget = bear_widget(0.5, 0.5)
    cells = show(widget)
    slider = cells.tab.get_by_role("slider", name="ears")
    box = slider.bounding_box()
    mouse = cells.tab.mouse
    mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    mouse.down()
    mouse.move(box["x"] + box["width"] + 20, box["y"] + 8, steps=5)
    mouse.up()
    cells.frames()
    assert cells.model("sent") == {"strengths": {"scarf": 0.5, "ears": 1.0}}
    widget.set_state(cells.model("sent"))
    assert widget.strengths == {"scarf": 0.5, "ears": 1.0}
    saved = cells.model("saved")
    cells.tab.evaluate(
        """() => { const input = views[0].root.querySelector("input");
        for (let i = 0; i < 50; i++) { input.value = i / 100; input.dispatchEvent(new Event("input")); } }"""
    )
    cells.frames()
    assert cells.model("saved") == saved + 1, "50 events of one frame are one change"
    mouse.move(200, 150)
    mouse.down()
    mouse.move(260, 150, steps=3)
    mouse.up()
    cells.frames()
    widget.set_state(cells.model("sent"))
    assert widget.camera["azimuth"] == pytest.approx(20.0 - 60 * 0.3)
    cells.tab.get_by_label("Hide scarf").click()
    cells.frames()
    widget.set_state(cells.model("sent"))
    assert widget.hidden == ["scarf"]


def test_changes_of_one_frame_are_sent_in_one_save(show: Any) -> None:
    cells = show(bear_widget(0.5, 0.5))
    cells.tab.evaluate(
        """() => { const { root } = views[0], input = root.querySelector("input");
        root.querySelector(".eye").click();
        input.value = 0.25;
        input.dispatchEvent(new Event("input")); }"""
    )
    cells.frames()
    assert cells.model("sent") == {"strengths": {"scarf": 0.5, "ears": 0.25}, "hidden": ["ears"]}
    assert cells.model("saved") == 1


def test_widget_hidden_for_a_frame_comes_back_up_to_date(show: Any) -> None:
    """A notebook hides its page while its theme changes."""
    cells = show(bear_widget(1.0, 1.0))
    before = cells.picture()
    cells.receive("strengths", {"scarf": 0.0, "ears": 1.0})
    cells.tab.evaluate(
        """() => new Promise((done) => {
        const { style } = document.body;
        requestAnimationFrame(() => { style.display = "none"; });
        views[0].model.receive("strengths", { scarf: 1.0, ears: 1.0 });  // and draws in the same frame
        requestAnimationFrame(() => { style.display = ""; done(); });
        })"""
    )
    cells.rest()
    assert psnr(cells.picture(), before) > 90


@pytest.mark.slow
def test_widgets_are_independent_and_release_their_context(show: Any) -> None:
    cells = show(bear_widget(0.0, 0.0), bear_widget(1.0, 1.0))
    before = cells.picture(1)
    assert psnr(cells.picture(0), before) < 40
    cells.receive("strengths", {"scarf": 1.0, "ears": 1.0}, 0)
    assert psnr(cells.picture(0), before) > 90
    cells.tab.evaluate("globalThis.first = views[0].canvas.getContext('webgl2')")
    cells.tab.evaluate("views[0].close(); views[0].el.remove()")
    cells.frames()
    assert cells.tab.evaluate("first.isContextLost()")
    cells.receive("strengths", {"scarf": 0.0, "ears": 1.0}, 1)
    assert psnr(cells.picture(1), before) < 40, "the other one goes on"
    assert cells.complaints == []


@pytest.mark.slow
def test_widget_takes_keys_and_wheel_only_after_a_click(show: Any) -> None:
    cells = show(bear_widget(1.0, 1.0))
    cells.tab.evaluate(
        "globalThis.heard = []; addEventListener('keydown', (e) => heard.push(e.key));"
        "document.body.style.height = '3000px'"
    )
    assert "click, then scroll to zoom" in cells.tab.get_by_text("Drag to turn").inner_text()
    edited = cells.picture()
    keyboard = cells.tab.keyboard
    cells.tab.mouse.move(200, 150)
    cells.tab.mouse.wheel(0, 60)
    cells.tab.wait_for_function("scrollY === 60")
    keyboard.press("d")
    keyboard.down(" ")
    cells.frames()
    assert psnr(cells.picture(), edited) > 90, "Space outside compares nothing"
    keyboard.up(" ")
    cells.tab.evaluate("scrollTo({ top: 60, behavior: 'instant' })")  # Space has scrolled the page
    cells.tab.wait_for_timeout(800)  # ends the smooth scrolling of the wheel
    cells.tab.mouse.click(200, 150)
    cells.tab.mouse.wheel(0, -100)
    cells.tab.wait_for_function("views[0].model.sent.camera", timeout=10_000)
    assert cells.tab.evaluate("scrollY") == 60, "once clicked it zooms"
    cells.rest()
    zoomed = cells.picture()
    keyboard.press("d")
    keyboard.down(" ")
    cells.frames()
    assert psnr(cells.picture(), zoomed) < 40
    keyboard.up(" ")
    cells.frames()
    assert psnr(cells.picture(), zoomed) > 90
    keyboard.press("Control+s")
    assert cells.tab.evaluate("heard") == ["d", " ", "Control", "s"], "d, d would delete the cell"


def test_page_of_a_widget_has_its_strengths_and_camera(tmp_path: Path) -> None:
    widget = bear_widget(0.0, 0.0)
    widget.strengths["ears"] = 0.25
    widget.camera = {"azimuth": -30.0}
    line = widget.to_html(tmp_path / "page.html", title="<bear>")
    text = (tmp_path / "page.html").read_text()
    data = gzip.decompress(base64.b64decode(re.search(r'id="data">([^<]*)<', text)[1]))
    header = json.loads(data[4 : 4 + int.from_bytes(data[:4], "little")])
    assert "<title>&lt;bear&gt;</title>" in text
    assert [layer["strength"] for layer in header["layers"]] == [0.0, 0.25]
    assert header["camera"]["azimuth"] == -30.0
    assert "MB, compact" in line


def test_in_place_changes_of_strengths_and_camera_notify_observers() -> None:
    widget = bear_widget(0.0, 0.0)
    changes = list[Any]()
    widget.observe(lambda change: changes.append(dict(change.new)), ["strengths", "camera"])
    widget.strengths["ears"] = 0.5
    widget.strengths |= {"ears": np.float32(0.25)}
    widget.strengths.update(scarf=torch.tensor(0.75))
    widget.camera["azimuth"] = 70.0
    assert [each.get("ears", each.get("azimuth")) for each in changes] == [0.5, 0.25, 0.25, 70.0]
    assert widget.strengths == {"scarf": 0.75, "ears": 0.25}
    assert widget.camera["azimuth"] == 70.0


def test_scene_in_training_is_shown_as_it_is() -> None:
    scene = bear().scene
    gdfs = bear().gdfs
    trained = replace(scene.to(dtype=torch.float64), means=scene.means.clone().requires_grad_())
    shown, expected = (np.asarray(Widget(each, gdfs).snapshot(96, 64)) for each in (trained, scene))
    assert (shown == expected).all()


@pytest.mark.slow
def test_invalid_values_from_python_are_ignored(show: Any) -> None:
    """Another program may send such values to the same model."""
    widget = bear_widget(0.5, 0.5)
    cells = show(widget)
    before = cells.picture()
    for strengths in ({"scarf": None, "ears": "x"}, {"hat": 1.0}, None):
        cells.receive("strengths", strengths)
    cells.receive("hidden", None)
    cells.receive("hidden", ["hat"])
    cells.receive("camera", {})
    cells.receive("camera", None)
    assert psnr(cells.picture(), before) > 90
    cells.receive("strengths", {"scarf": 0.5, "ears": 1.0})
    assert psnr(cells.picture(), before) < 40, "and it goes on"
    assert cells.complaints == []


def test_invalid_arguments_raise_one_clear_line(tmp_path: Path) -> None:
    scene, (scarf, ears) = bear().scene, bear().gdfs
    widget = Widget(scene, [scarf, ears])
    known = {**widget.strengths}
    camera = {**widget.camera}

    def bad_trait(name: str, value: object) -> Any:
        return lambda: setattr(widget, name, value)

    cases: list[tuple[Any, type[Exception], str]] = [
        (lambda: Widget(None), TypeError, "the scene is NoneType"),
        (lambda: Widget(scene, [tmp_path]), TypeError, "a layer is PosixPath"),
        (lambda: Widget(scene[:100], [scarf]), ProgdfError, "made for another scene"),
        (lambda: Widget(scene, [Layer(scarf, float("nan"))]), ProgdfError, "the strength of scarf is nan"),
        (lambda: Widget(scene, [Layer(scarf, -1.0)]), ValueError, "strength is -1.0"),
        (lambda: Widget(scene, [scarf], blend="mix"), ProgdfError, "unknown blend rule 'mix'"),
        (lambda: Widget(scene, [scarf], quality="best"), ProgdfError, "unknown quality 'best'"),
        (lambda: Widget(scene, background=(2.0, 0.0, 0.0)), ValueError, "background"),
        (bad_trait("strengths", {"hat": 1.0}), ProgdfError, "there is no layer hat; there are scarf, ears"),
        (bad_trait("strengths", {"ears": float("nan")}), ProgdfError, "the strength of ears is nan"),
        (bad_trait("strengths", {"ears": 1.1}), ProgdfError, "use a number, 0 to 1"),
        (bad_trait("hidden", ["hat"]), ProgdfError, "there is no layer hat"),
        (bad_trait("camera", {"azimuth": float("inf")}), ValueError, "azimuth"),
        (bad_trait("camera", {"zoom": 2.0}), ValueError, "zoom"),
        (bad_trait("blend", "mix"), ProgdfError, "unknown blend rule"),
        (lambda: widget.strengths.update({"ears": 7.0}), ProgdfError, "ears is 7.0"),
        (
            lambda: widget.set_state({"strengths": {"ears": None}}),
            ProgdfError,
            "ears is None",
        ),
        (bad_trait("strengths", {"ears": "0.5"}), ProgdfError, "the strength of ears is '0.5'"),
        (
            lambda: widget.strengths.pop("ears"),
            ProgdfError,
            "entries of strengths cannot be added or removed",
        ),
        (lambda: operator.ior(widget.strengths, {"ears": float("nan")}), ProgdfError, "ears is nan"),
        (lambda: operator.setitem(widget.camera, "distance", -1.0), ValueError, "distance is -1.0"),
        (lambda: Widget(replace(scene, sh0=scene.sh0 / 0)), ProgdfError, "sh0 holds NaN or infinity"),
        (lambda: widget.snapshot(0, 10), ProgdfError, "0 × 10 cannot be drawn"),
        (lambda: widget.to_html(tmp_path / "no" / "page.html"), ProgdfError, "create it first"),
    ]
    for act, kind, message in cases:
        with pytest.raises(kind, match=re.escape(message)) as caught:
            act()
        assert "\n" not in str(caught.value)
    assert (widget.strengths, widget.camera) == (known, camera)
    assert Widget(scene, [scarf, scarf]).strengths == {"scarf": 1.0, "scarf-2": 1.0}


def test_missing_extra_is_named_in_the_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "viewer.widget")
    monkeypatch.setitem(sys.modules, "anywidget", None)
    with pytest.raises(ProgdfError, match=re.escape("pip install 'progdf-studio[jupyter]'")):
        _ = viewer.Widget


def test_old_import_of_the_widget_names_the_new_location() -> None:
    with pytest.raises(AttributeError, match="`from viewer import Widget`"):
        _ = progdf.Widget
