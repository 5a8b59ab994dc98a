"""Cholesky factor, solutions, determinant and the needed part of the inverse of a block tridiagonal matrix.

The precision of a spline field (`spline.py`) couples grid rows that are at most three apart, so in blocks of three rows it
is block tridiagonal. All work is done by BLAS on dense blocks, and no fill-in arises outside them.
"""

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, get_blas_funcs, get_lapack_funcs

Float = NDArray[np.float64]
Matrix = tuple[Float, Float]  # symmetric: blocks on the diagonal (B, b, b), blocks below it (B - 1, b, b)

_potrf, _trtri = get_lapack_funcs(("potrf", "trtri"), dtype=np.float64)
(_trsm,) = get_blas_funcs(("trsm",), dtype=np.float64)


@dataclass(frozen=True)
class Factor:
    """A = L Lᵀ. `diagonal` (B, b, b) holds L_kk, `below` (B - 1, b, b) holds L_{k+1,k}; `logdet` is log det A."""

    diagonal: Float
    below: Float
    logdet: float


def split(matrix: sp.spmatrix, b: int) -> Matrix:
    """The blocks of a sparse symmetric matrix whose duplicates are summed."""
    coo = matrix.tocoo()
    count = coo.shape[0] // b
    i, r = np.divmod(coo.row, b)
    j, c = np.divmod(coo.col, b)
    diagonal = np.zeros((count, b, b))
    below = np.zeros((max(count - 1, 0), b, b))
    on = i == j
    diagonal[i[on], r[on], c[on]] = coo.data[on]
    under = i == j + 1
    below[j[under], r[under], c[under]] = coo.data[under]
    return diagonal, below


def factor(matrix: Matrix) -> Factor:
    """Factor a symmetric positive definite matrix.

    Raises
    ------
    scipy.linalg.LinAlgError
        if the matrix is not positive definite.
    """
    diagonal, below = np.empty_like(matrix[0]), np.empty_like(matrix[1])
    for k, block in enumerate(matrix[0]):
        if k:
            # Row-major L is column-major Lᵀ, which is what BLAS takes without a copy.
            below[k - 1] = _trsm(1.0, diagonal[k - 1].T, matrix[1][k - 1].T, lower=0, trans_a=1).T
            block = block - below[k - 1] @ below[k - 1].T
        upper, info = _potrf(block.T, lower=0, clean=1)
        if info:
            raise LinAlgError(f"block {k} is not positive definite (order {info})")
        diagonal[k] = upper.T
    logdet = 2 * float(np.log(np.diagonal(diagonal, axis1=1, axis2=2)).sum())
    return Factor(diagonal, below, logdet)


def solve(f: Factor, rhs: Float) -> Float:
    """A⁻¹ rhs for `rhs` (n,) or (n, k)."""
    count, b, _ = f.diagonal.shape
    x = np.array(rhs, dtype=float).reshape(count, b, -1)
    for k in range(count):
        if k:
            x[k] -= f.below[k - 1] @ x[k - 1]
        x[k] = _trsm(1.0, f.diagonal[k].T, x[k], lower=0, trans_a=1)
    for k in range(count - 1, -1, -1):
        if k < count - 1:
            x[k] -= f.below[k].T @ x[k + 1]
        x[k] = _trsm(1.0, f.diagonal[k].T, x[k], lower=0)
    return x.reshape(np.shape(rhs))


def selected_inverse(f: Factor) -> Matrix:
    """Blocks of A⁻¹ on and below the diagonal, by Takahashi's recursion."""
    count = len(f.diagonal)
    diagonal = np.empty_like(f.diagonal)
    below = np.empty_like(f.below)
    for k in range(count - 1, -1, -1):
        inverse = _trtri(f.diagonal[k].T, lower=0)[0].T  # L_kk⁻¹
        diagonal[k] = inverse.T @ inverse
        if k < count - 1:
            step = f.below[k] @ inverse
            below[k] = -diagonal[k + 1] @ step
            diagonal[k] -= below[k].T @ step
    return diagonal, below


def covariance(inverse: Matrix, index: NDArray[np.int64], left: Float, right: Float) -> Float:
    """`left_i A⁻¹ right_iᵀ` (N, p, q) for stencils of coefficients `index` (N, k), weights (N, p, k) and (N, q, k).

    All coefficients of a stencil must lie in the same or in adjacent blocks.
    """
    diagonal, below = inverse
    b = diagonal.shape[1]
    block, inner = np.divmod(index, b)
    bi, bj = block[:, :, None], block[:, None, :]
    flat = np.concatenate((diagonal.ravel(), below.ravel()))
    i, j = inner[:, :, None], inner[:, None, :]
    number = np.where(bi == bj, bi, len(diagonal) + np.minimum(bi, bj))
    values = flat[np.where(bi >= bj, (number * b + i) * b + j, (number * b + j) * b + i)]
    return (left @ values) @ np.swapaxes(right, 1, 2)
