"""Neural field of ProGDF (AAAI 2025): a small network gives the offset of every Gaussian along the slider.

The paper's network receives an encoded position and the control signal H(s), and outputs the offset. Two
Gaussians at the same position then cannot move differently, and 6 million numbers are spent on information
that the position does not contain. ProGDF Studio's own form stores the recorded end, which s = 1 needs
exactly anyway. The network only describes how the trajectory bends away from the straight line. A Gaussian's
appearance and its end are inputs. The scene and the file already contain them, so they cost no bytes. A short
learned code per Gaussian carries the remainder.

    paper:  Δ_i(s) = g(s) · spread · f(γ(x_i), H(s))                             g(0) = 0
    own:    Δ_i(s) = s · end_i + 4 s (1 − s) · spread · f(γ(x_i), look_i, end_i, code_i, H(s))
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor
from torch.nn.functional import linear, silu

from progdf.gaussians import BASE_CHANNELS, attribute_slices
from progdf.io.tensors import check_tensor
from progdf.system.equality import equal_fields

Inputs = Literal["own", "position"]
Bins = Literal["smooth", "hard"]
Size = Literal["tiny", "small", "paper"]

LAYOUT: Mapping[Size, tuple[int, int]] = {"tiny": (64, 3), "small": (384, 4), "paper": (1088, 6)}
"""Width and number of hidden layers: about 17 000, 0.5 million and the paper's 6 million numbers."""

CONTROL = 16
"""Length of one node of the control signal."""

_APPEARANCE = slice(3, BASE_CHANNELS)  # columns of a packed row: all but the center
_INPUT_LIMIT = 4.0  # inputs are clamped to this many standard deviations


@dataclass(frozen=True)
class NeuralShape:
    """Layout of a network and of its inputs."""

    # width of the hidden layers, and their number
    width: int
    layers: int
    attributes: tuple[str, ...]  # attributes that change; only they have outputs
    channels: int  # width of a packed row, 14 or 14 + 3K
    # "position" is the paper's. "own" adds the Gaussian's appearance and its end, and the network describes
    # only the bend of the trajectory to that end
    inputs: Inputs = "own"
    code: int = 0  # length of each Gaussian's learned code
    bins: int = 10  # bins of the slider (paper: k = 10)
    # true: the paper's bins, in which H(s) is constant, see `hard_bin`. false: H(s) is linear between bins +
    # 1 nodes, node 0 being 0
    hard: bool = False
    frequencies: int = 8  # frequencies of the positional encoding, doubling from a period of twice the box

    def __post_init__(self) -> None:
        for label, value, low, high in (
            ("width", self.width, 1, 8192),
            ("layers", self.layers, 1, 64),
            ("code", self.code, 0, 256),
            ("bins", self.bins, 1, 1024),
            ("frequencies", self.frequencies, 0, 24),
        ):
            if not low <= value <= high:
                raise ValueError(f"{label} is {value}, expected {low} to {high}")
        if self.inputs not in ("own", "position"):
            raise ValueError(f"inputs is {self.inputs!r}, expected 'own' or 'position'")
        known = attribute_slices(self.channels)
        listed = list(self.attributes)
        if not listed or [name for name in known if name in listed] != listed:
            raise ValueError(f"attributes {listed} are not a subset of {list(known)}, in this order")

    @property
    def columns(self) -> Tensor:
        """Columns of a packed row that the network changes. [c] int64"""
        slices = attribute_slices(self.channels)
        return torch.cat([torch.arange(slices[name].start, slices[name].stop) for name in self.attributes])

    @property
    def outputs(self) -> dict[str, slice]:
        """Slice of each attribute in the network's output."""
        outputs = {}
        start = 0
        for name in self.attributes:
            width = attribute_slices(self.channels)[name]
            outputs[name] = slice(start, start + width.stop - width.start)
            start = outputs[name].stop
        return outputs

    @property
    def seen(self) -> int:
        """Number of inputs of the first layer per Gaussian, without code and control signal."""
        appearance_inputs = BASE_CHANNELS - 3 + len(self.columns) if self.inputs == "own" else 0
        return 3 + 6 * self.frequencies + appearance_inputs

    def weights(self) -> dict[str, tuple[int, ...]]:
        """Return names and shapes of all learned tensors except the codes."""
        shapes: dict[str, tuple[int, ...]] = {"control": (self.bins, CONTROL)}
        before = self.seen + self.code + CONTROL
        for i in range(self.layers):
            shapes[f"layers.{i}.weight"] = (self.width, before)
            shapes[f"layers.{i}.bias"] = (self.width,)
            before = self.width
        shapes["heads.weight"] = (len(self.columns), before)
        shapes["heads.bias"] = (len(self.columns),)
        return shapes

    def frame(self) -> dict[str, tuple[int, ...]]:
        """Return names and shapes of the tensors that scale inputs and outputs, float32."""
        width = self.seen - 3 - 6 * self.frequencies
        return {"center": (3,), "extent": (), "look_mean": (width,), "look_spread": (width,),
                "spread": (len(self.columns),)}  # fmt: skip


