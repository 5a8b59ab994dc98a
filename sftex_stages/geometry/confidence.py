"""How far the surface may be off, beyond what the linear model says of itself.

The posterior takes errors as independent and of one size everywhere. They are neither: all instances of a texton share what
its frontal frame and its registration got wrong; where elements are small against a fold they are not flat, on a rim not
modelled at all. The instances themselves show it, by their residuals against the surface:

- texton by texton, in what each moves the surface (the cluster-robust covariance of Liang & Zeger 1986);
- nearby, in their scatter (the noise there) and in their mean (what the surface does not follow).

And the posterior is as right as its prior: all but exact on a round body, whose smoothness reaches over all of the image, less
so on folds, where it reaches over a few nodes.

What all textons have wrong together shows in no residual; `calibration.py` estimates it. It is taken through the fit as well:
where the surface faces the camera a tensor hardly says how it leans, and its error there is that of the places around.

Under perspective the focal length is known only so well: what the surface would be under another goes in as it is.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sftex_stages.geometry import blocks, pooling, refine, spline, tensors
from sftex_stages.geometry.camera import ORTHOGRAPHIC, Camera

Float = NDArray[np.floating]
Int = NDArray[np.integer]

NEAR, WIDE = 24, 256  # instances that speak for a place; and for its surroundings
UPPER_QUARTILE = float(np.log(4.0))  # of half a chi-square of two degrees of freedom
NOISE_FACTORS = (0.005, 20.0)
# Textons on one printed motif err together, so that fewer are independent; what instances nearby err in common tells half of
# what they may have in common everywhere. Round numbers, the same for all images; chosen among some hundred settings on the
# benchmark's images and sixty-eight scenes drawn at random.
TEXTONS, MISFIT = 1.5, 0.5
# Reach of smoothness, in spacings of nodes, at which the posterior is taken as it is; its variance falls with the root of the
# reach, and no more is made of one under the second.
REACH, SHORT = 6.0, 4.0
CHUNK = 4096  # places at a time: bounded memory


@dataclass(frozen=True)
class Other:
    """The surface, coefficients `a` (M,), under another `camera` that may as well be the right one."""

    camera: Camera
    a: Float


@dataclass(frozen=True)
class Errors:
    """Of instances believed the places `xy` (N, 2) and half the squared residuals over the stated variance (N,); `influence`
    (M, K) of errors that instances share; the surface's grid, selected inverse (`blocks.py`), `reach` of its smoothness, in
    spacings of nodes, and camera."""

    xy: Float
    chi2: Float
    influence: Float
    grid: spline.Grid
    inverse: tuple[Float, Float]
    reach: float = REACH
    camera: Camera = ORTHOGRAPHIC
    other: Other | None = None

    @cached_property
    def tree(self) -> cKDTree:
        return cKDTree(self.xy)

    def noise(self, at: Float) -> Float:
        """Factor (P,) on the stated noise that the residuals show about `at` (P, 2): of those next to it and of those in the
        surroundings, the geometric mean. What few of them show is itself uncertain."""
        near = self.tree.query(at, min(WIDE, len(self.xy)))[1].reshape(len(at), -1)
        shown = [np.quantile(self.chi2[near[:, :k]], 0.75, axis=1) / UPPER_QUARTILE for k in (NEAR, WIDE)]
        return np.clip(np.sqrt(shown[0] * shown[1]), *NOISE_FACTORS)


def residuals(w: Float, covariance: Float, g: Float) -> tuple[Float, Float]:
    """Residuals (N, 2) of w (N, 2) against slopes `g` (N, 2), and half their squares over the stated variance (N,)."""
    residual = w - tensors.predict(g)[0]
    return residual, np.einsum("ni,nij,nj->n", residual, np.linalg.inv(covariance), residual) / 2


def misfit(xy: Float, residual: Float) -> float:
    """Root mean square, over the image, of what instances nearby, at `xy` (N, 2) with residuals (N, 2) of w, err in common."""
    at = xy[:: max(1, len(xy) // CHUNK)]
    near = cKDTree(xy).query(at, min(NEAR, len(xy)))[1].reshape(len(at), -1)
    return float(np.sqrt((np.median(residual[near], axis=1) ** 2).mean()))


def influence(
    solution: refine.Solution, nodes: pooling.Nodes, residual: Float, texton: Int, shear: Float, xy: Float
) -> Float:
    """By how much what instances have wrong together moves the surface: coefficients (M, K), whose squares add up to a
    covariance. Columns: the residuals of each texton; S of the `shear` of all; two of a shift of w, by half the `misfit`.

    Parameters
    ----------
    solution
        the surface refined on the nodes.
    residual, texton, xy : (N, 2), (N,), (N, 2)
        of w against the surface, number, and place, of the instances that the nodes were pooled from.
    shear : (N, 2, S)
        what w may be off by in all of them together, in S independent ways.
    """
    used = np.flatnonzero(nodes.member >= 0)
    node = nodes.member[used]
    f, jacobian = solution.field, tensors.predict(solution.gradient)[1]
    precision = np.linalg.inv(nodes.covariance) * (solution.weight / solution.noise)[:, None, None]
    gain = (np.swapaxes(jacobian, 1, 2) @ precision)[node] @ nodes.share[used]

    def moved(change: Float, group: Int) -> Float:
        """The coefficients (M, G), one column a group, that changes of w (n, 2) at the instances used add."""
        count = int(group.max()) + 1
        value = np.einsum("npk,npj,nj->nk", f.stencil[node], gain, change, optimize=True)
        place = (f.index[node] * count + group[:, None]).ravel()
        right = np.bincount(place, value.ravel(), f.grid.size * count).astype(float, copy=False)
        return np.asarray(blocks.solve(solution.factor, right.reshape(f.grid.size, count)))

    group: Int = np.unique(texton[used], return_inverse=True)[1]
    if group.max() == 0:  # a single texton: its nodes have to do
        group = node
    count = int(group.max()) + 1
    own = moved(residual[used], group) * np.sqrt(TEXTONS * count / max(count - 1, 1))
    shift = MISFIT * misfit(xy[used], residual[used]) * np.eye(2)
    ways = [*np.moveaxis(shear[used], 2, 0), *(np.tile(s, (len(used), 1)) for s in shift)]
    return np.concatenate((own, *(moved(change, np.zeros_like(node)) for change in ways)), 1)


def spread(e: Errors, at: Float) -> Float:
    """Covariance (P, 2, 2) to expect of the surface's slopes relative to the rays of `at` (P, 2) px."""
    parts = [_spread(e, at[k : k + CHUNK]) for k in range(0, len(at), CHUNK)]
    return np.concatenate(parts) if parts else np.zeros((0, 2, 2))


