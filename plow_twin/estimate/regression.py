"""Ridge regression, and covariance matrices from few samples."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from plow_twin.estimate import tuning

Array = NDArray[np.float64]


def ridge(basis: Array, penalty: float, weight: Array | None = None) -> tuple[Array, Array]:
    """Return the inverse of the normal matrix of a ridge regression, (k, k), and the leverage of each row, (n,).

    Parameters
    ----------
    basis : ndarray, shape (n, k)
        Design matrix. The first column is the constant term, which is not penalised.
    penalty : float
        Number that is added to the diagonal of the normal matrix, except for the constant term.
    weight : ndarray, shape (n,), optional
        Weights of the rows.
    """
    weighted = basis if weight is None else weight[:, None] * basis
    held = np.diag([0.0] + [penalty] * (basis.shape[1] - 1))
    inverse = np.asarray(np.linalg.inv(basis.T @ weighted + held), np.float64)
    leverage: Array = np.einsum("ij,jk,ik->i", basis, inverse, basis)
    return inverse, leverage if weight is None else leverage * weight


def shrunk_root(covariance: Array, least: float) -> Array:
    """Return the Cholesky factor of a covariance that is shrunk toward its diagonal, with `least` added to it."""
    share = tuning.SHRINKAGE[0]
    shrunk = (1.0 - share) * covariance + np.diag(share * np.diag(covariance) + least)
    return np.asarray(np.linalg.cholesky(shrunk), np.float64)
