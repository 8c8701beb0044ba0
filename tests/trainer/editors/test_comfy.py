"""Editor `comfy:WORKFLOW.json` with a real HTTP server that runs the graph's titles."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from threading import Event
from typing import Any

import pytest
import torch
from PIL import Image

from progdf.errors import ProgdfError
from tests.helpers.comfy_server import Job, Result, comfy_server, edit
from tests.helpers.image_server import Refusal, swap_colors
from tests.helpers.trained import quick_options, small, train, write_bear
from trainer import cli
from trainer.editors import make_editor
from trainer.editors.painter import PaintRequest, RefusedError
from trainer.editors.server.comfy import check_comfy
from trainer.editors.server.editor import ServedEditor, explain_sending
from trainer.options import EditorOptions, with_values

WORKFLOWS = Path(__file__).parents[3] / "docs" / "workflows"


@pytest.fixture(autouse=True)
def _short_waits(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("trainer.editors.server.calls.RETRIES", 2)
    monkeypatch.setattr("trainer.editors.server.calls._FIRST_WAIT_S", 0.01)
    monkeypatch.setattr("trainer.editors.server.comfy._FIRST_POLL_S", 0.01)


def node(kind: str, title: str, **inputs: object) -> dict[str, Any]:
    return {"class_type": kind, "inputs": inputs, "_meta": {"title": title}}


def graph() -> dict[str, Any]:
    """Return a workflow with all roles, around a custom node."""
    return {
        "1": node("LoadImage", "Input", image=""),
        "2": node("LoadImage", "reference", image=""),
        "3": node("ColorMatch", "match colors", image=["1", 0], reference=["2", 0]),
        "4": node("LoadImage", "reference 2", image=""),
        "5": node("LoadImageMask", "mask", image="", channel="red"),
        "6": node("PrimitiveStringMultiline", "prompt", value="turn it into marble"),
        "7": node("PrimitiveFloat", "strength", value=1.0),
        "8": node("PrimitiveInt", "seed", value=0),
        "9": node(
            "EditPicture", "edit", image=["1", 0], text=["6", 0], strength=["7", 0], seed=["8", 0],
            reference=["3", 0], reference_2=["4", 0], mask=["5", 0],
        ),
        "10": node("SaveImage", "output", images=["9", 0], filename_prefix="ComfyUI"),
    }  # fmt: skip


def write(folder: Path, content: object) -> Path:
    path = folder / "workflow.json"
    path.write_text(json.dumps(content), encoding="utf-8")
    return path


def settings_of(path: Path, url: str, **more: object) -> EditorOptions:
    options = EditorOptions(f"comfy:{path}", api_url=url, edit_size=64)
    return replace(options, **more)  # type: ignore[arg-type]


def editor_of(settings: EditorOptions) -> ServedEditor:
    case = small()
    editor = make_editor(settings, case.scene, case.region, case.views)
    assert isinstance(editor, ServedEditor)
    return editor


def paint_first(settings: EditorOptions, **request: object) -> torch.Tensor:
    editor = editor_of(settings)
    return editor.paint(PaintRequest(editor.original(small().views[0]), **request))  # type: ignore[arg-type]


def test_all_titled_nodes_are_filled(tmp_path: Path) -> None:
    path = write(tmp_path, graph())
    with comfy_server(polls=2) as server:
        editor = editor_of(settings_of(path, server.url, prompt="turn it into gold"))
        assert editor.references == 2
        assert editor.has_strength
        original = editor.original(small().views[0])
        mask = torch.zeros(original.shape[:2])
        mask[:8] = 1.0
        painted = editor.paint(
            PaintRequest(original, [original.flip(2), original], mask, strength=0.5, seed=7)
        )
    expected = 0.5 * (original + original.flip(2))
    assert float((painted - expected).abs().max()) < 1.1 / 255
    (job,) = server.jobs
    assert set(job.pictures) == {"input", "reference", "reference 2", "mask"}
    assert job.pictures["reference"].tobytes() == swap_colors(job.pictures["input"]).tobytes()
    assert job.pictures["mask"].getpixel((0, 0)) == (255, 255, 255, 0)
    assert job.pictures["mask"].getpixel((0, 9)) == (0, 0, 0, 255)
    assert job.values["strength"] == 0.5
    assert job.values["seed"] == 7
    assert job.values["prompt"].startswith("turn it into gold\n\nEdit the first picture only")


def test_missing_references_and_their_nodes_are_removed(tmp_path: Path) -> None:
    with comfy_server() as server:
        painted = paint_first(settings_of(write(tmp_path, graph()), server.url))
    (job,) = server.jobs
    assert set(job.pictures) == {"input"}, "ColorMatch cannot run without its reference"
    assert job.values["prompt"] == "turn it into marble", "the workflow's own"
    assert painted.shape[2] == 3


def test_reference_that_the_output_requires_is_a_one_line_error(tmp_path: Path) -> None:
    content = graph()
    content["9"]["inputs"]["image"] = ["3", 0]
    with comfy_server() as server, pytest.raises(ProgdfError, match="connect it to an optional input"):
        paint_first(settings_of(write(tmp_path, content), server.url))


def test_same_picture_is_uploaded_once(tmp_path: Path) -> None:
    with comfy_server() as server:
        editor = editor_of(settings_of(write(tmp_path, graph()), server.url))
        original = editor.original(small().views[0])
        for seed in range(3):
            editor.paint(PaintRequest(original, seed=seed))
        assert len(server.files) == 1
        assert sum(b"image/png" in body for body in server.bodies) == 1


@pytest.mark.parametrize("name", ["flux2-klein-edit", "qwen-image-edit"])
@pytest.mark.parametrize("references", [0, 1, 2])
def test_documented_workflow_runs(name: str, references: int) -> None:
    with comfy_server() as server:
        editor = editor_of(settings_of(WORKFLOWS / f"{name}.json", server.url))
        original = editor.original(small().views[0])
        painted = editor.paint(PaintRequest(original, [original] * references, original[..., 0]))
    assert torch.equal(painted, original.flip(2))
    (job,) = server.jobs
    expected = {"input", *("reference", "reference 2")[:references]}
    assert set(job.pictures) == expected


def rename(title: str, new: str) -> Callable[[dict[str, Any]], object]:
    def change(content: dict[str, Any]) -> None:
        for row in content.values():
            if row["_meta"]["title"] == title:
                row["_meta"]["title"] = new

    return change


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        (rename("Input", "load"), "no node titled input; rename the node that loads the picture"),
        (rename("output", "save"), "no node titled output; rename the node that saves the picture"),
        (rename("match colors", "seed"), "two nodes titled seed (3 and 8); rename one of them"),
        (rename("reference", "style"), "titled reference 2 but none titled reference"),
        (rename("prompt", "text"), "no node titled prompt; title one, or leave it out"),
        (lambda content: content["8"].update(class_type="X", inputs={}), "titled seed (X) has no free input"),
        (lambda content: content.clear(), "is no workflow; save one in ComfyUI"),
        (lambda content: content.update(nodes=[], links=[]), "is a workflow of the editor; save it in"),
        (lambda content: content.update(extra=3), "is no workflow; save one in ComfyUI"),
    ],
)
def test_unusable_workflow_is_a_one_line_error(
    change: Callable[[dict[str, Any]], object], fault: str, tmp_path: Path
) -> None:
    content = graph()
    change(content)
    path = write(tmp_path, content)
    options = settings_of(path, "http://127.0.0.1:8188", prompt="turn it into gold")
    with pytest.raises(ProgdfError, match=re.escape(fault)) as caught:
        check_comfy(options.text, options)
    assert "\n" not in str(caught.value)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize(
    ("changes", "fault"),
    [
        ({"editor": "comfy:"}, "needs a workflow"),
        ({"editor": "comfy:no-such-file.json"}, "cannot be read"),
        ({"api_url": ""}, "add --api-url, for example http://127.0.0.1:8188"),
        ({"api_url": "http://me:pass@host:8188"}, "must hold no key and no password"),
        ({"api_url": "http://host:port"}, "needs the address of a server"),
    ],
)
def test_invalid_option_is_a_one_line_error(changes: dict[str, str], fault: str, tmp_path: Path) -> None:
    options = settings_of(write(tmp_path, graph()), "http://127.0.0.1:8188", **changes)
    with pytest.raises(ProgdfError, match=re.escape(fault)) as caught:
        check_comfy(options.text, options)
    assert "\n" not in str(caught.value)
    assert ":pass@" not in str(caught.value)


def test_text_that_is_not_json_is_a_one_line_error(tmp_path: Path) -> None:
    path = tmp_path / "workflow.json"
    path.write_text("{", encoding="utf-8")
    options = settings_of(path, "http://127.0.0.1:8188")
    with pytest.raises(ProgdfError, match=r"is not JSON .*; save it with Export \(API\)"):
        check_comfy(options.text, options)


def test_node_that_the_server_lacks_is_named_before_any_picture(tmp_path: Path) -> None:
    content = graph()
    content["3"]["class_type"] = "MagicMatch"
    path = write(tmp_path, content)
    with comfy_server() as server, pytest.raises(ProgdfError, match="has no node MagicMatch; update ComfyUI"):
        editor_of(settings_of(path, server.url))
    assert not server.bodies


def test_refused_graph_names_the_node_and_its_fault(tmp_path: Path) -> None:
    content = json.loads((WORKFLOWS / "flux2-klein-edit.json").read_text(encoding="utf-8"))
    content["4"]["inputs"]["unet_name"] = "missing.safetensors"
    fault = (
        r"refuses the workflow: node 4 \(UNETLoader\): Value not in list: unet_name: 'missing.safetensors'"
    )
    with comfy_server() as server, pytest.raises(ProgdfError, match=fault):
        paint_first(settings_of(write(tmp_path, content), server.url))


@pytest.mark.parametrize(
    ("result", "error", "fault"),
    [
        ("CUDA out of memory", ProgdfError, r"failed in node 10 \(SaveImage\): CUDA out of memory; change"),
        ("rejected by content filter", RefusedError, "refuses it: rejected by content filter"),
        (Image.new("RGB", (64, 20)), ProgdfError, "returned a picture that cannot be used"),
        (Refusal(500, "", "no disk"), ProgdfError, r"with status 500 \(no disk\); look at its log"),
        (Refusal(429, "", "slow down", {"Retry-After": "0.01"}), ProgdfError, "use fewer --edit-workers"),
        (Refusal(200, "", "<html>"), ProgdfError, "gave no valid answer"),
        (
            Refusal(404, "", "no route"),
            ProgdfError,
            r"is no ComfyUI: status 404 \(no route\)",
        ),
    ],
)
def test_failed_job_is_a_one_line_error(
    result: Result, error: type[Exception], fault: str, tmp_path: Path
) -> None:
    with (
        comfy_server(lambda job, number: result) as server,
        pytest.raises(error, match=fault) as caught,
    ):
        paint_first(settings_of(write(tmp_path, graph()), server.url))
    assert "\n" not in str(caught.value)


def test_server_that_asks_to_wait_is_asked_again(tmp_path: Path) -> None:
    def model(job: Job, number: int) -> Result:
        return edit(job) if number else Refusal(429, "", "slow down", {"Retry-After": "0.01"})

    with comfy_server(model) as server:
        paint_first(settings_of(write(tmp_path, graph()), server.url))
        assert len(server.jobs) == 2


def test_dead_server_is_a_one_line_error(tmp_path: Path) -> None:
    with comfy_server() as server:
        url = server.url
    with pytest.raises(ProgdfError, match=r"^comfy: 127.0.0.1:\d+ cannot be reached .*; check --api-url$"):
        editor_of(settings_of(write(tmp_path, graph()), url))


def test_slow_job_is_cancelled_on_the_server(tmp_path: Path) -> None:
    with comfy_server() as server:
        server.delay = Event()
        settings = settings_of(write(tmp_path, graph()), server.url, edit_timeout=0.05)
        with pytest.raises(ProgdfError, match=r"within 0\.05 seconds; allow more with --edit-timeout"):
            paint_first(settings)
        assert set(server.cancelled) == set(server.records)


def test_destination_is_stated(tmp_path: Path) -> None:
    options = settings_of(write(tmp_path, graph()), "http://127.0.0.1:8188")
    assert explain_sending(options, 10, 4) == (
        "40 pictures of the scene and your instruction are sent to 127.0.0.1:8188 (workflow workflow.json), "
        "one call each"
    )


def test_pictures_go_to_another_machine_only_with_consent(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    path = write(tmp_path, graph())
    command = ["scene.ply", "-o", "run", "--region", "all", "--editor", f"comfy:{path}"]
    with pytest.raises(ProgdfError, match="only if you agree; add --yes"):
        cli.train([*command, "--api-url", "http://192.0.2.1:8188"])


def test_catalogue_sends_pictures_only_if_it_is_allowed_to(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_bear(tmp_path)
    path = write(tmp_path, graph())
    with comfy_server() as server:
        (tmp_path / "catalogue.toml").write_text(
            '[[scenes]]\npath = "scene.ply"\n[[scenes.edits]]\nname = "marble"\nregion = "all"\n'
            f"editor = 'comfy:{path}'\napi-url = '{server.url}'\n",
            encoding="utf-8",
        )
        command = [str(tmp_path / "catalogue.toml"), "--out", str(tmp_path / "runs"), "--workers", "1"]
        assert cli.batch(command) == 2
        assert "it sends pictures to http://127.0.0.1" in capsys.readouterr().err
        assert cli.batch([*command, "--dry-run", "--allow-commands"]) == 0
        assert not server.bodies


@pytest.mark.slow
def test_run_evens_the_strength_of_the_workflow(tmp_path: Path) -> None:
    """Shift every picture by a pixel, refuse one view, and ask to wait once."""
    write_bear(tmp_path)
    refused = set[bytes]()

    def model(job: Job, number: int) -> Result:
        if number == 2:
            return Refusal(429, "", "slow down", {"Retry-After": "0.01"})
        picture = job.pictures["input"]
        if number == 4:
            refused.add(picture.tobytes())
        if picture.tobytes() in refused and job.values["strength"] == 1.0:
            return "blocked by the content filter"
        job.values["strength"] = job.values["strength"] ** 2  # type: ignore[index]
        changed = edit(job)
        shifted = Image.new("RGB", changed.size)
        shifted.paste(changed, (0, 0))
        shifted.paste(changed, (1, 0))
        return shifted

    with comfy_server(model) as server:
        options = with_values(
            quick_options(tmp_path), editor=f"comfy:{write(tmp_path, graph())}", api_url=server.url,
            edit_size=64, kind="color", steps=48, stages=2, views=5, edit_workers=3,
        )  # fmt: skip
        result = train(options)
        calls = len(server.jobs)
        report = (tmp_path / "run" / "report.json").read_text(encoding="utf-8")
        assert report.count("the content filter") == 1
        gdf = result.gdf.read_bytes()
        strengths = {round(float(job.values["strength"]), 3) for job in server.jobs}
        assert len(strengths) > 3, "measured on one view"
        result.gdf.unlink()
        (tmp_path / "run" / "trajectory.safetensors").unlink()
        again = train(options)
        assert again.gdf.read_bytes() == gdf
        assert len(server.jobs) <= calls + 3, "only the refused picture is asked for again"
