"""The neural field of ProGDF (AAAI 2025): a small network says how every Gaussian moves along the slider.

The paper's network sees a position, encoded, and the control signal H(s), and its output is the offset. Two
Gaussians at one place can then not move differently, and 6 M numbers are spent on what its place does not
tell. Our own form keeps the recorded end, which s = 1 needs to be exact anyway, and lets the network say
only how the way bends beside it; what a Gaussian looks like and where it ends are inputs that the scene
and the file hold already, so they cost no byte. A short learned code per Gaussian carries the rest.

    paper:  Δ_i(s) = g(s) · spread · f(γ(x_i), H(s))                             g(0) = 0
    ours:   Δ_i(s) = s · end_i + 4 s (1 − s) · spread · f(γ(x_i), look_i, end_i, code_i, H(s))
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

Inputs = Literal["own", "position"]
Bins = Literal["smooth", "hard"]
Size = Literal["tiny", "small", "paper"]

LAYOUT: Mapping[Size, tuple[int, int]] = {"tiny": (64, 3), "small": (384, 4), "paper": (1088, 6)}
"""Width and number of hidden layers: about 17 000, 0.5 million and the paper's 6 million numbers."""

CONTROL = 16
"""Numbers in one node of the control signal."""

_LOOK = slice(3, BASE_CHANNELS)  # of a packed row: all but the center
_LIMIT = 4.0  # standard deviations within which the inputs are kept


@dataclass(frozen=True)
class NeuralShape:
    """Everything that says how a network is laid out and read."""

    # width, layers: of the hidden layers
    width: int
    layers: int
    attributes: tuple[str, ...]  # those that move; only they have outputs
    channels: int  # width of a packed row, 14 or 14 + 3K
    # "position" is the paper's; "own" adds what the Gaussian looks like and where it ends, and has the
    # network describe only how the way there bends
    inputs: Inputs = "own"
    code: int = 0  # numbers in each Gaussian's learned code
    bins: int = 10  # how many the slider has (paper: k = 10)
    # the paper's bins, in which H(s) is constant, see `hard_bin`; else it is linear between bins + 1 nodes,
    # node 0 being 0
    hard: bool = False
    frequencies: int = 8  # of the positional encoding, doubling from a period of twice the box

    def __post_init__(self) -> None:
        for what, value, low, high in (
            ("width", self.width, 1, 8192),
            ("layers", self.layers, 1, 64),
            ("code", self.code, 0, 256),
            ("bins", self.bins, 1, 1024),
            ("frequencies", self.frequencies, 0, 24),
        ):
            if not low <= value <= high:
                raise ValueError(f"{what} is {value}, expected {low} to {high}")
        if self.inputs not in ("own", "position"):
            raise ValueError(f"inputs is {self.inputs!r}, expected 'own' or 'position'")
        known = attribute_slices(self.channels)
        named = list(self.attributes)
        if not named or [name for name in known if name in named] != named:
            raise ValueError(f"attributes {named} are not some of {list(known)}, in this order")

    @property
    def columns(self) -> Tensor:
        """Columns of a packed row that the network moves. [c] int64"""
        slices = attribute_slices(self.channels)
        return torch.cat([torch.arange(slices[name].start, slices[name].stop) for name in self.attributes])

    @property
    def outputs(self) -> dict[str, slice]:
        """Where each attribute lies in the network's output."""
        outputs = {}
        start = 0
        for name in self.attributes:
            width = attribute_slices(self.channels)[name]
            outputs[name] = slice(start, start + width.stop - width.start)
            start = outputs[name].stop
        return outputs

    @property
    def seen(self) -> int:
        """Numbers that the first layer sees of a Gaussian, code and control signal left out."""
        look = BASE_CHANNELS - 3 + len(self.columns) if self.inputs == "own" else 0
        return 3 + 6 * self.frequencies + look

    def weights(self) -> dict[str, tuple[int, ...]]:
        """Names and shapes of all that is learned but the codes."""
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
        """Names and shapes of what scales inputs and outputs, float32."""
        look = self.seen - 3 - 6 * self.frequencies
        return {"center": (3,), "extent": (), "look_mean": (look,), "look_spread": (look,),
                "spread": (len(self.columns),)}  # fmt: skip


