"""Editor `command:…` with real programs: strengths, failures, time limits and what a catalogue may run."""

from __future__ import annotations

import re
import shlex
import sys
import threading
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from progdf.errors import ProgdfError
from progdf.gdf.file import read_gdf
from tests.helpers.trained import quick_options, small, train, write_bear
from trainer import cli
from trainer.editors import make_editor
from trainer.editors.command import (
    ATTEMPTS,
    CallFailedError,
    CommandEditor,
    Programs,
    check_command_editor,
    parse_command,
)
from trainer.options import EditorOptions, with_values
from trainer.resolve import resolve
from trainer.run.command import check_command

DARKEN = """
import sys
from PIL import Image
source, target, strength = sys.argv[1:4]
Image.open(source).point(lambda level: int(level * (1 - 0.5 * float(strength)))).save(target)
"""

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="programs are written as POSIX scripts")


def program(folder: Path, code: str, arguments: str = "{input} {output} {strength}") -> str:
    """Write a Python program and return the `command:` editor that runs it."""
    path = folder / "edit.py"
    path.write_text(code, encoding="utf-8")
    return f"command:{shlex.quote(sys.executable)} {shlex.quote(str(path))} {arguments}"


def editor_of(spec: str, **more: object) -> CommandEditor:
    case = small()
    options = replace(EditorOptions(spec), **more)  # type: ignore[arg-type]
    editor = make_editor(options, case.scene, case.region, case.views)
    assert isinstance(editor, CommandEditor)
    return editor


def count_calls(folder: Path) -> int:
    return len((folder / "calls").read_text(encoding="utf-8"))


COUNT = "open(__file__.replace('edit.py', 'calls'), 'a').write('x')\n"


def test_arguments_take_every_value_and_no_shell_sees_them() -> None:
    command = parse_command(
        "edit '{input} copy' {output} {strength} {percent} {100..30} {-1..1} {prompt} {{x}}"
    )
    values = {"input": "a b.png", "output": "$(rm).png", "prompt": "; ls"}
    words = command.fill(values, 0.25)
    assert words == ["edit", "a b.png copy", "$(rm).png", "0.25", "25", "82.5", "-0.5", "; ls", "{x}"]
    assert command.has_strength
    assert not parse_command("edit {input} {output} {seed}").has_strength


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("", "needs a program"),
        ("edit {input}", "{output} is missing"),
        ("edit {output}", "{input} is missing"),
        ("edit {input} {output} {amount}", "{amount} is not a placeholder"),
        ("edit {input} {output} {1..}", "{1..} is not a placeholder"),
        ("edit '{input} {output}", "no closing quotation"),
        ("no-such-program-here {input} {output}", "is not a program here"),
        (f"{sys.executable} {{input}} {{output}} {{prompt}}", "add --prompt"),
    ],
)
def test_invalid_command_is_a_one_line_error_with_a_remedy(text: str, fault: str) -> None:
    with pytest.raises(ProgdfError, match=re.escape(fault)) as caught:
        check_command_editor(text, EditorOptions(f"command:{text}"))
    assert "\n" not in str(caught.value)
    assert "; " in str(caught.value)


def test_program_edits_views_at_every_strength(tmp_path: Path) -> None:
    editor = editor_of(program(tmp_path, DARKEN))
    view = small().views[1]
    assert editor.stages == ()
    assert torch.equal(editor.edit(view, 0.0), view.image)
    for strength in (0.5, 1.0):
        expected = view.image * (1 - 0.5 * strength)
        assert float((editor.edit(view, strength) - expected).abs().max()) < 2.1 / 255


