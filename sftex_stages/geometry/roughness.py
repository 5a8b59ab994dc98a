"""Where a surface is rougher than elsewhere: the prior of `spline.py` with a factor of its own in every part of the grid.

One roughness for all irons a fold out to be right about the flat cloth beside it, and lets flat cloth wave to be right about
the fold. Here the energies E2 and E3 of every cell are multiplied by λ = λ_B λ_b, one factor for the large block that it is in
and one for the small: a fold is rough as a whole, a crease in it more so. The factors' priors are gamma distributions of mean
1: the surface's derivatives are Student distributed then, as a crease or a depth edge among smooth folds asks for. Given the
surface,

    E[λ_b] = (ν + n_b) / (ν + Σ_b E[λ_B] E),   E[λ_B] alike,

n_b the cells of the block, E a cell's expected energy l2 E2 + l3 E3 (the mean surface's, and that of the posterior's own
spread). By turns with the surface this is mean-field inference for a scale mixture (Tipping & Lawrence, Neurocomputing 69,
2005).
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import digamma, gammaln

from sftex_stages.geometry import blocks, gaussian, spline

Float = NDArray[np.floating]
Int = NDArray[np.integer]

BLOCKS = (9, 3)  # cells along a block's side
FREEDOM = 6.0  # ν; few cells of a block would else be taken at their word
SWEEPS = 8  # of the levels in turn


class Roughness(NamedTuple):
    """Factors λ (C,) of the cells, what the bound of the evidence has beyond the evidence at λ, nats: their cost; and the field
    with that prior."""

    factor: Float
    bound: float
    field: gaussian.Field


def squares(grid: spline.Grid, side: int) -> Int:
    """The block (C,), from 0, of `side` by `side` cells that each cell of a grid is in."""
    outer, inner = spline.places(grid)
    across = -(-grid.cells[1 - grid.outer] // side)
    return outer // side * across + inner // side


def cell_energy(grid: spline.Grid, order: int) -> Float:
    """Matrix (16, 16) of the energy E_m of one cell: all cells have the same."""
    return np.asarray(spline.energy(replace(grid, cells=(1, 1)), order).todense())


def energies(f: gaussian.Field) -> tuple[Float, Float]:
    """E2 and E3 of every cell, (C, 16, 16) each."""
    if f.cells is not None:
        return f.cells
    count = int(np.prod(f.grid.cells))
    second, third = (np.broadcast_to(cell_energy(f.grid, m), (count, 16, 16)) for m in (2, 3))
    return second, third


def shaped(f: gaussian.Field, factor: Float) -> gaussian.Field:
    """The field with the energies of its cells multiplied by `factor` (C,)."""
    add = gaussian.scatter(f.grid, spline.cells(f.grid))
    local = [add(factor[:, None, None] * e) for e in energies(f)]
    return replace(f, energies=(*f.energies[:2], *local), logdets={})


def learn(f: gaussian.Field, a: Float, factor: blocks.Factor, smooth: gaussian.Smoothness) -> Roughness:
    """Factors of the cells for the posterior of mean `a` (M,) and precision `factor`, under the prior `smooth` over all."""
    index, (second, third) = spline.cells(f.grid), energies(f)
    inverse, unit = blocks.selected_inverse(factor), np.eye(16)[None]
    found = np.empty(len(index))
    for at in (slice(k, k + blocks.CHUNK) for k in range(0, len(index), blocks.CHUNK)):
        every = np.broadcast_to(unit, (len(index[at]), 16, 16))
        moment = blocks.covariance(inverse, index[at], every, every)
        moment += a[index[at]][:, :, None] * a[index[at]][:, None, :]
        energy = smooth.strength * (second[at] + smooth.reach**2 * third[at])
        found[at] = np.einsum("cij,cij->c", moment, energy)
    levels = [squares(f.grid, side) for side in BLOCKS]
    number = [np.bincount(level).astype(float) for level in levels]
    mean = np.ones((len(levels), len(index)))
    prior = FREEDOM / 2
    shape, rate = [prior + n / 2 for n in number], [prior + n / 2 for n in number]
    for _ in range(SWEEPS):
        for k, level in enumerate(levels):
            others = np.delete(mean, k, 0).prod(0)
            rate[k] = prior + np.bincount(level, others * found) / 2
            mean[k] = (shape[k] / rate[k])[level]
    bound = sum(_bound(n, s, r) for n, s, r in zip(number, shape, rate, strict=True))
    product = mean.prod(0)
    field = shaped(f, product)
    while product.max() > 1 and not gaussian.holds(field, smooth):
        product = np.minimum(product, max(product.max() / 2, 1.0))
        field = shaped(f, product)
    return Roughness(product, bound, field)


def _bound(number: Float, shape: Float, rate: Float) -> float:
    """What gamma distributed factors (B,) of that shape and rate, of blocks of `number` cells, add to the bound."""
    prior = FREEDOM / 2
    apart = (shape - prior) * digamma(shape) - gammaln(shape) + gammaln(prior)
    apart += prior * np.log(rate / prior) + shape * (prior - rate) / rate
    blurred = 0.5 * number * (digamma(shape) - np.log(shape))  # E log λ for log E λ in the prior's determinant
    return float((blurred - apart).sum())
