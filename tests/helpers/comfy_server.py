"""A real HTTP server on this machine with the endpoints of ComfyUI that a workflow needs.

It checks a graph as ComfyUI does: known classes, required inputs, links. It runs a graph from the output back
to all nodes on which the output depends. The titles on the way are the inputs of the model, a function of the
pictures, so that tests know every result.
"""

from __future__ import annotations

import io
import json
import threading
import uuid
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from email.parser import BytesParser
from email.policy import HTTP
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import parse_qs, unquote, urlsplit

from PIL import Image

from tests.helpers.image_server import Refusal, png, swap_colors

# Required and optional inputs of ComfyUI's own nodes, by class. EditPicture and ColorMatch are custom nodes.
NODES: Mapping[str, tuple[str, str]] = {
    "LoadImage": ("image", ""),
    "LoadImageMask": ("image channel", ""),
    "SaveImage": ("images filename_prefix", ""),
    "PreviewImage": ("images", ""),
    "UNETLoader": ("unet_name weight_dtype", ""),
    "CLIPLoader": ("clip_name type", "device"),
    "VAELoader": ("vae_name", ""),
    "CLIPTextEncode": ("text clip", ""),
    "VAEEncode": ("pixels vae", ""),
    "VAEDecode": ("samples vae", ""),
    "ConditioningZeroOut": ("conditioning", ""),
    "ReferenceLatent": ("conditioning", "latent"),
    "CFGGuider": ("model positive negative cfg", ""),
    "KSamplerSelect": ("sampler_name", ""),
    "Flux2Scheduler": ("steps width height", ""),
    "RandomNoise": ("noise_seed", ""),
    "GetImageSize": ("image", ""),
    "EmptyFlux2LatentImage": ("width height batch_size", ""),
    "SamplerCustomAdvanced": ("noise guider sampler sigmas latent_image", ""),
    "TextEncodeQwenImageEditPlus": ("clip prompt", "vae image1 image2 image3"),
    "ModelSamplingAuraFlow": ("model shift", ""),
    "CFGNorm": ("model strength", ""),
    "KSampler": (
        "model seed steps cfg sampler_name scheduler positive negative latent_image denoise",
        "",
    ),
    "PrimitiveStringMultiline": ("value", ""),
    "PrimitiveFloat": ("value", ""),
    "PrimitiveInt": ("value", ""),
    "EditPicture": ("image text strength seed", "reference reference_2 mask"),
    "ColorMatch": ("image reference", ""),
}


@dataclass(frozen=True)
class Job:
    """Inputs of one call of a graph, by title. Nodes that the output does not depend on are missing."""

    pictures: Mapping[str, Image.Image]
    values: Mapping[str, Any]  # prompt, strength, seed


Result = Image.Image | Refusal | str
"""Result of the model: a picture; an answer to /prompt; or the message of a node that fails while running."""


@dataclass
class ComfyUi:
    """A running server."""

    url: str
    jobs: list[Job] = field(default_factory=list)
    files: dict[str, bytes] = field(default_factory=dict)  # uploaded pictures, by folder/name
    records: dict[str, dict[str, Any]] = field(default_factory=dict)  # history, by job
    views: dict[str, bytes] = field(default_factory=dict)  # pictures of results, by name
    bodies: list[bytes] = field(default_factory=list)  # everything that callers sent
    cancelled: list[str] = field(default_factory=list)
    delay: threading.Event | None = None  # results wait for it


def edit(job: Job) -> Image.Image:
    """Return the input, cross-faded to its picture with red and blue exchanged by the strength."""
    picture = job.pictures["input"].convert("RGB")
    return Image.blend(picture, swap_colors(picture), float(job.values.get("strength", 1.0)))


