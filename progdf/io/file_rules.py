"""Rules for reading third-party files.

1. A field that changes the result is either used, or the file is refused and the error names the field.
   `progdf info` lists harmless unknown fields.
2. An error calls a file damaged only if it breaks its own format. For an unsupported format, version or
   feature, the error names it and gives a way to convert the file.
3. An error names the file at fault.
"""

from __future__ import annotations

import os
import re
from collections.abc import Collection, Iterable, Mapping

from progdf.errors import ProgdfError


def unsupported_error(path: str | os.PathLike[str], feature: str, remedy: str) -> ProgdfError:
    """Return the error for a valid file with a feature that is not supported.

    Args:
        path: the file at fault
        feature: the feature by the format's own name, such as "mesh compression (EXT_meshopt_compression)"
        remedy: an imperative phrase, such as "convert it with `splat-transform in.sog out.ply`"
    """
    return ProgdfError(f"{os.fspath(path)} uses {feature}, which is not supported; {remedy}")


def damage_error(path: str | os.PathLike[str], detail: str) -> ProgdfError:
    """Return the error for a file that breaks its own format.

    Args:
        path: the file at fault
        detail: the violated rule and what was found, such as "row 12 ends after 3 of 14 numbers"
    """
    return ProgdfError(f"{os.fspath(path)} is damaged: {detail}; copy or export it again")


def check_fields(
    path: str | os.PathLike[str],
    present: Iterable[str],
    honored: Collection[str],
    refused: Mapping[str, str],
    remedy: str,
) -> tuple[str, ...]:
    """Return the fields that a reader ignores, in the order of the file.

    Args:
        path: the file that holds the fields
        present: names of the fields in the file
        honored: fields that the reader uses or has checked
        refused: fields that change geometry, color or cameras and are not supported → their meaning
        remedy: an imperative phrase for the error of a refused field

    Raises:
        ProgdfError: a refused field is present.
    """
    ignored = []
    for name in present:
        if name in refused:
            raise unsupported_error(path, f"'{name}' ({refused[name]})", remedy)
        if name not in honored:
            ignored.append(name)
    return tuple(ignored)


_VARIANTS = {
    r"trbf_(center|scale)|motion(_\d+)?|omega(_\d+)?|f_t_\d+": "motion over time (SpacetimeGaussians)",
    r"t|times?|t_scale|scales?_t|mu_t|cov_t_\d+|velocity(_\d+)?|v[xyz]|durations?": "time (4D Gaussians)",
    r"rot_r_\d+|rot_([4-9]|\d\d+)": "rotations in four dimensions",
    r"scale_([3-9]|\d\d+)|f_offset_\d+|f_anchor_feat_\d+|anchor_\w+": "anchors of Scaffold-GS",
    r"betas?|sb_params(_\d+)?": "kernel shapes of Deformable Beta Splatting",
    r"shape": "kernel shapes of generalized exponential splatting",
    r"f_dc_([3-9]|\d\d+)": "more than three color channels",
    r"f_asg_\d+|roughness|metallic|(base_color|albedo|specular|brdf|incidents)_\w+": "reflectance",
    r"appearance_\w+|features|colors": "colors that depend on an appearance network, as gsplat's `app_opt`",
}
"""Fields of 3DGS variants that change geometry, color or time: pattern of the whole name → meaning.

.ply files and checkpoints share the table, as trainers export tensors under their internal names.
"""

PLAIN_GAUSSIANS = "export plain 3D Gaussians from the program that trained it"


def variant_fields(names: Iterable[str]) -> dict[str, str]:
    """Return the names that belong to an unsupported 3DGS variant, with their meanings."""
    meanings = {}
    for name in names:
        for pattern, meaning in _VARIANTS.items():
            if re.fullmatch(pattern, name):
                meanings[name] = meaning
    return meanings
