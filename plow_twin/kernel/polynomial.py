"""First root and maximum of a polynomial on an interval, by the Bernstein form, which misses no root.

The smallest and the largest Bernstein coefficient bound the values of a polynomial, and the number of sign changes of
the coefficients bounds the number of roots. Both bounds become sharper when the interval is halved (Farouki, Comput.
Aided Geom. Des. 29 (2012) 379).
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from plow_twin.kernel.compiler import kernel
from plow_twin.kernel.simd import exact_row, set_row

Array = NDArray[np.float64]

#: Largest number of halvings of an interval when a root or a maximum is isolated.
MAX_HALVINGS: Final = 48


@kernel()
def to_bernstein(g: Array, n: int, h: float, inverse_binomial: Array, b: Array) -> None:
    """Write the Bernstein coefficients on [0, h] of the polynomial g of degree n to b[0..n]."""
    power = 1.0
    for k in range(n + 1):
        b[k] = g[k] * power * inverse_binomial[k]
        power *= h
    for r in range(1, n + 1):
        for j in range(n, r - 1, -1):
            b[j] += b[j - 1]


@kernel()
def sum_to_bernstein(b: Array, n: int) -> None:
    """Convert g_k h^k / C(n, k) in each of b's eight columns to the Bernstein coefficients of g on [0, h], in place."""
    # two sweeps at a time, with half the stores
    for r in range(1, n + 1, 2):
        before = exact_row(b, r)
        once = before + exact_row(b, r - 1)
        set_row(b, r, once)
        for j in range(r + 1, n + 1):
            here = exact_row(b, j)
            swept = here + before
            set_row(b, j, swept + once)
            before, once = here, swept


@kernel(inline="code")
def _halve_top(b: Array, bounds: Array, top: int, n: int) -> None:
    """Replace the interval `top`, whose coefficients are b[top], by its right half, and put the left half on top."""
    left, right = b[top + 1], b[top]
    for k in range(n + 1):
        left[k] = right[k]
    for r in range(n + 1):
        right[n - r] = left[n]
        for j in range(n, r, -1):
            left[j] = 0.5 * (left[j] + left[j - 1])
    middle = 0.5 * (bounds[top, 0] + bounds[top, 1])
    bounds[top + 1, 0], bounds[top + 1, 1], bounds[top + 1, 2] = bounds[top, 0], middle, bounds[top, 2]
    bounds[top, 0] = middle


@kernel(fast=True)
def _crossing(g: Array, n: int, low: float, high: float, start: float) -> float:
    """Return the only root in [low, high], by Halley's method with bisection as fallback. g(low) >= 0 > g(high)."""
    x = min(max(start, low), high)
    for _ in range(80):
        value, slope, bend = g[n], 0.0, 0.0
        for k in range(n - 1, -1, -1):
            bend = bend * x + slope
            slope = slope * x + value
            value = value * x + g[k]
        if value >= 0.0:
            low = x
        else:
            high = x
        steepness = slope * slope - value * bend
        change = value * slope / steepness if slope < 0.0 and steepness > 0.0 else np.inf
        new = x - change
        if not (low <= new <= high):
            new = 0.5 * (low + high)
        elif abs(change) <= 1e-6 * new and abs(bend * change) <= 1e-3 * abs(slope):
            # Halley's method converges cubically, so the next change is negligible
            return new
        if abs(new - x) <= 2e-16 * high or high - low <= 2e-16 * high:
            return new
        x = new
    return x


@kernel()
def first_root(g: Array, n: int, h: float, w) -> float:
    """Return the point in [0, h) where g first becomes negative, or inf without such a point. g[0] must be >= 0."""
    to_bernstein(g, n, h, w.binomial[n], w.halves[0])
    return first_root_within(g, n, h, w)


