"""The clearances at which the path of the head over the load's period is likeliest.

What drawn motions are like, their mean path over the period among it, is a quadratic function of what they were drawn
with, and normal noise (synthetic likelihood: Wood, Nature 466 (2010) 1102). The clearances at which the likelihood of a
motion is largest are numbers that a regression can then use beside others (semi-automatic approximate Bayesian
computation: Fearnhead and Prangle, J. R. Stat. Soc. B 74 (2012) 419): it learns from the drawn motions what they are
worth. A path has more parts than there are draws, so a regression on the parts themselves tells nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations_with_replacement

import numpy as np
from numpy.typing import NDArray

from plow_twin.estimate.laws import LEAST_FREE, OWN_VARIANCE

Array = NDArray[np.float64]

#: What a coefficient is held to zero by, and the least variance.
_RIDGE, _LEAST = 1e-2, 1e-14
#: Deviation of a parameter that all were drawn with alike.
_SAME = 1e-12
#: Parameters whose effect changes with each other: clearances, softness and damping.
_CURVED = tuple(combinations_with_replacement(range(4), 2))
#: Parts of the draws, each predicted from the others.
_PARTS = 10
#: Gauss-Newton steps, the longest one, and the farthest from the middle, in deviations of the draws.
_STEPS, _LONGEST, _FARTHEST = 5, 1.5, 5.0
#: Deviation of the delay that is left in s, and that of a parameter that is not known before, in that of the draws.
_LATE_S, _FREE = 4e-3, 100.0


@dataclass(frozen=True, eq=False)
class Seen:
    """What motions are like, (n, m), and the derivatives of that by the delay, (n, m) in 1/s."""

    like: Array
    late: Array

    def rows(self, which: NDArray[np.bool_]) -> Seen:
        """Return some of the motions."""
        return Seen(self.like[which], self.late[which])


def likeliest(drawn: Array, gain: float, motions: Seen, measured: Seen) -> Array:
    """Return the clearances in m at which each of n motions is likeliest, as it is told by others: (n + 1, 2).

    The last row is that of the measured one. `drawn`, shape (n, 7), holds clearances, the logarithms of penetration and
    damping and the gains of the load, which are known to `gain`.
    """
    told = np.zeros((len(drawn) + 1, 2))
    told[-1] = _told(drawn, gain, motions, measured)[0]
    for part in range(_PARTS):
        inside = np.arange(len(drawn)) % _PARTS == part
        told[:-1][inside] = _told(drawn[~inside], gain, motions.rows(~inside), motions.rows(inside))
    return told


def _told(drawn: Array, gain: float, motions: Seen, asked: Seen) -> Array:
    """Return the likeliest clearances in m of the motions asked for, by others that were drawn: (k, 2)."""
    middle, scale = drawn.mean(axis=0), drawn.std(axis=0)
    scale[scale <= _SAME] = 1.0
    terms = _terms((drawn - middle) / scale)
    inverse = np.linalg.inv(terms.T @ terms + np.diag([0.0] + [_RIDGE] * (terms.shape[1] - 1)))
    surface = inverse @ (terms.T @ motions.like)
    free = np.maximum(1.0 - np.einsum("ij,jk,ik->i", terms, inverse, terms), LEAST_FREE)
    error = (motions.like - terms @ surface) / np.sqrt(free)[:, None]
    whiten = np.linalg.inv(_root(error.T @ error / len(error))).T
    seen, late, surface = asked.like @ whiten, asked.late @ whiten, surface @ whiten
    # priors: of the gains and, last, of the delay
    mean = np.concatenate([np.zeros(4), (1.0 - middle[4:]) / scale[4:], np.zeros(1)])
    weight = np.concatenate([np.full(4, _FREE), gain / scale[4:], np.full(1, _LATE_S)]) ** -2.0
    point = np.zeros((len(seen), len(mean)))
    for _ in range(_STEPS):
        places = point[:, :-1]
        left = seen - _terms(places) @ surface - late * point[:, -1:]
        slope = np.concatenate([_slopes(places) @ surface, late[:, None]], axis=1)
        curvature = slope @ slope.transpose(0, 2, 1) + np.diag(weight)
        pull = np.einsum("nkm,nm->nk", slope, left) + (mean - point) * weight
        step = np.linalg.solve(curvature, pull[:, :, None])[:, :, 0]
        point += np.clip(step, -_LONGEST, _LONGEST)
        np.clip(point, -_FARTHEST, _FARTHEST, out=point)
    found: Array = point[:, :2] * scale[:2] + middle[:2]
    return found


def _root(covariance: Array) -> Array:
    """Return the Cholesky factor of a covariance whose parts are drawn toward each being for itself."""
    held = (1.0 - OWN_VARIANCE) * covariance + np.diag(OWN_VARIANCE * np.diag(covariance) + _LEAST)
    return np.asarray(np.linalg.cholesky(held), np.float64)


def _terms(points: Array) -> Array:
    """Return the polynomial's terms at some points (n, 7)."""
    products = [points[:, one] * points[:, other] for one, other in _CURVED]
    return np.column_stack([np.ones(len(points)), points, *products])


def _slopes(points: Array) -> Array:
    """Return the derivatives of the terms by each of the parameters, shape (n, 7, terms)."""
    count, size = points.shape
    slopes = np.zeros((count, size, 1 + size + len(_CURVED)))
    each = np.arange(size)
    slopes[:, each, 1 + each] = 1.0
    for place, (one, other) in enumerate(_CURVED, 1 + size):
        slopes[:, one, place] += points[:, other]
        slopes[:, other, place] += points[:, one]
    return slopes
