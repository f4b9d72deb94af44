"""Sine, cosine, and a coarse logarithm and power, of the eight numbers in a SIMD vector."""

from __future__ import annotations

import math

from plow_twin.kernel.compiler import kernel
from plow_twin.kernel.simd import (
    below,
    choose,
    exact_row,
    exact_splat,
    exponent_of,
    fused,
    magnitude,
    power_of_two,
    set_row,
    significand_of,
)

#: Largest angle for which the product of the number of quarter turns and the first part of pi / 2 is exact.
_LARGEST = 1e5
#: Number whose addition and subtraction rounds a double to an integer.
_ROUNDS = 6755399441055744.0
#: 2 / pi, and pi / 2 in three parts, the first two of 33 bits (fdlibm, e_rem_pio2.c).
_QUARTERS = (0.6366197723675814, 1.57079632673412561417, 6.07710050630396597660e-11, 2.02226624879595063154e-21)
#: Polynomials of sine and cosine on [-pi/4, pi/4] (fdlibm, k_sin.c, k_cos.c).
_SINE = (
    1.58969099521155010221e-10, -2.50507602534068634195e-08, 2.75573137070700676789e-06, -1.98412698298579493134e-04,
    8.33333333332248946124e-03, -1.66666666666666324348e-01,
)  # fmt: skip
_COSINE = (
    -1.13596475577881948265e-11, 2.08757232129817482790e-09, -2.75573143513906633035e-07, 2.48015872894767294178e-05,
    -1.38888888888741095749e-03, 4.16666666666666019037e-02,
)  # fmt: skip
#: Interpolating polynomials with Chebyshev nodes: log2 on [1, 2] with an error of 1.2e-4, and 2^x on [0, 1] with a
#: relative error of 3.5e-6.
_LOGARITHM = (
    -0.07844067620915011, 0.6260321821639458, -2.0783351682517304, 4.029211391071475, -2.4983531488141586,
)  # fmt: skip
_POWER = (
    0.013670309453307137, 0.05174499776419958, 0.24160435727003668, 0.6929729221730628, 1.0000034929076977,
)  # fmt: skip


@kernel(inline="code")
def coarse_log2(value):
    """Return the binary logarithm of the positive number in each lane, with an error of 1.2e-4."""
    part = significand_of(value)
    polynomial = exact_splat(_LOGARITHM[0])
    for i in range(1, 5):
        polynomial = fused(polynomial, part, exact_splat(_LOGARITHM[i]))
    return polynomial + exponent_of(value)


@kernel(inline="code")
def coarse_exp2(value):
    """Return 2 to the power of the number in each lane, with a relative error of 3.5e-6, for |number| <= 1e3."""
    whole = (value - 0.5 + _ROUNDS) - _ROUNDS
    part, polynomial = value - whole, exact_splat(_POWER[0])
    for i in range(1, 5):
        polynomial = fused(polynomial, part, exact_splat(_POWER[i]))
    return polynomial * power_of_two(whole)


@kernel()
def turn_lanes(angle, cosine, sine) -> None:
    """Write cosine and sine of the eight numbers in `angle`, with one or two rounding errors."""
    x = exact_row(angle, 0)
    turns = (x * _QUARTERS[0] + _ROUNDS) - _ROUNDS
    r = fused(turns, exact_splat(-_QUARTERS[1]), x)
    r = fused(turns, exact_splat(-_QUARTERS[2]), r)
    r = fused(turns, exact_splat(-_QUARTERS[3]), r)
    square = r * r
    s, c = exact_splat(_SINE[0]), exact_splat(_COSINE[0])
    for i in range(1, 6):
        s = fused(s, square, exact_splat(_SINE[i]))
        c = fused(c, square, exact_splat(_COSINE[i]))
    s = fused(s * square, r, r)
    c = fused(c * square, square, fused(square, exact_splat(-0.5), exact_splat(1.0)))
    # number of quarter turns without whole turns, 0 to 3
    whole = (turns * 0.25 - 0.375 + _ROUNDS) - _ROUNDS
    quarter = turns - whole * 4.0
    first, half, last = (
        below(quarter, exact_splat(0.5)), below(quarter, exact_splat(1.5)), below(quarter, exact_splat(2.5)),
    )  # fmt: skip
    swapped = (half & ~first) | ~last
    set_row(sine, 0, choose(half, exact_splat(1.0), exact_splat(-1.0)) * choose(swapped, c, s))
    set_row(cosine, 0, choose(last & ~first, exact_splat(-1.0), exact_splat(1.0)) * choose(swapped, s, c))
    large = below(exact_splat(_LARGEST), magnitude(x))
    if large != 0:
        for lane in range(8):
            if large >> lane & 1:
                cosine[lane], sine[lane] = math.cos(angle[lane]), math.sin(angle[lane])
