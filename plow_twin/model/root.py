"""A root of one equation.

By the same operations as `scipy.optimize.brentq`, to the last bit: importing that package would take a third of the
start of every process.
"""

from __future__ import annotations

import math
from collections.abc import Callable


def bracketed_root(function: Callable[[float], float], low: float, high: float, rtol: float) -> float:
    """Return the root between `low` and `high`, where the function has opposite signs.

    Source: R. P. Brent, Algorithms for Minimization without Derivatives, Prentice-Hall, 1973, chapter 4.
    """
    last, now, far = low, high, low
    f_last, f_now = function(last), function(now)
    f_far = f_last
    step_before = step = now - last
    while True:
        if abs(f_far) < abs(f_now):
            # the better of the two ends goes on
            last, now, far = now, far, now
            f_last, f_now, f_far = f_now, f_far, f_now
        least, half = 0.5 * rtol * abs(now), 0.5 * (far - now)
        if f_now == 0.0 or abs(half) < least:
            return now
        guess = math.inf
        if abs(step_before) > least and abs(f_now) < abs(f_last):
            guess = _interpolated(last, now, far, f_last, f_now, f_far)
        if 2.0 * abs(guess) < min(abs(step_before), 3.0 * abs(half) - least):
            step_before, step = step, guess
        else:
            step_before = step = half
        last, f_last = now, f_now
        now += step if abs(step) > least else math.copysign(least, half)
        f_now = function(now)
        if (f_last < 0.0) != (f_now < 0.0):
            far, f_far = last, f_last
            step_before = step = now - last


def _interpolated(last: float, now: float, far: float, f_last: float, f_now: float, f_far: float) -> float:
    """Return the way to the zero of the secant, or of the inverse parabola through three points."""
    if last == far:
        return -f_now * (now - last) / (f_now - f_last)
    by_last, by_far = (f_last - f_now) / (last - now), (f_far - f_now) / (far - now)
    return -f_now * (f_far * by_far - f_last * by_last) / (by_far * by_last * (f_far - f_last))
