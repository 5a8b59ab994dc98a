"""Cholesky factor, solutions, determinant and the needed part of the inverse of a banded matrix of grid rows.

The precision of a spline field (`spline.py`) couples grid rows that are at most three apart: it is banded, and in blocks of
three rows it is block tridiagonal. LAPACK factors the band; with many right-hand sides, and for the inverse, the factor is
used as dense blocks, where BLAS is fast.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, get_lapack_funcs

Float = NDArray[np.floating]
Int = NDArray[np.integer]

_pbtrf, _pbtrs, _trtri = get_lapack_funcs(("pbtrf", "pbtrs", "trtri"), dtype=np.float64)
CHUNK = 4096  # stencils whose k² entries of the inverse are gathered at a time: bounded memory
FEW = 2  # right-hand sides up to which the band is solved directly


@dataclass(frozen=True)
class Factor:
    """A = L Lᵀ: `band` (w + 1, n), L in LAPACK's lower band storage; `b`, rows in a block; `logdet` = log det A."""

    band: Float
    b: int
    logdet: float

    @cached_property
    def blocks(self) -> tuple[Float, Float]:
        """Inverse diagonal blocks L_kk⁻¹ (B, b, b), and blocks L_{k+1,k} (B - 1, b, b)."""
        count = self.band.shape[1] // self.b
        diagonal, below = unpack(self.band, self.b)
        for k in range(count):
            diagonal[k] = _trtri(diagonal[k].T, lower=0)[0].T
        return diagonal, below


def pack(matrix: sp.spmatrix, width: int) -> Float:
    """Lower band storage (width + 1, n) of a sparse symmetric matrix whose duplicates are summed."""
    coo = matrix.tocoo()
    band = np.zeros((width + 1, coo.shape[0]), order="F")
    lower = coo.row >= coo.col
    band[(coo.row - coo.col)[lower], coo.col[lower]] = coo.data[lower]
    return band


def unpack(band: Float, b: int) -> tuple[Float, Float]:
    """Lower triangles of the diagonal blocks (B, b, b), and the blocks below them (B - 1, b, b), of a banded matrix."""
    n = band.shape[1]
    count = n // b
    padded = np.zeros((2 * b, n))
    rows = min(len(band), 2 * b)
    padded[:rows] = band[:rows]
    skew = padded.reshape(2 * b, count, b)
    i, j = np.arange(b)[:, None], np.arange(b)
    diagonal = np.where(i >= j, skew[np.maximum(i - j, 0), :, j].transpose(2, 0, 1), 0.0)
    below = skew[b + i - j, :, j].transpose(2, 0, 1)[:-1]
    return np.ascontiguousarray(diagonal), np.ascontiguousarray(below)


def factor(band: Float, b: int) -> Factor:
    """Factor a positive definite matrix in lower band storage (w + 1, n).

    Raises
    ------
    scipy.linalg.LinAlgError
        if the matrix is not positive definite.
    """
    lower, info = _pbtrf(band, lower=1)
    if info:
        raise LinAlgError(f"not positive definite at order {info}")
    return Factor(lower, b, 2 * float(np.log(lower[0]).sum()))


def solve(f: Factor, rhs: Float) -> Float:
    """A⁻¹ rhs for `rhs` (n,) or (n, k)."""
    if rhs.ndim == 1 or rhs.shape[1] <= FEW:
        return np.asarray(_pbtrs(f.band, rhs, lower=1)[0]).reshape(rhs.shape)
    inverse, below = f.blocks
    count, b, _ = inverse.shape
    x = np.array(rhs, dtype=float).reshape(count, b, -1)
    for k in range(count):
        if k:
            x[k] -= below[k - 1] @ x[k - 1]
        x[k] = inverse[k] @ x[k]
    for k in range(count - 1, -1, -1):
        if k < count - 1:
            x[k] -= below[k].T @ x[k + 1]
        x[k] = inverse[k].T @ x[k]
    return x.reshape(rhs.shape)


def selected_inverse(f: Factor) -> tuple[Float, Float]:
    """Blocks of A⁻¹ on (B, b, b) and below (B - 1, b, b) the diagonal, by Takahashi's recursion."""
    inverse, lower = f.blocks
    diagonal = np.empty_like(inverse)
    below = np.empty_like(lower)
    for k in range(len(inverse) - 1, -1, -1):
        diagonal[k] = inverse[k].T @ inverse[k]
        if k < len(inverse) - 1:
            step = lower[k] @ inverse[k]
            below[k] = -diagonal[k + 1] @ step
            diagonal[k] -= below[k].T @ step
    return diagonal, below


def covariance(inverse: tuple[Float, Float], index: Int, left: Float, right: Float) -> Float:
    """`left_i A⁻¹ right_iᵀ` (N, p, q) for stencils of coefficients `index` (N, k), weights (N, p, k) and (N, q, k).

    All coefficients of a stencil must lie in the same or in adjacent blocks.
    """
    diagonal, below = inverse
    b = diagonal.shape[1]
    flat = np.concatenate((diagonal.ravel(), below.ravel()))
    out = np.empty((len(index), left.shape[1], right.shape[1]))
    for at in (slice(k, k + CHUNK) for k in range(0, len(index), CHUNK)):
        block, inner = np.divmod(index[at], b)
        bi, bj = block[:, :, None], block[:, None, :]
        i, j = inner[:, :, None], inner[:, None, :]
        number = np.where(bi == bj, bi, len(diagonal) + np.minimum(bi, bj))
        values = flat[np.where(bi >= bj, (number * b + i) * b + j, (number * b + j) * b + i)]
        out[at] = (left[at] @ values) @ np.swapaxes(right[at], 1, 2)
    return out