def test_program_without_a_strength_makes_the_end_only_or_is_cross_faded(tmp_path: Path) -> None:
    spec = program(tmp_path, DARKEN, "{input} {output} 1")
    assert editor_of(spec).stages == (1.0,)
    faded = editor_of(spec, strengths_by="blend")
    view = small().views[1]
    assert faded.stages == ()
    low, half, end = (float(faded.edit(view, s).mean()) for s in (0.0, 0.5, 1.0))
    assert half == pytest.approx((low + end) / 2, abs=0.02)
    with pytest.raises(ProgdfError, match="strengths-by blend is for programs without a strength"):
        editor_of(program(tmp_path, DARKEN), strengths_by="blend")


def test_mask_seed_prompt_and_view_reach_the_program(tmp_path: Path) -> None:
    code = (
        "import sys\nfrom PIL import Image\n"
        "assert sys.argv[4:] == ['7', 'a red hat; $HOME', sys.argv[6]]\nassert sys.argv[6]\n"
        "mask = Image.open(sys.argv[3]).convert('L')\npicture = Image.open(sys.argv[1])\n"
        "picture.paste((255, 0, 0), mask=mask)\npicture.save(sys.argv[2])\n"
    )
    spec = program(tmp_path, code, "{input} {output} {mask} {seed} {prompt} {view}")
    editor = editor_of(spec, seed=7, prompt="a red hat; $HOME")
    view = small().views[0]
    edited = editor.edit(view, 1.0)
    inside = view.mask > 0.999
    assert torch.equal(edited[inside], torch.tensor([1.0, 0.0, 0.0]).expand_as(edited[inside]))
    assert float((edited - view.image)[view.mask == 0].abs().max()) < 1 / 255


@pytest.mark.parametrize(
    ("code", "fault"),
    [
        ("print('out of paint')\nraise SystemExit(3)", "ended with status 3: out of paint"),
        ("pass", "wrote no picture"),
        ("import sys\nopen(sys.argv[2], 'w').write('text')", "its picture cannot be used"),
        (
            "import sys\nfrom PIL import Image\nImage.new('RGB', (64, 20)).save(sys.argv[2])",
            "its picture cannot be used",
        ),
        ("import sys, shutil\nshutil.copy(sys.argv[1], sys.argv[2])", "does not change the view"),
    ],
)
def test_failing_program_is_a_one_line_error(code: str, fault: str, tmp_path: Path) -> None:
    with pytest.raises(ProgdfError, match=fault) as caught:
        editor_of(program(tmp_path, COUNT + code))
    assert "\n" not in str(caught.value)
    assert count_calls(tmp_path) == (ATTEMPTS if "does not change" not in fault else 1)


def test_program_over_the_time_limit_is_killed(tmp_path: Path) -> None:
    code = "import threading\nthreading.Event().wait()"
    with pytest.raises(ProgdfError, match=r"takes more than 0\.2 seconds; allow more with --edit-timeout"):
        editor_of(program(tmp_path, code), edit_timeout=0.2)


@pytest.mark.skipif(sys.platform == "win32", reason="the test reads /proc")
def test_program_over_the_time_limit_ends_with_its_children(tmp_path: Path) -> None:
    code = (
        "import subprocess, sys, threading\n"
        "wait = [sys.executable, '-c', 'import threading; threading.Event().wait()']\n"
        "child = subprocess.Popen(wait)\n"
        "open(__file__.replace('edit.py', 'child'), 'w').write(str(child.pid))\n"
        "threading.Event().wait()"
    )
    with pytest.raises(ProgdfError, match="takes more than 2 seconds"):
        editor_of(program(tmp_path, code), edit_timeout=2.0)
    child = Path("/proc", (tmp_path / "child").read_text(encoding="utf-8"))
    for _ in range(100):  # an orphan is removed by the system a moment later
        if not child.exists() or "State:\tZ" in (child / "status").read_text(encoding="utf-8"):
            return
        threading.Event().wait(0.05)
    pytest.fail("the child still runs")


def test_stopped_editor_ends_its_programs_and_starts_none(tmp_path: Path) -> None:
    program_words = [sys.executable, "-c", "import threading; threading.Event().wait()"]
    programs = Programs()
    threading.Timer(0.3, programs.stop).start()
    with pytest.raises(CallFailedError):
        programs.run(program_words, 60.0)
    with pytest.raises(CallFailedError, match="it is stopped"):
        programs.run(program_words, 60.0)


