"""Peers that are called from Python: solvers of SciPy, and scikit-sundae's CVODE, with the compiled rates of `lean`."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
from bench_scenes import T_END
from cases import Array, Sample, timed
from lean import rhs_into

#: Absolute tolerances divided by rtol: a tenth of the usual magnitude of poses (1e-2) and velocities (1).
_ATOL = np.array([1e-3, 1e-3, 1e-3, 1e-1, 1e-1, 1e-1])


Rhs = Callable[[float, Array], Array]


def _grid(output_dt: float) -> Array:
    return np.arange(0.0, round(T_END / output_dt) + 1.0) * output_dt


def _rhs(p: Array) -> Rhs:
    def rhs(t: float, y: Array) -> Array:
        out = np.empty(6)
        rhs_into(t, y, out, p)
        return out

    rhs(0.0, np.zeros(6))
    return rhs


def prepare_solve_ivp(p: Array, method: str, rtol: float, output_dt: float) -> Callable[[], Sample]:
    from scipy.integrate import solve_ivp

    solve = partial(
        solve_ivp, _rhs(p), (0.0, T_END), np.zeros(6), method, _grid(output_dt), rtol=rtol, atol=rtol * _ATOL
    )

    def run() -> Sample:
        wall, result = timed(solve)
        if not result.success:
            raise RuntimeError(result.message)
        return Sample(wall, result.y[:3].T, None, result.nfev)

    return run


def prepare_odeint(p: Array, rtol: float, output_dt: float) -> Callable[[], Sample]:
    """Prepare LSODA through `scipy.integrate.odeint`, whose loop is compiled."""
    from scipy.integrate import odeint

    solve = partial(
        odeint, _rhs(p), np.zeros(6), _grid(output_dt), rtol=rtol, atol=rtol * _ATOL, mxstep=10**7, tfirst=True,
        full_output=True,
    )  # fmt: skip

    def run() -> Sample:
        wall, (y, info) = timed(solve)
        if info["message"] != "Integration successful.":
            raise RuntimeError(info["message"])
        return Sample(wall, y[:, :3], int(info["nst"][-1]), int(info["nfe"][-1]))

    return run


def prepare_sundae(p: Array, method: str, rtol: float, output_dt: float) -> Callable[[], Sample]:
    from sksundae.cvode import CVODE

    grid = _grid(output_dt)

    def rhs(t: float, y: Array, out: Array) -> None:
        rhs_into(t, y, out, p)

    rhs(0.0, np.zeros(6), np.zeros(6))
    solver = CVODE(rhs, method=method, rtol=rtol, atol=rtol * _ATOL, max_num_steps=10**8)

    def run() -> Sample:
        wall, result = timed(partial(solver.solve, grid, np.zeros(6)))
        if len(result.y) != len(grid):
            raise RuntimeError(str(result.message))
        return Sample(wall, result.y[:, :3], None, int(result.nfev))

    return run
