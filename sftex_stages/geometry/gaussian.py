"""A spline field conditioned on Gaussian data about its gradient: the linear algebra shared by signs and refinement.

Data speak about the gradient g_i = grad h(x_i) through `½ g_iᵀ W_i g_i − v_iᵀ g_i`: information `W_i` (2, 2) and pull
`v_i` (2,); a measurement y_i of precision W_i pulls with W_i y_i. The prior is that of `spline.py`. With `B` the gradient
design, the posterior precision is `A = Bᵀ W B + P`, the mean `A⁻¹ Bᵀ v`, and the field is integrated out in closed form.
"""

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.linalg import LinAlgError

from sftex_stages.geometry import blocks, spline

Float = NDArray[np.floating]
Int = NDArray[np.integer]

FREEDOM = 4.0  # of the Student distribution of measured heights, and of the sizes that tell them
HEIGHT_SCALE = 1.0  # standard deviation of the free constant of h, in extents
PIVOT = 1e-10  # of a diagonal element, where rounding does not reach: measured on stiff priors of up to 80 by 80 cells
SLOPE_SCALE = 3.0  # standard deviation of an overall lean; both make evidences of different priors comparable


@dataclass(frozen=True)
class Smoothness:
    """Prior precision `strength * (E2 + reach² E3)`: gradients vary by about 1/sqrt(strength), smoothly below `reach`."""

    strength: float
    reach: float  # px


@dataclass(frozen=True)
class Scatter:
    """Where the products of N stencils go in the band of a matrix of `size` coefficients in blocks of `b`."""

    position: Int  # into the transposed band, for those of the N * 256 pairs in `keep`
    keep: Int
    size: int
    width: int
    b: int

    def __call__(self, products: Float) -> Float:
        """Lower band storage of the sum of `products` (N, 16, 16)."""
        flat = np.bincount(self.position, products.ravel()[self.keep], (self.width + 1) * self.size)
        return flat.astype(float, copy=False).reshape(self.size, self.width + 1).T

    def pack(self, matrix: sp.spmatrix) -> Float:
        """The same storage for a sparse matrix."""
        return blocks.pack(matrix, self.width)


def scatter(grid: spline.Grid, index: Int) -> Scatter:
    """The scatter of stencils with coefficients `index` (N, 16)."""
    b = spline.BLOCK * grid.shape[1]
    width = b + spline.BLOCK
    i, j = index[:, :, None], index[:, None, :]
    lower = np.flatnonzero((i >= j).ravel())
    return Scatter((j * (width + 1) + i - j).ravel()[lower], lower, grid.size, width, b)


@dataclass(frozen=True)
class Field:
    """A grid with the gradient stencils of N points on it and the energies of its prior, E0 … E3.

    `cells`, E2 and E3 of every cell (C, 16, 16) each, where they are not alike (`curvature.py`).
    """

    grid: spline.Grid
    index: Int  # (N, 16)
    stencil: Float  # (N, 2, 16), gradient in px/px
    value: Float  # (N, 16), height in px
    design: sp.csr_matrix  # (2N, M): the gradient stencils, rows interleaved
    add: Scatter
    energies: tuple[Float, ...]  # band storage
    cells: tuple[Float, Float] | None = None
    logdets: dict[Smoothness, float] = field(default_factory=dict, compare=False)  # of priors, as they are asked for


def make_field(grid: spline.Grid, xy: Float, stretch: Float | None = None) -> Field:
    """The field of that grid with points `xy` (N, 2) px, its gradients times `stretch` (N, 2, 2) (`perspective.py`)."""
    index, p = spline.stencil(grid, xy, 1, 0)
    stencil = np.stack((p, spline.stencil(grid, xy, 0, 1)[1]), 1)
    if stretch is not None:
        stencil = stretch @ stencil
    rows = np.arange(0, 2 * index.size + 1, 16)
    design = sp.csr_matrix((stencil.ravel(), np.repeat(index, 2, 0).ravel(), rows), shape=(2 * len(index), grid.size))
    add = scatter(grid, index)
    energies = tuple(add.pack(spline.energy(grid, m)) for m in range(4))
    return Field(grid, index, stencil, spline.stencil(grid, xy)[1], design, add, energies)


