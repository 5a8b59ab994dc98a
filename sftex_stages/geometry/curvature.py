"""The roughness prior of `spline.py` as energies of the surface, not of its height map.

E2 and E3 of a height map charge for its derivatives. Where a surface turns away these grow without end, on the roundest sphere
too: such a prior flattens rims and the flanks of folds. Integrals over the surface's own area, of its second fundamental form
II and that one's covariant derivative, do not depend on the side that it is seen from:

    E2 = ∫ |II|² dA,   II_ij = h_ij / W,   W² = 1 + |grad h|²,
    E3 = ∫ |∇II|² dA,   (∇II)_ijk = (h_ijk − p_i h_jk − p_j h_ik − p_k h_ij) / W,   p_i = h_ij h_j / W²

(do Carmo, Differential Geometry of Curves and Surfaces, 1976, sections 3-3 and 4-3; h_ij… are derivatives of h), norms in the
surface's metric. Planes are free in both, spheres and cylinders in E3. About a known surface W, the metric and p are known,
cell by cell: what is left is quadratic in the coefficients, as before, and moves along with the surface as it is refined. On
the plane h = 0 both are those of the height map.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sftex_stages.geometry import gaussian, roughness, spline, tensors
from sftex_stages.geometry.camera import Camera

Float = NDArray[np.floating]

STEEPEST = 5.0  # slope (79 degrees) at which the metric is held: beyond, a rim's slopes are guesses
SECOND, THIRD = ((2, 0), (1, 1), (0, 2)), ((3, 0), (2, 1), (1, 2), (0, 3))  # derivatives along x and y
# Which of them an entry of the symmetric tensors is
_IJ = np.add.outer(np.arange(2), np.arange(2))
_IJK = np.add.outer(_IJ, np.arange(2))


def follow(f: gaussian.Field, a: Float, camera: Camera) -> gaussian.Field:
    """The field with the prior that charges for the curvature of surfaces near that of coefficients `a` (M,)."""
    return roughness.shaped(replace(f, cells=about(f.grid, a, camera)), np.ones(int(np.prod(f.grid.cells))))


def about(grid: spline.Grid, a: Float, camera: Camera) -> tuple[Float, Float]:
    """E2 and E3 of every cell, (C, 16, 16) each, about the surface of coefficients `a` (M,).

    W, metric and p are those at the middle of the cell, of slopes relative to the rays of `camera`.
    """
    at, index = spline.centres(grid), spline.cells(grid)
    g = tensors.limit(camera.slopes_of(grid, a, at), STEEPEST)
    second = np.stack([np.einsum("ck,ck->c", spline.stencil(grid, at, *d)[1], a[index]) for d in SECOND], 1)
    w2 = 1 + (g**2).sum(1)
    p = np.einsum("cij,cj->ci", second[:, _IJ], g) / w2[:, None]
    # root of the inverse metric I − g gᵀ / W²
    root = np.eye(2) - (g[:, :, None] * g[:, None, :]) / (w2 + np.sqrt(w2))[:, None, None]
    form, change = _tensors(p)
    form = np.einsum("cia,cjb,abm->cijm", root, root, form, optimize=True).reshape(-1, 4, 3)
    change = np.einsum("cia,cjb,ckd,cabdm->cijkm", root, root, root, change, optimize=True).reshape(-1, 8, 7)
    product = _products(grid)
    return _energies(form, w2, product[:3, :3]), _energies(change, w2, product)


def _tensors(p: Float) -> tuple[Float, Float]:
    """W II (2, 2, 3) and W ∇II (C, 2, 2, 2, 7), linear in the `SECOND` and then the `THIRD` derivatives, for p (C, 2)."""
    form = np.eye(3)[_IJ]
    change = np.zeros((len(p), 2, 2, 2, 7))
    change[..., 3:] = np.eye(4)[_IJK]
    for axes in ("ci,jkm->cijkm", "cj,ikm->cijkm", "ck,ijm->cijkm"):
        change[..., :3] -= np.einsum(axes, p, form)
    return form, change


def _products(grid: spline.Grid) -> Float:
    """Integrals (7, 7, 16, 16) over a cell of the products of the `SECOND` and `THIRD` derivatives of its 16 splines."""
    node, weight = np.polynomial.legendre.leggauss(4)  # exact, as in `spline.energy`
    x, y = np.meshgrid((node + 1) / 2, (node + 1) / 2)
    at = np.array(grid.origin) + grid.spacing * np.stack((x.ravel(), y.ravel()), 1)
    area = grid.spacing**2 * np.outer(weight, weight).ravel() / 4
    splines = np.stack([spline.stencil(grid, at, *d)[1] for d in SECOND + THIRD])
    return np.einsum("dgk,egl,g->dekl", splines, splines, area, optimize=True)


def _energies(tensor: Float, w2: Float, product: Float) -> Float:
    """Energies (C, 16, 16) of tensors over W (C, …, D) of D derivatives: squares over W² on an area W, integrated."""
    square = np.swapaxes(tensor, 1, 2) @ tensor / np.sqrt(w2)[:, None, None]
    count = len(product) ** 2
    return np.asarray((square.reshape(-1, count) @ product.reshape(count, 256)).reshape(-1, 16, 16))
