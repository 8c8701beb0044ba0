"""torch uses one thread while the viewer draws and all threads while edits are read."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch

from progdf import threads
from progdf.gdf.file import Gdf, load_gdf
from tests.helpers.ui_rig import bear
from viewer.commands import render
from viewer.files import document


def test_commands_draw_on_one_thread_and_read_edits_on_all(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    seen: list[tuple[str, int]] = []

    def reading(path: Path, *where: Any) -> Gdf:
        seen.append(("read", torch.get_num_threads()))
        return load_gdf(path, *where)

    def drawing(self: object, *_: object, **__: object) -> None:
        seen.append(("draw", torch.get_num_threads()))
        raise KeyboardInterrupt

    monkeypatch.setattr(threads, "MAX_THREADS", 3)
    monkeypatch.setattr(document, "load_gdf", reading)
    monkeypatch.setattr(render.ViewEngine, "image", drawing)
    before = torch.get_num_threads()
    scene, edit, *_ = bear().save(tmp_path)
    with pytest.raises(KeyboardInterrupt):
        render.render([str(scene), str(edit), "--engine", "cpu", "-o", str(tmp_path / "out.png")])
    assert seen == [("read", 3), ("draw", 1)]
    assert torch.get_num_threads() == before