def prior(f: Field, smooth: Smoothness) -> Float:
    """Prior precision P in band storage, positive definite; its lowest terms are weak and fixed."""
    area = float(np.prod(f.grid.cells)) * f.grid.spacing**2
    weak = f.energies[0] / (area * HEIGHT_SCALE) ** 2 + f.energies[1] / (area * SLOPE_SCALE**2)
    return weak + smooth.strength * (f.energies[2] + smooth.reach**2 * f.energies[3])


def reasonable(f: Field, strength: float, reach: float) -> bool:
    """Whether a prior is within what the grid can show and double precision can hold."""
    extent = max(f.grid.cells) * f.grid.spacing
    inside = 1e-3 <= strength <= 1e5 and 0.05 * f.grid.spacing <= reach <= 0.6 * extent
    return inside and holds(f, Smoothness(strength, reach))


def holds(f: Field, smooth: Smoothness) -> bool:
    """Whether double precision holds the prior: a stiff one on a fine grid has next to no say about a lean."""
    try:
        prior_logdet(f, smooth)
    except LinAlgError:
        return False
    return True


def softened(f: Field, smooth: Smoothness) -> Smoothness:
    """The smoothness, or the stiffest below it that double precision holds."""
    while not holds(f, smooth):
        smooth = replace(smooth, strength=smooth.strength / 2)
    return smooth


def prior_logdet(f: Field, smooth: Smoothness) -> float:
    """log det P, remembered.

    Raises
    ------
    scipy.linalg.LinAlgError
        if double precision does not hold P.
    """
    if smooth not in f.logdets:
        precision = prior(f, smooth)
        factor = blocks.factor(precision, f.add.b)
        if (factor.band[0] ** 2 < PIVOT * precision[0]).any():
            raise LinAlgError("pivots are lost in rounding")
        f.logdets[smooth] = factor.logdet
    return f.logdets[smooth]


def posterior(f: Field, weight: Float, precision: Float, height: Float | None = None) -> blocks.Factor:
    """Factor of A = Bᵀ W B + P for `weight` (N, 2, 2), and optionally precisions (N,) of measured heights."""
    products = np.swapaxes(f.stencil, 1, 2) @ (weight @ f.stencil)
    if height is not None:
        products += height[:, None, None] * f.value[:, :, None] * f.value[:, None, :]
    return blocks.factor(f.add(products) + precision, f.add.b)


def pulled(f: Field, pull: Float) -> Float:
    """`Bᵀ v` (M, …) of pulls (N, 2, …) on the gradients."""
    return np.asarray(f.design.T @ pull.reshape(-1, *pull.shape[2:]))


def lifted(f: Field, pull: Float) -> Float:
    """The same (M,) for pulls (N,) on the heights."""
    return np.bincount(f.index.ravel(), (pull[:, None] * f.value).ravel(), f.grid.size).astype(float, copy=False)


def heights(f: Field, a: Float) -> Float:
    """Heights (N,) at the points for coefficients (M,)."""
    return (f.value * a[f.index]).sum(1)


def gradients(f: Field, a: Float) -> Float:
    """Gradients (N, 2) or (N, 2, S) at the points for coefficients (M,) or (M, S)."""
    return np.asarray((f.design @ a).reshape(len(f.index), 2, *a.shape[1:]))


def gradient_covariance(f: Field, factor: blocks.Factor) -> Float:
    """Posterior covariance (N, 2, 2) of the gradient at the points."""
    return blocks.covariance(blocks.selected_inverse(factor), f.index, f.stencil, f.stencil)


