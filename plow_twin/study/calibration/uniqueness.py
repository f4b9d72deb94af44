"""Uniqueness of a fit: singular values of the Jacobian, and clusters of points that fit almost as well."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from plow_twin.study.calibration.calibrate import Calibration, jacobian
from plow_twin.study.calibration.objective import Objective
from plow_twin.study.calibration.unknowns import Space
from plow_twin.study.parameters import Value

Array = NDArray[np.float64]

_STEP: Final = 1e-5
#: Largest difference of an unknown between two members of a cluster, as a share of the range of the unknown.
_DISTANCE: Final = 0.1


@dataclass(frozen=True)
class Identifiability:
    """Singular values of the Jacobian dr/dz of the residuals r by the unknowns z that have a range, at the optimum.

    `weakest` is the singular vector of the smallest value: the combination of unknowns that the data determine least.
    """

    paths: tuple[str, ...]
    singular_values: tuple[float, ...]
    weakest: dict[str, float]


@dataclass(frozen=True)
class Cluster:
    """A group of near-optimal points with equal choices and similar values of the unknowns that have a range."""

    members: int
    objective: float
    values: dict[str, Value]
    #: Smallest and largest value of each unknown among the members.
    spread: dict[str, tuple[float, float]]


def identifiability(space: Space, objective: Objective, point: Array) -> Identifiability:
    """Compute the singular values of the Jacobian at a point, shape (n,), of the unit cube."""
    free = space.continuous
    paths = tuple(space.unknowns[index].path for index in free)
    if free.size == 0:
        return Identifiability((), (), {})
    _, singular, right = np.linalg.svd(jacobian(space, objective, point, _STEP)[:, free], full_matrices=False)
    # the sign of a singular vector is arbitrary; here its largest component is positive
    weakest = right[-1] * np.sign(right[-1][np.argmax(np.abs(right[-1]))])
    return Identifiability(
        paths, tuple(map(float, singular)), {path: float(x) for path, x in zip(paths, weakest, strict=True)}
    )


def near_optimal(space: Space, calibration: Calibration, excess: float) -> list[Cluster]:
    """Cluster all points with an objective of at most the smallest objective plus `excess`. The best cluster comes
    first.
    """
    points = np.concatenate([[start.point for start in calibration.starts], calibration.population])
    values = np.concatenate([[start.objective for start in calibration.starts], calibration.population_objective])
    keep = values <= calibration.best.objective + excess
    points = np.array([space.settled(point) for point in points[keep]])
    values = values[keep]
    groups: dict[tuple[float, ...], list[int]] = {}
    choices = [index for index, unknown in enumerate(space.unknowns) if unknown.choices]
    for row, point in enumerate(points):
        groups.setdefault(tuple(point[choices]), []).append(row)
    clusters = [
        _cluster(space, points[rows], values[rows])
        for members in groups.values()
        for rows in _linked(points, np.array(members))
    ]
    return sorted(clusters, key=lambda cluster: cluster.objective)


def near_optimal_ends(clusters: Sequence[Cluster], path: str) -> tuple[float, float] | None:
    """Return the smallest and largest value of an unknown in all clusters, or None for an unknown with choices."""
    ends = [cluster.spread[path] for cluster in clusters if path in cluster.spread]
    return (min(low for low, _ in ends), max(high for _, high in ends)) if ends else None


def _linked(points: Array, rows: NDArray[np.int64]) -> list[NDArray[np.int64]]:
    from scipy.cluster.hierarchy import fcluster, linkage

    if len(rows) == 1:
        return [rows]
    labels = fcluster(linkage(points[rows], "complete", metric="chebyshev"), _DISTANCE, "distance")
    return [rows[labels == label] for label in np.unique(labels)]


def _cluster(space: Space, points: Array, values: Array) -> Cluster:
    best = int(np.argmin(values))
    spread = {}
    for index in space.continuous:
        unknown = space.unknowns[index]
        ends = [unknown.value(float(points[:, index].min())), unknown.value(float(points[:, index].max()))]
        spread[unknown.path] = (float(ends[0]), float(ends[1]))
    return Cluster(len(points), float(values[best]), space.values(points[best]), spread)
