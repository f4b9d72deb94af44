"""The maximum of a polynomial on an interval, which is used to find the peaks of forces."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.polynomial import Polynomial
from numpy.typing import NDArray

from plow_twin.kernel.compiler import kernel
from plow_twin.kernel.polynomial import maximum
from plow_twin.solve.state import new_work


@kernel(entry=True)
def _maximum(g: NDArray[np.float64], n: int, h: float, floor: float, work) -> float:  # type: ignore[no-untyped-def]
    return maximum(g, n, h, floor, work)


def _expected(g: NDArray[np.float64], h: float, floor: float) -> float:
    """Return the maximum from the roots of the derivative, which are eigenvalues of its companion matrix."""
    polynomial = Polynomial(g)
    roots = polynomial.deriv().roots() if len(g) > 2 else np.zeros(0)
    inside = [x.real for x in roots if abs(x.imag) < 1e-6 * h and 0.0 < x.real < h]
    return max(floor, *polynomial(np.array([0.0, h, *inside])))


@pytest.mark.parametrize("seed", range(20))
def test_the_maximum_is_found_among_stationary_points_and_ends(seed: int) -> None:
    random, work = np.random.default_rng(seed), new_work()
    for _ in range(20):
        degree, h = int(random.integers(0, 12)), 10.0 ** random.uniform(-4.0, 1.0)
        terms = random.normal(size=degree + 1) * random.uniform(0.3, 3.0) ** np.arange(degree + 1)
        g = np.zeros(len(work.column[0]))
        g[: degree + 1] = terms / h ** np.arange(degree + 1)
        floor = abs(random.normal())
        scale = np.abs(terms).sum()
        assert _maximum(g, degree, h, floor, work) == pytest.approx(
            _expected(g[: degree + 1], h, floor), abs=1e-11 * scale
        )
