"""CLIP directional similarity: formula, a real model from disk, and reasons for not measuring it."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor

from progdf.errors import ProgdfError
from progdf.field import BakedField
from progdf.io.images import to_picture
from tests.helpers.tiny_clip import tiny_clip
from tests.helpers.trained import WHITE, quick_options, small, train, write_bear
from trainer.fit.evaluate import make_evaluator
from trainer.options import FitOptions, TextOptions, with_values
from trainer.report.clip import Clip, direction, load_clip, square_picture
from trainer.report.measures import clip_curve
from trainer.resolve import resolve
from trainer.run.finish import refit


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a tiny CLIP model."""
    pytest.importorskip("transformers")
    return tiny_clip(tmp_path_factory.mktemp("clip"))


def _unit(*values: float) -> Tensor:
    return torch.nn.functional.normalize(torch.tensor(values), dim=0)


def test_direction_is_1_for_the_described_change_and_minus_1_reversed() -> None:
    bear = _unit(1.0, 0.0, 0.2)
    golden = _unit(0.8, 0.6, 0.2)
    before = _unit(0.1, 0.2, 1.0)
    steps = torch.stack([before + 0.1 * (golden - bear), before - 0.1 * (golden - bear)])
    found = direction(before.expand(2, 3), steps, bear, golden)
    assert found == pytest.approx([1.0, -1.0], abs=1e-5)


def test_unchanged_picture_or_text_has_no_direction() -> None:
    a = _unit(1.0, 2.0, 3.0)
    b = _unit(3.0, 1.0, 0.0)
    assert direction(a[None], a[None], a, b) == [None]
    assert direction(a[None], b[None], a, a) == [None]
    rounded = a * (1.0 + 2e-7)
    assert direction(a[None], rounded[None], a, b) == [None]
    assert direction(a[None], b[None], a, rounded) == [None]


def test_model_from_disk_gives_distinct_unit_features(saved: Path) -> None:
    clip = load_clip(str(saved))
    torch.manual_seed(1)
    pictures = clip.pictures([torch.rand(40, 60, 3), torch.rand(40, 60, 3)])
    sentences = clip.texts(["a bear", "a golden bear " * 40])
    for features in (pictures, sentences):
        assert features.shape == (2, 12)
        assert torch.allclose(features.norm(dim=1), torch.ones(2))
        assert float((features[0] - features[1]).norm()) > 1e-3


def test_features_match_the_original_model(saved: Path) -> None:
    from transformers import CLIPModel

    clip = load_clip(str(saved))
    image = torch.rand(32, 32, 3, generator=torch.Generator().manual_seed(2))
    mean = torch.tensor([0.48145466, 0.4578275, 0.40821073])
    spread = torch.tensor([0.26862954, 0.26130258, 0.27577711])
    model = CLIPModel.from_pretrained(saved).eval()
    with torch.no_grad():
        seen = model.vision_model(pixel_values=((image - mean) / spread).permute(2, 0, 1)[None])
        expected = model.visual_projection(seen.pooler_output)
    assert torch.allclose(clip.pictures([image])[0], expected[0] / expected.norm(), atol=1e-5)


def test_return_values_of_older_transformers_are_accepted() -> None:
    features = torch.tensor([[3.0, 4.0]])

    def network(answer: Any) -> Any:
        return SimpleNamespace(get_image_features=lambda pixel_values: answer)

    for answer in (features, SimpleNamespace(pooler_output=features)):
        found = Clip(network(answer), None, 16, "tiny").pictures([torch.zeros(8, 8, 3)])
        assert torch.allclose(found, torch.tensor([[0.6, 0.8]]))


def test_wide_picture_is_seen_whole() -> None:
    image = torch.zeros(20, 60, 3)
    image[:, :4] = torch.tensor([1.0, 0.0, 0.0])
    seen = square_picture(image, 30)
    assert seen.shape == (3, 30, 30)
    assert float(seen[0, 15, 0]) > 0.9
    assert float(seen[1, 15, 0]) < 0.1
    assert torch.allclose(seen[:, 0], torch.ones(3, 30))


def test_pictures_are_scaled_like_pillow_does_for_clip() -> None:
    # away from black and white, because Pillow clamps overshoot between its two passes
    image = 0.3 + 0.4 * torch.rand(50, 50, 3, generator=torch.Generator().manual_seed(0))
    scaled = to_picture(image).resize((32, 32), Image.Resampling.BICUBIC)
    expected = torch.from_numpy(np.asarray(scaled, dtype=np.float32) / 255)
    assert (square_picture(image, 32).permute(1, 2, 0) - expected).abs().max() < 2.5 / 255


def test_missing_or_wrong_clip_model_error_names_the_remedy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("transformers")
    with pytest.raises(ProgdfError, match="hf download nobody/no-such-clip"):
        load_clip("nobody/no-such-clip")
    with pytest.raises(ProgdfError, match="does not hold a complete CLIP model"):
        load_clip(str(tmp_path))
    (tmp_path / "config.json").write_text(json.dumps({"model_type": "bert"}))
    with pytest.raises(ProgdfError, match="bert model, not CLIP"):
        load_clip(str(tmp_path))
    monkeypatch.setitem(sys.modules, "transformers", None)
    with pytest.raises(ProgdfError, match=r"pip install 'progdf-studio\[clip\]"):
        load_clip("nobody/no-such-clip")


def test_instruction_is_not_used_as_text_after() -> None:
    options = quick_options(Path(), editor='instruct:"make it gold"', text_before="a bear")
    assert resolve(options).texts.text_after == ""
    assert resolve(with_values(options, text_after="a golden bear")).texts.text_after == "a golden bear"


@pytest.mark.slow
def test_run_reports_clip_along_the_slider_and_refit_accepts_other_texts(
    tmp_path: Path, saved: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("trainer.report.measures.CLIP_MODEL", str(saved))
    write_bear(tmp_path)
    options = quick_options(tmp_path, steps=24, stages=2, views=5, text_before="a bear", text_after="blue")
    result = train(options, quiet=True)
    edit = result.report["edit"]
    course = result.report["curves"]["clip_direction"]
    assert course["s"][0] == 0.0
    assert course["similarity"][0] is None
    assert len(course["similarity"]) == 11
    assert edit["clip_direction"] == course["similarity"][-1]
    assert -1.0 <= edit["clip_direction"] <= 1.0
    assert edit["clip_model"] == saved.name

    again = refit(with_values(FitOptions(result.folder.root), text_after="zebra", threads=1), quiet=True)
    assert again.report["edit"]["clip_direction"] != edit["clip_direction"]


def test_reason_for_not_measuring_clip_is_reported(saved: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bear = small(count=3)
    unedited = {1.0: [view.image for view in bear.views]}
    evaluator = make_evaluator(bear.scene, bear.region, bear.views, unedited, WHITE, 14)

    def reason(before: str, after: str, model: str = str(saved)) -> str:
        monkeypatch.setattr("trainer.report.measures.CLIP_MODEL", model)
        found = clip_curve(
            evaluator,
            bear.views,
            BakedField("separable", torch.tensor([0.0, 1.0]), {}, 14),
            TextOptions(before, after),
        )
        assert not found.s
        return found.reason

    assert "--text-after is missing" in reason("a bear", "")
    assert "same features" in reason("a bear", "a bear")
    assert "hf download" in reason("a bear", "gold", "nobody/no-such-clip")
