"""The two-fold sign of every instance, with the surface integrated out.

Let the field have gradient design B, prior precision P, and let instance i measure `s_i d_i` with precision W_i, s_i = ±1.
For known signs the surface is Gaussian; integrating it out leaves an energy of the signs alone,

    E(s) = −½ sᵀ K s − hᵀ s + const,     K = Dᵀ W B A⁻¹ Bᵀ W D,  A = Bᵀ W B + P,

with D = diag(d_i) and `h` whatever else speaks about single signs (shading). No surface can get stuck in it.
`K` is never formed: a product with it is one banded solution. Measured heights y of precision R (element sizes under
perspective) with design V enter A as Vᵀ R V, and h as D W B A⁻¹ Vᵀ R y: they tell signs where they lift the surface.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.linalg import LinearOperator, eigsh

from sftex_stages.geometry import blocks, gaussian

Float = NDArray[np.floating]

DAMPING = 0.6  # share of the new mean in a parallel mean-field step; 1 oscillates


@dataclass(frozen=True)
class Coupling:
    """K of the collapsed energy: `pull` (N, 2) = W_i d_i, its diagonal `own` (N,), `log_det` = log det P / det A; the surface
    `raised` (M,) that measured heights make by themselves, and the field `lift` (N,) that it is on the signs."""

    field: gaussian.Field
    factor: blocks.Factor
    pull: Float
    own: Float
    log_det: float
    raised: Float
    lift: Float


def coupling(
    field: gaussian.Field,
    d: Float,
    weight: Float,
    smooth: gaussian.Smoothness,
    height: gaussian.Heights | None = None,
) -> Coupling:
    """The coupling of gradients `d` (N, 2) with precisions `weight` (N, 2, 2), and of measured heights, if there are any."""
    factor = gaussian.posterior(field, weight, gaussian.prior(field, smooth), None if height is None else height.precision)
    pull = np.einsum("nij,nj->ni", weight, d)
    variance = gaussian.gradient_covariance(field, factor)
    own = np.einsum("ni,nij,nj->n", pull, variance, pull)
    log_det = gaussian.prior_logdet(field, smooth) - factor.logdet
    if height is None:
        return Coupling(field, factor, pull, own, log_det, np.zeros(field.grid.size), np.zeros(len(d)))
    raised = blocks.solve(factor, gaussian.lifted(field, height.precision * height.value))
    lift = (pull * gaussian.gradients(field, raised)).sum(1)
    return Coupling(field, factor, pull, own, log_det, raised, lift)


def surface_of(c: Coupling, m: Float) -> Float:
    """Mean surface coefficients (M, …) for mean signs `m` (N, …)."""
    return _bent(c, m) + c.raised.reshape(-1, *(1,) * (m.ndim - 1))


def _bent(c: Coupling, m: Float) -> Float:
    signed = m[:, None] * c.pull.reshape(c.pull.shape + (1,) * (m.ndim - 1))
    return blocks.solve(c.factor, gaussian.pulled(c.field, signed))


def product(c: Coupling, m: Float) -> Float:
    """K m for `m` (N,) or (N, S)."""
    return np.einsum("ni...,ni->n...", gaussian.gradients(c.field, _bent(c, m)), c.pull)


def energies(c: Coupling, s: Float, bias: Float) -> Float:
    """E(s) without its constant, in nats, of patterns `s` (N, S) under fields `bias` (N, S)."""
    return -0.5 * (s * product(c, s)).sum(0) - (s * bias).sum(0)


def spectral_starts(c: Coupling, count: int) -> Float:
    """Signs (N, count) of the leading eigenvectors of K."""
    n = len(c.own)
    count = min(count, n - 1)
    operator = LinearOperator((n, n), matvec=lambda v: product(c, np.asarray(v).ravel()), dtype=np.float64)
    vectors = eigsh(operator, k=count, v0=np.ones(n), tol=1e-2)[1][:, ::-1]
    return np.where(vectors < 0, -1.0, 1.0)


def anneal(c: Coupling, start: Float, bias: Float, betas: Float) -> Float:
    """Mean-field annealing of mean signs `start` (N, S) at inverse temperatures `betas`; mean signs (N, S)."""
    m = np.array(start, dtype=float)
    for beta in betas:
        local = product(c, m) - c.own[:, None] * m + bias
        m += DAMPING * (np.tanh(beta * local) - m)
    return m


def descend(c: Coupling, start: Float, bias: Float, sweeps: int = 200) -> Float:
    """Greedy flips until none lowers the energy: patterns (N, S) from `start` (N, S).

    Each sweep flips the best sites of every pattern; if together they do not help, only the single best one, which must.
    """
    s = np.where(start < 0, -1.0, 1.0)
    pick = np.arange(s.shape[1])
    share = np.full(s.shape[1], 0.5)
    energy = energies(c, s, bias)
    for _ in range(sweeps):
        gain = -s * (product(c, s) - c.own[:, None] * s + bias)  # > 0: flipping lowers the energy by twice this
        best = gain.max(0)
        if (best <= 1e-9).all():
            break
        flip = (gain > 1e-9) & (gain >= (1 - share) * best)
        flip[gain.argmax(0), pick] = best > 1e-9
        trial = np.where(flip, -s, s)
        after = energies(c, trial, bias)
        worse = after > energy
        single = np.zeros_like(flip)
        single[gain.argmax(0), pick] = best > 1e-9
        trial[:, worse] = np.where(single, -s, s)[:, worse]
        after[worse] = (energy - 2 * np.maximum(best, 0))[worse]
        share = np.where(worse, share / 4, np.minimum(share * 1.5, 0.95))
        s, energy = trial, after
    return s


def flip_regions(c: Coupling, s: Float, bias: Float, region: NDArray[np.integer]) -> Float:
    """Cluster moves: the best signs (N,) that differ from `s` (N,) by whole regions (N,) numbered 0 … R − 1.

    The energy of region signs t is an R-spin problem of the same form; greedy descent of it from `s` and from each
    single region flipped.
    """
    count = int(region.max()) + 1
    member = np.zeros((len(s), count))
    member[np.arange(len(s)), region] = s
    k = member.T @ product(c, member)
    h = member.T @ bias
    own = np.diag(k)
    t = np.concatenate((np.ones((count, 1)), 1 - 2 * np.eye(count)), 1)
    pull = k @ t
    for _ in range(20 * count):
        gain = -t * (pull - own[:, None] * t + h[:, None])
        site = gain.argmax(0)
        moved = np.flatnonzero(gain[site, np.arange(t.shape[1])] > 1e-9)
        if len(moved) == 0:
            break
        site = site[moved]
        t[site, moved] *= -1
        pull[:, moved] += 2 * k[:, site] * t[site, moved]
    energy = -0.5 * (t * (k @ t)).sum(0) - h @ t
    return s * t[region, energy.argmin()]
