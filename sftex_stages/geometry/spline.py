"""A smooth scalar field on the image plane: uniform bicubic B-splines with a roughness prior.

The surface (and the irradiance) is `h(x) = sum_j a_j phi_j(x)`, so value and gradient are linear in the coefficients `a`, as in
section 4 of Lobay & Forsyth 2006. Their radial functions (see `radial.py`) couple every coefficient with every other; B-splines
have local support, so that the normal equations are banded, and evaluation over an image is separable. The ridge on `a` becomes
a Gaussian process prior with precision

    P = l0 E0 + l1 E1 + l2 E2 + l3 E3,      E_m = integral of the squared m-th derivatives of h,

whose strength is chosen by the marginal likelihood (`gaussian.py`). `E2` is the thin plate; `E3` leaves quadratics free.
"""

from dataclasses import dataclass
from math import comb

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

Float = NDArray[np.floating]

BLOCK = 3  # rows of the grid in a block: a cubic spline couples four consecutive rows, hence adjacent blocks only


@dataclass(frozen=True)
class Grid:
    """A uniform bicubic spline grid. `origin` (x, y) px of the first cell's corner, `spacing` px, `cells` (along x, along y).

    Coefficients are numbered with the axis of more coefficients outermost; there are `cells + 3` along an axis.
    """

    origin: tuple[float, float]
    spacing: float
    cells: tuple[int, int]

    @property
    def outer(self) -> int:
        """The outermost axis, 0 for x and 1 for y."""
        return 0 if self.cells[0] >= self.cells[1] else 1

    @property
    def shape(self) -> tuple[int, int]:
        """Number of coefficients along the outer and the inner axis; the outer one is a multiple of `BLOCK`."""
        return self.cells[self.outer] + 3, self.cells[1 - self.outer] + 3

    @property
    def size(self) -> int:
        """Number of coefficients."""
        return (self.cells[0] + 3) * (self.cells[1] + 3)


def cover(low: Float, high: Float, spacing: float) -> Grid:
    """The smallest grid of that spacing over the box `low` (2,) … `high` (2,) px, centred on it."""
    cells = np.maximum(np.ceil((high - low) / spacing - 1e-9).astype(int), 1)
    outer = 0 if cells[0] >= cells[1] else 1
    cells[outer] += -(cells[outer] + 3) % BLOCK
    origin = (low + high) / 2 - cells * spacing / 2
    return Grid((float(origin[0]), float(origin[1])), float(spacing), (int(cells[0]), int(cells[1])))


def _weights(u: Float, derivative: int) -> Float:
    """Weights (4, …) of the four cubic B-splines over a unit cell at `u` in 0…1, or their derivatives in u."""
    one = np.ones_like(u)
    polynomials = (
        ((1 - u) ** 3, 3 * u**3 - 6 * u**2 + 4 * one, -3 * u**3 + 3 * u**2 + 3 * u + one, u**3),
        (-3 * (1 - u) ** 2, 9 * u**2 - 12 * u, -9 * u**2 + 6 * u + 3 * one, 3 * u**2),
        (6 * (1 - u), 18 * u - 12 * one, -18 * u + 6 * one, 6 * u),
        (-6 * one, 18 * one, -18 * one, 6 * one),
    )
    return np.asarray(np.stack(polynomials[derivative]) / 6)


def _axis(grid: Grid, axis: int, x: Float, derivative: int) -> tuple[NDArray[np.integer], Float]:
    """First coefficient (N,) and the four weights (4, N) of coordinates `x` (N,) px; the end cells extrapolate."""
    t = (np.asarray(x, float) - grid.origin[axis]) / grid.spacing
    cell = np.clip(np.floor(t).astype(np.int64), 0, grid.cells[axis] - 1)
    return cell, _weights(t - cell, derivative) / grid.spacing**derivative


