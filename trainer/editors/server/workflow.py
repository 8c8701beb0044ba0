"""Workflow of ComfyUI in API format: a graph of nodes, of which some are filled for each picture.

{"3": {"class_type": "KSampler", "inputs": {"seed": 0, "model": ["4", 0]}, "_meta": {"title": "seed"}}, …}

An input is a value, or a link: the name of another node and the number of its output. The title of a node is
its role (`ROLES`).
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from progdf.errors import ProgdfError
from progdf.io.json_values import decode_json
from progdf.terminal import escape_text, shorten

Graph = dict[str, dict[str, Any]]
"""Nodes by name, each with `class_type`, `inputs` and, for a title, `_meta`."""

ROLES: Mapping[str, tuple[str, ...]] = {
    "input": ("image",),
    "reference": ("image",),
    "reference 2": ("image",),
    "mask": ("image",),
    "prompt": ("prompt", "text", "value", "string"),
    "strength": ("denoise", "strength", "strength_model", "value", "float"),
    "seed": ("seed", "noise_seed", "value", "int"),
    "output": (),
}
"""Titles of the nodes that are filled or read, and the inputs to fill; the first that the node has counts."""

_REQUIRED = ("input", "output")


@dataclass(frozen=True)
class Workflow:
    """Checked workflow of a file."""

    path: Path
    graph: Graph
    nodes: Mapping[str, str]  # role → name of its node

    @property
    def references(self) -> int:
        """Number of nodes for reference pictures, 0 to 2."""
        return len(self.nodes.keys() & {"reference", "reference 2"})

    @property
    def prompt(self) -> str:
        """The workflow's own prompt; "" if no node is titled prompt."""
        if "prompt" not in self.nodes:
            return ""
        return str(self.graph[self.nodes["prompt"]]["inputs"][self.slot("prompt")])

    @property
    def digest(self) -> str:
        """SHA-256 of the graph."""
        return hashlib.sha256(json.dumps(self.graph, sort_keys=True).encode()).hexdigest()

    @property
    def classes(self) -> list[str]:
        """Classes of all nodes, sorted."""
        return sorted({str(node["class_type"]) for node in self.graph.values()})

    def fill(self, values: Mapping[str, object], optional: Mapping[str, frozenset[str]]) -> Graph:
        """Return the graph of one call.

        A reference or a mask without a value is removed, with all nodes that cannot run without it.

        Args:
            values: role → value of its input
            optional: class → its optional inputs

        Raises:
            ProgdfError: the output cannot be made without a reference that is missing.
        """
        graph = deepcopy(self.graph)
        for role, name in self.nodes.items():
            if role == "output":
                continue
            if role in values:
                graph[name]["inputs"][self.slot(role)] = values[role]
            elif role in ("reference", "reference 2", "mask"):
                _remove(graph, name, optional)
                if self.nodes["output"] not in graph:
                    raise ProgdfError(
                        f"comfy: {self.path} makes no output without the node titled {role}, and the first "
                        "views have none; connect it to an optional input"
                    )
        return graph

    def slot(self, role: str) -> str:
        """Return the input of a role's node that is filled.

        Raises:
            ProgdfError: it has none.
        """
        node = self.graph[self.nodes[role]]
        for name in ROLES[role]:
            if name in node["inputs"] and not isinstance(node["inputs"][name], list):
                return name
        expected = " or ".join(ROLES[role])
        raise ProgdfError(
            f"comfy: {self.path}: the node titled {role} ({_kind(node)}) has no free input {expected}; "
            "give the title to a node that has one"
        )


def read_workflow(path: Path) -> Workflow:
    """Read and check a workflow.

    Raises:
        ProgdfError: the file cannot be read, is no workflow in API format, or lacks a title or has it twice.
    """
    try:
        content = decode_json(path.read_bytes())
    except OSError as error:
        raise ProgdfError(
            f"comfy: {path} cannot be read ({error.strerror}); give a workflow's file"
        ) from error
    except ValueError as error:
        raise ProgdfError(f"comfy: {path} is not JSON ({error}); save it with Export (API)") from error
    if isinstance(content, dict) and isinstance(content.get("nodes"), list):
        raise ProgdfError(
            f"comfy: {path} is a workflow of the editor; save it in ComfyUI with Workflow > Export (API)"
        )
    if not isinstance(content, dict) or not content or not all(map(_is_node, content.values())):
        raise ProgdfError(f"comfy: {path} is no workflow; save one in ComfyUI with Workflow > Export (API)")
    nodes: dict[str, str] = {}
    for name, node in content.items():
        role = _title(node)
        if role not in ROLES:
            continue
        if role in nodes:
            raise ProgdfError(
                f"comfy: {path} has two nodes titled {role} ({nodes[role]} and {name}); rename one of them"
            )
        nodes[role] = name
    for role in _REQUIRED:
        if role not in nodes:
            raise ProgdfError(
                f"comfy: {path} has no node titled {role}; rename the node that "
                f"{'loads the picture' if role == 'input' else 'saves the picture'}"
            )
    if "reference 2" in nodes and "reference" not in nodes:
        raise ProgdfError(f"comfy: {path} has a node titled reference 2 but none titled reference; rename it")
    workflow = Workflow(path, content, nodes)
    for role in nodes:
        if role != "output":
            workflow.slot(role)
    return workflow


def _is_node(node: object) -> bool:
    return isinstance(node, dict) and "class_type" in node and isinstance(node.get("inputs"), dict)


def _title(node: Mapping[str, Any]) -> str:
    """Return the title of a node, in lower case without spaces around it; "" without one."""
    meta = node.get("_meta")
    title = meta.get("title") if isinstance(meta, dict) else ""
    return str(title).strip().lower()


def _kind(node: Mapping[str, Any]) -> str:
    return shorten(escape_text(str(node["class_type"])))


def _remove(graph: Graph, name: str, optional: Mapping[str, frozenset[str]]) -> None:
    """Remove a node, its links to optional inputs, and the nodes that require it."""
    del graph[name]
    for other in list(graph):
        node = graph.get(other)
        if node is None:  # removed by an earlier step
            continue
        links = [
            key for key, value in node["inputs"].items() if isinstance(value, list) and value[:1] == [name]
        ]
        if not links:
            continue
        if set(links) <= optional.get(str(node["class_type"]), frozenset()):
            for key in links:
                del node["inputs"][key]
        else:
            _remove(graph, other, optional)
