"""The relative irradiance field and the scales of the textons (section 4.1), in one linear system.

Every texton k knows irradiance up to its own factor, so log L_i = u(x_i) + c_k + noise, r_k = exp(−c_k). The paper minimises
`(r_k L_i − sum_j a_j phi_j(x_i))²`; in logarithms noise is relative, as it is in images, the field stays positive, and no
prior can win by making everything dark. The roughness prior is `strength * (E1 + reach² E2)`: sharp enough for cast shadows.
Neighbouring instances of different textons tie the scales together; no surface is needed.
"""

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from sftex_stages.geometry import blocks, spline

Float = NDArray[np.float64]

FREEDOM = 3.0  # of the Student distribution of the noise: highlights, elements half in a shadow
SCALE_SPREAD = 3.0  # standard deviation of a texton's log scale; only keeps the system definite
OFFSET_SPREAD = 3.0  # standard deviation of the field's mean


@dataclass(frozen=True)
class Irradiance:
    """`grid`, coefficients `a` of the log field, `offset` (K,) = c_k, log field at the points (N,), weights (N,), noise factor."""

    grid: spline.Grid
    a: Float
    offset: Float
    at: Float
    weight: Float
    noise: float
    evidence: float


@dataclass(frozen=True)
class _System:
    value: sp.csr_matrix  # (N, M)
    index: NDArray[np.int64]
    stencil: Float  # (N, 1, 16)
    member: sp.csr_matrix  # (N, K), one at the instance's texton
    energies: tuple[sp.csr_matrix, ...]
    area: float
    block: int

    def prior(self, strength: float, reach: float) -> sp.csr_matrix:
        weak = self.energies[0] / (self.area * OFFSET_SPREAD**2)
        return weak + strength * (self.energies[1] + reach**2 * self.energies[2])


@dataclass(frozen=True)
class _Posterior:
    a: Float
    offset: Float
    factor: blocks.Factor
    evidence: float


def _posterior(s: _System, y: Float, weight: Float, strength: float, reach: float) -> _Posterior:
    """Field and offsets of data `y` (N,) with precisions `weight` (N,), the offsets eliminated by their Schur complement."""
    prior = s.prior(strength, reach)
    heavy = s.value.multiply(weight[:, None]).tocsr()
    factor = blocks.factor((s.value.T @ heavy + prior).tocsr(), s.block)
    b = heavy.T @ y
    cross = np.asarray((heavy.T @ s.member).todense())
    k = s.member.shape[1]
    corner = np.diag(s.member.T @ weight + 1 / SCALE_SPREAD**2)
    right = s.member.T @ (weight * y)
    solved = blocks.solve(factor, np.concatenate((b[:, None], cross), 1))
    schur = corner - cross.T @ solved[:, 1:]
    offset = np.linalg.solve(schur, right - cross.T @ solved[:, 0])
    a = solved[:, 0] - solved[:, 1:] @ offset
    used = weight > 0
    fit = float(b @ a + right @ offset - weight @ y**2)
    logdet = blocks.factor(prior, s.block).logdet - factor.logdet - np.linalg.slogdet(schur)[1]
    logdet += float(np.log(weight[used] / (2 * np.pi)).sum()) - 2 * k * np.log(SCALE_SPREAD)
    return _Posterior(a, offset, factor, 0.5 * (fit + logdet))


def fit(xy: Float, log_l: Float, sigma: Float, texton: NDArray[np.int64], trust: Float, grid: spline.Grid, spacing: float) -> Irradiance:
    """Field and class offsets from log irradiances.

    Parameters
    ----------
    xy, log_l, sigma : (N, 2), (N,), (N,)
        positions in px, log L_i and its standard deviation.
    texton : (N,) integers 0 … K − 1
        every one of which has a member with positive `trust` (N,), 0…1.
    grid, spacing
        where the field lives, and the mean distance of instances in px.
    """
    index, value = spline.stencil(grid, xy)
    n, count = len(xy), int(texton.max()) + 1
    member = sp.csr_matrix((np.ones(n), (np.arange(n), texton)), shape=(n, count))
    energies = tuple(spline.energy(grid, m) for m in range(3))
    area = float(np.prod(grid.cells)) * grid.spacing**2
    s = _System(spline.design(grid, xy), index, value[:, None, :], member, energies, area, spline.BLOCK * grid.shape[1])
    centre = np.array([np.median(log_l[(texton == k) & (trust > 0)]) for k in range(count)])
    y = log_l - centre[texton]  # near zero, so that the weak priors are neutral
    base = trust / sigma**2
    robust = np.ones(n)
    x = np.log([10.0, spacing, 1.0])  # strength, reach, noise factor
    pace = np.array([1.4, 1.0, 0.7])
    post = _posterior(s, y, base, *np.exp(x[:2]))
    for _ in range(4):
        for _ in range(2):
            x, post, moved = _pattern_step(s, y, base * robust, x, pace)
            if not moved:
                pace = pace / 2
        noise = float(np.exp(x[2]))
        weight = base * robust / noise
        # Residuals against what the others predict: a lone bright instance must not carry its own field.
        spread = blocks.covariance(blocks.selected_inverse(post.factor), s.index, s.stencil, s.stencil)[:, 0, 0]
        r = (y - s.value @ post.a - post.offset[texton]) / np.maximum(1 - weight * spread, 0.05)
        own = noise * sigma**2 + spread
        robust = (FREEDOM + 1) / (FREEDOM + r**2 / own)
    post = _posterior(s, y, base * robust / noise, *np.exp(x[:2]))
    return Irradiance(grid, post.a, post.offset + centre, s.value @ post.a, robust * trust, noise, post.evidence)


def _pattern_step(
    s: _System, y: Float, base: Float, x: Float, pace: Float
) -> tuple[Float, _Posterior, bool]:
    """One round of a pattern search for the (log) strength, reach and noise factor of greatest evidence."""

    def at(x: Float) -> _Posterior:
        return _posterior(s, y, base / np.exp(x[2]), *np.exp(x[:2]))

    best, moved = at(x), False
    for k in range(3):
        for sign in (1, -1):
            trial = x + sign * pace * (np.arange(3) == k)
            post = at(trial)
            if post.evidence > best.evidence:
                x, best, moved = trial, post, True
                break
    return x, best, moved
