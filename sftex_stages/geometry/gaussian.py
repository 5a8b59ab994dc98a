"""A spline field conditioned on Gaussian data about its gradient: the linear algebra shared by signs and refinement.

Data speak about the gradient g_i = grad h(x_i) through `½ g_iᵀ W_i g_i − v_iᵀ g_i`: information `W_i` (2, 2) and pull `v_i` (2,)
(a measurement y_i with precision W_i pulls with W_i y_i). The prior is `spline.energy`. With `B` the gradient design the
posterior precision is `A = Bᵀ W B + P`, the mean `A⁻¹ Bᵀ v`, and the field can be integrated out in closed form.
"""

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from sftex_stages.geometry import blocks, spline

Float = NDArray[np.float64]

HEIGHT_SCALE = 3.0  # standard deviation of the free constant of h, of the extent
SLOPE_SCALE = 3.0  # standard deviation of an overall lean; both make evidences of different priors comparable


@dataclass(frozen=True)
class Smoothness:
    """Prior precision `strength * (E2 + reach² E3)`: gradients vary by about 1/sqrt(strength), smoothly below `reach` px."""

    strength: float
    reach: float


@dataclass(frozen=True)
class Field:
    """A grid with the gradient stencils of N points on it and the energies of its prior."""

    grid: spline.Grid
    index: NDArray[np.int64]  # (N, 16)
    stencil: Float  # (N, 2, 16), gradient in px/px
    design: sp.csr_matrix  # (2N, M), the same, rows interleaved
    energies: tuple[sp.csr_matrix, ...]  # E0 … E3

    @property
    def block(self) -> int:
        return spline.BLOCK * self.grid.shape[1]


def field(grid: spline.Grid, xy: Float) -> Field:
    """The field of that grid with points `xy` (N, 2) px."""
    index, p = spline.stencil(grid, xy, 1, 0)
    stencil = np.stack((p, spline.stencil(grid, xy, 0, 1)[1]), 1)
    energies = tuple(spline.energy(grid, m) for m in range(4))
    return Field(grid, index, stencil, spline.gradient_design(grid, xy), energies)


def prior(f: Field, smooth: Smoothness) -> sp.csr_matrix:
    """Prior precision P (M, M), positive definite; its lowest terms are weak and fixed."""
    extent = np.array(f.grid.cells) * f.grid.spacing
    area = extent.prod()
    weak = f.energies[0] / (area * (HEIGHT_SCALE**2) * area) + f.energies[1] / (area * SLOPE_SCALE**2)
    return weak + smooth.strength * (f.energies[2] + smooth.reach**2 * f.energies[3])


def weighted(f: Field, weight: Float) -> sp.csr_matrix:
    """Rows `W_i B_i` (2N, M) for `weight` (N, 2, 2)."""
    data = np.einsum("npq,nqk->npk", weight, f.stencil)
    return sp.csr_matrix((data.ravel(), f.design.indices, f.design.indptr), shape=f.design.shape)


def posterior(f: Field, weight: Float, precision: sp.csr_matrix) -> blocks.Factor:
    """Factor of A = Bᵀ W B + P."""
    return blocks.factor(f.design.T @ weighted(f, weight) + precision, f.block)


def gradients(f: Field, a: Float) -> Float:
    """Gradients (N, 2) or (N, 2, S) at the points for coefficients (M,) or (M, S)."""
    return (f.design @ a).reshape(len(f.index), 2, *a.shape[1:])


def gradient_covariance(f: Field, factor: blocks.Factor) -> Float:
    """Posterior covariance (N, 2, 2) of the gradient at the points."""
    return blocks.covariance(blocks.selected_inverse(factor), f.index, f.stencil, f.stencil)


def without_own(g: Float, covariance: Float, weight: Float, pull: Float) -> tuple[Float, Float]:
    """Mean (N, 2) and covariance (N, 2, 2) of the gradient at every point as all the other points alone predict it."""
    inverse = np.linalg.inv(covariance)
    others = np.linalg.inv(inverse - (1 - 1e-9) * weight)
    return np.einsum("nij,nj->ni", others, np.einsum("nij,nj->ni", inverse, g) - pull), others


def log_evidence(f: Field, weight: Float, pull: Float, smooth: Smoothness) -> float:
    """log of the integral of exp(−½ gᵀ W g + vᵀ g) over the prior of the field, in nats."""
    precision = prior(f, smooth)
    factor = posterior(f, weight, precision)
    b = f.design.T @ pull.ravel()
    return 0.5 * (float(b @ blocks.solve(factor, b)) + blocks.factor(precision, f.block).logdet - factor.logdet)
