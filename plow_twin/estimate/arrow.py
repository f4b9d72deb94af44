"""Normal equations of the swings, block tridiagonal with a border of shared unknowns, solved in linear time.

Each swing has six unknowns and is linked only to its neighbours. The part of the swings is therefore factorised as a
band matrix (Cholesky), and the border by its Schur complement.

Reference: Golub and Van Loan, Matrix Computations, ch. 4.3 and 3.2.6.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, cho_solve_banded, cholesky_banded

Array = NDArray[np.float64]

#: Definition: number of unknowns of one swing: the pose and its rate at the start, three numbers each.
OWN = 6


@dataclass(frozen=True, eq=False)
class Arrow:
    """A symmetric matrix for k shared unknowns and the six unknowns of each of s swings.

    border : (k, k) block of the shared unknowns
    coupling : (6 s, k) block between the swings' unknowns and the shared unknowns
    bands : (12, 6 s) main diagonal and subdiagonals of the swings' block, in LAPACK's band storage
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
        """Add a block for the shared unknowns and the consecutive swings that begin with `swing`."""
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
        """Return the matrix with `diagonal` added to its main diagonal."""
        shared = len(self.border)
        bands = self.bands.copy()
        bands[0] += diagonal[shared:]
        return Arrow(self.border + np.diag(diagonal[:shared]), self.coupling, bands)

    def factorised(self) -> Factor:
        """Return the factors.

        Raises
        ------
        numpy.linalg.LinAlgError
            If the matrix is not positive definite.
        """
        band = cholesky_banded(self.bands, lower=True, check_finite=False)
        eliminated = cho_solve_banded((band, True), self.coupling, check_finite=False)
        schur, _ = cho_factor(self.border - self.coupling.T @ eliminated, lower=True)
        return Factor(band, eliminated, schur)


@dataclass(frozen=True, eq=False)
class Factor:
    """Cholesky factors of the swings' block and of the Schur complement.

    `eliminated`, shape (6 s, k), is the inverse of the swings' block times the coupling.
    """

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
        """Return the inverse's block for the shared unknowns, shape (k, k)."""
        inverse: Array = cho_solve((self.schur, True), np.eye(len(self.schur)))
        return 0.5 * (inverse + inverse.T)
