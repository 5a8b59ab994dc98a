"""The relative irradiance field and the scales of the textons (section 4.1), in one linear system.

Every texton k knows irradiance up to its own factor, so log L_i = u(x_i) + c_k + noise, r_k = exp(−c_k). The paper
minimises `(r_k L_i − sum_j a_j phi_j(x_i))²`; in logarithms noise is relative, as it is in images, the field stays
positive, and no prior can win by making everything dark. The roughness prior is `strength * (E1 + reach² E2)`: sharp enough
for cast shadows. Neighbouring instances of different textons tie the scales together; no surface is needed.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sftex_stages.geometry import blocks, gaussian, pooling, spline
from sftex_stages.geometry.climb import climb

Float = NDArray[np.floating]
Int = NDArray[np.integer]

FREEDOM = 3.0  # of the Student distribution of the noise: highlights, elements half in a shadow
SCALE_SPREAD = 3.0  # standard deviation of a texton's log scale; only keeps the system definite
POOLED_FLOOR = 0.003  # relative error that no pooling removes
OFFSET_SPREAD = 3.0  # standard deviation of the field's mean


@dataclass(frozen=True)
class Irradiance:
    """The field: `grid` and coefficients `a` of its logarithm; textons' `offset` (K,) = c_k; robust weights (N,); noise
    factor; log evidence in nats; `factor` of the field's precision given the offsets; `tuned`, logarithms of the prior's
    strength and reach and of the noise factor."""

    grid: spline.Grid
    a: Float
    offset: Float
    weight: Float
    noise: float
    evidence: float
    factor: blocks.Factor
    tuned: Float


@dataclass(frozen=True)
class _System:
    """Stencils of data rows on the grid, each row with its texton; `count` textons, or none."""

    grid: spline.Grid
    index: Int  # (N, 16)
    stencil: Float  # (N, 16)
    texton: Int
    count: int
    add: gaussian.Scatter
    energies: tuple[Float, ...]

    def values(self, a: Float) -> Float:
        return (self.stencil * a[self.index]).sum(1)


def _system(grid: spline.Grid, xy: Float, texton: Int, count: int) -> _System:
    index, stencil = spline.stencil(grid, xy)
    add = gaussian.scatter(grid, index)
    energies = tuple(add.pack(spline.energy(grid, m)) for m in range(3))
    return _System(grid, index, stencil, texton, count, add, energies)


@dataclass(frozen=True)
class _Posterior:
    a: Float
    offset: Float
    factor: blocks.Factor
    evidence: float


def _posterior(s: _System, y: Float, weight: Float, strength: float, reach: float) -> _Posterior:
    """Field and offsets of data `y` (N,) with precisions `weight` (N,); the offsets by their Schur complement."""
    area = float(np.prod(s.grid.cells)) * s.grid.spacing**2
    prior = s.energies[0] / (area * OFFSET_SPREAD**2) + strength * (s.energies[1] + reach**2 * s.energies[2])
    data = s.add(weight[:, None, None] * s.stencil[:, :, None] * s.stencil[:, None, :])
    factor = blocks.factor(data + prior, s.add.b)
    heavy = weight[:, None] * s.stencil
    b = np.bincount(s.index.ravel(), (heavy * y[:, None]).ravel(), s.grid.size)
    place = (s.index * s.count + s.texton[:, None]).ravel()
    cross = np.bincount(place, heavy.ravel(), s.grid.size * s.count)
    cross = cross[: s.grid.size * s.count].reshape(s.grid.size, s.count)
    right = np.bincount(s.texton, weight * y, s.count)[: s.count]
    solved = blocks.solve(factor, np.concatenate((b[:, None], cross), 1))
    schur = np.diag(np.bincount(s.texton, weight, s.count)[: s.count] + 1 / SCALE_SPREAD**2) - cross.T @ solved[:, 1:]
    offset = np.linalg.solve(schur, right - cross.T @ solved[:, 0])
    a = solved[:, 0] - solved[:, 1:] @ offset
    used = weight > 0
    fit = float(b @ a + right @ offset - weight @ y**2)
    logdet = blocks.factor(prior, s.add.b).logdet - factor.logdet - float(np.linalg.slogdet(schur)[1])
    logdet += float(np.log(weight[used] / (2 * np.pi)).sum()) - 2 * s.count * np.log(SCALE_SPREAD)
    return _Posterior(a, offset, factor, 0.5 * (fit + logdet))


def fit(
    xy: Float,
    log_l: Float,
    sigma: Float,
    texton: Int,
    trust: Float,
    spacing: float,
    detail: float,
    tuned: Float | None = None,
) -> Irradiance:
    """Field and texton offsets from log irradiances; smoothness and noise of greatest evidence, robust.

    Parameters
    ----------
    xy, log_l, sigma : (N, 2), (N,), (N,)
        positions in px, log L_i and its standard deviation.
    texton : (N,) integers 0 … K − 1
        every one of which has a member with positive `trust` (N,), 0…1.
    spacing, detail
        px of the cells in which instances are pooled to find the smoothness; the grid's spacing is `detail` of that.
    tuned
        smoothness and noise of another fit, to be used as they are.
    """
    margin = 2 * spacing
    grid = spline.cover(xy.min(0) - margin, xy.max(0) + margin, detail * spacing)
    count = int(texton.max()) + 1
    full = _system(grid, xy, texton, count)
    cells = pooling.cells(xy, spacing)
    centre = np.array([np.median(log_l[(texton == k) & (trust > 0)]) for k in range(count)])
    y = log_l - centre[texton]  # near zero, so that the weak priors are neutral
    base = trust / sigma**2
    robust = np.ones(len(xy))
    x = np.log([10.0, spacing, 1.0]) if tuned is None else tuned  # strength, reach, noise factor
    for k in range(3):
        weight = base * robust / float(np.exp(x[2]))
        post = _posterior(full, y, weight, *np.exp(x[:2]))
        # What the other instances predict: a lone bright instance must not carry its own field.
        spread = blocks.covariance(
            blocks.selected_inverse(post.factor), full.index, full.stencil[:, None], full.stencil[:, None]
        )[:, 0, 0]
        r = (y - full.values(post.a) - post.offset[texton]) / np.maximum(1 - weight * spread, 0.05)
        robust = (FREEDOM + 1) / (FREEDOM + r**2 * base / trust.clip(1e-9) / (np.exp(x[2]) + base * spread))
        if k < 2 and tuned is None:
            x = _tune(grid, xy, y - post.offset[texton], base * robust, cells, x)
    post = _posterior(full, y, base * robust / float(np.exp(x[2])), *np.exp(x[:2]))
    return Irradiance(
        grid, post.a, post.offset + centre, robust * trust, float(np.exp(x[2])), post.evidence, post.factor, x
    )


def _tune(grid: spline.Grid, xy: Float, y: Float, weight: Float, cells: Int, x: Float) -> Float:
    """(log) strength, reach and noise factor of greatest evidence for data on one scale, pooled in `cells` (N,)."""
    total = np.bincount(cells, weight)
    node_y = np.bincount(cells, weight * y) / total
    node_xy = np.stack([np.bincount(cells, weight * xy[:, k]) / total for k in range(2)], 1)
    s = _system(grid, node_xy, np.zeros(len(node_xy), np.int64), 0)

    def score(x: Float) -> float:
        strength, reach, noise = map(float, np.exp(x))
        if not (1e-4 < strength < 1e5 and 0.05 * grid.spacing < reach < 0.6 * grid.spacing * max(grid.cells)):
            return -np.inf
        # Members of one cell share their errors (the print, the shadow's edge): more of them do not help without end.
        return _posterior(s, node_y, 1 / (noise / total + POOLED_FLOOR**2), strength, reach).evidence

    pace = np.array([1.4, 1.0, 0.7])
    for _ in range(3):
        x, moved = climb(score, x, pace)
        pace = pace if moved else pace / 2
    return x
