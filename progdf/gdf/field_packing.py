"""A field in a .gdf file: bases as they are, or the network that they are baked from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import torch
from torch import Tensor

from progdf.field.bake import BakePlan, NeuralForm
from progdf.field.baked import AttributeBases, BakedField
from progdf.field.neural import NeuralField
from progdf.gaussians import ATTRIBUTES

from .header import FieldTable, NetworkTable

_PARTS = {"end_offset": "full", "residual_basis": "rest", "scale": "step", "coefficients": "coefficients"}
"""Parts of `AttributeBases`, and what they are called in a file."""
_NETWORK = "network."


def pack_field(field: BakedField) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Tensors and JSON values for a .gdf file; of a baked network, the network."""
    described: dict[str, Any] = {
        "kind": field.kind,
        "channels": field.channels,
        "attributes": list(field.attributes),
        "recorded": list(field.recorded),
    }
    if field.origin is None:
        tensors = {"nodes": field.knots}
        for name, bases in field.attributes.items():
            for part, key in _PARTS.items():
                tensors[f"{name}.{key}"] = getattr(bases, part)
        return tensors, described
    form = field.origin
    network, plan = form.network, form.plan
    tensors = {_NETWORK + name: tensor for name, tensor in network.tensors.items()}
    tensors |= {"nodes": plan.knots, "end": network.end}
    tensors |= {f"pull.{name}": share for name, share in plan.end_correction.items()}
    if network.shape.code:
        tensors |= {"codes": network.codes, "code_step": network.code_step}
    described["network"] = {
        "shape": {**asdict(network.shape), "attributes": list(network.shape.attributes)},
        "ranks": dict(plan.ranks),
        "rows_sha256": form.rows_sha256,
        "bake_error": dict(form.error or {}),
    }
    return tensors, described


def unpack_field(table: FieldTable, tensors: Mapping[str, Tensor]) -> tuple[BakedField, NeuralForm | None]:
    """The inverse of `pack_field`; of a network, a field that is not baked yet and moves nothing, and it.

    Raises:
        ValueError, KeyError, TypeError: the parts do not fit each other.
    """
    recorded = tuple(table.recorded)
    for name in table.attributes:
        if name not in ATTRIBUTES:
            raise ValueError(f"unknown attribute {name}")
    if table.network is None:
        attributes = {
            name: AttributeBases(**{part: tensors[f"{name}.{key}"] for part, key in _PARTS.items()})
            for name in table.attributes
        }
        return BakedField(table.kind, tensors["nodes"], attributes, table.channels, recorded), None
    form = _unpack_network(table.network, tensors, recorded)
    if form.network.shape.channels != table.channels:
        raise ValueError(
            f"the network has {form.network.shape.channels} channels, the field {table.channels}"
        )
    return BakedField("neural", torch.tensor([0.0, 1.0]), {}, table.channels, recorded, form), form


def _unpack_network(
    table: NetworkTable, tensors: Mapping[str, Tensor], recorded: tuple[float, ...]
) -> NeuralForm:
    end = tensors["end"]
    codes = tensors.get("codes", torch.zeros(len(end), 0, dtype=torch.int8))
    network = NeuralField(
        table.shape,
        {name.removeprefix(_NETWORK): t for name, t in tensors.items() if name.startswith(_NETWORK)},
        end,
        codes,
        tensors.get("code_step", torch.zeros(0)),
        recorded,
    )
    end_correction = {
        name.removeprefix("pull."): t for name, t in tensors.items() if name.startswith("pull.")
    }
    plan = BakePlan(tensors["nodes"], table.ranks, end_correction)
    return NeuralForm(network, plan, table.rows_sha256, table.bake_error)
