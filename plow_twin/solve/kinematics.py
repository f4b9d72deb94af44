"""Rows of `model.geometry` applied to a state: everything that is linear in cosine, sine and place, and its rate."""

from __future__ import annotations

from plow_twin.kernel.compiler import kernel
from plow_twin.kernel.simd import row


@kernel(inline=True)
def row_value(rows, pair, c, s, x, y):
    """Return rows . (c, s, x, y) of one pair."""
    return rows[0, pair] * c + rows[1, pair] * s + rows[2, pair] * x + rows[3, pair] * y


@kernel(fast=True)
def row_values(rows, c, s, x, y):
    """Return rows . (c, s, x, y) of all pairs side by side."""
    return (row(rows, 0) * c + row(rows, 1) * s) + (row(rows, 2) * x + row(rows, 3) * y)


@kernel(inline=True)
def penetration(p, wear_depth, pair, c, s, x, y):
    """Return the penetration of one pair whose pad is worn by `wear_depth`."""
    return row_value(p.penetration_rows, pair, c, s, x, y) + p.penetration_rows[4, pair] - wear_depth


@kernel(inline=True)
def row_rate(rows, pair, c, s, omega, x, y, vx, vy):
    """Return the rate of rows . (c, s, x, y) of one pair: body axes turn with omega."""
    return row_value(rows, pair, -omega * s, omega * c, vx + omega * y, vy - omega * x)
