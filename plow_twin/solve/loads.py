"""The loads as values at one time, and rows of `model.geometry` applied to a state."""

from __future__ import annotations

import math

import numpy as np

from plow_twin.model.kernel import kernel
from plow_twin.model.lanes import row


@kernel()
def load_at(p, harmonics, second, segments, t, out) -> None:
    """Write force per mass and moment per inertia at t, world axes."""
    for j in range(3):
        out[j] = p.constant[j]
    if harmonics is not None:
        _add_harmonics(p, harmonics, second, t, out)
    if segments is not None:
        piece = max(np.searchsorted(segments.knots, t, side="right") - 1, 0)
        ahead = max(t - segments.knots[piece], 0.0)
        for j in range(3):
            out[j] += segments.start[piece, j] + segments.slope[piece, j] * ahead


@kernel()
def _add_harmonics(p, harmonics, second, t, out) -> None:
    for i in range(harmonics.omega.size):
        sine, cosine = math.sin(harmonics.omega[i] * t), math.cos(harmonics.omega[i] * t)
        s1 = harmonics.first[i, 0] * sine + harmonics.first[i, 1] * cosine
        out[0] += p.direction[0, 0] * s1
        out[1] += p.direction[0, 1] * s1
        out[2] += harmonics.moment[i, 0] * sine + harmonics.moment[i, 1] * cosine
        if second is not None:
            s2 = second[i, 0] * sine + second[i, 1] * cosine
            out[0] += p.direction[1, 0] * s2
            out[1] += p.direction[1, 1] * s2


@kernel(inline=True)
def combined(rows, pair, c, s, x, y):
    """Return rows . (c, s, x, y) of one pair."""
    return rows[0, pair] * c + rows[1, pair] * s + rows[2, pair] * x + rows[3, pair] * y


@kernel(fast=True)
def combine(rows, c, s, x, y):
    """Return rows . (c, s, x, y) of all pairs side by side."""
    return (row(rows, 0) * c + row(rows, 1) * s) + (row(rows, 2) * x + row(rows, 3) * y)
