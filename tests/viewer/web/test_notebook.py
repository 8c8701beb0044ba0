"""docs/notebook.ipynb in a real JupyterLab and Chromium, driven by the mouse."""

from __future__ import annotations

import base64
import io
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from tests.helpers.paths import ROOT

NOTEBOOK = ROOT / "docs" / "notebook.ipynb"
KEPT = """
  const context = HTMLCanvasElement.prototype.getContext;
  HTMLCanvasElement.prototype.getContext = function (kind, options) {
    return context.call(this, kind, { ...options, preserveDrawingBuffer: true });
  };
"""
PYTHON = """async (code) => {
  const kernel = jupyterapp.shell.currentWidget.context.sessionContext.session.kernel;
  const future = kernel.requestExecute({ code });
  let text = "";
  future.onIOPub = ({ content }) => { text += content.text ?? content.evalue ?? ""; };
  await future.done;
  return text.trim();
}"""
CANVAS = (
    "[...document.querySelectorAll('.jp-OutputArea-output div')].find((element) => element.shadowRoot)"
    ".shadowRoot.querySelector('canvas')"
)
CELL = "jupyterapp.shell.currentWidget.content.activeCellIndex"


@pytest.fixture
def jupyter(tmp_path: Path) -> Iterator[str]:
    """Start a JupyterLab server on a copy of the notebook; yield its address."""
    for name in ("anywidget", "jupyterlab"):  # checked here because importing them takes seconds
        pytest.importorskip(name, reason=f"{name} is not installed")
    shutil.copy(NOTEBOOK, tmp_path)
    settings = tmp_path / "settings" / "labconfig"
    settings.mkdir(parents=True)
    quiet = {"disabledExtensions": {"@jupyterlab/apputils-extension:announcements": True}}
    (settings / "page_config.json").write_text(json.dumps(quiet))
    folders = {f"JUPYTER_{kind}_DIR": str(tmp_path / kind) for kind in ("RUNTIME", "DATA")}
    folders |= {"JUPYTER_CONFIG_DIR": str(settings.parent), "JUPYTERLAB_SETTINGS_DIR": str(tmp_path / "user")}
    folders |= {
        "JUPYTERLAB_WORKSPACES_DIR": str(tmp_path / "spaces"),
        "IPYTHONDIR": str(tmp_path / "ipython"),
    }
    options = ["--no-browser", "--allow-root", "--ServerApp.port=0", "--IdentityProvider.token="]
    options += [f"--ServerApp.root_dir={tmp_path}", "--LabApp.expose_app_in_browser=True"]
    environment = os.environ | folders | {"PYTHONPATH": str(ROOT)}
    with (tmp_path / "log").open("w") as log:
        server = subprocess.Popen(
            [sys.executable, "-P", "-m", "jupyterlab", *options], env=environment, stdout=log, stderr=log
        )
    try:
        yield wait_for_address(tmp_path, server)
    finally:
        server.terminate()
        server.wait(30)


def wait_for_address(folder: Path, server: subprocess.Popen[bytes]) -> str:
    for _ in range(600):
        for about in (folder / "RUNTIME").glob("jpserver-*.json"):
            return f"{json.loads(about.read_text())['url']}lab/tree/{NOTEBOOK.name}"
        assert server.poll() is None, (folder / "log").read_text()
        time.sleep(0.1)
    raise AssertionError((folder / "log").read_text())


def picture(tab: Any) -> np.ndarray:
    for _ in range(12):
        tab.evaluate("new Promise(requestAnimationFrame)")
    address = tab.evaluate(f"{CANVAS}.toDataURL()")
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(address.split(",")[1]))).convert("RGB"))


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    return float(10 * np.log10(255**2 / max(np.mean((a.astype(float) - b) ** 2), 1e-12)))


@pytest.mark.slow
def test_notebook_runs_in_jupyterlab_and_its_sliders_sync_both_ways(
    browser: Any, jupyter: str, tmp_path: Path
) -> None:
    context = browser.new_context(viewport={"width": 1280, "height": 800})
    tab, complaints = context.new_page(), list[str]()
    tab.on("pageerror", lambda error: complaints.append(str(error)))
    tab.add_init_script(KEPT)
    tab.goto(jupyter)
    tab.wait_for_function("globalThis.jupyterapp?.shell.currentWidget?.context?.isReady", timeout=60_000)
    tab.evaluate("jupyterapp.shell.currentWidget.context.sessionContext.ready")
    tab.evaluate("jupyterapp.commands.execute('notebook:run-all-cells')")

    def python(code: str) -> str:
        return str(tab.evaluate(PYTHON, code))

    assert python("print(widget.strengths)") == "{'scarf': 0.8, 'evening': 0.35}"
    outputs = tab.evaluate(
        "jupyterapp.shell.currentWidget.model.toJSON().cells.flatMap((c) => c.outputs ?? [])"
    )
    assert [output for output in outputs if output["output_type"] == "error"] == []
    widget = tab.locator(".jp-OutputArea-output .page.drawn")
    widget.scroll_into_view_if_needed()
    widget.locator("#fold").click()

    def snapshot() -> np.ndarray:
        height, width, _ = picture(tab).shape
        python(f"widget.snapshot({width}, {height}).save('now.png')")
        return np.asarray(Image.open(Path(python("import os; print(os.getcwd())"), "now.png")))

    first = picture(tab)
    assert psnr(first, snapshot()) >= 50
    python("widget.strengths = {'scarf': 0.0, 'evening': 1.0}")
    second = picture(tab)
    assert psnr(first, second) < 40
    assert psnr(second, snapshot()) >= 50

    widget.locator("#fold").click()
    light = picture(tab)
    color = "([panel]) => getComputedStyle(panel).color"
    ink = widget.locator("#panel").evaluate_all(color)
    tab.evaluate("jupyterapp.commands.execute('apputils:change-theme', {theme: 'JupyterLab Dark'})")
    tab.wait_for_function("document.body.dataset.jpThemeLight === 'false'")
    assert psnr(picture(tab), light) > 90
    assert widget.locator("#panel").evaluate_all(color) != ink, "the panel goes with the theme"
    box = widget.get_by_role("slider", name="scarf").bounding_box()
    tab.mouse.move(box["x"] + 8, box["y"] + box["height"] / 2)
    tab.mouse.down()
    tab.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2, steps=8)
    tab.mouse.up()
    tab.keyboard.press("ArrowRight")
    for _ in range(50):  # messages of the drag may still be on their way
        moved = float(python("print(widget.strengths['scarf'])"))
        if moved == pytest.approx(0.51, abs=0.02):
            break
    assert moved == pytest.approx(0.51, abs=0.02)

    cells = tab.evaluate("jupyterapp.shell.currentWidget.content.widgets.length")
    active = tab.evaluate(CELL)
    for key in ("d", "d", "b", "ArrowDown", "p"):
        tab.keyboard.press(key)
    assert tab.evaluate("jupyterapp.shell.currentWidget.content.widgets.length") == cells
    assert tab.evaluate(CELL) == active, "the keys of a slider are none of the notebook's"

    tab.evaluate(f"globalThis.gl = {CANVAS}.getContext('webgl2')")
    python("widget.close()")
    tab.wait_for_function("gl.isContextLost()")
    assert complaints == []
    context.close()
