"""The web page in a real Chromium: its numbers, its pictures, and what a person does with it."""

from __future__ import annotations

import base64
import io
import json
import re
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from progdf.__main__ import main
from progdf.compose.layers import BLENDS, Gains, Layer
from progdf.compose.reference import compose_layers
from progdf.field.baked import GradeForm, SliderRemap, identity_map, lattice_colors
from progdf.field.grade import bake_grade
from progdf.formats.ply import load_ply
from progdf.gaussians import ATTRIBUTES, Gaussians, pack
from progdf.gdf.file import Gdf, load_gdf, save_gdf
from progdf.rasterize import render
from tests.helpers.draws import Draws
from tests.helpers.edits import curved_field, edit_of, growing, some_rows
from tests.helpers.scenes import random_gaussians
from tests.helpers.sessions import bear_files, saved_session
from tests.helpers.stacks import Stack
from tests.helpers.ui_rig import bear
from viewer.camera.view_camera import first_camera, to_camera
from viewer.files.document import Document
from viewer.files.web_page import PageOptions, write_page
from viewer.state.layers import LayerState
from viewer.state.view_state import ViewState
from viewer.web.page import script

playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
SOFTWARE = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
SIZE = 480, 360


@pytest.fixture(scope="session")
def browser() -> Iterator[Any]:
    if CHROMIUM is None:
        pytest.skip("no Chromium is installed")
    with playwright.sync_playwright() as started:
        chromium = started.chromium.launch(executable_path=CHROMIUM, args=SOFTWARE)
        yield chromium
        chromium.close()


@dataclass
class Opened:
    """A page in a tab of its own, and what it asked for and complained of."""

    tab: Any
    requests: list[str]
    complaints: list[str]

    def strengths(self) -> dict[str, float]:
        return self.tab.evaluate("Object.fromEntries(progdf.view.layers.map((l) => [l.name, l.strength]))")

    def camera(self) -> dict[str, Any]:
        return self.tab.evaluate("progdf.camera")

    def picture(self) -> np.ndarray:
        address = self.tab.evaluate("progdf.picture()")
        return np.asarray(Image.open(io.BytesIO(base64.b64decode(address.split(",")[1]))).convert("RGB"))

    def slide(self, strengths: Sequence[float]) -> None:
        self.tab.evaluate(
            "(s) => progdf.change({...progdf.view,"
            " layers: progdf.view.layers.map((l, i) => ({...l, strength: s[i]}))})",
            list(strengths),
        )


@pytest.fixture
def open_page(browser: Any) -> Iterator[Any]:
    contexts = []

    def opening(path: Path, script: str = "", **options: Any) -> Opened:
        context = browser.new_context(viewport=dict(zip(("width", "height"), SIZE, strict=True)) | {}, **options)
        contexts.append(context)
        tab = context.new_page()
        opened = Opened(tab, [], [])
        tab.on("request", lambda request: opened.requests.append(request.url))
        tab.on("pageerror", lambda error: opened.complaints.append(str(error)))
        tab.on("console", lambda message: opened.complaints.append(message.text))
        if script:
            tab.add_init_script(script)
        tab.goto(path.as_uri())
        return opened

    yield opening
    for context in contexts:
        context.close()


def ready(opened: Opened) -> Opened:
    opened.tab.wait_for_selector("body.drawn", timeout=20_000)
    return opened


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    return float(10 * np.log10(255**2 / max(np.mean((a.astype(float) - b) ** 2), 1e-12)))


def grade_form(members: int, degree: int, bands: int, seed: int) -> GradeForm:
    """A map that bends colors, with a residual, a mask and a slider of its own."""
    draws = Draws(seed)
    knots, same = torch.tensor([0.0, 0.5, 1.0]), identity_map(2) if degree else lattice_colors(5)
    bent = same + 0.3 * draws.normal(*same.shape)
    table = torch.stack([same, same + 0.4 * (bent - same), bent])
    if not degree:
        knots, table = knots[::2], table[::2]
    coefficients = torch.linspace(0, 1, len(knots))[:, None]
    residual = (draws.normal(1, members, 3 * bands) * 40).clamp(-127, 127).to(torch.int8)
    ends = torch.tensor([0.0, 0.4, 1.0], dtype=torch.float64), torch.tensor([0.0, 0.6, 1.0], dtype=torch.float64)
    mask = (255 * draws.uniform(members)).to(torch.uint8)
    scale = torch.full((1, 3 * bands), 0.004)
    return GradeForm(degree, knots, table, residual, scale, coefficients, SliderRemap(*ends), mask)


