"""Solution in linear time of the normal equations for the unknowns of the swings and the shared unknowns.

A swing is a part of the measured motion that begins in flight. It is coupled only to its neighbours and to the unknowns
that all swings share, so the matrix is block tridiagonal with a border. The block of the swings is factorised as a band
matrix by Cholesky's method, and the border by its Schur complement.

Reference: Golub and Van Loan, Matrix Computations, ch. 4.3 and 3.2.6.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, cho_solve_banded, cholesky_banded

Array = NDArray[np.float64]

#: Number of unknowns of a swing, by definition the pose and its rates at the start of the swing.
OWN = 6


@dataclass(frozen=True, eq=False)
class Arrow:
    """Symmetric matrix for k shared unknowns and six unknowns of each of s swings.

    border : (k, k) block of the shared unknowns
    coupling : (6 s, k) block that couples the unknowns of the swings with the shared unknowns
    bands : (12, 6 s) main diagonal and subdiagonals of the block of the swings, in LAPACK's band storage
    """

    border: Array
    coupling: Array
    bands: Array

    @staticmethod
    def empty(shared: int, swings: int) -> Arrow:
        """Return a matrix of zeros."""
        size = OWN * swings
        return Arrow(np.zeros((shared, shared)), np.zeros((size, shared)), np.zeros((2 * OWN, size)))

    def add(self, swing: int, block: Array) -> None:
        """Add a square block for the shared unknowns and for consecutive swings, of which `swing` is the first."""
        shared = len(self.border)
        self.border[:] += block[:shared, :shared]
        first = OWN * swing
        self.coupling[first : first + len(block) - shared] += block[shared:, :shared]
        bands = block[shared:, shared:]
        for column in range(len(bands)):
            self.bands[: len(bands) - column, first + column] += bands[column:, column]

    def diagonal(self) -> Array:
        """Return the main diagonal, which begins with the shared unknowns."""
        return np.concatenate([np.diag(self.border), self.bands[0]])

    def plus(self, diagonal: Array) -> Arrow:
        """Return the matrix with `diagonal` added to its main diagonal."""
        shared = len(self.border)
        bands = self.bands.copy()
        bands[0] += diagonal[shared:]
        return Arrow(self.border + np.diag(diagonal[:shared]), self.coupling, bands)

    def factorised(self) -> Factor:
        """Return the Cholesky factors of the matrix.

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
    """Cholesky factors of the block of the swings and of the Schur complement of the border.

    eliminated : (6 s, k) inverse of the block of the swings times the coupling
    """

    band: Array
    eliminated: Array
    schur: Array

    def solve(self, right: Array) -> Array:
        """Return the solution for right-hand sides of shape (k + 6 s,) or (k + 6 s, m)."""
        shared = len(self.schur)
        border, states = right[:shared], right[shared:]
        first = cho_solve((self.schur, True), border - self.eliminated.T @ states)
        own = cho_solve_banded((self.band, True), states, check_finite=False) - self.eliminated @ first
        return np.concatenate([first, own])

    def covariance(self) -> Array:
        """Return the block of the inverse for the shared unknowns, shape (k, k)."""
        inverse: Array = cho_solve((self.schur, True), np.eye(len(self.schur)))
        return 0.5 * (inverse + inverse.T)
