"""Where a surface is rougher than elsewhere: the prior of `spline.py` with a factor of its own in every part of the grid.

One roughness for all irons a fold out to be right about the flat cloth beside it, and lets flat cloth wave to be right about
the fold. Here the energies E2 and E3 of square blocks of cells are multiplied by λ_b, whose prior is a gamma distribution of
mean 1: the surface's derivatives are Student distributed then, as a crease or a depth edge among smooth folds asks for. Given
the surface,

    E[λ_b] = (ν + n_b) / (ν + l2 E2_b + l3 E3_b),

n_b the cells of the block, E_b its expected energy (the mean surface's, and that of the posterior's own spread). By turns with
the surface this is mean-field inference for a scale mixture (Tipping & Lawrence, Neurocomputing 69, 2005).
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import digamma, gammaln

from sftex_stages.geometry import blocks, gaussian, spline

Float = NDArray[np.floating]
Int = NDArray[np.integer]

BLOCK = 3  # cells along a block's side: about three nodes of the sign search
FREEDOM = 6.0  # ν; few cells of a block would else be taken at their word


class Roughness(NamedTuple):
    """Factors λ (B,) of the blocks, and what the bound of the evidence has beyond the evidence at λ, nats: their cost."""

    factor: Float
    bound: float


def cells(grid: spline.Grid) -> tuple[Int, Int]:
    """Coefficient numbers (C, 16) of all cells of a grid, and the block (C,) that each is in, from 0."""
    outer, inner = (g.ravel() for g in np.indices((grid.cells[grid.outer], grid.cells[1 - grid.outer])))
    k = np.arange(4)
    index = (outer[:, None] + k)[:, :, None] * grid.shape[1] + (inner[:, None] + k)[:, None, :]
    across = -(-grid.cells[1 - grid.outer] // BLOCK)
    return index.reshape(-1, 16), outer // BLOCK * across + inner // BLOCK


def cell_energy(grid: spline.Grid, order: int) -> Float:
    """Matrix (16, 16) of the energy E_m of one cell: all cells have the same."""
    return np.asarray(spline.energy(replace(grid, cells=(1, 1)), order).todense())


def shaped(f: gaussian.Field, factor: Float | None) -> gaussian.Field:
    """The field with the energies of its prior multiplied by `factor` (B,) block by block; None: as it is."""
    if factor is None:
        return f
    index, block = cells(f.grid)
    add = gaussian.scatter(f.grid, index)
    local = [add(factor[block][:, None, None] * cell_energy(f.grid, m)) for m in (2, 3)]
    return replace(f, energies=(*f.energies[:2], *local), logdets={})


def learn(f: gaussian.Field, a: Float, factor: blocks.Factor, smooth: gaussian.Smoothness) -> Roughness:
    """Factors of the blocks for the posterior of mean `a` (M,) and precision `factor`, under the prior `smooth` over all."""
    index, block = cells(f.grid)
    energy = smooth.strength * (cell_energy(f.grid, 2) + smooth.reach**2 * cell_energy(f.grid, 3))
    inverse, unit = blocks.selected_inverse(factor), np.eye(16)[None]
    found = np.einsum("ci,ij,cj->c", a[index], energy, a[index])
    for at in (slice(k, k + blocks.CHUNK) for k in range(0, len(index), blocks.CHUNK)):
        every = np.broadcast_to(unit, (len(index[at]), 16, 16))
        found[at] += np.einsum("cij,ij->c", blocks.covariance(inverse, index[at], every, every), energy)
    number = np.bincount(block).astype(float)
    prior, shape = FREEDOM / 2, (FREEDOM + number) / 2
    rate = (FREEDOM + np.bincount(block, found)) / 2
    apart = (shape - prior) * digamma(shape) - gammaln(shape) + gammaln(prior)
    apart += prior * np.log(rate / prior) + shape * (prior - rate) / rate
    blurred = 0.5 * number * (digamma(shape) - np.log(shape))  # E log λ for log E λ in the prior's determinant
    return Roughness(shape / rate, float((blurred - apart).sum()))