@dataclass(frozen=True)
class NeuralField:
    """A trained network and what it needs beside the scene.

    Raises:
        ValueError: a tensor is absent or has another shape or type.
    """

    shape: NeuralShape  # its layout
    tensors: Mapping[str, Tensor]  # `shape.weights()` in float16 or float32, `shape.frame()` in float32
    end: Tensor  # the recorded offset at s = 1 of the columns that move. [M,c] float32
    codes: Tensor  # learned codes, as stored. [M,code] int8
    code_step: Tensor  # what one unit of a code is worth. [code] float32
    recorded: tuple[float, ...] = ()  # strengths of the recorded snapshots, for the slider's ticks

    def __post_init__(self) -> None:
        shape = self.shape
        expected = {**shape.weights(), **shape.frame()}
        if set(self.tensors) != set(expected):
            raise ValueError(f"the network's tensors are not those of {shape.layers} layers")
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
        """Learned numbers, the codes included."""
        return sum(self.tensors[name].numel() for name in self.shape.weights()) + self.codes.numel()

    @property
    def bytes_per_member(self) -> float:
        """Bytes on disk for one member, its share of the network included, names and header left out."""
        stored = [*self.tensors.values(), self.end, self.codes, self.code_step]
        return sum(tensor.numel() * tensor.element_size() for tensor in stored) / max(1, self.members)

    def bind(self, rows: Tensor) -> BoundField:
        """The field of these Gaussians. `rows`: their raw values, packed, in the region's order. [M,≥14]"""
        if rows.shape[0] != self.members:
            raise ValueError(f"rows is {list(rows.shape)}, expected {self.members} of them")
        weights = {name: tensor.float() for name, tensor in self.tensors.items()}
        return BoundField(self, weights, self.codes.float() * self.code_step, rows)


class BoundField:
    """A neural field on its Gaussians: `offsets(s)` is the network's own answer, before it is baked."""

    def __init__(
        self, field: NeuralField, weights: Mapping[str, Tensor], codes: Tensor, rows: Tensor
    ) -> None:
        self.shape = field.shape
        self.end = field.end
        self.attributes = field.shape.attributes
        self._weights = weights
        with torch.no_grad():
            inputs = torch.cat([encode(self.shape, weights, rows, self.end), codes], dim=1)
            # all of the first layer that does not depend on s
            first = weights["layers.0.weight"]
            self._first = linear(inputs, first[:, : inputs.shape[1]], weights["layers.0.bias"])

    def offsets(self, s: float) -> Tensor:
        """Packed offsets at strength `s`; exactly 0 at 0. [M,C] float32"""
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
    """What the network sees of the Gaussians. [M,≥14], [M,c] -> [M,seen]"""
    position = (rows[:, :3] - frame["center"]) / frame["extent"]
    waves = position[:, None, :] * (math.pi / 2 * 2.0 ** torch.arange(shape.frequencies))[:, None]
    parts = [position, waves.sin().flatten(1), waves.cos().flatten(1)]
    if shape.inputs == "own":
        look = (appearance(rows, end) - frame["look_mean"]) / frame["look_spread"]
        parts.append(look.clamp(-_LIMIT, _LIMIT))
    return torch.cat(parts, dim=1)


def appearance(rows: Tensor, end: Tensor) -> Tensor:
    """What a Gaussian looks like and where it ends, raw units. [M,≥14], [M,c] -> [M,11+c]"""
    return torch.cat([rows[:, _LOOK], end], dim=1)


def control_signal(shape: NeuralShape, nodes: Tensor, s: Tensor) -> Tensor:
    """The control signal H(s) of each strength. [bins,CONTROL], [B] -> [B,CONTROL]"""
    # index_select: the gradient of indexing adds up in the order that threads come in
    if shape.hard:
        return nodes.index_select(0, hard_bin(s, shape.bins))
    position = s.clamp(0.0, 1.0) * shape.bins
    left = position.floor().clamp(max=shape.bins - 1).long()
    full = torch.cat([torch.zeros_like(nodes[:1]), nodes])
    ends = full.index_select(0, left), full.index_select(0, left + 1)
    return torch.lerp(*ends, (position - left)[:, None])


def hard_bin(s: Tensor, bins: int = 10) -> Tensor:
    """The paper's bin of each strength, as GraCo (CVPR 2024) takes it: ⌊clamp(k·s − 1, 0, k − 1)⌋.

    So the first holds all s < 2/k, and the last s = 1 alone. [B] -> [B] int64
    """
    return (s * bins - 1.0).clamp(0.0, bins - 1.0).long()


def apply_later_layers(shape: NeuralShape, weights: Mapping[str, Tensor], hidden: Tensor) -> Tensor:
    """What the network answers, in spreads, from the sums of its first layer. [B,width] -> [B,c]"""
    hidden = silu(hidden)
    for i in range(1, shape.layers):
        hidden = silu(linear(hidden, weights[f"layers.{i}.weight"], weights[f"layers.{i}.bias"]))
    return linear(hidden, weights["heads.weight"], weights["heads.bias"]) * weights["spread"]


def offsets_of_answer(shape: NeuralShape, s: Tensor, answer: Tensor, end: Tensor) -> Tensor:
    """Offsets from the network's answer; exactly 0 at s = 0. [B], [B,c], [B,c] -> [B,c]"""
    s = s[:, None]
    if shape.inputs == "own":
        return s * end + 4.0 * s * (1.0 - s) * answer
    return (s > 0) * answer if shape.hard else s * answer