@kernel()
def first_root_within(g: Array, n: int, h: float, w) -> float:
    """Return the root of `first_root`, given the Bernstein coefficients in `w.halves[0]`.

    An interval without a negative Bernstein coefficient has no root. An interval with one sign change has one root. An
    interval with several sign changes is halved.
    """
    b, bounds = w.halves, w.bounds
    bounds[0, 0], bounds[0, 1] = 0.0, h
    top = 0
    while top >= 0:
        low, high = bounds[top, 0], bounds[top, 1]
        changes, crossing, positive, lowest = 0, low, b[top, 0] >= 0.0, b[top, 0]
        for k in range(1, n + 1):
            lowest = min(lowest, b[top, k])
            if (b[top, k] >= 0.0) != positive:
                changes += 1
                if changes == 1:
                    span = b[top, k - 1] - b[top, k]
                    crossing = low + (high - low) * (k - 1 + b[top, k - 1] / span) / n
                positive = not positive
        if lowest >= 0.0:
            top -= 1
        elif changes == 1 and b[top, 0] >= 0.0:
            return _crossing(g, n, low, high, crossing)
        elif b[top, 0] < 0.0:
            return low
        elif top >= MAX_HALVINGS or high - low <= 4e-16 * h:
            if b[top, n] < 0.0:
                return low
            top -= 1
        else:
            _halve_top(b, bounds, top, n)
            top += 1
    return np.inf


@kernel()
def _value(g: Array, n: int, x: float) -> float:
    value = g[n]
    for k in range(n - 1, -1, -1):
        value = value * x + g[k]
    return value


@kernel()
def maximum(g: Array, n: int, h: float, floor: float, w) -> float:
    """Return the larger of `floor` >= 0 and the maximum of g on [0, h], with a relative error of 1e-12.

    An interval where the Bernstein coefficients of g' change sign at most once has at most one interior maximum, the
    root of g'. Other intervals are halved if the sums of their coefficients, which bound g, exceed the largest known
    value.
    """
    best, slope, b, bounds = max(floor, g[0], _value(g, n, h)), w.column[1], w.halves, w.bounds
    steepest, power = 0.0, 1.0
    for k in range(2, n + 1):
        power *= h
        steepest += k * abs(g[k]) * power
    if abs(g[1]) >= steepest:
        # g is monotonic on [0, h]
        return best
    for k in range(n):
        slope[k] = (k + 1) * g[k + 1]
    to_bernstein(slope, n - 1, h, w.binomial[n - 1], b[0])
    bounds[0, 0], bounds[0, 1], bounds[0, 2] = 0.0, h, g[0]
    top = 0
    while top >= 0:
        low, high, value = bounds[top, 0], bounds[top, 1], bounds[top, 2]
        best, bound, share = max(best, value), value, (high - low) / n
        changes, crossing, rises = 0, low, b[top, 0] >= 0.0
        positive = rises
        for k in range(n):
            if (b[top, k] >= 0.0) != positive:
                changes += 1
                span = b[top, k - 1] - b[top, k]
                crossing = low + (high - low) * (k - 1 + b[top, k - 1] / span) / (n - 1)
                positive = not positive
            value += share * b[top, k]
            bound = max(bound, value)
        if changes <= 1:
            if changes == 1 and rises:
                best = max(best, _value(g, n, _crossing(slope, n - 1, low, high, crossing)))
            top -= 1
        elif bound <= best * (1.0 + 1e-12) or top >= MAX_HALVINGS:
            top -= 1
        else:
            _halve_top(b, bounds, top, n - 1)
            bounds[top, 2] = bounds[top + 1, 2]
            for k in range(n):
                bounds[top, 2] += 0.5 * share * b[top + 1, k]
            top += 1
    return best


@kernel()
def shift_column(g: Array, lane: int, n: int, x: float, out: Array) -> None:
    """Write the coefficients of g(x + t) to column `lane` of `out`, for the polynomial in column `lane` of `g`."""
    for k in range(n + 1):
        out[k, lane] = g[k, lane]
    for r in range(n):
        for j in range(n - 1, r - 1, -1):
            out[j, lane] += x * out[j + 1, lane]
