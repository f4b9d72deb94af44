"""Odds of two contact laws for a hard contact, from the likelihood of the measured motion under each law.

The features of motions that are simulated under each law are modelled as a polynomial of the drawn parameters plus
normal noise (synthetic likelihood: Wood, Nature 466 (2010) 1102). Laplace's method integrates the likelihood over the
parameters, and the odds are the ratio of the two integrals.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations_with_replacement

import numpy as np
from numpy.typing import NDArray

from plow_twin.estimate import tuning
from plow_twin.estimate.regression import ridge, shrunk_root

Array = NDArray[np.float64]

#: Smallest variance of a feature, a guard against division by zero.
_LEAST = 1e-9
#: Definition of the polynomial. It has terms up to the third degree in the parameters `_CURVED` (penetration, damping),
#: and their products with the parameters `_CHANGING` (clearances).
_CURVED, _CHANGING = (0, 1), (5, 6)
#: Levenberg-Marquardt search for the most likely parameters: upper bound on the number of steps, damping of the first
#: step, smallest gain for a further step, and step of the difference quotients.
_STEPS, _DAMPED, _ENOUGH, _SMALL = 30, 1e-2, 1e-2, 1e-4


@dataclass(frozen=True, eq=False)
class Draws:
    """Motions simulated under one law.

    like : (n, m) features of the motions
    drawn : (n, 7) drawn unknowns: logarithms of penetration and damping, three gains of the load, and two differences
    between clearance and reach
    """

    like: Array
    drawn: Array


def log_odds(own: Draws, other: Draws, measured: Array) -> float:
    """Return the log odds of the law of `other` against the law of `own`, given m measured features."""
    both = np.concatenate([own.like, other.like])
    middle, scale = both.mean(axis=0), both.std(axis=0) + _LEAST
    surfaces = [_Surface.through(law.drawn, (law.like - middle) / scale) for law in (own, other)]
    residuals = np.concatenate([surface.left for surface in surfaces])
    covariance = residuals.T @ residuals / len(residuals)
    root = shrunk_root(covariance, _LEAST)
    normalised: Array = np.linalg.solve(root, (measured - middle) / scale)
    one, two = (surface.ln_evidence(root, normalised) for surface in surfaces)
    return two - one


@dataclass(frozen=True, eq=False)
class _Surface:
    """Standardised features as a polynomial of the standardised parameters.

    coefficients : (terms, m) coefficients of the polynomial
    left : (n, m) leave-one-out residuals
    points : (n, 7) parameters of the draws
    """

    coefficients: Array
    left: Array
    points: Array

    @staticmethod
    def through(drawn: Array, like: Array) -> _Surface:
        scatter = drawn.std(axis=0)
        points = (drawn - drawn.mean(axis=0)) / np.where(scatter > _LEAST, scatter, np.inf)
        terms = _terms(points)
        inverse, leverage = ridge(terms, tuning.RIDGE[3])
        coefficients = inverse @ (terms.T @ like)
        residuals = (like - terms @ coefficients) / np.sqrt(np.maximum(1.0 - leverage, tuning.LEAST_FREE))[:, None]
        return _Surface(coefficients, residuals, points)

    def ln_evidence(self, root: Array, normalised: Array) -> float:
        """Return the logarithm of the evidence of the measured features `normalised`, shape (m,).

        They are whitened by `root`, the Cholesky factor of the residual covariance.
        """
        matrix = np.linalg.solve(root, self.coefficients.T)

        def misfit(points: Array) -> tuple[Array, Array]:
            residual = normalised - _terms(points) @ matrix.T
            return (residual**2).sum(axis=1) + (points**2).sum(axis=1), residual

        each, residual = misfit(self.points)
        best = int(np.argmin(each))
        point, cost, error = self.points[best], float(each[best]), residual[best]
        size, damped = len(point), _DAMPED
        for _ in range(_STEPS):
            nearby = _terms(np.concatenate([point[None], point + _SMALL * np.eye(size)]))
            slope = matrix @ (nearby[1:] - nearby[0]).T / _SMALL
            curvature = slope.T @ slope + np.eye(size)
            held = curvature + damped * np.diag(np.diag(curvature))
            tried = np.clip(point + np.linalg.solve(held, slope.T @ error - point), -tuning.FARTHEST, tuning.FARTHEST)
            each, residual = misfit(tried[None])
            gained = cost - float(each[0])
            damped *= 0.1 if gained > 0.0 else 10.0
            if gained > 0.0:
                point, cost, error = tried, float(each[0]), residual[0]
                if gained < _ENOUGH:
                    break
        return -0.5 * (cost + float(np.linalg.slogdet(curvature)[1]))


def _terms(points: Array) -> Array:
    products = [
        np.prod(points[:, list(index)], axis=1)
        for degree in (2, 3)
        for index in combinations_with_replacement(_CURVED, degree)
    ]
    products += [points[:, one] * points[:, other] for one in _CURVED for other in _CHANGING]
    return np.column_stack([np.ones(len(points)), points, *products])