@contextmanager
def comfy_server(
    model: Callable[[Job, int], Result] = lambda job, number: edit(job),
    polls: int = 1,
) -> Iterator[ComfyUi]:
    """Run a server while the context is open.

    Args:
        model: returns the result of a job, from the job and the number of jobs before it
        polls: number of looks at the history before a job is done
    """
    state = ComfyUi("")
    lock = threading.Lock()
    looks: dict[str, int] = {}

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def log_message(self, *values: object) -> None:
            """Print nothing."""

        def do_GET(self) -> None:
            parts = urlsplit(self.path)
            name = unquote(parts.path.rpartition("/")[2])
            if parts.path.startswith("/object_info/"):
                self._json({name: _object_info(name)} if name in NODES else {})
            elif parts.path.startswith("/history/"):
                with lock:
                    looks[name] = looks.get(name, 0) + 1
                waits = looks[name] <= polls or (state.delay is not None and not state.delay.is_set())
                self._json({} if waits else {name: state.records[name]})
            elif parts.path == "/queue":
                running = [] if state.delay is None else [[0, job] for job in state.records]
                self._json({"queue_running": running[:1], "queue_pending": running[1:]})
            elif parts.path == "/view":
                content = state.views.get(parse_qs(parts.query)["filename"][0], b"")
                self._send(200 if content else 404, content, {"Content-Type": "image/png"})
            else:
                self._send(404, b"404: Not Found", {"Content-Type": "text/plain"})

        def do_POST(self) -> None:
            body = self.rfile.read(int(self.headers["Content-Length"]))
            with lock:
                state.bodies.append(body)
            if self.path == "/upload/image":
                self._json(_store(state, self.headers["Content-Type"], body))
            elif self.path == "/prompt":
                self._start(json.loads(body)["prompt"])
            elif self.path in ("/queue", "/interrupt"):
                request = json.loads(body)
                state.cancelled += request.get("delete") or [request["prompt_id"]]
                self._json({})
            else:
                self._send(404, b"404: Not Found", {"Content-Type": "text/plain"})

        def _start(self, graph: dict[str, Any]) -> None:
            faults = _faults(graph)
            if faults:
                error = {
                    "type": "prompt_outputs_failed_validation",
                    "message": "Prompt outputs failed validation",
                }
                self._json({"error": error, "node_errors": faults}, 400)
                return
            output = next(name for name, node in graph.items() if node["class_type"] == "SaveImage")
            job = _job(graph, output, state.files)
            with lock:
                number = len(state.jobs)
                state.jobs.append(job)
            result = model(job, number)
            if isinstance(result, Refusal):
                self._send(result.status, result.message.encode(), result.headers)
                return
            name = uuid.uuid4().hex
            if isinstance(result, str):
                fault = {"node_id": output, "node_type": "SaveImage", "exception_message": result}
                messages = [["execution_start", {}], ["execution_error", fault]]
                state.records[name] = {"outputs": {}, "status": {"status_str": "error", "messages": messages}}
            else:
                state.views[f"{name}.png"] = png(result)
                row = {"filename": f"{name}.png", "subfolder": "progdf", "type": "output"}
                state.records[name] = {
                    "outputs": {output: {"images": [row]}},
                    "status": {"status_str": "success", "completed": True, "messages": []},
                }
            self._json({"prompt_id": name, "number": number, "node_errors": {}})

        def _json(self, value: object, status: int = 200) -> None:
            self._send(status, json.dumps(value).encode(), {"Content-Type": "application/json"})

        def _send(self, status: int, content: bytes, headers: Mapping[str, str]) -> None:
            self.send_response(status)
            for name, value in headers.items():
                self.send_header(name, value)
            self.send_header("Content-Length", str(len(content)))
            self.end_headers()
            self.wfile.write(content)

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    state.url = f"http://127.0.0.1:{server.server_address[1]}"
    try:
        yield state
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


def _object_info(kind: str) -> dict[str, Any]:
    required, optional = NODES[kind]
    inputs = {"required": {name: ["*"] for name in required.split()}}
    if optional:
        inputs["optional"] = {name: ["*"] for name in optional.split()}
    return {"input": inputs, "name": kind}


def _faults(graph: dict[str, Any]) -> dict[str, Any]:
    """Return the errors of a graph by node, as ComfyUI reports them."""
    faults: dict[str, Any] = {}
    for name, node in graph.items():
        kind = node["class_type"]
        missing = [key for key in NODES.get(kind, ("",))[0].split() if key not in node["inputs"]]
        broken = [
            key for key, value in node["inputs"].items() if isinstance(value, list) and value[0] not in graph
        ]
        errors = [{"message": "Required input is missing", "details": key} for key in missing]
        errors += [{"message": "Bad linked input", "details": key} for key in broken]
        if kind not in NODES:
            errors.append({"message": "Cannot execute because node does not exist.", "details": kind})
        for key, value in node["inputs"].items():
            if key == "unet_name" and "missing" in str(value):
                errors.append({"message": "Value not in list", "details": f"unet_name: '{value}' not in []"})
        if errors:
            faults[name] = {"errors": errors, "class_type": kind, "dependent_outputs": []}
    return faults


def _job(graph: dict[str, Any], output: str, files: Mapping[str, bytes]) -> Job:
    """Return the titled inputs of all nodes that the output depends on."""
    pictures: dict[str, Image.Image] = {}
    values: dict[str, Any] = {}
    pending = [output]
    seen: set[str] = set()
    while pending:
        name = pending.pop()
        if name in seen:
            continue
        seen.add(name)
        node = graph[name]
        title = str(node.get("_meta", {}).get("title", "")).lower()
        free = {key: value for key, value in node["inputs"].items() if not isinstance(value, list)}
        if node["class_type"] in ("LoadImage", "LoadImageMask"):
            picture = Image.open(io.BytesIO(files[free["image"]]))
            picture.load()
            pictures[title] = picture
        elif title in ("prompt", "strength", "seed"):
            keys = ("prompt", "text", "value", "denoise", "strength", "noise_seed", "seed")
            values[title] = next(free[key] for key in keys if key in free)
        pending += [value[0] for value in node["inputs"].values() if isinstance(value, list)]
    return Job(pictures, values)


def _store(state: ComfyUi, kind: str, body: bytes) -> dict[str, str]:
    """Keep an uploaded picture, and return its place."""
    message = BytesParser(policy=HTTP).parsebytes(f"Content-Type: {kind}\r\n\r\n".encode() + body)
    parts = {str(part.get_param("name", header="content-disposition")): part for part in message.iter_parts()}
    folder = str(parts["subfolder"].get_payload())
    name = str(parts["image"].get_filename())
    content = parts["image"].get_payload(decode=True)
    assert isinstance(content, bytes)
    assert str(parts["overwrite"].get_payload()) == "true"
    state.files[f"{folder}/{name}"] = content
    return {"name": name, "subfolder": folder, "type": "input"}
