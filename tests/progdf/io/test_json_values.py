"""Tests of hostile JSON: every reader refuses it in one line."""

from __future__ import annotations

from pathlib import Path

import pytest

from progdf.cli.info import main as info
from progdf.errors import ProgdfError
from progdf.io.cameras import load_cameras
from progdf.io.json_values import MAX_NESTING, decode_json
from progdf.io.session import SessionFile, read_session
from tests.helpers.hostile import JSON_TEXTS
from trainer.store.state import StateFolder


@pytest.mark.parametrize("content", JSON_TEXTS.values(), ids=JSON_TEXTS.keys())
def test_hostile_json_is_refused(content: str) -> None:
    with pytest.raises(ValueError) as refused:  # noqa: PT011  of one line, whatever it says
        decode_json(content)
    assert "\n" not in str(refused.value)


def test_ordinary_values_are_unchanged() -> None:
    text = '{"a": [1, -2.5, true, null, "ä\\ud83d\\ude00"], "b": {"c": 123456789012345678}}'
    assert decode_json(text) == {
        "a": [1, -2.5, True, None, "ä\N{GRINNING FACE}"],
        "b": {"c": 123456789012345678},
    }
    assert decode_json("1" + "0" * 30) == 1e30
    deep = "[" * MAX_NESTING + "]" * MAX_NESTING
    assert decode_json(deep) is not None


@pytest.mark.parametrize("content", JSON_TEXTS.values(), ids=JSON_TEXTS.keys())
@pytest.mark.parametrize(
    "frame",
    [
        '{"progdf_session": 1, "scene": {"file": "a", "sha256": ""}, "view": {"layers": %s}}',
        '{"cameras": [{"width": 4, "height": 4, "K": %s}]}',
    ],
    ids=["session", "cameras"],
)
def test_every_reader_refuses_hostile_json_in_one_line(frame: str, content: str, tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    path.write_text(frame % content)
    readers = [lambda: info([str(path)]), lambda: load_cameras(path), lambda: read_session(path, SessionFile)]
    for read in readers:
        with pytest.raises(ProgdfError) as refused:
            read()
        assert "\n" not in str(refused.value)


@pytest.mark.parametrize("content", JSON_TEXTS.values(), ids=JSON_TEXTS.keys())
def test_stopped_run_with_hostile_json_is_damaged(content: str, tmp_path: Path) -> None:
    folder = StateFolder(tmp_path)
    (tmp_path / "run.json").write_text(f'{{"options": {content}}}')
    with pytest.raises(ProgdfError, match="is damaged"):
        folder.identity()
