"""Fit of the unknown parameters of a scene by global and local minimisation of an objective.

The fit consists of independent starts. Each start has three stages:

1. The objective is evaluated at `screen` random points of the unit cube.
2. The best of these points are the first population of a differential evolution (scipy). Each generation is one
   ensemble of runs.
3. The best point is improved by least squares in all unknowns that have a range (trust region reflective, scipy). One
   ensemble gives the finite-difference Jacobian. Least squares may stop at a kink of the residuals. If `Search.simplex`
   is positive, a Nelder-Mead simplex search follows.

Every start has its own random generator. A seed therefore gives bit-identical results with any number of threads.

References
----------
Storn, Price (1997), Differential evolution, J. Global Optim. 11, 341.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from plow_twin.study.calibration.objective import Objective
from plow_twin.study.calibration.unknowns import Space
from plow_twin.study.parameters import Value

Array = NDArray[np.float64]
#: Callback that receives the share of the work done, 0..1, and the smallest objective so far.
OnProgress = Callable[[float, float], object]


@dataclass(frozen=True)
class Search:
    """Limits of the effort of one start."""

    screen: int = 200
    population: int = 30
    generations: int = 40
    simplex: int = 0
    #: The evolution ends when the standard deviation of the population's objectives, relative to their mean, is below
    #: this number.
    spread: float = 1e-3
    step: float = 1e-6


@dataclass(frozen=True)
class Start:
    """Result of a start, with the objective before and after stage 3."""

    number: int
    point: Array
    values: dict[str, Value]
    objective: float
    before_polish: float
    runs: int


@dataclass(frozen=True)
class Calibration:
    """Result of a calibration. The starts are sorted by objective, the best start first."""

    starts: tuple[Start, ...]
    seed: int
    runs: int
    #: The final populations of all starts. They show which points fit almost as well as the best point.
    population: Array = field(repr=False)
    population_objective: Array = field(repr=False)

    @property
    def best(self) -> Start:
        """The start with the smallest objective."""
        return self.starts[0]


def calibrate(
    space: Space,
    objective: Objective,
    *,
    seed: int,
    starts: int,
    search: Search,
    first: Array | None = None,
    on_progress: OnProgress = lambda share, best: None,
) -> Calibration:
    """Minimise the objective over the space from independent random starts.

    The first population of the first start contains the point `first`, for example the point of the given scene.
    `on_progress` is called after every generation.
    """
    done: list[Start] = []
    populations: list[tuple[Array, Array]] = []
    for number, child in enumerate(np.random.SeedSequence(seed).spawn(starts)):
        rng = np.random.default_rng(child)

        def report(share: float, best: float, number: int = number) -> None:
            on_progress((number + share) / starts, min([best, *(start.objective for start in done)]))

        before = objective.runs
        given_start = first if number == 0 else None
        points, values = _evolve(space, objective, rng, search, given_start, report)
        point, best = _polish(space, objective, points[np.argmin(values)], search)
        populations.append((points, values))
        # the objective at the end of least squares may be larger than at the beginning
        if values.min() < best:
            point, best = points[np.argmin(values)], float(values.min())
        point = space.settled(point)
        done.append(Start(number, point, space.values(point), best, float(values.min()), objective.runs - before))
    order = sorted(done, key=lambda start: (start.objective, start.number))
    return Calibration(
        tuple(order), seed, objective.runs,
        np.concatenate([points for points, _ in populations]), np.concatenate([values for _, values in populations]),
    )  # fmt: skip


def _evolve(
    space: Space,
    objective: Objective,
    rng: np.random.Generator,
    search: Search,
    first: Array | None,
    report: Callable[[float, float], None],
) -> tuple[Array, Array]:
    from scipy.optimize import differential_evolution

    points = rng.random((max(search.screen, search.population), space.size))
    if first is not None:
        points[0] = first
    values = _screened(space, objective, points, search.population)
    order = np.argsort(values, kind="stable")[: search.population]
    points, values = points[order], values[order]
    report(0.1, float(values.min()))
    if search.generations == 0:
        return points, values
    cut, generation = float(values.max()), [0]

    def evaluate(columns: Array) -> Array:
        # the evolution never accepts a trial that is worse than the whole population
        return _sums(objective.residuals(space.values_of(np.atleast_2d(columns.T)), cut))

    def after(intermediate_result: object) -> None:
        generation[0] += 1
        best = float(getattr(intermediate_result, "fun", np.inf))
        report(0.1 + 0.8 * min(1.0, generation[0] / search.generations), best)

    result = differential_evolution(
        evaluate, [(0.0, 1.0)] * space.size, init=points, rng=rng, maxiter=search.generations, tol=search.spread,
        polish=False, vectorized=True, updating="deferred", callback=after,
    )  # fmt: skip
    return np.asarray(result.population), np.asarray(result.population_energies)


def _screened(space: Space, objective: Objective, points: Array, keep: int) -> Array:
    """Return the objective of every point. Points that cannot be among the best `keep` may stop early."""
    batch = max(keep, 64)
    values = np.zeros(0)
    for begin in range(0, len(points), batch):
        cut = np.inf if len(values) < keep else float(np.sort(values)[keep - 1])
        sums = _sums(objective.residuals(space.values_of(points[begin : begin + batch]), cut))
        values = np.concatenate([values, sums])
    return values


def _polish(space: Space, objective: Objective, point: Array, search: Search) -> tuple[Array, float]:
    """Improve a point in the unknowns that have a range. Return the new point and its objective."""
    from scipy.optimize import least_squares, minimize

    free = space.continuous
    point = space.settled(point)
    if free.size == 0:
        return point, objective_of(objective, space.values(point))

    def full(x: Array) -> Array:
        whole = point.copy()
        whole[free] = x
        return whole

    result = least_squares(
        lambda x: objective.residuals([space.values(full(x))])[0], point[free],
        jac=lambda x: jacobian(space, objective, full(x), search.step)[:, free], bounds=(0.0, 1.0),
        xtol=1e-12, ftol=1e-12, gtol=1e-14, max_nfev=30,
    )  # fmt: skip
    best, value = full(result.x), float(2.0 * result.cost)
    if search.simplex > 0:
        simplex = minimize(
            lambda x: objective_of(objective, space.values(full(x))), best[free], method="Nelder-Mead",
            bounds=[(0.0, 1.0)] * free.size,
            options={"maxfev": search.simplex, "xatol": 1e-7, "fatol": 1e-7, "adaptive": True},
        )  # fmt: skip
        if float(simplex.fun) < value:
            best, value = full(simplex.x), float(simplex.fun)
    return best, value


def jacobian(space: Space, objective: Objective, point: Array, step: float) -> Array:
    """Return the Jacobian of the residuals in the unit cube, shape (r, n). The columns of choices are zero.

    Differences are central in the interior of the cube and one-sided at its faces.
    """
    free = space.continuous
    moved = np.repeat(point[None], 2 * free.size, axis=0)
    for row, index in enumerate(free):
        moved[2 * row, index] = max(point[index] - step, 0.0)
        moved[2 * row + 1, index] = min(point[index] + step, 1.0)
    residuals = objective.residuals(space.values_of(moved))
    result = np.zeros((residuals.shape[1], space.size))
    for row, index in enumerate(free):
        width = moved[2 * row + 1, index] - moved[2 * row, index]
        result[:, index] = (residuals[2 * row + 1] - residuals[2 * row]) / width
    return result


def objective_of(objective: Objective, values: Mapping[str, Value]) -> float:
    """Return the objective of one candidate."""
    return float(_sums(objective.residuals([values]))[0])


def _sums(residuals: Array) -> Array:
    return np.asarray((residuals**2).sum(axis=1))
