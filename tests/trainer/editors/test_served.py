"""Editor `api:"…"` with a real HTTP server: agreement, refusals, waits, broken answers and keys."""

from __future__ import annotations

import base64
import contextlib
import os
import re
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from threading import Event

import pytest
import torch
from PIL import Image

from progdf.errors import ProgdfError
from tests.helpers.image_server import Answer, Call, Refusal, image_server, png, swap_colors
from tests.helpers.trained import LABELS, quick_options, small, train, write_bear
from trainer import cli
from trainer.editors import make_editor
from trainer.editors.painter import PaintRequest, RefusedError
from trainer.editors.server.calls import Address, BusyError, Waits, persist
from trainer.editors.server.editor import ServedEditor, check_served, explain_sending
from trainer.editors.server.images_api import ImagesApi, check_api
from trainer.options import EditorOptions, with_values
from trainer.resolve import resolve
from trainer.run.command import check_command

MARBLE = 'api:"turn it into marble"'


@pytest.fixture(autouse=True)
def _package(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("openai", reason="pip install progdf-studio[api]")
    monkeypatch.delenv("OPENAI_API_KEY", raising=False)
    monkeypatch.setattr("trainer.editors.server.calls.RETRIES", 2)
    monkeypatch.setattr("trainer.editors.server.calls._FIRST_WAIT_S", 0.01)


def settings_of(url: str, **more: object) -> EditorOptions:
    return replace(EditorOptions(MARBLE, "marble-1", api_url=url, edit_size=64), **more)  # type: ignore[arg-type]


def editor_of(settings: EditorOptions) -> ServedEditor:
    case = small()
    editor = make_editor(settings, case.scene, case.region, case.views)
    assert isinstance(editor, ServedEditor)
    return editor


def paint_first(settings: EditorOptions) -> torch.Tensor:
    editor = editor_of(settings)
    return editor.paint(PaintRequest(editor.original(small().views[0])))


def test_server_edits_the_picture_and_its_references(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OPENAI_API_KEY", "sk-secret")
    with image_server() as server:
        editor = editor_of(settings_of(server.url))
        original = editor.original(small().views[0])
        painted = editor.paint(PaintRequest(original, [original, original]))
    assert torch.equal(painted, original.flip(2)), "red and blue are exchanged"
    (call,) = server.calls
    assert len(call.pictures) == 3
    assert call.key == "Bearer sk-secret"
    assert call.fields["model"] == "marble-1"
    assert call.fields["size"] == f"{original.shape[1]}x{original.shape[0]}"
    assert call.fields["prompt"].startswith("turn it into marble\n")
    assert "sk-secret" not in repr(editor), "the key is in no object"


def test_picture_of_an_address_is_fetched_without_the_key(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OPENAI_API_KEY", "sk-secret")

    def model(call: Call, number: int) -> Answer:
        server.files["/picture.png"] = png(swap_colors(call.pictures[0]))
        return {"created": 0, "data": [{"url": server.url.replace("/v1", "/picture.png")}]}

    with image_server(model) as server:
        painted = paint_first(settings_of(server.url))
    assert torch.equal(painted.flip(2), editor_of(settings_of(server.url)).original(small().views[0]))


def test_address_of_another_machine_must_be_encrypted() -> None:
    server = ImagesApi(Address("api", "https://api.example.org/v1"), "marble-1", 1.0)
    for url in ("http://127.0.0.1/a.png", "file:///etc/passwd", "ftp://host/a.png"):
        with pytest.raises(ProgdfError, match="does not begin with https://: "):
            server.fetch(url)


def test_server_that_asks_to_wait_is_asked_again() -> None:
    def model(call: Call, number: int) -> Answer:
        if number == 0:
            return Refusal(429, "rate_limit_exceeded", "slow down", {"Retry-After": "0.01"})
        return swap_colors(call.pictures[0])

    with image_server(model) as server:
        paint_first(settings_of(server.url))
        assert len(server.calls) == 2


class _NoWait(Event):
    """Event whose waits end at once."""

    def wait(self, timeout: float | None = None) -> bool:
        return self.is_set()


@pytest.mark.parametrize(
    ("wait_s", "lines"),
    [
        (20.0, ["The server asks to wait 20 s"]),
        (0.5, []),  # too short to be noticed
        (None, ["The server is busy. Next call in 1 s"]),
    ],
)
def test_wait_for_a_busy_server_is_reported(
    wait_s: float | None, lines: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("trainer.editors.server.calls._FIRST_WAIT_S", 1.0)
    reported = list[str]()

    @contextmanager
    def report(line: str) -> Iterator[None]:
        reported.append(line)
        yield

    failures = [BusyError(ProgdfError("busy"), wait_s)]

    def call() -> str:
        if failures:
            raise failures.pop()
        return "picture"

    assert persist(call, Waits(_NoWait(), report)) == "picture"
    assert reported == lines


HALF = base64.b64encode(png(Image.new("RGB", (64, 64), "red")))[:-3].decode()


@pytest.mark.parametrize(
    ("answer", "fault"),
    [
        (Refusal(401, "invalid_api_key", "wrong key"), "status 401 (wrong key); set OPENAI_API_KEY"),
        (Refusal(404, "model_not_found", "no such model"), "status 404 (no such model); check --api-url"),
        (Refusal(429, "rate_limit_exceeded", "slow down", {"Retry-After": "0.01"}), "fewer --edit-workers"),
        (Refusal(400, "invalid_image", "too many pictures"), "check --model and --api-references"),
        (Refusal(500, "", "out of memory", {"Retry-After": "0.01"}), "look at its log"),
        (Refusal(429, "insufficient_quota", "no money"), "(no money); add credit to the account of the key"),
        (b"<html>a login page</html>", "gave no valid answer"),
        ({"created": 0, "data": []}, "returned no picture"),
        ({"created": 0, "data": [{"b64_json": HALF}]}, "returned half a picture"),
        ({"created": 0, "data": [{"b64_json": base64.b64encode(b"GIF").decode()}]}, "cannot be used"),
        (
            {"created": 0, "data": [{"url": "file:///etc/passwd"}]},
            "does not begin with http:// or https://: file:///etc/passwd",
        ),
        ({"created": 0, "data": [{"url": "http://127.0.0.1:1/a.png"}]}, "an address without a picture"),
        (Image.new("RGB", (64, 20)), "cannot be used"),
    ],
)
def test_unusable_answer_is_a_one_line_error(answer: Answer, fault: str) -> None:
    with (
        image_server(lambda call, number: answer) as server,
        pytest.raises(ProgdfError, match=re.escape(fault)) as caught,
    ):
        paint_first(settings_of(server.url))
    assert "\n" not in str(caught.value)
    assert str(caught.value).startswith("api: 127.0.0.1:")


def test_dead_server_is_a_one_line_error() -> None:
    with image_server() as server:
        url = server.url
    with pytest.raises(ProgdfError, match=r"cannot be reached .*; check --api-url"):
        paint_first(settings_of(url))


def test_dead_server_is_reported_before_the_run_is_prepared(tmp_path: Path) -> None:
    with image_server() as server:
        write_bear(tmp_path)
        options = quick_options(tmp_path, editor=MARBLE, model="marble-1", api_url=server.url)
        check_command(resolve(options))
        assert not server.calls, "nothing is sent"
    with pytest.raises(ProgdfError, match=r"cannot be reached .*; check --api-url"):
        check_command(resolve(options))
    assert not (tmp_path / "run").exists()


def test_refused_connection_ends_the_calls_and_a_lost_one_does_not() -> None:
    address = Address("api", "http://127.0.0.1:8080/v1")
    lost = OSError("no route to host")
    assert isinstance(address.unreachable(lost), BusyError)
    lost.__cause__ = ConnectionRefusedError(111, "Connection refused")
    assert isinstance(address.unreachable(lost), ProgdfError)
    unknown = socket.gaierror(socket.EAI_NONAME, "Name or service not known")
    assert isinstance(address.unreachable(unknown), ProgdfError)


def test_refused_picture_is_told_from_a_fault() -> None:
    refusal = Refusal(400, "moderation_blocked", "rejected by the safety system")
    with (
        image_server(lambda call, number: refusal) as server,
        pytest.raises(RefusedError, match="rejected by the safety system"),
    ):
        paint_first(settings_of(server.url))


@pytest.mark.parametrize(
    ("changes", "fault"),
    [
        ({"editor": 'api:""'}, "needs an instruction"),
        ({"api_url": ""}, "add --api-url"),
        ({"api_url": "ftp://host/v1"}, "add --api-url"),
        ({"api_url": "https://me:pass@host/v1"}, "must hold no key"),
        ({"model": ""}, "add --model"),
        ({"api_url": "https://api.example.org/v1"}, "set OPENAI_API_KEY"),
    ],
)
def test_invalid_option_is_a_one_line_error(changes: dict[str, str], fault: str) -> None:
    options = replace(settings_of("http://127.0.0.1:8080/v1"), **changes)  # type: ignore[arg-type]
    with pytest.raises(ProgdfError, match=re.escape(fault)) as caught:
        check_api(options.text, options)
    assert "; " in str(caught.value)
    assert "pass" not in str(caught.value).replace("password", "")


def test_key_is_never_sent_unencrypted_to_another_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OPENAI_API_KEY", "sk-secret")
    options = settings_of("http://api.example.org/v1")
    with pytest.raises(ProgdfError, match="must not be sent to"):
        check_api(options.text, options)


def test_redirection_sends_no_picture_to_another_address() -> None:
    with image_server() as other:
        headers = {"Location": f"{other.url}/images/edits"}
        moved = Refusal(307, "", "moved", headers)
        with (
            image_server(lambda call, number: moved) as server,
            pytest.raises(ProgdfError, match="it redirects to another address"),
        ):
            paint_first(settings_of(server.url))
    assert len(server.calls) == 1
    assert not other.calls


@pytest.mark.parametrize("status", [400, 401, 429])
def test_error_that_quotes_the_key_hides_it(status: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OPENAI_API_KEY", "sk-secret")
    monkeypatch.setattr("trainer.editors.server.calls.RETRIES", 0)
    with (
        image_server(lambda call, number: Refusal(status, "", f"bad header {call.key}!")) as server,
        pytest.raises(ProgdfError) as error,
    ):
        paint_first(settings_of(server.url))
    assert "bad header Bearer (key)!" in str(error.value)
    assert "sk-secret" not in str(error.value)


SIZES = ("1024x1024", "1024x1536", "1536x1024")
BAD_SIZE = "Invalid value: '{}'. Supported values are: " + ", ".join(f"'{size}'" for size in SIZES)


def test_model_of_few_sizes_gets_the_picture_on_a_canvas() -> None:
    def model(call: Call, number: int) -> Answer:
        size = call.fields["size"]
        assert "{}x{}".format(*call.pictures[0].size) == size
        return swap_colors(call.pictures[0]) if size in SIZES else Refusal(400, "", BAD_SIZE.format(size))

    with image_server(model) as server:
        editor = editor_of(settings_of(server.url))
        rows = torch.arange(30)[:, None, None]
        columns = torch.arange(24)[:, None]
        tiles = ((rows + 2 * columns + torch.arange(3)) % 3).float() / 2  # large pixels: a shift would show
        picture = tiles.repeat_interleave(8, 0).repeat_interleave(8, 1)
        for calls in (2, 3):
            painted = editor.paint(PaintRequest(picture, [picture]))
            assert len(server.calls) == calls, "the sizes are learned once"
    assert server.calls[-1].fields["size"] == "1024x1536", "5 : 4 is nearer to 3 : 2 than to a square"
    assert [one.size for one in server.calls[-1].pictures] == [(1024, 1536)] * 2
    assert painted.shape == picture.shape
    assert float((painted.flip(2) - picture).abs().mean()) < 0.05  # blurred edges; a shift of one pixel: 0.08


def test_server_that_refuses_every_size_is_a_one_line_error() -> None:
    with (
        image_server(lambda call, number: Refusal(400, "", BAD_SIZE.format("x"))) as server,
        pytest.raises(ProgdfError, match=r"refuses the call with status 400 .*Supported values") as error,
    ):
        paint_first(settings_of(server.url))
    assert "\n" not in str(error.value)
    assert len(server.calls) == 2


def test_destination_number_of_calls_and_cost_are_stated() -> None:
    line = explain_sending(settings_of("http://127.0.0.1:8080/v1", price_per_call=0.04), 12)
    assert line == (
        "12 pictures of the scene and your instruction are sent to 127.0.0.1:8080 (model marble-1), "
        "one call each, about 0.48 in all"
    )


def test_pictures_go_to_another_machine_only_with_consent(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("OPENAI_API_KEY", "sk-secret")
    monkeypatch.chdir(tmp_path)
    command = ["scene.ply", "-o", "run", "--region", "all", "--editor", MARBLE, "--model", "marble-1"]
    with pytest.raises(ProgdfError, match="only if you agree; add --yes"):
        cli.train([*command, "--api-url", "https://api.example.org/v1"])


def test_catalogue_sends_pictures_only_if_it_is_allowed_to(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_bear(tmp_path)
    with image_server() as server:
        (tmp_path / "catalogue.toml").write_text(
            '[[scenes]]\npath = "scene.ply"\n[[scenes.edits]]\nname = "marble"\nregion = "all"\n'
            f"editor = '{MARBLE}'\nmodel = 'marble-1'\napi-url = '{server.url}'\n",
            encoding="utf-8",
        )
        command = [str(tmp_path / "catalogue.toml"), "--out", str(tmp_path / "runs"), "--workers", "1"]
        assert cli.batch(command) == 2
        assert "it sends pictures to http://127.0.0.1" in capsys.readouterr().err
        assert cli.batch([*command, "--dry-run", "--allow-commands"]) == 0
        assert not server.calls


def test_mask_of_the_region_is_sent_if_asked_for() -> None:
    mask = torch.zeros(64, 64)
    mask[:8] = 0.5
    for sends in (False, True):
        with image_server() as server:
            editor = editor_of(settings_of(server.url, api_mask=sends))
            editor.paint(PaintRequest(editor.original(small().views[0]), mask=mask))
        (call,) = server.calls
        assert (call.mask is not None) == sends
    assert call.mask is not None
    assert call.mask.getpixel((0, 0))[3] == 0, "transparent where the model edits"
    assert call.mask.getpixel((0, 9))[3] == 255


def blend_by_prompt(call: Call, number: int) -> Image.Image:
    """Return the picture blended with its swapped colors by the word that begins the prompt."""
    picture = call.pictures[0].convert("RGB")
    share = {"slightly": 0.3, "half": 0.6, "again": 0.62, "nothing": 0.0}
    return Image.blend(picture, swap_colors(picture), share.get(call.fields["prompt"].split()[0], 1.0))


@pytest.mark.slow
def test_prompts_become_strengths_by_what_their_pictures_show(tmp_path: Path) -> None:
    write_bear(tmp_path)
    with image_server(blend_by_prompt) as server:
        options = with_values(
            quick_options(tmp_path), editor=MARBLE, model="marble-1", api_url=server.url, edit_size=64,
            kind="color", steps=48, stages=0, views=5, edit_workers=2,
            degrees="half marble|slightly marble|nothing|again half",
        )  # fmt: skip
        train(options)
        calls = len(server.calls)
    log = (tmp_path / "run" / "log.txt").read_text(encoding="utf-8")
    found = re.search(r"strengths by prompts.*; (\d) of 4 used, largest step (0\.\d+)", log)
    assert found is not None, log
    assert found[1] == "2"
    assert float(found[2]) == pytest.approx(0.4, abs=0.05)
    assert "strengths: the prompts of --degrees; visible steps are 0." in log
    assert calls == 5 + 4 + 2 * 5, "all views, each prompt in one view, and all views by two prompts"


@pytest.mark.slow
@pytest.mark.parametrize("degrees", ["|", "warm|", " | cold"])
def test_empty_prompt_of_a_degree_is_refused(degrees: str) -> None:
    options = replace(settings_of("http://127.0.0.1:8080/v1"), degrees=degrees)
    with pytest.raises(ProgdfError, match="has an empty prompt; write"):
        check_served(options)


@pytest.mark.parametrize("references", [0, 2])
def test_run_leaves_refused_views_out_and_pays_for_no_picture_twice(tmp_path: Path, references: int) -> None:
    write_bear(tmp_path)
    refused = set[bytes]()

    def model(call: Call, number: int) -> Answer:
        if number == 2:
            return Refusal(429, "rate_limit_exceeded", "slow down", {"Retry-After": "0.01"})
        picture = call.pictures[0].tobytes()
        if number == 4:
            refused.add(picture)
        if picture in refused:
            return Refusal(400, "content_policy_violation", "not this one")
        return swap_colors(call.pictures[0])

    with image_server(model) as server:
        options = with_values(
            quick_options(tmp_path), editor=MARBLE, model="marble-1", api_url=server.url, edit_size=64,
            api_references=references, kind="color", steps=48, stages=0, views=5, edit_workers=3,
        )  # fmt: skip
        result = train(options)
        assert result.gdf.is_file()
        calls = len(server.calls)
        report = (tmp_path / "run" / "report.json").read_text(encoding="utf-8")
        assert report.count("the content filter") == 1
        gdf = result.gdf.read_bytes()
        result.gdf.unlink()
        (tmp_path / "run" / "trajectory.safetensors").unlink()
        again = train(options)
        assert again.gdf.read_bytes() == gdf
        assert len(server.calls) == calls + 2, "only the refused picture is asked for again, twice"


@pytest.mark.slow
def test_key_is_in_no_file_no_output_and_no_list_of_processes(tmp_path: Path) -> None:
    write_bear(tmp_path)
    key = "sk-secret"
    listed = []

    def model(call: Call, number: int) -> Answer:
        assert call.key == f"Bearer {key}"
        for path in Path("/proc").glob("[0-9]*/cmdline"):
            with contextlib.suppress(OSError):  # the process has ended
                listed.append(path.read_bytes())
        return swap_colors(call.pictures[0])

    with image_server(model) as server:
        words = [
            sys.executable,
            "-m",
            "progdf",
            "train",
            str(tmp_path / "scene.ply"),
            "-o",
            str(tmp_path / "run"),
        ]
        words += ["--region", f"labels:{tmp_path / 'labels.npy'}:{LABELS.index('body')}", "--editor", MARBLE]
        words += ["--model", "marble-1", "--api-url", server.url, "--edit-size", "64", "--kind", "color"]
        words += ["--views", "4", "--image-size", "56", "--steps", "48", "--threads", "1"]
        home = {"HOME": str(tmp_path / "home"), "XDG_CACHE_HOME": str(tmp_path / "cache")}
        environment = {**os.environ, **home, "OPENAI_API_KEY": key}
        ended = subprocess.run(words, env=environment, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr
    assert key not in ended.stdout + ended.stderr
    files = [path for path in tmp_path.rglob("*") if path.is_file()]
    assert (tmp_path / "run" / "report.json") in files
    assert not [path for path in files if key.encode() in path.read_bytes()]
    assert server.calls
    assert not any(key.encode() in line for line in listed)
