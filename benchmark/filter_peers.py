"""A UKF and an EnKF (filterpy) on the data of the estimate's benchmark, compared with the estimate.

    python benchmark/filter_peers.py --truths 5 --seed 5000 --group plain

The state of both filters contains the pose and its rate, the clearances, softness, damping, load gains, and the bias
and delay of the sensor. The process model of both filters is the solver of this project. The initial state is the
nominal scene with the prior of the estimate. The measurement noise is the true noise of the sensor. Rows are appended
to `results/filter_peers.jsonl`, and truths that are in the file are skipped.
"""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import click
import numpy as np
from estimate import completed
from estimate_pages import filter_table
from estimate_truths import GROUPS, Truth, draw
from filterpy.kalman import EnsembleKalmanFilter, MerweScaledSigmaPoints, UnscentedKalmanFilter
from numpy.typing import NDArray

from plow_twin.estimate.result import NORMAL_P95
from plow_twin.estimate.screening import thinned
from plow_twin.estimate.unknowns import DAMPING, GX, GY, SIZE, SOFTNESS, Unknowns
from plow_twin.kernel.compiler import kernel
from plow_twin.model.geometry import body_states
from plow_twin.model.scene import Clearance
from plow_twin.solve.compiled_scene import compile_scene, inertias
from plow_twin.solve.loop import advance_rows
from plow_twin.solve.method.implicit import new_implicit
from plow_twin.solve.modes import settle_modes
from plow_twin.solve.state import (
    PACE,
    PARAMS,
    ROW,
    SEGMENT,
    STATE,
    TOTALS,
    WORK,
    new_record,
    new_records,
    new_work,
)

Array = NDArray[np.float64]
RESULTS = Path(__file__).resolve().parent / "results"

TOLERANCE = 1e-4
MEMBERS = 128
#: Index of the first unknown of the estimate in the state of the filters. The pose and its rates have lower indices.
_FIRST = 6
#: Process noise of x, y [m], theta [rad] and their rates per step. The values were set by trials on seeds 200 and 201.
_STATE_NOISE = np.array([1e-5, 1e-5, 4e-5, 3e-3, 3e-3, 1e-2])
#: Process noise of the unknowns per step, as a share of the standard deviation of the prior, set by the same trials.
_UNKNOWN_NOISE = 3e-4


@kernel(entry=True)
def move(params, parts, states, saved, work, totals, times, wrench, rows, pace):  # type: ignore[no-untyped-def]
    marks = np.zeros(0, np.int64)
    for m in range(states.size):
        settle_modes(params[m], states[m], parts.terms.stick)
    advance_rows(
        params, parts, states, saved, work, totals, 0, states.size, times, wrench, 20_000, rows, marks, states[:0],
        None, pace,
    )  # fmt: skip


class Members:
    """Ensemble of heads with different parameters. A filter can change their states between two steps."""

    def __init__(self, truth: Truth, count: int) -> None:
        self.unknowns = Unknowns(truth.nominal)
        period = truth.load.period()
        self.load, _ = thinned(truth.load, period)
        scene = replace(truth.nominal, loads=(), wear=None)
        compiled = compile_scene(scene, TOLERANCE, sampled=True)
        self._params = new_records(PARAMS, count)
        self._params[:] = compiled.params
        clearance = scene.clearance
        # the rows of the penetrations are linear in the clearances, so a second value of each clearance gives the slope
        self._rows = np.array(compiled.params["penetration_rows"])
        wider = (
            Clearance(clearance.horizontal_m + 1e-3, clearance.vertical_m),
            Clearance(clearance.horizontal_m, clearance.vertical_m + 1e-3),
        )
        others = [compile_scene(replace(scene, clearance=one), TOLERANCE, sampled=True).params for one in wider]
        self._by_clearance = [(np.array(one["penetration_rows"]) - self._rows) / 1e-3 for one in others]
        self._nominal = np.array([clearance.horizontal_m, clearance.vertical_m])
        self._parts = compiled.parts._replace(segments=np.zeros(1, SEGMENT), implicit=new_implicit(support=False))
        self._work, self._totals = new_records(WORK, 1), new_records(TOTALS, 1)
        self._work[0] = new_work()
        self._masses = inertias(scene)

    def move(self, points: Array, start: float, end: float) -> Array:
        """Return the points, shape (m, 17), advanced from one time to another [s]."""
        out = points.copy()
        unknown = out[:, _FIRST:]
        unknown[:] = np.array([self.unknowns.within(row) for row in unknown])
        shift = unknown[:, [GX, GY]] - self._nominal
        rows = self._rows + sum(shift[:, i, None, None] * self._by_clearance[i] for i in range(2))
        self._params["penetration_rows"] = rows
        self._params["stiffness"] = [self.unknowns.stiffness_of(psi) for psi in unknown[:, SOFTNESS]]
        states = new_records(STATE, len(out))
        states["y"] = body_states(out[:, :_FIRST], (0.0, 0.0))
        states["damping_factor"] = np.exp(np.clip(unknown[:, DAMPING], -6.0, 6.0))[:, None]
        states["step_start"] = states["time"] = start
        ends = np.stack([np.interp([start, end], self.load.t, column) for column in self.load.wrench.T], axis=1)
        wrench = ends * unknown[:, None, 4:7] / self._masses
        result = np.zeros((len(out), 1), ROW)
        pace = new_record(PACE)
        pace.slice = 2**62  # larger than any amount of work, so that one slice contains all work
        move(
            self._params, self._parts, states, new_records(STATE, 1), self._work, self._totals, np.array([end]), wrench,
            result, pace,
        )  # fmt: skip
        good = (result["status"][:, 0] == 0) & np.isfinite(result["q"][:, 0]).all(axis=1)
        out[good, :3], out[good, 3:6] = result["q"][good, 0], result["v"][good, 0]
        return out

    def begin(self, truth: Truth) -> tuple[Array, Array]:
        """Return the mean and the standard deviations of the state at the first pose."""
        first = np.nan_to_num(truth.poses.q[0])
        mean = np.concatenate([first, np.zeros(3), self.unknowns.nominal()])
        spread = np.concatenate([[2e-3, 2e-3, 8e-3, 0.1, 0.1, 0.4], self.unknowns.deviations()])
        return mean, spread