def stencil(grid: Grid, xy: Float, dx: int = 0, dy: int = 0) -> tuple[NDArray[np.integer], Float]:
    """Coefficient numbers (N, 16) and weights (N, 16) of the (dx, dy) derivative of the field at `xy` (N, 2) px."""
    xy = np.asarray(xy, float)
    (first_x, x), (first_y, y) = _axis(grid, 0, xy[:, 0], dx), _axis(grid, 1, xy[:, 1], dy)
    first, weight = (first_x, first_y), (x, y)
    o, i = grid.outer, 1 - grid.outer
    k = np.arange(4)
    rows = first[o][:, None] + k
    cols = first[i][:, None] + k
    index = rows[:, :, None] * grid.shape[1] + cols[:, None, :]
    value = weight[o].T[:, :, None] * weight[i].T[:, None, :]
    return index.reshape(len(xy), 16), value.reshape(len(xy), 16)


def places(grid: Grid) -> tuple[NDArray[np.integer], NDArray[np.integer]]:
    """Number along the outer and along the inner axis (C,) of all cells of a grid."""
    outer, inner = np.indices((grid.cells[grid.outer], grid.cells[1 - grid.outer]))
    return outer.ravel(), inner.ravel()


def cells(grid: Grid) -> NDArray[np.integer]:
    """Coefficient numbers (C, 16) of all cells, in the order of `places`."""
    outer, inner = places(grid)
    k = np.arange(4)
    index = (outer[:, None] + k)[:, :, None] * grid.shape[1] + (inner[:, None] + k)[:, None, :]
    return index.reshape(-1, 16)


def centres(grid: Grid) -> Float:
    """Middles (C, 2) px of all cells, in the order of `places`."""
    at = np.stack(places(grid), 1)
    return np.array(grid.origin) + (at[:, [grid.outer, 1 - grid.outer]] + 0.5) * grid.spacing


def design(grid: Grid, xy: Float, dx: int = 0, dy: int = 0) -> sp.csr_matrix:
    """Sparse (N, M) matrix that takes coefficients to the (dx, dy) derivative of the field at `xy` (N, 2) px."""
    index, value = stencil(grid, xy, dx, dy)
    rows = np.arange(0, index.size + 1, 16)
    return sp.csr_matrix((value.ravel(), index.ravel(), rows), shape=(len(index), grid.size))


def energy(grid: Grid, order: int) -> sp.csr_matrix:
    """`E_m`: aᵀ E a = integral over the grid of sum_j C(m, j) (d^m h / dx^j dy^(m-j))², exact. Sparse (M, M)."""
    node, weight = np.polynomial.legendre.leggauss(4)  # exact to degree 7; the integrands have degree 6
    node, weight = (node + 1) / 2, weight / 2
    grams: list[list[sp.csr_matrix]] = []
    for axis in (grid.outer, 1 - grid.outer):
        n = grid.cells[axis]
        grams.append([])
        for d in range(order + 1):
            w = _weights(node, d) / grid.spacing**d
            cell = np.einsum("ig,jg,g->ij", w, w, weight) * grid.spacing
            i = (np.arange(n)[:, None, None] + np.arange(4)[:, None]).repeat(4, 2)
            j = (np.arange(n)[:, None, None] + np.arange(4)).repeat(4, 1)
            value = np.broadcast_to(cell, (n, 4, 4)).ravel()
            grams[-1].append(sp.csr_matrix((value, (i.ravel(), j.ravel())), shape=(n + 3, n + 3)))
    terms = [comb(order, d) * sp.kron(grams[0][d], grams[1][order - d], format="csr") for d in range(order + 1)]
    return sp.csr_matrix(sum(terms[1:], terms[0]))


def evaluate(grid: Grid, a: Float, x: Float, y: Float, dx: int = 0, dy: int = 0) -> Float:
    """The (dx, dy) derivative on the raster of columns `x` (W,) and rows `y` (H,) px: (H, W). Separable, hence cheap."""
    c = a.reshape(grid.shape)
    c = c.T if grid.outer == 0 else c  # (along y, along x)
    raster = []
    for axis, at, d in ((0, x, dx), (1, y, dy)):
        first, w = _axis(grid, axis, at, d)
        index = (first[:, None] + np.arange(4)).ravel()
        shape = (len(first), grid.cells[axis] + 3)
        raster.append(sp.csr_matrix((w.T.ravel(), index, np.arange(0, index.size + 1, 4)), shape=shape))
    return np.asarray((raster[0] @ (raster[1] @ c).T).T)
