"""The relative irradiance field and the scales of the textons (section 4.1), in one linear system.

Every texton k knows irradiance up to its own factor, so log L_i = u(x_i) + c_k + noise, r_k = exp(−c_k). The paper
minimises `(r_k L_i − sum_j a_j phi_j(x_i))²`; in logarithms noise is relative, as it is in images, the field stays
positive, and no prior can win by making everything dark. The roughness prior is `strength * (E1 + reach² E2)`: sharp enough
for cast shadows. Neighbouring instances of different textons tie the scales together; no surface is needed.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sftex_stages.geometry import blocks, gaussian, spline

Float = NDArray[np.float64]
Int = NDArray[np.int64]

FREEDOM = 3.0  # of the Student distribution of the noise: highlights, elements half in a shadow
SCALE_SPREAD = 3.0  # standard deviation of a texton's log scale; only keeps the system definite
OFFSET_SPREAD = 3.0  # standard deviation of the field's mean


@dataclass(frozen=True)
class Irradiance:
    """The field: `grid` and coefficients `a` of its logarithm; textons' `offset` (K,) = c_k; robust weights (N,); noise
    factor; log evidence in nats; `factor` of the field's precision given the offsets."""

    grid: spline.Grid
    a: Float
    offset: Float
    weight: Float
    noise: float
    evidence: float
    factor: blocks.Factor


@dataclass(frozen=True)
class _System:
    index: Int  # (N, 16)
    stencil: Float  # (N, 16)
    texton: Int
    count: int
    add: gaussian.Scatter
    energies: tuple[blocks.Matrix, ...]
    grid: spline.Grid

    def values(self, a: Float) -> Float:
        return (self.stencil * a[self.index]).sum(1)


@dataclass(frozen=True)
class _Posterior:
    a: Float
    offset: Float
    factor: blocks.Factor
    evidence: float


def _posterior(s: _System, y: Float, weight: Float, strength: float, reach: float) -> _Posterior:
    """Field and offsets of data `y` (N,) with precisions `weight` (N,); the offsets by their Schur complement."""
    area = float(np.prod(s.grid.cells)) * s.grid.spacing**2
    parts = (1 / (area * OFFSET_SPREAD**2), strength, strength * reach**2)
    prior = [sum(w * e[k] for w, e in zip(parts, s.energies, strict=True)) for k in range(2)]
    data = s.add(weight[:, None, None] * s.stencil[:, :, None] * s.stencil[:, None, :])
    factor = blocks.factor((data[0] + prior[0], data[1] + prior[1]))
    heavy = weight[:, None] * s.stencil
    b = np.bincount(s.index.ravel(), (heavy * y[:, None]).ravel(), s.grid.size)
    place = (s.index * s.count + s.texton[:, None]).ravel()
    cross = np.bincount(place, heavy.ravel(), s.grid.size * s.count).reshape(s.grid.size, s.count)
    right = np.bincount(s.texton, weight * y, s.count)
    solved = blocks.solve(factor, np.concatenate((b[:, None], cross), 1))
    schur = np.diag(np.bincount(s.texton, weight, s.count) + 1 / SCALE_SPREAD**2) - cross.T @ solved[:, 1:]
    offset = np.linalg.solve(schur, right - cross.T @ solved[:, 0])
    a = solved[:, 0] - solved[:, 1:] @ offset
    used = weight > 0
    fit = float(b @ a + right @ offset - weight @ y**2)
    logdet = blocks.factor((prior[0], prior[1])).logdet - factor.logdet - float(np.linalg.slogdet(schur)[1])
    logdet += float(np.log(weight[used] / (2 * np.pi)).sum()) - 2 * s.count * np.log(SCALE_SPREAD)
    return _Posterior(a, offset, factor, 0.5 * (fit + logdet))


def fit(
    xy: Float, log_l: Float, sigma: Float, texton: Int, trust: Float, grid: spline.Grid, spacing: float
) -> Irradiance:
    """Field and texton offsets from log irradiances; smoothness and noise of greatest evidence, robust.

    Parameters
    ----------
    xy, log_l, sigma : (N, 2), (N,), (N,)
        positions in px, log L_i and its standard deviation.
    texton : (N,) integers 0 … K − 1
        every one of which has a member with positive `trust` (N,), 0…1.
    grid, spacing
        where the field lives, and the mean distance of instances in px.
    """
    index, stencil = spline.stencil(grid, xy)
    count = int(texton.max()) + 1
    add = gaussian.scatter(grid, index)
    energies = tuple(blocks.split(spline.energy(grid, m), add.b) for m in range(3))
    s = _System(index, stencil, texton, count, add, energies, grid)
    centre = np.array([np.median(log_l[(texton == k) & (trust > 0)]) for k in range(count)])
    y = log_l - centre[texton]  # near zero, so that the weak priors are neutral
    base = trust / sigma**2
    robust = np.ones(len(xy))
    x = np.log([10.0, spacing, 1.0])  # strength, reach, noise factor
    pace = np.array([1.4, 1.0, 0.7])
    for _ in range(4):
        for _ in range(2):
            x, post, moved = _climb(s, y, base * robust, x, pace)
            pace = pace if moved else pace / 2
        noise = float(np.exp(x[2]))
        weight = base * robust / noise
        # Residuals against what the others predict: a lone bright instance must not carry its own field.
        spread = blocks.covariance(blocks.selected_inverse(post.factor), index, stencil[:, None], stencil[:, None])
        r = (y - s.values(post.a) - post.offset[texton]) / np.maximum(1 - weight * spread[:, 0, 0], 0.05)
        robust = (FREEDOM + 1) / (FREEDOM + r**2 / (noise * sigma**2 + spread[:, 0, 0]))
    post = _posterior(s, y, base * robust / noise, *np.exp(x[:2]))
    return Irradiance(grid, post.a, post.offset + centre, robust * trust, noise, post.evidence, post.factor)


def _climb(s: _System, y: Float, base: Float, x: Float, pace: Float) -> tuple[Float, _Posterior, bool]:
    """One round of a pattern search for the (log) strength, reach and noise factor of greatest evidence."""
    best, moved = _posterior(s, y, base / np.exp(x[2]), *np.exp(x[:2])), False
    for k in range(3):
        for sign in (1, -1):
            trial = x + sign * pace * (np.arange(3) == k)
            post = _posterior(s, y, base / np.exp(trial[2]), *np.exp(trial[:2]))
            if post.evidence > best.evidence:
                x, best, moved = trial, post, True
                break
    return x, best, moved
