"""Tests of the discs under fine paint."""

from __future__ import annotations

import numpy as np

from trainer.paint.discs import _main_pieces


def test_main_piece_has_the_most_weight() -> None:
    random = np.random.default_rng(0)
    owner = random.integers(0, 50, 400).astype(np.int32)
    piece = random.integers(0, 5, 400)
    weights = (random.integers(1, 4, 400) / 4.0).astype(np.float32)  # with ties, where the first piece counts
    sums = np.zeros((60, 5))
    np.add.at(sums, (owner, piece), weights)
    np.testing.assert_array_equal(_main_pieces(owner, piece, weights, 60), sums.argmax(axis=1))
