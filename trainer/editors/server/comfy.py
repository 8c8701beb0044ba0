"""Editor `comfy:WORKFLOW.json`: a workflow that ComfyUI runs, once for each picture.

The pictures are uploaded under the digest of their content, so a server keeps each of them once. The answer
is polled. Nodes are filled by their titles (`workflow`).
"""

from __future__ import annotations

import hashlib
import json
import time
import uuid
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from threading import Event, Lock
from typing import Any
from urllib.parse import quote, urlencode

from torch import Tensor

from progdf.errors import ProgdfError
from trainer.editors.cache import Recipe
from trainer.editors.painter import PaintRequest, RefusedError
from trainer.options import EditorOptions

from .calls import Address, Answer, BusyError, Waits, check_anchor, mask_png, one_line, persist, png
from .workflow import Workflow, read_workflow

_FIRST_POLL_S = 0.1  # wait before the second look for a result; grows to the longest one
_MAX_POLL_S = 2.0
_REQUEST_TIMEOUT_S = 30.0  # for a single request; the result of a workflow may take longer
_FOLDER = "progdf"  # folder of the uploaded pictures in the server's input folder
_REFUSALS = ("content filter", "content policy", "moderation", "safety", "nsfw")


@dataclass(frozen=True)
class ComfyServer:
    """Workflow on a server of ComfyUI."""

    address: Address
    workflow: Workflow
    timeout: float  # seconds for one picture
    _optional: dict[str, frozenset[str]] = field(default_factory=dict, repr=False)  # class → optional inputs
    _uploaded: set[str] = field(default_factory=set, repr=False)
    _lock: Lock = field(default_factory=Lock, repr=False)

    @property
    def references(self) -> int:
        """See `ImageModel.references`."""
        return self.workflow.references

    @property
    def has_strength(self) -> bool:
        """See `ImageModel.has_strength`."""
        return "strength" in self.workflow.nodes

    @property
    def recipe(self) -> Recipe:
        """See `ImageModel.recipe`."""
        return {"workflow": self.workflow.digest}

    @property
    def name(self) -> str:
        """See `ImageModel.name`."""
        return f"workflow {self.workflow.path.name}"

    def connect(self) -> None:
        """Check that the server has all nodes of the workflow, and read their optional inputs.

        Raises:
            ProgdfError: the server cannot be reached, or a node is missing.
        """
        missing = []
        for kind in self.workflow.classes:
            known = self._json(f"/object_info/{quote(kind, safe='')}")
            row = known.get(kind)
            if not isinstance(row, dict):
                missing.append(kind)
                continue
            inputs = row.get("input")
            optional = inputs.get("optional") if isinstance(inputs, dict) else None
            self._optional[kind] = frozenset(optional or ())
        if missing:
            raise self.address.fault(
                f"has no node {', '.join(missing)}; update ComfyUI or install the custom nodes of "
                f"{self.workflow.path}"
            )

    def edit(self, request: PaintRequest, prompt: str, waits: Waits) -> Tensor:
        """See `ImageModel.edit`."""
        height, width = request.picture.shape[:2]
        files = {"input": png(request.picture)}
        for role, picture in zip(("reference", "reference 2"), request.references, strict=False):
            files[role] = png(picture)
        if request.mask is not None:
            files["mask"] = mask_png(request.mask)
        values: dict[str, object] = {
            role: persist(partial(self._upload, content), waits)
            for role, content in files.items()
            if role in self.workflow.nodes
        }
        values["prompt"] = prompt
        values["strength"] = request.strength
        values["seed"] = request.seed or 0
        graph = self.workflow.fill(values, self._optional)
        content = persist(partial(self._run, graph, waits.stop), waits)
        return self.address.read_picture(content, (width, height))

    def _upload(self, content: bytes) -> str:
        """Upload a picture, and return its name for a node."""
        name = f"{hashlib.sha256(content).hexdigest()[:32]}.png"
        with self._lock:
            if name in self._uploaded:
                return f"{_FOLDER}/{name}"
        parts = {"type": b"input", "subfolder": _FOLDER.encode(), "overwrite": b"true"}
        body, kind = _multipart(parts, name, content)
        answer = self._decode(self.address.request("/upload/image", _REQUEST_TIMEOUT_S, body, kind))
        stored = str(answer.get("name", ""))
        folder = str(answer.get("subfolder", ""))
        if not stored:
            raise self.address.fault("did not keep an uploaded picture; look at its log")
        with self._lock:
            self._uploaded.add(name)
        return f"{folder}/{stored}" if folder else stored

    def _run(self, graph: Mapping[str, Any], stop: Event) -> bytes:
        """Run a graph and return the content of its output picture.

        Raises:
            BusyError: the server is busy, or the workflow takes too long.
            RefusedError: a node's content filter refuses the picture.
            ProgdfError: a node fails, the result has no picture, or the run is stopped.
        """
        output = self.workflow.nodes["output"]
        name = uuid.uuid4().hex
        if "filename_prefix" in graph[output]["inputs"]:
            # another name for each call, as ComfyUI may return no pictures for a node that it has run before
            graph[output]["inputs"]["filename_prefix"] = f"{_FOLDER}/{name}"
        body = json.dumps({"prompt": graph, "client_id": name}).encode()
        answer = self.address.request("/prompt", _REQUEST_TIMEOUT_S, body, "application/json")
        if answer.status == 400:
            raise self._explain(_object(answer.content))
        job = str(self._decode(answer).get("prompt_id", ""))
        if not job:
            raise self.address.fault("did not start the workflow; check --api-url")
        result = self._wait(job, stop)
        status = result.get("status")
        if isinstance(status, dict) and status.get("status_str") == "error":
            raise self._explain_run(status)
        outputs = result.get("outputs")
        pictures = outputs.get(output, {}).get("images") if isinstance(outputs, dict) else None
        if not pictures:
            raise self.address.fault(
                f"returned no picture of the node titled output in {self.workflow.path}; use a SaveImage node"
            )
        query = urlencode({key: str(pictures[0].get(key, "")) for key in ("filename", "subfolder", "type")})
        picture = persist(lambda: self.address.request(f"/view?{query}", _REQUEST_TIMEOUT_S), Waits(Event()))
        if picture.status != 200:
            raise self.address.fault(f"refuses its own picture with status {picture.status}; look at its log")
        return picture.content

    def _wait(self, job: str, stop: Event) -> dict[str, Any]:
        """Return the record of a finished job. A job that has not begun when the run stops is cancelled."""
        begin = time.monotonic()
        pause = _FIRST_POLL_S
        while True:
            found = self._record(job)
            if found is not None:
                return found
            if stop.is_set() and self._cancel(job):
                found = self._record(job)  # it may have ended since the last look
                if found is not None:
                    return found
                raise ProgdfError("the calls of the server are stopped")
            if time.monotonic() - begin > self.timeout:
                self._cancel(job, also_running=True)
                raise BusyError(self.address.slow(self.timeout))
            if stop.is_set():
                time.sleep(pause)  # the picture is being made; it is kept
            else:
                stop.wait(pause)
            pause = min(1.5 * pause, _MAX_POLL_S)

    def _record(self, job: str) -> dict[str, Any] | None:
        """Return the record of a job; None if it has not ended."""
        found = self._json(f"/history/{quote(job, safe='')}").get(job)
        return found if isinstance(found, dict) else None

    def _cancel(self, job: str, also_running: bool = False) -> bool:
        """Take a job from the queue. Return True if the server no longer works on it."""
        queue = self._json("/queue")
        running = any(str(job) in map(str, row) for row in queue.get("queue_running") or ())
        if running and not also_running:
            return False
        path = "/interrupt" if running else "/queue"
        body = {"prompt_id": job} if running else {"delete": [job]}
        self.address.request(path, _REQUEST_TIMEOUT_S, json.dumps(body).encode(), "application/json")
        return True

    def _json(self, path: str) -> dict[str, Any]:
        """Return the JSON object at a path, asking again while the server is busy."""
        return persist(lambda: self._decode(self.address.request(path, _REQUEST_TIMEOUT_S)), Waits(Event()))

    def _decode(self, answer: Answer) -> dict[str, Any]:
        """Return the JSON object of an answer."""
        if answer.status != 200:
            text = one_line(answer.content[:400].decode("utf-8", "replace"))
            reason = f" ({text})" if text else ""
            raise self.address.fault(f"is no ComfyUI: status {answer.status}{reason}; check --api-url")
        try:
            value = json.loads(answer.content)
        except ValueError as error:
            raise self.address.fault(f"gave no valid answer ({one_line(error)}); check --api-url") from error
        if not isinstance(value, dict):
            raise self.address.fault("gave no valid answer (no JSON object); check --api-url")
        return value

    def _explain(self, body: Mapping[str, Any]) -> Exception:
        """Return the error of a workflow that the server does not accept."""
        faults = []
        for name, row in (body.get("node_errors") or {}).items():
            for error in row.get("errors") or ():
                text = f"{error.get('message', '')}: {error.get('details', '')}".strip(": ")
                faults.append(f"node {name} ({row.get('class_type', '')}): {text}")
        error = body.get("error")
        message = error.get("message") if isinstance(error, dict) else error
        text = one_line(faults[0] if faults else message or "no reason given")
        return self.address.fault(f"refuses the workflow: {text}; change it in {self.workflow.path}")

    def _explain_run(self, status: Mapping[str, Any]) -> Exception:
        """Return the error of a workflow that failed while it ran."""
        messages = dict(row for row in status.get("messages") or () if len(row) == 2)
        if "execution_interrupted" in messages:
            return self.address.fault("stopped the workflow, as its user asked; start again to continue")
        fault = messages.get("execution_error") or {}
        reason = one_line(fault.get("exception_message") or "no reason given")
        where = f"node {fault.get('node_id', '?')} ({fault.get('node_type', '?')})"
        if any(word in reason.lower() for word in _REFUSALS):
            return RefusedError(f"{where} of {self.address.host} refuses it: {reason}")
        return self.address.fault(f"failed in {where}: {reason}; change {self.workflow.path}")


