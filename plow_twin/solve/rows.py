"""Rows of `model.geometry` applied to a state: everything that is linear in cosine, sine and place, and its rate."""

from __future__ import annotations

from plow_twin.model.kernel import kernel
from plow_twin.model.lanes import row


@kernel(inline=True)
def combined(rows, pair, c, s, x, y):
    """Return rows . (c, s, x, y) of one pair."""
    return rows[0, pair] * c + rows[1, pair] * s + rows[2, pair] * x + rows[3, pair] * y


@kernel(fast=True)
def combine(rows, c, s, x, y):
    """Return rows . (c, s, x, y) of all pairs side by side."""
    return (row(rows, 0) * c + row(rows, 1) * s) + (row(rows, 2) * x + row(rows, 3) * y)


@kernel(inline=True)
def penetration(p, depth, pair, c, s, x, y):
    """Return the penetration of one pair whose pad is worn by `depth`."""
    return combined(p.gap, pair, c, s, x, y) + p.gap[4, pair] - depth


@kernel(inline=True)
def moving(rows, pair, c, s, omega, x, y, vx, vy):
    """Return the rate of rows . (c, s, x, y) of one pair: body axes turn with omega."""
    return combined(rows, pair, -omega * s, omega * c, vx + omega * y, vy - omega * x)
