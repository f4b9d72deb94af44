"""Contact forces with intervals, from an ensemble of twins with parameters drawn from an estimate.

The clearances, contact parameters and load gains of each twin (member) are drawn from the estimate with their
correlations. The intervals are quantiles over the members. After some load periods the initial states have no
influence, so the members differ only by the uncertainty of the estimate.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from plow_twin.errors import PlowTwinError
from plow_twin.estimate import tuning
from plow_twin.estimate.harmonics import Harmonics
from plow_twin.estimate.measurements import Load
from plow_twin.estimate.result import NORMAL_P95, Estimate, Interval, State
from plow_twin.estimate.unknowns import CORRELATED, DAMPING, GAIN, SOFTNESS, contact_numbers
from plow_twin.model.pairs import PAIR_COUNT, PAIR_NAMES
from plow_twin.model.scene import Scene, variants
from plow_twin.run.batch import TwinBatch

Array = NDArray[np.float64]

#: Default number of members, derived from a standard error of 1.4 % of the probability below the 5 % quantile.
MEMBERS: Final = 256
#: Definition of an interval by the probabilities of its lower end, middle and upper end.
POINTS: Final = (0.05, 0.5, 0.95)
#: Smallest number of members, derived from the condition that at least one member lies below the 5 % quantile.
FEWEST: Final = 20
#: Lower bound on the clearance of a member, as a share of the estimated clearance.
_LEAST_SHARE = 0.02
#: Tolerance of the solver for the members, equal to the tolerance in a fit.
TOLERANCE: Final = tuning.TOLERANCE
#: Upper bound on the number of samples in one call, so that the rows of all members fit into the processor's cache.
_CALL = 10


class ForcesError(PlowTwinError):
    """The forces cannot be computed from the estimate."""


@dataclass(frozen=True, eq=False)
class Forces:
    """Quantiles of the forces over the members, in the order of `POINTS`.

    start : time in s at which the span of peaks and impulses begins
    t : (n,) times in s
    force : (3, n, 8) force of each pair at the times `t` in N
    peak : (3, 8) largest force of each pair in N from `start` to the end
    impulse : (3, 8) impulse of each pair in N s from `start` to the end
    members : number of members that are within the range of the model
    left_out : number of members that have left the range of the model
    """

    start: float
    t: Array
    force: Array
    peak: Array
    impulse: Array
    members: int
    left_out: int

    def as_dict(self) -> dict[str, Any]:
        """Return peaks and impulses as JSON values."""
        pairs = {
            name: {
                key: dict(zip(("p05", "p50", "p95"), map(float, values[:, index]), strict=True))
                for key, values in (("peak_n", self.peak), ("impulse_n_s", self.impulse))
            }
            for index, name in enumerate(PAIR_NAMES)
        }
        counts = {"members": self.members, "left_out": self.left_out}
        return {**counts, "t_start": self.start, "t_end": float(self.t[-1]), "pairs": pairs}

    def table(self) -> tuple[list[str], Array]:
        """Return column names and rows of a table of the forces over time."""
        names = [f"force_{name}/{point}" for name in PAIR_NAMES for point in ("p05", "p50", "p95")]
        return ["t", *names], np.column_stack([self.t, self.force.transpose(1, 2, 0).reshape(len(self.t), -1)])


class ForceEnsemble:
    """Ensemble of twins with parameters drawn from an estimate.

    Parameters
    ----------
    scene : Scene
        The nominal scene. All members have its geometry, masses and gravity.
    estimate : Estimate
        The estimate from which members are drawn; it must not be withdrawn.
    members : int
        Number of members, at least 20.
    start : float
        Time in s at which all members are in the scene's initial state.

    Raises
    ------
    ForcesError
        If the estimate is withdrawn, or there are too few members.
    """

    def __init__(self, scene: Scene, estimate: Estimate, members: int = MEMBERS, *, start: float = 0.0) -> None:
        if State.WITHDRAWN in estimate.states:
            raise ForcesError(
                f"estimate: got a withdrawn estimate ({'; '.join(estimate.reasons)}), expected a valid one"
            )
        if members < FEWEST:
            raise ForcesError(f"members: got {members}, expected at least {FEWEST}")
        rng = np.random.default_rng(0)
        scenes, self._gain = draw_scenes(scene, estimate, members, rng)
        self._lacking = estimate.load_harmonics, amplitudes_of(estimate, members, rng)
        self._twins = TwinBatch(scenes, tol=tuning.TOLERANCE, start=start)
        self._good = np.ones(members, dtype=bool)

    def __len__(self) -> int:
        return len(self._twins)

    def advance(self, t: Array, wrench: Array, *, over_time: bool = True) -> Forces:
        """Advance all members through samples of the measured load, and return the forces.

        Parameters
        ----------
        t : ndarray, shape (n,)
            Times of the samples in s.
        wrench : ndarray, shape (n, 3)
            Fx, Fy [N] and M [N m].
        over_time : bool
            Whether the forces at each sample are computed, which doubles the cost. If not, the field `force` is 0.

        Raises
        ------
        ForcesError
            If fewer than 20 members are within the range of the model.
        """
        start, force = self._twins.time, np.zeros((len(POINTS), len(t), PAIR_COUNT))
        peak, impulse = np.zeros((len(self), PAIR_COUNT)), np.zeros((len(self), PAIR_COUNT))
        for first in range(0, len(t), _CALL):
            part = slice(first, first + _CALL)
            batch = self._twins.advance_samples(t[part], loads_of(t[part], wrench[part], self._gain, *self._lacking))
            self._good &= (batch.status == 0).all(axis=1)
            if self._good.sum() < FEWEST:
                raise ForcesError(
                    f"t = {t[first]:.3f} s: got {self._good.sum()} members within the model's range, expected at least "
                    f"{FEWEST}"
                )
            if over_time:
                force[:, part] = quantiles(batch.force[self._good])
            np.maximum(peak, batch.peak.max(axis=1), out=peak)
            impulse += batch.impulse.sum(axis=1)
        good, left_out = self._good, int((~self._good).sum())
        return Forces(start, t, force, quantiles(peak[good]), quantiles(impulse[good]), len(self) - left_out, left_out)


def quantiles(values: Array) -> Array:
    """Return the nearest-rank quantiles of non-negative values over the first axis, in the order of `POINTS`."""
    places = [min(int(share * len(values)), len(values) - 1) for share in POINTS]
    out = np.zeros((len(POINTS), *values.shape[1:]))
    # in most pairs the forces of all members are 0
    touched = values.any(axis=0)
    out[:, touched] = np.partition(np.ascontiguousarray(values[:, touched].T), places, axis=1)[:, places].T
    return out


def forces_of(
    scene: Scene, estimate: Estimate, load: Load, members: int, settle_s: float, *, over_time: bool = True
) -> Forces:
    """Return the forces under a load, beginning `settle_s` [s] after the first sample of the load.

    After `settle_s`, the initial states of the members must have no influence on the forces.
    """
    ensemble = ForceEnsemble(scene, estimate, members, start=float(load.t[0]))
    load = load.with_knot(float(load.t[0]) + settle_s)
    first = int(np.searchsorted(load.t, load.t[0] + settle_s, side="right"))
    if first >= len(load.t):
        raise ForcesError(f"load: got {load.t[-1] - load.t[0]:g} s, expected more than the {settle_s:g} s of settling")
    if first:
        ensemble.advance(load.t[:first], load.wrench[:first], over_time=False)
    return ensemble.advance(load.t[first:], load.wrench[first:], over_time=over_time)


def draw_scenes(scene: Scene, estimate: Estimate, members: int, rng: np.random.Generator) -> tuple[list[Scene], Array]:
    """Return m scenes drawn from an estimate, and the drawn gains of their loads, shape (m, 3)."""
    white = rng.standard_normal((members, len(CORRELATED)))
    if estimate.correlation is not None:
        white = white @ np.linalg.cholesky(np.array(estimate.correlation) + 1e-9 * np.eye(len(CORRELATED))).T
    horizontal, vertical = (
        np.maximum(_normal(value, white[:, index]), _LEAST_SHARE * value.mean)
        for index, value in enumerate(estimate.in_scene_frame())
    )
    stiffness = np.exp(_normal(_logarithm(estimate.stiffness), -white[:, SOFTNESS]))
    restitution = scene.contact.restitution is not None
    damping: Array | None = None
    if estimate.damping is not None:
        value = estimate.damping if restitution else _logarithm(estimate.damping)
        damping = _normal(value, white[:, DAMPING])
        damping = np.clip(damping, 1e-3, 0.999) if restitution else np.exp(damping)
    gains = [
        np.ones(members) if value is None else _normal(value, white[:, GAIN.start + index])
        for index, value in enumerate((estimate.gain_fx, estimate.gain_fy, estimate.gain_m))
    ]
    numbers = {
        "clearance": {"horizontal_m": horizontal, "vertical_m": vertical},
        "contact": contact_numbers(scene.contact, stiffness, damping),
    }
    return variants([scene] * members, numbers, loads=(), wear=None), np.stack(gains, axis=1)


def draw_biases(estimate: Estimate, members: int, rng: np.random.Generator) -> Array:
    """Return biases of the sensor drawn from an estimate, shape (m, 3); the first member has the mean biases."""
    drawn = np.zeros((members, 3))
    for index, value in enumerate((estimate.bias_x, estimate.bias_y, estimate.bias_theta)):
        if value is not None:
            drawn[:, index] = value.mean
            drawn[1:, index] = _normal(value, rng.standard_normal(members - 1))
    return drawn


def amplitudes_of(estimate: Estimate, members: int, rng: np.random.Generator) -> Array:
    """Return amplitudes of the load's harmonics drawn from an estimate, shape (m, k, 3); the first has the means."""
    harmonics = estimate.load_harmonics
    return np.zeros((members, 0, 3)) if harmonics is None else harmonics.drawn(members, rng)


def loads_of(t: Array, wrench: Array, gain: Array, harmonics: Harmonics | None, amplitude: Array) -> Array:
    """Return the loads of the members, shape (m, n, 3).

    The samples `wrench`, shape (n, 3), at the times `t` are added to harmonics of the amplitudes `amplitude`, shape
    (m, k, 3), and multiplied by `gain`, shape (m, 3).
    """
    if harmonics is not None:
        wrench = wrench + harmonics.basis(t) @ amplitude
    scaled: Array = wrench * gain[:, None, :]
    return scaled


def _normal(value: Interval, white: Array) -> Array:
    """Convert standard normal numbers `white` to numbers with the 5 % and 95 % quantiles of an interval."""
    below, above = (value.mean - value.p05) / NORMAL_P95, (value.p95 - value.mean) / NORMAL_P95
    return value.mean + np.where(white < 0.0, below, above) * white


def _logarithm(value: Interval) -> Interval:
    return Interval(*(float(np.log(max(number, 1e-12))) for number in (value.mean, value.p05, value.p95)))
