"""Disk cache of painted pictures, so that a repeated or resumed run paints nothing twice.

RUN/views/painted/VIEW.png              output of a learned editor, at its own size
RUN/views/painted/VIEW.json             note: digest of the source picture, the editor and all its options
RUN/views/painted/0.25/VIEW.png         output at another strength, if the editor has several

A picture is reused while its note matches. A picture that the user has retouched is therefore kept.
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
"""All inputs of a painted picture except its source picture."""


@dataclass(frozen=True)
class PictureCache:
    """Cache of pictures in a folder. Without a folder nothing is cached."""

    folder: Path | None

    def picture(
        self,
        name: str,
        source: Tensor,
        recipe: Recipe,
        paint: Callable[[Tensor], Tensor],
        place: str = "",
    ) -> Tensor:
        """Return `paint(source)` in 8 bits, from the cache if the note matches.

        Args:
            name: file name of the view
            source: picture to paint from. [H,W,3]
            recipe: see `Recipe`
            paint: [H,W,3] -> [H,W,3]
            place: subfolder
        """
        if self.folder is None:
            return from_bytes(to_bytes(paint(source)))
        path = self.folder / place / f"{name}.png"
        note = path.with_suffix(".json")
        expected = {"source": digest(source), "editor": dict(recipe)}
        with suppress(OSError, ValueError, ProgdfError):  # deleted or broken files are painted again
            if decode_json(note.read_bytes()) == expected:
                return read_picture(path, size=(source.shape[1], source.shape[0]))
        painted = paint(source)
        note.unlink(missing_ok=True)  # an old note must never describe a new picture
        write_image(path, painted)
        write_json(note, expected)
        add_pictures(self.folder, [path, note])
        return from_bytes(to_bytes(painted))


def digest(image: Tensor) -> str:
    """Return the SHA-256 of a picture as stored in an 8-bit file. [H,W,3]"""
    pixels = np.asarray(to_picture(image))
    return hashlib.sha256(repr(pixels.shape).encode() + pixels.tobytes()).hexdigest()
