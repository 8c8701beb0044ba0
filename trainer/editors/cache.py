"""Painted pictures kept on disk, so that a run that comes again, or goes on, paints nothing twice.

RUN/views/painted/VIEW.png              what a learned editor made of what it was shown, at its own size
RUN/views/painted/VIEW.json             from what: a digest of that, the editor, all its options
RUN/views/painted/0.25/VIEW.png         at another strength, where the editor has several

A picture is taken again while its note fits. So one that was touched up by hand stays as it is.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from torch import Tensor

from progdf.errors import ProgdfError
from progdf.io.images import read_picture, to_picture, write_image
from progdf.io.json_values import decode_json
from trainer.store.run_folder import add_pictures, from_bytes, to_bytes, write_json

Recipe = Mapping[str, str | int | float | None]
"""All that a painted picture depends on besides the picture that it is painted from."""


@dataclass(frozen=True)
class KeptPictures:
    """Pictures in a folder; with no folder nothing is kept."""

    folder: Path | None

    def picture(
        self,
        name: str,
        source: Tensor,
        recipe: Recipe,
        paint: Callable[[Tensor], Tensor],
        place: str = "",
    ) -> Tensor:
        """What `paint` makes of `source`, in 8 bits: read where the note fits, else painted and kept.

        Args:
            name: of the view, a file name
            source: the picture that is painted from. [H,W,3]
            recipe: see `Recipe`
            paint: [H,W,3] -> [H,W,3]
            place: subfolder
        """
        if self.folder is None:
            return from_bytes(to_bytes(paint(source)))
        path = self.folder / place / f"{name}.png"
        note = path.with_suffix(".json")
        expected = {"source": digest(source), "editor": dict(recipe)}
        with suppress(OSError, ValueError, ProgdfError):  # what is deleted or broken is painted anew
            if decode_json(note.read_bytes()) == expected:
                return read_picture(path, size=(source.shape[1], source.shape[0]))
        painted = paint(source)
        note.unlink(missing_ok=True)  # a new picture never lies beside an old note
        write_image(path, painted)
        write_json(note, expected)
        add_pictures(self.folder, [path, note])
        return from_bytes(to_bytes(painted))


def digest(image: Tensor) -> str:
    """SHA-256 of a picture as an 8-bit file holds it. [H,W,3]"""
    pixels = np.asarray(to_picture(image))
    return hashlib.sha256(repr(pixels.shape).encode() + pixels.tobytes()).hexdigest()