def test_failed_call_is_made_again(tmp_path: Path) -> None:
    unreliable = (
        COUNT + "import os\nif os.path.getsize(__file__.replace('edit.py', 'calls')) % 2: raise OSError\n"
    )
    editor = editor_of(program(tmp_path, unreliable + DARKEN))
    view = small().views[2]
    assert float((editor.edit(view, 1.0) - 0.5 * view.image).abs().max()) < 2.1 / 255


def test_random_program_is_named_in_the_log(tmp_path: Path) -> None:
    code = (
        "import random, sys\nfrom PIL import Image\n"
        "Image.new('RGB', Image.open(sys.argv[1]).size, random.randrange(2**24)).save(sys.argv[2])\n"
    )
    lines: list[str] = []
    case = small()
    options = EditorOptions(program(tmp_path, code, "{input} {output}"))
    make_editor(options, case.scene, case.region, case.views, say=lines.append)
    assert "differs from call to call" in lines[0]
    make_editor(
        EditorOptions(program(tmp_path, DARKEN)), case.scene, case.region, case.views, say=lines.append
    )
    assert "the same each time" in lines[1]


@pytest.mark.slow
def test_run_trains_an_edit_and_asks_for_no_picture_twice(tmp_path: Path) -> None:
    write_bear(tmp_path)
    listing = (
        "import sys\nprint(*sys.argv[3:], file=open(__file__.replace('edit.py', 'calls'), 'a'), flush=True)\n"
    )
    spec = program(tmp_path, listing + DARKEN, "{input} {output} {strength} {view}")
    options = with_values(
        quick_options(tmp_path),
        name="dark",
        editor=spec,
        kind="color",
        steps=48,
        stages=2,
        views=4,
        edit_workers=3,
    )
    check_command(resolve(options))
    train(options)
    calls = (tmp_path / "calls").read_text(encoding="utf-8").splitlines()
    tried = calls[0]
    assert calls[1] == tried, "the first view is tried twice"
    assert len(set(calls)) == len(calls) - 1, "and nothing else is"
    assert read_gdf(tmp_path / "run" / "dark.gdf").instruction == spec
    trajectory = (tmp_path / "run" / "trajectory.safetensors").read_bytes()
    train(with_values(options, edit_workers=1, out=tmp_path / "again"))
    assert (tmp_path / "again" / "trajectory.safetensors").read_bytes() == trajectory


def test_messages_of_the_program_are_kept_beside_its_pictures(tmp_path: Path) -> None:
    case = small()
    options = EditorOptions(program(tmp_path, "print('ten strokes')\n" + DARKEN), cache=tmp_path / "painted")
    make_editor(options, case.scene, case.region, case.views)
    log = (tmp_path / "painted" / "command.log").read_text(encoding="utf-8")
    assert log.startswith(f"{case.views[0].camera.name} at strength 1:\nten strokes\n")


def test_catalogue_runs_programs_only_if_it_is_allowed_to(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_bear(tmp_path)
    spec = program(tmp_path, COUNT + DARKEN)
    catalogue = tmp_path / "catalogue.toml"
    catalogue.write_text(
        '[[scenes]]\npath = "scene.ply"\n[[scenes.edits]]\nname = "dark"\nregion = "all"\n'
        f"editor = {spec!r}\n",
        encoding="utf-8",
    )
    command = [str(catalogue), "--out", str(tmp_path / "runs"), "--dry-run", "--workers", "1"]
    assert cli.batch(command) == 2
    assert "add --allow-commands" in capsys.readouterr().err
    assert cli.batch([*command, "--allow-commands"]) == 0
    assert "scene/dark" in capsys.readouterr().out
    assert not (tmp_path / "calls").exists()