def graded(scene: Gaussians, name: str, degree: int, seed: int) -> Gdf:
    rows = some_rows(scene, 120, seed)
    form = grade_form(len(rows), degree, 1 + min(scene.shN.shape[1], 3), seed)
    return edit_of(scene, rows, bake_grade(form, pack(scene[rows], True)), name)


def document_of(scene: Gaussians, gdfs: Sequence[Gdf]) -> tuple[Document, ViewState]:
    layers = tuple(LayerState(i, gdf.name) for i, gdf in enumerate(gdfs))
    return Document("scene.ply", scene, tuple(gdfs)), ViewState(camera=first_camera(scene), layers=layers)


RUN = """([layers, blend]) => {
  const { composer } = progdf;
  composer.update(layers, blend);
  return Object.fromEntries([...composer.moving].map((name) => [name, [...composer.after[name]]]));
}"""


@pytest.mark.parametrize("degree", [0, 1])
def test_every_attribute_is_that_of_the_plain_form_under_every_rule(
    open_page: Any, tmp_path: Path, degree: int
) -> None:
    scene = random_gaussians(300, seed=5, sh_degree=degree)
    scene = replace(scene, logit_opacities=scene.logit_opacities.clamp(min=-4.0))  # all are on the page
    gdfs = [
        growing(scene, some_rows(scene, 40, 1), 25, 7),
        edit_of(scene, some_rows(scene, 150, 2), curved_field(150, 2, 14 + 3 * len(scene.shN[0])), "shirt"),
        graded(scene, "warm", 2, 3),
        graded(scene, "table", 0, 4),
    ]
    document, view = document_of(scene, gdfs)
    write_page(tmp_path / "page.html", document, view, (), PageOptions(quality="exact"))
    opened = ready(open_page(tmp_path / "page.html"))
    assert opened.complaints == []
    means = np.asarray(opened.tab.evaluate("[...progdf.means]"), np.float32).reshape(-1, 3)
    rows = {row.tobytes(): i for i, row in enumerate(document.scene.means.numpy())}
    order = np.array([rows[row.tobytes()] for row in means])  # of the page's rows in the scene
    place = np.empty(len(order), int)
    place[order] = np.arange(len(order))
    count = opened.tab.evaluate("progdf.composer.count")
    draws = Draws(degree)
    stacks: list[tuple[list[Layer], str]] = [([Layer(g, s)], "adjust") for g in document.gdfs for s in (1.0, 0.0)]
    for blend in BLENDS * 6:
        stacks.append((
            [
                Layer(
                    document.gdfs[i],
                    float(draws.uniform(1)) * 1.2,
                    gains=Gains(*draws.uniform(3).tolist()) if float(draws.uniform(1)) < 0.4 else Gains(),
                    weights=draws.uniform(document.gdfs[i].members) if float(draws.uniform(1)) < 0.4 else None,
                )
                for i in draws.order(4).tolist()
            ],
            blend,
        ))  # fmt: skip
    for number, (layers, blend) in enumerate(stacks):
        sent = []
        for layer in layers:
            edit = next(i for i, gdf in enumerate(document.gdfs) if gdf is layer.gdf)
            at = np.argsort(place[layer.gdf.region.members.numpy()])
            weights = None if layer.weights is None else layer.weights.numpy()[at].tolist()
            gains = {kind: getattr(layer.gains, kind) for kind in ("geometry", "opacity", "color")}
            sent.append({"edit": edit, "strength": layer.strength, "gains": gains, "weights": weights, "paint": number})
        after = opened.tab.evaluate(RUN, [sent, blend])
        plain = compose_layers(document.scene, layers, blend)
        for name in ATTRIBUTES:
            if name not in after:
                continue
            numbers = getattr(plain, name)[torch.from_numpy(order[:count])].numpy()
            page = np.asarray(after[name], np.float32).reshape(numbers.shape)
            if number < 8:  # one layer at an end
                assert page.tobytes() == numbers.tobytes(), (name, number)
            else:
                assert np.abs(page - numbers).max() <= 1e-6 * max(1.0, np.abs(numbers).max()), (name, blend)
