"""Normal force of a pair, as a single value or as a power series in time.

    additive laws     F = K d^n + C psi(d) d',  psi = 1 (Kelvin-Voigt) or u^2 (3 - 2 u), u = min(d / ramp, 1)
    all other laws    F = K d^n (1 + lambda d')

Equation 6 of the paper, the original contact law, is lost; these laws replace it. `contact_laws` computes lambda from
the restitution.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from plow_twin.kernel.compiler import kernel
from plow_twin.kernel.simd import row, splat


@kernel(inline="code")
def free_force(
    penetration: float,
    rate: float,
    stiffness: float,
    exponent: float,
    damping_factor: float,
    viscous: float,
    ramp: float,
) -> float:
    """Return the contact law's force F in N for the penetration d in m and its rate d' in m/s.

    F is negative where the law would pull. `damping_factor` is lambda in s/m and `viscous` is C in N s/m; one of them
    is zero. `ramp` in m is zero for a law without a ramp.
    """
    elastic = stiffness * (penetration if exponent == 1.0 else max(penetration, 0.0) ** exponent)
    if ramp > 0.0 and penetration < ramp:
        share = penetration / ramp
        viscous *= share * share * (3.0 - 2.0 * share)
    return elastic * (1.0 + damping_factor * rate) + viscous * rate


@kernel(inline="code")
def normal_force(
    penetration: float,
    rate: float,
    stiffness: float,
    exponent: float,
    damping_factor: float,
    viscous: float,
    ramp: float,
) -> float:
    """Return the contact force in N: `free_force`, or 0 without penetration and where the law would pull."""
    if penetration <= 0.0:
        return 0.0
    return max(0.0, free_force(penetration, rate, stiffness, exponent, damping_factor, viscous, ramp))


@kernel(fast=True, inline="code")
def ramp_terms(square: NDArray[np.float64], cube: NDArray[np.float64], k: int, ramp: float) -> Any:
    """Return coefficient k of the power series u^2 (3 - 2 u) with u = d / ramp, for the eight columns.

    `square` and `cube` contain the coefficients of d^2 and d^3.
    """
    return row(square, k) * (3.0 / (ramp * ramp)) - row(cube, k) * (2.0 / (ramp * ramp * ramp))


@kernel(fast=True, entry=True)
def power_term(
    base: NDArray[np.float64], power: NDArray[np.float64], lane: int, k: int, exponent: float, shift: int
) -> float:
    """Return coefficient k of base(t)^exponent for one column. `base` and `power` are power series of shape (n, 8).

    The recurrence is b_0 k P_k = sum_j (exponent j - (k - j)) b_j P_{k-j} (Knuth, TAOCP 2, sec. 4.7). If the lowest
    order of the base is t^shift, the recurrence is applied to base / t^shift.
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


@kernel(fast=True, inline="code")
def power_terms(base: NDArray[np.float64], power: NDArray[np.float64], k: int, exponent: float) -> Any:
    """Return P_k base[0] for the eight columns, where P_k is coefficient k >= 1 of base^exponent (no shift)."""
    # the newest orders are added last, so that the sum can start before they are available
    even, odd = splat(0.0), splat(0.0)
    weight = (exponent + 1.0) * (k - 1) - k
    for j in range(k - 1, 2, -2):
        even = even + row(base, j) * row(power, k - j) * weight
        odd = odd + row(base, j - 1) * row(power, k - j + 1) * (weight - exponent - 1.0)
        weight -= 2.0 * (exponent + 1.0)
    if k % 2 == 1 and k > 1:
        even = even + row(base, 2) * row(power, k - 2) * (2.0 * (exponent + 1.0) - k)
    odd = odd + row(base, k) * row(power, 0) * (exponent * k)
    if k > 1:
        even = even + row(base, 1) * row(power, k - 1) * (exponent + 1.0 - k)
    return (even + odd) * (1.0 / k)


@kernel(fast=True, inline="code")
def root_terms(newest: Any, root: NDArray[np.float64], k: int) -> Any:
    """Return 2 r_0 r_k for k >= 1, where r is the square root of a series b, for eight series. `newest` contains b_k.

    The recurrence is 2 r_0 r_k = b_k - sum_{j=1}^{k-1} r_j r_{k-j}; the terms j and k - j are equal.
    """
    rest, products = newest, splat(0.0)
    half = k // 2
    if k == 2 * half:
        rest = rest - row(root, half) * row(root, half)
        half -= 1
    for j in range(half, 0, -1):
        products = products + row(root, j) * row(root, k - j)
    return rest - products * 2.0
