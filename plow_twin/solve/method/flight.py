"""Free flight in closed form. A step can have any size, as long as the head cannot reach a wall.

Without contact, position and angle of the head are double integrals of the load, which are elementary functions for
constant, piecewise linear and harmonic loads. An upper bound of the distance that the head moves within a time limits
the step (conservative advancement).
"""

from __future__ import annotations

import math

import numpy as np

from plow_twin.kernel.compiler import kernel
from plow_twin.model.pairs import PAIR_COUNT
from plow_twin.solve.kinematics import penetration_of, to_body, to_world

#: Smallest phase [rad] of the fastest harmonic load in a flight. A step of a Taylor series covers about 2 rad.
_LEAST_PHASE = 8.0
#: Largest distance that the head may move in a flight, divided by the smallest gap.
_SAFE = 0.9


@kernel(inline="code")
def amplitudes(p, harmonic, j):
    """Return the sine and cosine amplitudes of a harmonic load's acceleration along x, y or theta (j = 0, 1, 2)."""
    if j == 2:
        return harmonic.moment[0], harmonic.moment[1]
    sine = p.direction[0, j] * harmonic.first[0] + p.direction[1, j] * harmonic.second[0]
    return sine, p.direction[0, j] * harmonic.first[1] + p.direction[1, j] * harmonic.second[1]


@kernel()
def _smallest_gap(p, state) -> float:
    y, nearest = state.y, np.inf
    for pair in range(PAIR_COUNT):
        if p.enabled[pair] == 1:
            penetration = penetration_of(p, state, pair, y)
            nearest = min(nearest, -penetration)
    return nearest


@kernel()
def _bounds(p, harmonics, t, z, w) -> None:
    """Write upper bounds of the motion along x, y and theta to `w.flight[1:]`, shape (4, 3).

    The rows are:

    - the current speed;
    - the speed without the oscillation due to the harmonic loads;
    - the largest acceleration by the harmonic loads;
    - the amplitude of the oscillation.
    """
    for j in range(3):
        drift, push, swing = z[3 + j], 0.0, 0.0
        for i in range(harmonics.size):
            harmonic = harmonics[i]
            sine, cosine = amplitudes(p, harmonic, j)
            phase, size = harmonic.omega * t, p.free[j] * math.hypot(sine, cosine)
            drift += p.free[j] * (sine * math.cos(phase) - cosine * math.sin(phase)) / harmonic.omega
            push += size
            swing += 2.0 * size / (harmonic.omega * harmonic.omega)
        w.flight[1, j], w.flight[2, j] = abs(z[3 + j]), abs(drift)
        w.flight[3, j], w.flight[4, j] = push, swing


@kernel()
def _reach(p, w, time, leverage) -> float:
    """Return an upper bound in m of the motion within `time` of a point at most `leverage` from the centre of mass."""
    place = 0.0
    for j in range(3):
        steady = p.free[j] * (abs(w.wrench[0, j]) + abs(w.wrench[1, j]) * time / 3.0) * time * time / 2.0
        pushed = w.flight[1, j] * time + w.flight[3, j] * time * time / 2.0
        way = steady + min(pushed, w.flight[2, j] * time + w.flight[4, j])
        place += (leverage if j == 2 else 1.0) * way
    return place


@kernel(inline="source")
def own(parts):
    """Return 1 for flights in closed form, and None without."""
    return parts.terms.flight


@kernel(inline="source")
def lay_out(p, parts, own, state, w, span, penetrating) -> bool:
    """Compute a step of free flight, if it is longer than a step of a Taylor series."""
    return _lay_out(p, parts.harmonics, own, state, w, span, penetrating)


@kernel()
def _lay_out(p, harmonics, flight, state, w, span, penetrating) -> bool:
    if flight is None:
        return False
    size = 0.0 if penetrating else safe_time(p, harmonics, state, w, span)
    state.in_flight = 1 if size > 0.0 else 0
    state.sigma_end, state.order = size, 1
    state.ends_at_stop = 1 if size == span else 0
    return size > 0.0


@kernel()
def safe_time(p, harmonics, state, w, span) -> float:
    """Return a time, at most `span`, within which the head cannot reach a wall; 0 if a step of a series is as long."""
    least = _LEAST_PHASE / p.fastest
    if span < least:
        return 0.0
    gap = _smallest_gap(p, state)
    z = w.flight[0]
    to_world(p, state.y, z)
    _bounds(p, harmonics, state.step_start, z, w)
    # the walls rotate about the head's centre of mass
    leverage = p.leverage + math.hypot(z[0], z[1]) + max(gap, 0.0)
    time = span
    while time >= least:
        if _reach(p, w, time, leverage) < _SAFE * gap:
            return time
        time *= 0.5
    return 0.0


@kernel()
def fly(p, harmonics, flight, state, w, time, y) -> None:
    """Write the body coordinates at `time` after the start of a flight to y."""
    if flight is not None:
        start, z = w.flight[0], w.flight[5]
        for j in range(3):
            rate = w.wrench[0, j] * time + w.wrench[1, j] * time * time / 2.0
            way = w.wrench[0, j] * time * time / 2.0 + w.wrench[1, j] * time * time * time / 6.0
            swing_rate, swing = _swing(p, harmonics, j, state.step_start, time)
            z[j] = start[j] + start[3 + j] * time + p.free[j] * (way + swing)
            z[3 + j] = start[3 + j] + p.free[j] * (rate + swing_rate)
        to_body(p, state.y, z, y)


@kernel()
def _swing(p, harmonics, j, t, time):
    """Return the rate and the distance that the harmonic loads add along x, y or theta from t to t + `time`."""
    rate = way = 0.0
    for i in range(harmonics.size):
        harmonic = harmonics[i]
        sine, cosine = amplitudes(p, harmonic, j)
        before, after = harmonic.omega * t, harmonic.omega * (t + time)
        rise, fall = math.sin(after) - math.sin(before), math.cos(after) - math.cos(before)
        rate += (cosine * rise - sine * fall) / harmonic.omega
        steady = sine * math.cos(before) - cosine * math.sin(before)
        way += (steady * time - (sine * rise + cosine * fall) / harmonic.omega) / harmonic.omega
    return rate, way