def seen(point: Array) -> Array:
    """Return the pose that the sensor would measure in a state."""
    unknown = point[_FIRST:]
    pose: Array = point[:3] + unknown[7:10] - point[3:6] * unknown[10]
    return pose


class Ukf(UnscentedKalmanFilter):  # type: ignore[misc]
    """The UKF of filterpy. All sigma points are advanced in one call."""

    def __init__(self, truth: Truth) -> None:
        size = _FIRST + SIZE
        self.members = Members(truth, 2 * size + 1)
        points = MerweScaledSigmaPoints(size, alpha=0.5, beta=2.0, kappa=0.0)
        super().__init__(size, 3, 0.01, seen, lambda x, dt: x, points)
        self.x, spread = self.members.begin(truth)
        self.P = np.diag(spread**2)
        self.now = float(truth.poses.t[0])

    def compute_process_sigmas(self, dt: float, fx: Any = None, **_: Any) -> None:
        """Advance the sigma points by `dt` [s]."""
        self.P = 0.5 * (self.P + self.P.T) + 1e-14 * np.eye(len(self.P))
        self.sigmas_f = self.members.move(self.points_fn.sigma_points(self.x, self.P), self.now, self.now + dt)
        self.now += dt


class Enkf(EnsembleKalmanFilter):  # type: ignore[misc]
    """The EnKF of filterpy. All members are advanced in one call."""

    sigmas: Array

    def __init__(self, truth: Truth, seed: int) -> None:
        np.random.seed(seed)  # noqa: NPY002  filterpy draws from the global generator
        self.members = Members(truth, MEMBERS)
        mean, spread = self.members.begin(truth)
        super().__init__(mean, np.diag(spread**2), 3, 0.01, MEMBERS, seen, lambda x, dt: x)
        self.now = float(truth.poses.t[0])

    def predict(self, dt: float) -> None:
        """Advance the members by `dt` [s]."""
        self.sigmas = self.members.move(self.sigmas, self.now, self.now + dt)
        self.sigmas += np.random.standard_normal(self.sigmas.shape) * np.sqrt(np.diag(self.Q))  # noqa: NPY002
        self.x = self.sigmas.mean(axis=0)
        self.P = np.cov(self.sigmas.T)
        self.now += dt


def run_one(name: str, method: str, seed: int) -> dict[str, Any]:
    truth = draw(GROUPS[name], seed)
    begin = time.process_time()
    filter_: Any = Ukf(truth) if method == "ukf" else Enkf(truth, seed)
    noise = truth.group.noise_m * np.array([1.0, 1.0, 4.0])
    unknown_noise = _UNKNOWN_NOISE * filter_.members.unknowns.deviations()
    filter_.Q = np.diag(np.concatenate([_STATE_NOISE, unknown_noise]) ** 2)
    filter_.R = np.diag(noise**2)
    row: dict[str, Any] = {"group": name, "method": method, "seed": seed}
    try:
        for t, q in zip(truth.poses.t[1:], truth.poses.q[1:], strict=True):
            filter_.predict(float(t) - filter_.now)
            # a component that was not measured gets so much noise that it has practically no effect
            finite = np.isfinite(q)
            filter_.update(np.where(finite, q, 0.0), np.diag(np.where(finite, noise, 1e3) ** 2))
    except np.linalg.LinAlgError as error:
        return row | {"failed": str(error)}
    deviation = np.sqrt(np.maximum(np.diag(filter_.P)[_FIRST:], 0.0))
    row["cpu_s"] = time.process_time() - begin
    for axis, index in (("h", GX), ("v", GY)):
        off = float(filter_.x[_FIRST + index] - truth.clearance[index])
        inside = int(abs(off) <= NORMAL_P95 * deviation[index])
        row |= {f"{axis}_error_m": off, f"{axis}_sd_m": float(deviation[index]), f"{axis}_inside": inside}
    return row


@click.command()
@click.option("--group", "groups", multiple=True, type=click.Choice(list(GROUPS)), default=("plain",))
@click.option("--truths", default=5, show_default=True)
@click.option("--seed", default=5000, show_default=True)
@click.option("--out", type=click.Path(path_type=Path), default=RESULTS / "filter_peers.jsonl", show_default=True)
def main(groups: tuple[str, ...], truths: int, seed: int, out: Path) -> None:
    cases = ((name, method, seed + i) for i in range(truths) for name in groups for method in ("ukf", "enkf"))
    rows = completed(out, ("group", "method", "seed"), cases, run_one)
    click.echo(filter_table([row for row in rows if row["group"] in groups]))


if __name__ == "__main__":
    main()