def check_comfy(what: str, options: EditorOptions) -> ComfyServer:
    """Return the server of `comfy:WORKFLOW.json` after checking the file and the options. Nothing is sent.

    Raises:
        ProgdfError: the workflow or the address is missing or invalid, or an option does not fit the
            workflow.
    """
    if not what:
        raise ProgdfError("comfy: needs a workflow; write comfy:WORKFLOW.json")
    address = Address("comfy", options.api_url)
    address.check("http://127.0.0.1:8188", "")
    workflow = read_workflow(Path(what))
    if options.prompt and "prompt" not in workflow.nodes:
        raise ProgdfError(
            f"--prompt has no effect: {workflow.path} has no node titled prompt; title one, or leave it out"
        )
    if options.degrees and "prompt" not in workflow.nodes:
        raise ProgdfError(f"--degrees has no effect: {workflow.path} has no node titled prompt; title one")
    if options.degrees and "strength" in workflow.nodes:
        raise ProgdfError(
            f"--degrees has no effect: {workflow.path} has a node titled strength; leave one of them out"
        )
    check_anchor(options, workflow.references, f"title a node of {workflow.path} reference")
    return ComfyServer(address, workflow, options.edit_timeout)


def _object(content: bytes) -> dict[str, Any]:
    """Return the JSON object of a content; an empty one if it is none."""
    try:
        value = json.loads(content)
    except ValueError:
        return {}
    return value if isinstance(value, dict) else {}


def _multipart(fields: Mapping[str, bytes], name: str, content: bytes) -> tuple[bytes, str]:
    """Return a form with an image file, and its media type."""
    boundary = uuid.uuid4().hex
    lines = []
    for key, value in fields.items():
        lines += [f"--{boundary}", f'Content-Disposition: form-data; name="{key}"', "", value.decode()]
    lines += [
        f"--{boundary}",
        f'Content-Disposition: form-data; name="image"; filename="{name}"',
        "Content-Type: image/png",
        "",
        "",
    ]
    body = "\r\n".join(lines).encode() + content + f"\r\n--{boundary}--\r\n".encode()
    return body, f"multipart/form-data; boundary={boundary}"
