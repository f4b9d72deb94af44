"""Clearances of largest likelihood, given the measured path (the mean pose at each phase of the load).

The features of simulated motions, including the path, are modelled as a quadratic function of the parameters plus
normal noise (synthetic likelihood: Wood, Nature 466 (2010) 1102). The path has more numbers than there are motions, so
a regression uses the clearances of largest likelihood instead (semi-automatic approximate Bayesian computation:
Fearnhead and Prangle, J. R. Stat. Soc. B 74 (2012) 419).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations_with_replacement

import numpy as np
from numpy.typing import NDArray

from plow_twin.estimate import tuning
from plow_twin.estimate.regression import ridge, shrunk_root

Array = NDArray[np.float64]

#: Smallest variance of a feature and smallest deviation of a drawn parameter, guards against division by zero.
_LEAST, _SAME = 1e-14, 1e-12
#: Definition of the quadratic terms by pairs of parameters: two clearances, softness and damping.
_CURVED = tuple(combinations_with_replacement(range(4), 2))
#: Upper bound on the number of folds of the cross-validation.
_PARTS = 10
#: Upper bounds on the number of Gauss-Newton steps, and on the size of a step in deviations of the draws.
_STEPS, _LONGEST = 5, 1.5
#: Prior deviation, in deviations of the draws, of parameters practically without a prior.
_FREE = 100.0


@dataclass(frozen=True, eq=False)
class PathFeatures:
    """Features of motions.

    like : (n, m) features
    late : (n, m) derivatives of the features with respect to the delay in 1/s
    """

    like: Array
    late: Array

    def rows(self, which: NDArray[np.bool_]) -> PathFeatures:
        """Return the features of the selected motions."""
        return PathFeatures(self.like[which], self.late[which])


def likeliest(drawn: Array, gain: float, motions: PathFeatures, measured: PathFeatures) -> Array:
    """Return the most likely clearances in m of n simulated motions and of the measured motion, shape (n + 1, 2).

    The last row belongs to the measured motion. For the simulated motions the model is cross-validated.

    Parameters
    ----------
    drawn : ndarray, shape (n, 7)
        Drawn parameters: two clearances, logarithms of penetration and damping, and three load gains.
    gain : float
        Prior standard deviation of the load gains.
    motions, measured : PathFeatures
        Features of the n simulated motions, and of the measured motion.
    """
    points = np.zeros((len(drawn) + 1, 2))
    points[-1] = _likeliest(drawn, gain, motions, measured)[0]
    for part in range(_PARTS):
        inside = np.arange(len(drawn)) % _PARTS == part
        points[:-1][inside] = _likeliest(drawn[~inside], gain, motions.rows(~inside), motions.rows(inside))
    return points


def _likeliest(drawn: Array, gain: float, motions: PathFeatures, measured_paths: PathFeatures) -> Array:
    """Return the most likely clearances in m of the k motions `measured_paths`, shape (k, 2)."""
    middle, scale = drawn.mean(axis=0), drawn.std(axis=0)
    scale[scale <= _SAME] = 1.0
    terms = _terms((drawn - middle) / scale)
    inverse, leverage = ridge(terms, tuning.RIDGE[3])
    surface = inverse @ (terms.T @ motions.like)
    free = np.maximum(1.0 - leverage, tuning.LEAST_FREE)
    error = (motions.like - terms @ surface) / np.sqrt(free)[:, None]
    whiten = np.linalg.inv(shrunk_root(error.T @ error / len(error), _LEAST)).T
    whitened, late, surface = measured_paths.like @ whiten, measured_paths.late @ whiten, surface @ whiten
    # the first four parameters have no prior; the gains and the delay follow
    mean = np.concatenate([np.zeros(4), (1.0 - middle[4:]) / scale[4:], np.zeros(1)])
    weight = np.concatenate([np.full(4, _FREE), gain / scale[4:], np.full(1, tuning.LATE)]) ** -2.0
    point = np.zeros((len(whitened), len(mean)))
    for _ in range(_STEPS):
        places = point[:, :-1]
        residual = whitened - _terms(places) @ surface - late * point[:, -1:]
        slope = np.concatenate([_slopes(places) @ surface, late[:, None]], axis=1)
        curvature = slope @ slope.transpose(0, 2, 1) + np.diag(weight)
        pull = np.einsum("nkm,nm->nk", slope, residual) + (mean - point) * weight
        step = np.linalg.solve(curvature, pull[:, :, None])[:, :, 0]
        point += np.clip(step, -_LONGEST, _LONGEST)
        np.clip(point, -tuning.OUTLYING, tuning.OUTLYING, out=point)
    position: Array = point[:, :2] * scale[:2] + middle[:2]
    return position


def _terms(points: Array) -> Array:
    products = [points[:, one] * points[:, other] for one, other in _CURVED]
    return np.column_stack([np.ones(len(points)), points, *products])


def _slopes(points: Array) -> Array:
    """Return the derivatives of the terms with respect to each parameter, shape (n, 7, terms)."""
    count, size = points.shape
    slopes = np.zeros((count, size, 1 + size + len(_CURVED)))
    each = np.arange(size)
    slopes[:, each, 1 + each] = 1.0
    for place, (one, other) in enumerate(_CURVED, 1 + size):
        slopes[:, one, place] += points[:, other]
        slopes[:, other, place] += points[:, one]
    return slopes
