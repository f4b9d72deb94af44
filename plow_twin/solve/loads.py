"""Evaluation of the loads at one time."""

from __future__ import annotations

import math

from plow_twin.kernel.arrays import count_up_to
from plow_twin.kernel.compiler import kernel


@kernel()
def load_at(p, harmonics, segments, t, out) -> None:
    """Write force per mass and moment per inertia of the loads at time t to `out`, shape (3,), in world axes."""
    for j in range(3):
        out[j] = p.constant[j]
    if harmonics is not None:
        add_harmonics(p, harmonics, t, out)
    if segments is not None:
        piece = max(count_up_to(segments.knot, t) - 1, 0)
        ahead = max(t - segments[piece].knot, 0.0)
        for j in range(3):
            out[j] += segments[piece].start[j] + segments[piece].slope[j] * ahead


@kernel()
def add_harmonics(p, harmonics, t, out) -> None:
    """Add the harmonic loads at time t to `out`, in the units of `load_at`."""
    for i in range(harmonics.size):
        harmonic = harmonics[i]
        sine, cosine = math.sin(harmonic.omega * t), math.cos(harmonic.omega * t)
        s1 = harmonic.first[0] * sine + harmonic.first[1] * cosine
        s2 = harmonic.second[0] * sine + harmonic.second[1] * cosine
        out[0] += p.direction[0, 0] * s1 + p.direction[1, 0] * s2
        out[1] += p.direction[0, 1] * s1 + p.direction[1, 1] * s2
        out[2] += harmonic.moment[0] * sine + harmonic.moment[1] * cosine