def angle(e: Errors, at: Float, g: Float, spread: Float) -> Float:
    """Root mean square angle (P,) in radians to expect of the normals of slopes `g` (P, 2) of covariance `spread` (P, 2, 2) at
    `at` (P, 2) px: in the camera's frame, and so with what the other camera makes of them."""
    own = tensors.angular_error(g, spread)
    if e.other is None:
        return own
    theirs = e.other.camera.turn(at, tensors.normals(e.other.camera.slopes_of(e.grid, e.other.a, at)))
    return np.asarray(np.hypot(own, np.linalg.norm(e.camera.turn(at, tensors.normals(g)) - theirs, axis=-1)))


def _spread(e: Errors, at: Float) -> Float:
    index, stencil = e.camera.stencil(e.grid, at)
    posterior = blocks.covariance(e.inverse, index, stencil, stencil)
    rows = np.arange(0, 2 * index.size + 1, 16)
    design = sp.csr_matrix((stencil.ravel(), np.repeat(index, 2, 0).ravel(), rows), shape=(2 * len(at), e.grid.size))
    moved = np.asarray(design @ e.influence).reshape(len(at), 2, -1)
    own = e.noise(at) * np.sqrt(REACH / max(e.reach, SHORT))
    return np.asarray(moved @ np.swapaxes(moved, 1, 2) + own[:, None, None] * posterior)
