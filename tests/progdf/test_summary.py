"""Tests of the notebook cards of scenes, fields and edits."""

from __future__ import annotations

import base64
import html
import io
import re
import subprocess
import sys
import time
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from progdf.field.baked import lattice_colors
from progdf.formats.cube import write_cube
from progdf.gaussians import Gaussians, concatenate
from progdf.gdf.file import Gdf, read_gdf
from progdf.summary import to_html
from tests.helpers.demo_scenes import bear
from tests.helpers.edits import curved_field, edit_of, growing, some_rows
from tests.helpers.scenes import random_gaussians

ROOT = Path(__file__).parents[2]
HOSTILE = "</div><script>alert(1)</script><img src=x onerror='alert(2)'>"


class Tags(HTMLParser):
    def __init__(self, text: str) -> None:
        super().__init__()
        self.names: list[str] = []
        self.words: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: object) -> None:
        self.names.append(tag)

    def handle_data(self, data: str) -> None:
        self.words.append(data)


def still(card: str) -> np.ndarray:
    """Return the picture of a card. [H,W,4] uint8"""
    source = re.search("src='data:image/webp;base64,([^']+)'", card)
    assert source is not None
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(source[1]))).convert("RGBA"))


def shirt(scene: Gaussians, name: str = "shirt") -> Gdf:
    rows = some_rows(scene, 50, 2)
    return edit_of(scene, rows, curved_field(len(rows), 2, 14 + 3 * scene.shN.shape[1]), name)


def test_scene_card_shows_a_front_view_and_the_size() -> None:
    scene = bear(1500).gaussians
    card = to_html(scene)
    assert Tags(card).words == ["1 500 Gaussians", "SH degree 1", "138.0 kB in memory"]
    pixels = still(card)
    assert pixels.shape == (200, 300, 4)
    assert len(card) < 40_000
    solid = pixels[..., 3] > 200
    assert 0.1 < solid.mean() < 0.9, "on nothing, for light and dark pages"
    middle = pixels[60:120, 110:190, :3].reshape(-1, 3).mean(axis=0)
    assert middle[0] > middle[2] + 30, "the bear, which is brown, is in the middle"


def test_card_of_a_large_scene_is_fast_and_small() -> None:
    scene = concatenate([bear(6000).gaussians] * 20)
    to_html(scene)
    began = time.process_time()
    card = to_html(scene)
    assert time.process_time() - began < 2.0
    assert len(card) < 40_000


def test_edit_and_field_cards_show_their_curves_and_size() -> None:
    edit = shirt(random_gaussians(300, seed=3, sh_degree=1))
    for shown in (edit, edit.field):
        card = to_html(shown)
        assert card.count("<polyline") == 3, "geometry, opacity and color"
        assert card.count("v5") == len(edit.field.recorded)
        assert "separable field" in card
    assert Tags(to_html(edit)).words[3] == "shirt"
    assert "50 members of 300 Gaussians" in to_html(edit)
    assert "7 rows added" in to_html(growing(random_gaussians(300, seed=3), torch.arange(20), 7, 1))


def test_untrusted_texts_are_escaped() -> None:
    edit = replace(
        shirt(random_gaussians(100, seed=3), HOSTILE), instruction=HOSTILE + "\x1b[2J" + "x" * 10_000
    )
    card = to_html(edit)
    tags = Tags(card)
    assert set(tags.names) == {"div", "b", "svg", "path", "polyline", "text"}
    assert HOSTILE[:59] + "…" in tags.words
    assert html.escape(HOSTILE[:20]) in card
    assert len(card) < 8_000


@pytest.mark.parametrize("broken", ["empty", "nan", "far", "double", "grad", "one"])
def test_undrawable_scene_has_a_card_without_a_picture(broken: str) -> None:
    scene = random_gaussians(60, seed=1)
    scene = {
        "empty": lambda: scene[:0],
        "nan": lambda: replace(scene, means=torch.full_like(scene.means, float("nan"))),
        "far": lambda: replace(scene, log_scales=torch.full_like(scene.log_scales, 1e30)),
        "double": lambda: scene.to(dtype=torch.float64),
        "grad": lambda: replace(scene, means=scene.means.clone().requires_grad_()),
        "one": lambda: scene[:1],
    }[broken]()
    assert f"{len(scene)} Gaussian" in to_html(scene)
    assert ("src=" in to_html(scene)) == (broken in ("double", "grad", "one"))


def test_card_of_an_unbaked_edit_shows_not_baked(tmp_path: Path) -> None:
    write_cube(tmp_path / "warm.cube", lattice_colors(2), "warm")
    card = to_html(read_gdf(tmp_path / "warm.cube"))
    assert "not baked" in card
    assert "<svg" not in card


NOTEBOOK = """
from IPython.core.interactiveshell import InteractiveShell
shell = InteractiveShell.instance()
from progdf.demo_scenes import bear
scene = bear(500).gaussians
data, _ = shell.display_formatter.format(scene)
print("500 Gaussians" in data["text/html"])
"""


@pytest.mark.slow
def test_ipython_shows_a_scene_as_its_card() -> None:
    run = subprocess.run([sys.executable, "-c", NOTEBOOK], capture_output=True, text=True, cwd=ROOT)
    assert run.stdout.strip() == "True", run.stderr