def without_own(g: Float, covariance: Float, weight: Float, pull: Float) -> tuple[Float, Float]:
    """Mean (N, 2) and covariance (N, 2, 2) of the gradient at every point as all the other points alone predict it."""
    inverse = np.linalg.inv(covariance)
    others = np.linalg.inv(inverse - (1 - 1e-9) * weight)
    return np.einsum("nij,nj->ni", others, np.einsum("nij,nj->ni", inverse, g) - pull), others


@dataclass(frozen=True)
class Heights:
    """Measured heights `value` (N,) px of precision `stated` (N,), off by `columns` (N, K) times unknown coefficients
    with standard deviations `spread` (K,), both up to one factor; `weight` (N,), what is left of their say."""

    value: Float
    stated: Float
    columns: Float
    spread: Float
    weight: Float

    @cached_property
    def precision(self) -> Float:
        return self.stated * self.weight

    def over(self, factor: float) -> "Heights":
        """The same with that factor on the variances: what they are off by together goes with what each is off by."""
        return replace(self, stated=self.stated / factor, spread=self.spread * np.sqrt(factor))

    def reweighted(self, h: Float, factor: float) -> "Heights":
        """The same with the weights of a Student distribution about heights `h` (N,), with `factor` on the variances."""
        heavy = self.precision[:, None] * self.columns
        normal, off = self.columns.T @ heavy + np.diag(1 / self.spread**2), self.value - h
        chi2 = self.stated / factor * (off - self.columns @ np.linalg.solve(normal, heavy.T @ off)) ** 2
        return replace(self, weight=(FREEDOM + 1) / (FREEDOM + chi2))

    @cached_property
    def normal(self) -> tuple[Float, Float]:
        """Precision (K, K) of the coefficients at known heights, and their right side (K,)."""
        heavy = self.precision[:, None] * self.columns
        return self.columns.T @ heavy + np.diag(1 / self.spread**2), heavy.T @ self.value

    @cached_property
    def constant(self) -> float:
        """What is left of the log likelihood without its quadratic terms."""
        p = self.precision[self.precision > 0]
        own = np.log(p / (2 * np.pi)).sum() - self.precision @ self.value**2
        return 0.5 * float(own) - float(np.log(self.spread).sum())

    def unrelated(self) -> float:
        """Log likelihood in nats if the surface is flat: the columns alone explain the values."""
        normal, right = self.normal
        return self.constant + 0.5 * float(right @ np.linalg.solve(normal, right) - np.linalg.slogdet(normal)[1])


def solve(f: Field, factor: blocks.Factor, pull: Float, height: Heights | None) -> tuple[Float, float]:
    """Mean coefficients (M,) under pulls (N, 2) and heights, whose precision `factor` has; and the log of the integral of
    the data's exponential over the coefficients and over those of the heights' columns, without the prior's log det."""
    b = pulled(f, pull)
    if height is None:
        a = blocks.solve(factor, b)
        return a, 0.5 * (float(b @ a) - factor.logdet)
    b = b + lifted(f, height.precision * height.value)
    cross = np.stack([lifted(f, height.precision * c) for c in height.columns.T], 1)
    solved = blocks.solve(factor, np.concatenate((b[:, None], cross), 1))
    normal, right = height.normal
    schur = normal - cross.T @ solved[:, 1:]
    beta = np.linalg.solve(schur, right - cross.T @ solved[:, 0])
    a = solved[:, 0] - solved[:, 1:] @ beta
    quadratic = float(b @ a + right @ beta) - factor.logdet - float(np.linalg.slogdet(schur)[1])
    return a, height.constant + 0.5 * quadratic


def log_evidence(f: Field, weight: Float, pull: Float, smooth: Smoothness, height: Heights | None = None) -> float:
    """log of the integral of exp(−½ gᵀ W g + vᵀ g) over the prior of the field, in nats.

    With measured heights, of their normalised likelihood as well.
    """
    factor = posterior(f, weight, prior(f, smooth), None if height is None else height.precision)
    return solve(f, factor, pull, height)[1] + 0.5 * prior_logdet(f, smooth)
