"""Which of two laws of a hard contact a motion is like, by its likelihood under each.

The features of drawn motions of a law are a smooth function of their unknowns, a polynomial of few terms, and
normal noise; of a measured motion the likelihood under each law follows, and from it the odds of the two (synthetic
likelihood: Wood, Nature 466 (2010) 1102; the integral over the parameters after Laplace).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations_with_replacement

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: Share of its own variance in the covariance of a feature: 160 draws do not determine that of 200 features.
OWN_VARIANCE = 0.4
#: What a coefficient is held to zero by, and the least variance.
_RIDGE, _LEAST = 1e-2, 1e-9
#: Parameters that act to the third power, and those whose effect changes with them.
_CURVED, _CHANGING = (0, 1), (5, 6)
#: Farthest from the middle of the draws, in their standard deviations.
_FARTHEST = 3.5
#: Steps to the likeliest parameters (Levenberg, Marquardt), damping of the first, gain that ends them, and distance of
#: the points of a difference quotient.
_STEPS, _DAMPED, _ENOUGH, _SMALL = 30, 1e-2, 1e-2, 1e-4
#: Least share of a draw's residual that the fit including the draw leaves.
LEAST_FREE = 0.2


@dataclass(frozen=True, eq=False)
class Draws:
    """Motions of one law: their features (n, m), and the unknowns that they were drawn with (n, 7).

    The latter are the logarithms of penetration and damping, three gains of the load, and by how much the two
    clearances differ from the reach.
    """

    like: Array
    drawn: Array


def log_odds(believed: Draws, other: Draws, measured: Array) -> float:
    """Return the logarithm of how much likelier `measured`, shape (m,), is under the other law."""
    both = np.concatenate([believed.like, other.like])
    middle, scale = both.mean(axis=0), both.std(axis=0) + _LEAST
    surfaces = [_Surface.through(law.drawn, (law.like - middle) / scale) for law in (believed, other)]
    left = np.concatenate([surface.left for surface in surfaces])
    covariance = left.T @ left / len(left)
    own = np.diag(covariance)
    root = np.linalg.cholesky((1.0 - OWN_VARIANCE) * covariance + np.diag(OWN_VARIANCE * own + _LEAST))
    seen: Array = np.linalg.solve(root, (measured - middle) / scale)
    one, two = (surface.ln_evidence(root, seen) for surface in surfaces)
    return two - one


@dataclass(frozen=True, eq=False)
class _Surface:
    """What motions are like over the parameters, in units of their scatter, zero in the middle.

    coefficients : (terms, m)
    left : (n, m) residuals, each as if it was foretold without its own draw
    points : (n, 7) of the draws
    """

    coefficients: Array
    left: Array
    points: Array

    @staticmethod
    def through(drawn: Array, like: Array) -> _Surface:
        scatter = drawn.std(axis=0)
        points = (drawn - drawn.mean(axis=0)) / np.where(scatter > _LEAST, scatter, np.inf)
        terms = _terms(points)
        inverse = np.linalg.inv(terms.T @ terms + np.diag([0.0] + [_RIDGE] * (terms.shape[1] - 1)))
        coefficients = inverse @ (terms.T @ like)
        leverage = np.einsum("ij,jk,ik->i", terms, inverse, terms)
        left = (like - terms @ coefficients) / np.sqrt(np.maximum(1.0 - leverage, LEAST_FREE))[:, None]
        return _Surface(coefficients, left, points)

    def ln_evidence(self, root: Array, seen: Array) -> float:
        """Return the logarithm of the evidence of `seen` (m,), whitened by the `root` of the covariance."""
        matrix = np.linalg.solve(root, self.coefficients.T)

        def misfit(points: Array) -> tuple[Array, Array]:
            off = seen - _terms(points) @ matrix.T
            return (off**2).sum(axis=1) + (points**2).sum(axis=1), off

        each, off = misfit(self.points)
        best = int(np.argmin(each))
        point, cost, rest = self.points[best], float(each[best]), off[best]
        size, damped = len(point), _DAMPED
        for _ in range(_STEPS):
            nearby = _terms(np.concatenate([point[None], point + _SMALL * np.eye(size)]))
            slope = matrix @ (nearby[1:] - nearby[0]).T / _SMALL
            curvature = slope.T @ slope + np.eye(size)
            held = curvature + damped * np.diag(np.diag(curvature))
            tried = np.clip(point + np.linalg.solve(held, slope.T @ rest - point), -_FARTHEST, _FARTHEST)
            each, off = misfit(tried[None])
            gained = cost - float(each[0])
            damped *= 0.1 if gained > 0.0 else 10.0
            if gained > 0.0:
                point, cost, rest = tried, float(each[0]), off[0]
                if gained < _ENOUGH:
                    break
        return -0.5 * (cost + float(np.linalg.slogdet(curvature)[1]))


def _terms(points: Array) -> Array:
    """Return the polynomial's terms at some points (n, 7)."""
    products = [
        np.prod(points[:, list(index)], axis=1)
        for degree in (2, 3)
        for index in combinations_with_replacement(_CURVED, degree)
    ]
    products += [points[:, one] * points[:, other] for one in _CURVED for other in _CHANGING]
    return np.column_stack([np.ones(len(points)), points, *products])