@dataclass(frozen=True)
class NeuralField:
    """Trained network and its data in addition to the scene.

    Raises:
        ValueError: a tensor is absent or has the wrong shape or type.
    """

    __eq__ = equal_fields

    shape: NeuralShape  # layout
    tensors: Mapping[str, Tensor]  # `shape.weights()` in float16 or float32, `shape.frame()` in float32
    end: Tensor  # recorded offset at s = 1 of the columns that change. [M,c] float32
    codes: Tensor  # learned codes in stored form. [M,code] int8
    code_step: Tensor  # value of one unit of a code. [code] float32
    recorded: tuple[float, ...] = ()  # strengths of the recorded snapshots, for the slider's ticks

    def __post_init__(self) -> None:
        shape = self.shape
        expected = {**shape.weights(), **shape.frame()}
        if set(self.tensors) != set(expected):
            raise ValueError(f"the tensors do not fit a network of {shape.layers} layers")
        for name, size in expected.items():
            halves = (torch.float16,) if name in shape.weights() else ()
            check_tensor(name, self.tensors[name], size, torch.float32, *halves)
        check_tensor("end", self.end, (None, len(shape.columns)), torch.float32)
        check_tensor("codes", self.codes, (len(self.end), shape.code), torch.int8)
        check_tensor("code_step", self.code_step, (shape.code,), torch.float32)

    @property
    def members(self) -> int:
        """Number of members M."""
        return int(self.end.shape[0])

    @property
    def parameters(self) -> int:
        """Number of learned values, codes included."""
        return sum(self.tensors[name].numel() for name in self.shape.weights()) + self.codes.numel()

    @property
    def bytes_per_member(self) -> float:
        """Bytes on disk per member, including its share of the network, without names and header."""
        stored = [*self.tensors.values(), self.end, self.codes, self.code_step]
        return sum(tensor.numel() * tensor.element_size() for tensor in stored) / max(1, self.members)

    def bind(self, rows: Tensor) -> BoundField:
        """Return the field of these Gaussians.

        Args:
            rows: raw values of the members, packed, in the region's order. [M,≥14]

        Raises:
            ValueError: the number of rows differs from the members.
        """
        if rows.shape[0] != self.members:
            raise ValueError(f"rows is {list(rows.shape)}, expected {self.members} rows")
        weights = {name: tensor.float() for name, tensor in self.tensors.items()}
        return BoundField(self, weights, self.codes.float() * self.code_step, rows)


