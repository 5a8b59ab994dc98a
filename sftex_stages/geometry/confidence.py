"""How far the surface may be off, beyond what the linear model says of itself.

The posterior takes errors as independent and of one size everywhere. They are neither: all instances of a texton share what
its frontal frame and its registration got wrong; where elements are small against a fold they are not flat, on a rim not
modelled at all. The instances themselves show it, by their residuals against the surface:

- texton by texton, in what each moves the surface (the cluster-robust covariance of Liang & Zeger 1986: `influence`);
- nearby, in their scatter (the noise there) and in their mean (what the surface does not follow).

What all textons have wrong together shows in no residual; `calibration.py` estimates it.
"""

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sftex_stages.geometry import blocks, gaussian, perspective, pooling, refine, spline, tensors

Float = NDArray[np.floating]
Int = NDArray[np.integer]

NEAR = 24  # instances that speak for a place
UPPER_QUARTILE = float(np.log(4.0))  # of half a chi-square of two degrees of freedom
NOISE_FACTORS = (0.005, 20.0)
# Textons on one printed motif err together, so that half as many are independent; the posterior's own share also stands for
# what lies between instances; of what instances nearby err in common half is their own (they often lie on one motif), and half
# the surface's. Round numbers, the same for all images; chosen among some forty settings on twelve images.
TEXTONS, POSTERIOR, MISFIT = 2.0, 1.5, 0.5
CHUNK = 4096  # places at a time: bounded memory


@dataclass(frozen=True)
class Errors:
    """Instances believed: places `xy` (N, 2), residuals of w (N, 2), half their squares over the stated variance (N,); the
    standard deviation of w that all textons share; `influence` (M, K) of the textons on the surface's coefficients, and the
    surface's grid, camera and selected inverse (`blocks.py`)."""

    xy: Float
    residual: Float
    chi2: Float
    common: float
    influence: Float
    grid: spline.Grid
    inverse: tuple[Float, Float]
    camera: perspective.Camera = perspective.ORTHOGRAPHIC


def residuals(w: Float, covariance: Float, g: Float) -> tuple[Float, Float]:
    """Residuals (N, 2) of w (N, 2) against slopes `g` (N, 2), and half their squares over the stated variance (N,)."""
    residual = w - tensors.predict(g)[0]
    return residual, np.einsum("ni,nij,nj->n", residual, np.linalg.inv(covariance), residual) / 2


def influence(f: gaussian.Field, solution: refine.Solution, nodes: pooling.Nodes, residual: Float, texton: Int) -> Float:
    """By how much each texton's residuals move the surface: coefficients (M, K), whose squares add up to a covariance.

    Parameters
    ----------
    f, solution
        the field at the nodes, and the surface refined on them.
    residual, texton : (N, 2), (N,)
        of w against the surface, and number, of the instances that the nodes were pooled from.
    """
    used = np.flatnonzero(nodes.member >= 0)
    node = nodes.member[used]
    group: Int = np.unique(texton[used], return_inverse=True)[1]
    if group.max() == 0:  # a single texton: its nodes have to do
        group = node
    count = int(group.max()) + 1
    jacobian = tensors.predict(solution.gradient)[1]
    precision = np.linalg.inv(nodes.covariance) * (solution.weight / solution.noise)[:, None, None]
    gain = np.swapaxes(jacobian, 1, 2) @ precision
    pull = np.einsum("nij,njk,nk->ni", gain[node], nodes.share[used], residual[used])
    value = np.einsum("npk,np->nk", f.stencil[node], pull)
    place = (f.index[node] * count + group[:, None]).ravel()
    right = np.bincount(place, value.ravel(), f.grid.size * count).astype(float, copy=False)
    moved = blocks.solve(solution.factor, right.reshape(f.grid.size, count))
    return np.asarray(moved * np.sqrt(count / max(count - 1, 1)))


def spread(e: Errors, at: Float, g: Float) -> Float:
    """Covariance (P, 2, 2) to expect of slopes `g` (P, 2) relative to the rays of `at` (P, 2) px."""
    tree = cKDTree(e.xy) if len(e.xy) else None
    parts = [_spread(e, tree, at[k : k + CHUNK], g[k : k + CHUNK]) for k in range(0, len(at), CHUNK)]
    return np.concatenate(parts) if parts else np.zeros((0, 2, 2))


def _spread(e: Errors, tree: cKDTree | None, at: Float, g: Float) -> Float:
    index, stencil = e.camera.stencil(e.grid, at)
    posterior = blocks.covariance(e.inverse, index, stencil, stencil)
    if tree is None:
        return POSTERIOR * posterior + tensors.common_error(g, e.common)
    near = tree.query(at, min(NEAR, len(e.xy)))[1].reshape(len(at), -1)
    noise = np.clip(np.quantile(e.chi2[near], 0.75, axis=1) / UPPER_QUARTILE, *NOISE_FACTORS)
    misfit = MISFIT * np.sqrt((np.median(e.residual[near], axis=1) ** 2).mean(1))
    rows = np.arange(0, 2 * index.size + 1, 16)
    design = sp.csr_matrix((stencil.ravel(), np.repeat(index, 2, 0).ravel(), rows), shape=(2 * len(at), e.grid.size))
    moved = np.asarray(design @ e.influence).reshape(len(at), 2, -1)
    shared = TEXTONS * moved @ np.swapaxes(moved, 1, 2)
    own = POSTERIOR * noise[:, None, None] * posterior
    return np.asarray(shared + own + tensors.common_error(g, np.hypot(misfit, e.common)))
