"""Normal equations of swings: block tridiagonal with a border of the shared unknowns, solved in linear time.

Each swing has six unknowns and is linked to its neighbours at most, so the swings' part is factorised as a band matrix
(Cholesky) and the border by its Schur complement.

Reference: Golub and Van Loan, Matrix Computations, ch. 4.3 and 3.2.6.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, cho_solve_banded, cholesky_banded

Array = NDArray[np.float64]

#: Definition: unknowns of one swing, pose and rate at its start.
OWN = 6


@dataclass(frozen=True, eq=False)
class Arrow:
    """A symmetric matrix of k shared unknowns and six of each of s swings.

    border : (k, k)
    coupling : (6 s, k) of the swings' unknowns with the shared unknowns
    bands : (12, 6 s) diagonals of the rest from the main one down, as LAPACK has them
    """

    border: Array
    coupling: Array
    bands: Array

    @staticmethod
    def empty(shared: int, swings: int) -> Arrow:
        """Return zeros."""
        size = OWN * swings
        return Arrow(np.zeros((shared, shared)), np.zeros((size, shared)), np.zeros((2 * OWN, size)))

    def add(self, swing: int, block: Array) -> None:
        """Add a block of the shared unknowns and of consecutive swings from `swing` on."""
        shared = len(self.border)
        self.border[:] += block[:shared, :shared]
        first = OWN * swing
        self.coupling[first : first + len(block) - shared] += block[shared:, :shared]
        rest = block[shared:, shared:]
        for column in range(len(rest)):
            self.bands[: len(rest) - column, first + column] += rest[column:, column]

    def diagonal(self) -> Array:
        """Return the main diagonal, the shared unknowns first."""
        return np.concatenate([np.diag(self.border), self.bands[0]])

    def plus(self, diagonal: Array) -> Arrow:
        """Return the matrix with something added to its main diagonal."""
        shared = len(self.border)
        bands = self.bands.copy()
        bands[0] += diagonal[shared:]
        return Arrow(self.border + np.diag(diagonal[:shared]), self.coupling, bands)

    def factorised(self) -> Factor:
        """Return the factors.

        Raises
        ------
        numpy.linalg.LinAlgError
            For a matrix that is not positive definite.
        """
        band = cholesky_banded(self.bands, lower=True, check_finite=False)
        eliminated = cho_solve_banded((band, True), self.coupling, check_finite=False)
        schur, _ = cho_factor(self.border - self.coupling.T @ eliminated, lower=True)
        return Factor(band, eliminated, schur)


@dataclass(frozen=True, eq=False)
class Factor:
    """Cholesky factors of the swings' part and of the Schur complement; `eliminated` (6 s, k): swings^-1 coupling."""

    band: Array
    eliminated: Array
    schur: Array

    def solve(self, right: Array) -> Array:
        """Return the solution for one right-hand side, (k + 6 s,), or several, (k + 6 s, m)."""
        shared = len(self.schur)
        border, rest = right[:shared], right[shared:]
        first = cho_solve((self.schur, True), border - self.eliminated.T @ rest)
        own = cho_solve_banded((self.band, True), rest, check_finite=False) - self.eliminated @ first
        return np.concatenate([first, own])

    def covariance(self) -> Array:
        """Return the part of the inverse that belongs to the shared unknowns, shape (k, k)."""
        inverse: Array = cho_solve((self.schur, True), np.eye(len(self.schur)))
        return 0.5 * (inverse + inverse.T)