class BoundField:
    """Neural field bound to its Gaussians. `offsets` evaluates the network itself, before baking."""

    def __init__(
        self, field: NeuralField, weights: Mapping[str, Tensor], codes: Tensor, rows: Tensor
    ) -> None:
        self.shape = field.shape
        self.end = field.end
        self.attributes = field.shape.attributes
        self._weights = weights
        with torch.no_grad():
            inputs = torch.cat([encode(self.shape, weights, rows, self.end), codes], dim=1)
            # part of the first layer that does not depend on s
            first = weights["layers.0.weight"]
            self._first = linear(inputs, first[:, : inputs.shape[1]], weights["layers.0.bias"])

    def offsets(self, s: float) -> Tensor:
        """Return packed offsets at strength `s`; exactly 0 at 0. [M,C] float32"""
        packed = torch.zeros(len(self.end), self.shape.channels)
        if s == 0.0 or not len(packed):
            return packed
        strengths = torch.full((1,), s)
        with torch.no_grad():
            signal = control_signal(self.shape, self._weights["control"], strengths)
            hidden = self._first + linear(signal, self._weights["layers.0.weight"][:, -CONTROL:])
            answer = apply_later_layers(self.shape, self._weights, hidden)
            packed[:, self.shape.columns] = offsets_of_answer(self.shape, strengths, answer, self.end)
        return packed


def encode(shape: NeuralShape, frame: Mapping[str, Tensor], rows: Tensor, end: Tensor) -> Tensor:
    """Return the network's inputs for the Gaussians. [M,≥14], [M,c] -> [M,seen]"""
    position = (rows[:, :3] - frame["center"]) / frame["extent"]
    waves = position[:, None, :] * (math.pi / 2 * 2.0 ** torch.arange(shape.frequencies))[:, None]
    parts = [position, waves.sin().flatten(1), waves.cos().flatten(1)]
    if shape.inputs == "own":
        appearance_inputs = (appearance(rows, end) - frame["look_mean"]) / frame["look_spread"]
        parts.append(appearance_inputs.clamp(-_INPUT_LIMIT, _INPUT_LIMIT))
    return torch.cat(parts, dim=1)


def appearance(rows: Tensor, end: Tensor) -> Tensor:
    """Return the appearance of the Gaussians and their end, raw units. [M,≥14], [M,c] -> [M,11+c]"""
    return torch.cat([rows[:, _APPEARANCE], end], dim=1)


def control_signal(shape: NeuralShape, nodes: Tensor, s: Tensor) -> Tensor:
    """Return the control signal H(s) of each strength. [bins,CONTROL], [B] -> [B,CONTROL]"""
    # index_select, because the gradient of indexing depends on the order of threads
    if shape.hard:
        return nodes.index_select(0, hard_bin(s, shape.bins))
    position = s.clamp(0.0, 1.0) * shape.bins
    left = position.floor().clamp(max=shape.bins - 1).long()
    full = torch.cat([torch.zeros_like(nodes[:1]), nodes])
    ends = full.index_select(0, left), full.index_select(0, left + 1)
    return torch.lerp(*ends, (position - left)[:, None])


def hard_bin(s: Tensor, bins: int = 10) -> Tensor:
    """Return the paper's bin of each strength, as in GraCo (CVPR 2024): ⌊clamp(k·s − 1, 0, k − 1)⌋.

    So the first bin contains all s < 2/k, and the last only s = 1. [B] -> [B] int64
    """
    return (s * bins - 1.0).clamp(0.0, bins - 1.0).long()


def apply_later_layers(shape: NeuralShape, weights: Mapping[str, Tensor], hidden: Tensor) -> Tensor:
    """Return the network's output in raw units, from the sums of its first layer. [B,width] -> [B,c]"""
    hidden = silu(hidden)
    for i in range(1, shape.layers):
        hidden = silu(linear(hidden, weights[f"layers.{i}.weight"], weights[f"layers.{i}.bias"]))
    return linear(hidden, weights["heads.weight"], weights["heads.bias"]) * weights["spread"]


def offsets_of_answer(shape: NeuralShape, s: Tensor, answer: Tensor, end: Tensor) -> Tensor:
    """Return offsets from the network's output; exactly 0 at s = 0. [B], [B,c], [B,c] -> [B,c]"""
    s = s[:, None]
    if shape.inputs == "own":
        return s * end + 4.0 * s * (1.0 - s) * answer
    return (s > 0) * answer if shape.hard else s * answer
