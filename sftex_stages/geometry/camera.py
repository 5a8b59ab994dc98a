"""The camera: a pinhole, or orthography as its limit. The rays that it sees along, and what they make of slopes and normals.

With range r along the ray of image point x, h(x) = −f log r takes the place of height. On the unit sphere of rays, with
u the direction away from the principal point and cos the cosine of the ray's angle with the axis:

- an image transform T is what that sphere shows, stretched: F T with F = I + (cos − 1) u uᵀ is the element as seen along its
  own ray, up to scale;
- the gradient relative to the ray is K grad h, K = (I + (1/cos − 1) u uᵀ) / cos, and the normal there is ∝ (−K grad h, 1).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sftex_stages.geometry import spline

Float = NDArray[np.floating]


@dataclass(frozen=True)
class Camera:
    """Principal point (x, y) px and 1/f in 1/px, 0 for orthography."""

    centre: tuple[float, float]
    bend: float

    def rays(self, xy: Float) -> tuple[Float, Float]:
        """Unit directions u (…, 2) away from the principal point and cosines (…,) of the rays of `xy` (…, 2) px."""
        offset = (np.asarray(xy, float) - self.centre) * self.bend
        t = np.linalg.norm(offset, axis=-1)
        u = np.where(t[..., None] > 1e-12, offset / np.maximum(t, 1e-12)[..., None], np.array([1.0, 0.0]))
        return u, 1 / np.sqrt(1 + t**2)

    def flatten(self, xy: Float) -> Float:
        """F (N, 2, 2): takes image transforms to what the rays see."""
        u, cosine = self.rays(xy)
        return np.eye(2) + (cosine - 1)[:, None, None] * u[:, :, None] * u[:, None, :]

    def stretch(self, xy: Float) -> Float:
        """K (N, 2, 2): takes image gradients of h to slopes relative to the ray."""
        u, cosine = self.rays(xy)
        k = np.eye(2) + (1 / cosine - 1)[:, None, None] * u[:, :, None] * u[:, None, :]
        return k / cosine[:, None, None]

    def stencil(self, grid: spline.Grid, xy: Float) -> tuple[NDArray[np.integer], Float]:
        """Coefficient numbers (N, 16) and weights (N, 2, 16) of the slope relative to the ray at `xy` (N, 2) px."""
        index, p = spline.stencil(grid, xy, 1, 0)
        both = np.stack((p, spline.stencil(grid, xy, 0, 1)[1]), 1)
        return index, both if self.bend == 0 else self.stretch(xy) @ both

    def slopes_of(self, grid: spline.Grid, a: Float, xy: Float) -> Float:
        """Slopes (N, 2) relative to the rays of `xy` (N, 2) px, of the surface of coefficients `a` (M,)."""
        index, stencil = self.stencil(grid, xy)
        return np.einsum("npk,nk->np", stencil, a[index])

    def slopes(self, xy: Float, g: Float) -> Float:
        """K g (…, 2) of gradients g (…, 2) at `xy` (…, 2)."""
        u, cosine = self.rays(xy)
        along = (u * g).sum(-1) * (1 / cosine - 1)
        return (g + along[..., None] * u) / cosine[..., None]

    def turn(self, xy: Float, normal: Float) -> Float:
        """Normals (…, 3) relative to the rays of `xy` (…, 2) in the camera's frame, by the smallest rotation."""
        if self.bend == 0:
            return normal
        u, cosine = self.rays(xy)
        sine = np.sqrt(np.maximum(1 - cosine**2, 0))
        along = (u * normal[..., :2]).sum(-1)
        # The ray toward the camera is (−sine u, cosine): what lay along z comes to lie along it.
        radial = cosine * along - sine * normal[..., 2]
        z = sine * along + cosine * normal[..., 2]
        return np.concatenate((normal[..., :2] + (radial - along)[..., None] * u, z[..., None]), -1)

    def height(self, xy: Float, h: Float) -> Float:
        """Height z (…,) px toward the camera of h (…,): px as they are at the distance f, where h is 0 on the axis."""
        if self.bend == 0:
            return h
        return (1 - np.exp(-h * self.bend) * self.rays(xy)[1]) / self.bend


ORTHOGRAPHIC = Camera((0.0, 0.0), 0.0)
