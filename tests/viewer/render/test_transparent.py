"""Pictures with a transparent background, in the library and on the command line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from progdf.__main__ import main
from tests.helpers.ui_rig import bear
from viewer.pictures.film import unmix


def test_color_and_coverage_are_recovered_from_black_and_white() -> None:
    color = np.array([0.8, 0.4, 0.2], np.float32)
    for alpha in (0.0, 0.25, 1.0):
        black = np.broadcast_to(alpha * color, (2, 3, 3)).astype(np.float32)
        rgba = unmix(black, black + np.float32(1.0 - alpha))
        assert rgba.shape == (2, 3, 4)
        assert (rgba[..., 3] == round(255 * alpha)).all()
        if alpha:
            assert np.abs(rgba[0, 0, :3] / 255.0 - color).max() < 0.003


def test_render_writes_a_picture_that_can_be_overlaid(tmp_path: Path) -> None:
    scene = bear().save(tmp_path)[0]
    over = tmp_path / "over.png"
    opaque = tmp_path / "opaque.png"
    words = ["--size", "64x48", "--engine", "cpu", "--background", "#204060"]
    assert main(["render", str(scene), "-o", str(over), "--alpha", *words]) == 0
    assert main(["render", str(scene), "-o", str(opaque), *words]) == 0
    with Image.open(over) as cut, Image.open(opaque) as whole:
        assert cut.mode == "RGBA"
        alpha = np.asarray(cut)[..., 3]
        assert alpha.min() == 0
        assert alpha.max() == 255
        laid = Image.new("RGBA", cut.size, "#204060")
        laid.alpha_composite(cut)
        difference = np.asarray(laid.convert("RGB"), int) - np.asarray(whole.convert("RGB"))
    assert np.abs(difference).max() <= 2


def test_comparisons_cannot_be_transparent(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene = bear().save(tmp_path)[0]
    assert main(["render", str(scene), "-o", str(tmp_path / "a.png"), "--alpha", "--split"]) == 2
    assert "--alpha goes with a picture or a film" in capsys.readouterr().err
