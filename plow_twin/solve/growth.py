"""Growth of errors from the fundamental matrices of successive stretches of a motion."""

from __future__ import annotations

import math
from typing import Final

from plow_twin.kernel.arrays import copy_into
from plow_twin.kernel.compiler import kernel

#: Largest number of earlier times from which the growth of errors is computed. Beyond it, every second time is removed.
MOST_KEPT: Final = 256
#: `_SQUARINGS`: largest number of squarings of a matrix, after which singular values with a ratio within 1e-6 of 1 are
#: treated as equal. `_RANK_ONE`: trace of the square above which a matrix with trace 1 is treated as having rank one.
_SQUARINGS, _RANK_ONE = 18, 1.0 - 1e-9


@kernel(fast=True)
def _multiply(a, b, out) -> None:
    size = len(a)
    for i in range(size):
        out[i] = 0.0
        for k in range(size):
            factor = a[i, k]
            for j in range(size):
                out[i, j] += factor * b[k, j]


@kernel(fast=True)
def _larger_norm(a, height, most, gram, power, square) -> float:
    """Return the larger of `most` and the largest singular value of the first `height` rows of a matrix.

    Let A be these rows and G = A^T A. The square of the largest singular value lies between trace(G^(m+1)) / trace(G^m)
    and trace(G^m)^(1/m). G is squared until the upper bound is below `most`, or until the power of G has rank one.
    """
    size, trace = a.shape[1], 0.0
    for i in range(size):
        for j in range(size):
            value = 0.0
            for k in range(height):
                value += a[k, i] * a[k, j]
            gram[i, j] = value
        trace += gram[i, i]
    if not 0.0 < trace < math.inf:
        return max(most, trace)
    for i in range(size):
        for j in range(size):
            power[i, j] = gram[i, j] / trace
    logarithm, degree = math.log(trace), 1.0
    for _ in range(_SQUARINGS):
        if logarithm <= 2.0 * math.log(most) * degree:
            return most
        _multiply(power, power, square)
        trace = 0.0
        for i in range(size):
            trace += square[i, i]
        for i in range(size):
            for j in range(size):
                power[i, j] = square[i, j] / trace
        logarithm, degree = 2.0 * logarithm + math.log(trace), 2.0 * degree
        if trace > _RANK_ONE:
            break
    largest = 0.0
    for i in range(size):
        for j in range(size):
            largest += gram[i, j] * power[j, i]
    return max(most, math.sqrt(largest))


@kernel(fast=True)
def _multiply_all(matrix, since, count, product) -> None:
    """Write the products of `matrix` and each matrix since[:, i, :]. `since[k]` contains row k of all matrices."""
    size = len(matrix)
    length = count * size
    for i in range(size):
        out = product[i].reshape(-1)
        out[:length] = 0.0
        for k in range(size):
            factor, row = matrix[i, k], since[k].reshape(-1)
            for j in range(length):
                out[j] += factor * row[j]


@kernel(fast=True)
def _largest(product, count, height, scratch) -> float:
    """Return the largest spectral norm of the first `height` rows of the matrices grown[:, i, :], at least 1.

    The sum of squares of a matrix is an upper bound of its squared norm. After the norm of the matrix with the largest
    sum, few norms have to be computed.
    """
    most, begin, size = 1.0, 0, len(product)
    squares = scratch[5:].reshape(-1)
    for i in range(count):
        squares[i] = 0.0
        for row in range(height):
            for column in range(size):
                squares[i] += product[row, i, column] ** 2
        if squares[i] > squares[begin]:
            begin = i
    for j in range(count):
        i = (begin + j) % count
        if not squares[i] <= most * most:
            for row in range(height):
                scratch[4, row] = product[row, i]
            most = _larger_norm(scratch[4], height, most, scratch[0], scratch[1], scratch[2])
    return most


@kernel()
def _stretch_basis(matrix, basis, moved, logs) -> None:
    """Multiply a basis by a matrix, orthonormalise it, and write the logarithm of each vector's growth factor."""
    size = len(matrix)
    _multiply(matrix, basis, moved)
    for j in range(size):
        for i in range(2 * j):
            # two passes, because a single pass leaves rounding errors
            before, share = i % j, 0.0
            for k in range(size):
                share += basis[k, before] * moved[k, j]
            for k in range(size):
                moved[k, j] -= share * basis[k, before]
        length = 0.0
        for k in range(size):
            length += moved[k, j] ** 2
        length = max(math.sqrt(length), 1e-300)
        logs[j] = math.log(length)
        for k in range(size):
            basis[k, j] = moved[k, j] / length


@kernel(entry=True)
def follow_growth(matrices, changes, ends, since, kept, whole, basis, scratch, totals, rows, growth, logs) -> None:
    """Compute products of fundamental matrices and the growth of errors, for n times in succession.

    Parameters
    ----------
    matrices : ndarray, shape (n, k, k)
        Fundamental matrices from the end of the last complete stretch to each of n times.
    changes : ndarray, shape (n, p, k)
        Effects of the parameters on the state since the end of the last complete stretch.
    ends : ndarray of int64, shape (n,)
        1 for a time at the end of a stretch, and 0 for a time within a stretch. Within a stretch, the growth includes
        only errors of coordinates, not of rates.
    since : ndarray, shape (2, k, m, k)
        since[0, :, i, :] is the product of the fundamental matrices since the earlier time i, for i < `kept[0]`.
        since[1] is scratch space.
    kept : ndarray of int64, shape (1,)
        Number of earlier times in `since`.
    whole : tuple of ndarray, shapes (k, k) and (p, k)
        Fundamental matrix and effects of the parameters over all complete stretches. Updated at the end of each
        stretch.
    basis : ndarray, shape (k, k)
        Orthonormal basis. Updated at the end of each stretch.
    scratch : ndarray, shape (5 + s, k, k)
        Scratch space, with at least m numbers after the first five matrices.
    totals : ndarray, shape (n, k, k)
        Array that receives the products of the fundamental matrices.
    rows : ndarray, shape (n, p, k)
        Array that receives the effects of the parameters.
    growth : ndarray, shape (n,)
        Array that receives the largest growth since an earlier time.
    logs : ndarray, shape (n, k)
        Array that receives the logarithms of the growth factors of the basis vectors.
    """
    most = since.shape[2]
    for index in range(len(matrices)):
        matrix, count = matrices[index], kept[0]
        product, size = since[1], len(matrix)
        _multiply_all(matrix, since[0], count, product)
        # growth since the beginning of the current stretch
        for k in range(size):
            copy_into(product[k, count], matrix[k])
        ended = ends[index] == 1
        growth[index] = _largest(product, count + 1, size if ended else size // 2, scratch)
        _multiply(matrix, whole[0], totals[index])
        for i in range(changes.shape[1]):
            for j in range(size):
                value = changes[index, i, j]
                for k in range(size):
                    value += matrix[j, k] * whole[1][i, k]
                rows[index, i, j] = value
        if not ended:
            continue
        copy_into(whole[0].reshape(-1), totals[index].reshape(-1))
        copy_into(whole[1].reshape(-1), rows[index].reshape(-1))
        _stretch_basis(matrix, basis, scratch[3], logs[index])
        step = 1 if count + 1 < most else 2
        kept[0] = (count + step) // step
        for i in range(kept[0]):
            for k in range(size):
                copy_into(since[0, k, i], product[k, i * step])
