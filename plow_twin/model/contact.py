"""The normal force of a pair, compiled: once as a number, once as a power series in time.

    Kelvin-Voigt      F = K d + C d'
    all other laws    F = K d^n (1 + lambda d')

(model of the paper's lost eq. 6; the laws' lambda comes from `contact_laws`). A solver decides when a pair is in
contact and when its force would pull: there the force is zero.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from plow_twin.model.kernel import kernel


@kernel(inline=True)
def normal_force(
    penetration: float, rate: float, stiffness: float, exponent: float, factor: float, viscous: float
) -> float:
    """Return F >= 0 in N for penetration d in m and rate d' in m/s; zero for d <= 0.

    `factor` is lambda in s/m, `viscous` is C in N s/m; one of them is zero.
    """
    if penetration <= 0.0:
        return 0.0
    elastic = stiffness * (penetration if exponent == 1.0 else penetration**exponent)
    return max(0.0, elastic * (1.0 + factor * rate) + viscous * rate)


@kernel(fast=True)
def power_term(
    base: NDArray[np.float64], power: NDArray[np.float64], lane: int, k: int, exponent: float, shift: int
) -> float:
    """Return coefficient k of base(t)^exponent for one column, series of shape (n, 8) with orders in rows.

    Recurrence  b_0 k P_k = sum_j (exponent j - (k - j)) b_j P_{k-j}  (Knuth, TAOCP 2, sec. 4.7). A base that starts
    with t^shift is divided by it first; its power then starts with t^(shift exponent).
    """
    offset = int(shift * exponent)
    if k < offset:
        return 0.0
    k -= offset
    if k == 0:
        return float(base[shift, lane] ** exponent)
    total = 0.0
    for j in range(1, k + 1):
        total += (exponent * j - (k - j)) * base[j + shift, lane] * power[k - j + offset, lane]
    return total / (k * base[shift, lane])


@kernel(fast=True)
def power_terms(
    base: NDArray[np.float64], power: NDArray[np.float64], k: int, exponent: float, inverse: NDArray[np.float64]
) -> None:
    """Write coefficient k >= 1 of the eight columns of base^exponent side by side: `power_term` without a shift.

    `inverse` (8,) is 1 / base[0], or zero for a column that is not wanted.
    """
    t0 = t1 = t2 = t3 = t4 = t5 = t6 = t7 = 0.0
    for j in range(1, k + 1):
        i = k - j
        scale = exponent * j - i
        t0 += scale * base[j, 0] * power[i, 0]
        t1 += scale * base[j, 1] * power[i, 1]
        t2 += scale * base[j, 2] * power[i, 2]
        t3 += scale * base[j, 3] * power[i, 3]
        t4 += scale * base[j, 4] * power[i, 4]
        t5 += scale * base[j, 5] * power[i, 5]
        t6 += scale * base[j, 6] * power[i, 6]
        t7 += scale * base[j, 7] * power[i, 7]
    scale = 1.0 / max(k, 1)
    power[k, 0], power[k, 1], power[k, 2], power[k, 3] = (
        t0 * scale * inverse[0], t1 * scale * inverse[1], t2 * scale * inverse[2], t3 * scale * inverse[3],
    )  # fmt: skip
    power[k, 4], power[k, 5], power[k, 6], power[k, 7] = (
        t4 * scale * inverse[4], t5 * scale * inverse[5], t6 * scale * inverse[6], t7 * scale * inverse[7],
    )  # fmt: skip
