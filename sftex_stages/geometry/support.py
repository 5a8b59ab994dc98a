"""The dense surface: height, normals, their uncertainty, and where measurements support them."""

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sftex_stages.geometry import blocks, gaussian, spline, tensors

Float = NDArray[np.float64]

REACH = 1.5  # local spacings of instances that a measurement speaks for
WORST = 20.0  # degrees; a normal less certain than this is not reported


def local_spacing(xy: Float, spacing: float) -> Float:
    """Distance (N,) to the third neighbour, within a factor of two of the mean `spacing`: larger where instances are rare."""
    near = cKDTree(xy).query(xy, min(4, len(xy)))[0][:, -1]
    return np.clip(near, 0.5 * spacing, 2 * spacing)


def supported(xy: Float, spacing: float, at: Float) -> Float:
    """Distance (P,) of points `at` (P, 2) from the nearest instance, in that instance's reach; ≤ 1 is supported."""
    reach = REACH * local_spacing(xy, spacing)
    distance, near = cKDTree(xy).query(at, min(6, len(xy)))
    distance, near = distance.reshape(len(at), -1), near.reshape(len(at), -1)
    return (distance / reach[near]).min(1)


def dense(
    f: gaussian.Field, a: Float, factor: blocks.Factor, shape: tuple[int, int], xy: Float, spacing: float
) -> dict[str, NDArray]:
    """Maps of an image of `shape` (H, W): `height` px, `normals` (H, W, 3), `sigma` degrees, `supported`.

    Height and gradient are exact at every pixel; what varies slowly (variance, support) is evaluated on a coarse raster
    and interpolated.
    """
    rows, columns = np.arange(shape[0], dtype=float), np.arange(shape[1], dtype=float)
    g = np.stack([spline.evaluate(f.grid, a, columns, rows, *d) for d in ((1, 0), (0, 1))], -1)
    pace = max(spacing / 3, 1.0)
    at_x, at_y = (np.linspace(0, n - 1, max(int(np.ceil((n - 1) / pace)) + 1, 2)) for n in (shape[1], shape[0]))
    points = np.stack(np.meshgrid(at_x, at_y), -1).reshape(-1, 2)
    slope = np.stack([spline.evaluate(f.grid, a, at_x, at_y, *d) for d in ((1, 0), (0, 1))], -1).reshape(-1, 2)
    spread = covariance_at(f.grid, factor, points)
    sigma = np.degrees(tensors.angular_error(slope, spread)).reshape(len(at_y), len(at_x))
    far = supported(xy, spacing, points).reshape(sigma.shape)
    sigma, far = (_enlarge(v, shape) for v in (sigma, far))
    return {
        "height": spline.evaluate(f.grid, a, columns, rows),
        "normals": tensors.normals(g),
        "sigma": sigma,
        "supported": (far <= 1) & (sigma <= WORST),
    }


def covariance_at(grid: spline.Grid, factor: blocks.Factor, xy: Float) -> Float:
    """Posterior covariance (N, 2, 2) of the gradient at any `xy` (N, 2) px."""
    index, p = spline.stencil(grid, xy, 1, 0)
    stencil = np.stack((p, spline.stencil(grid, xy, 0, 1)[1]), 1)
    inverse = blocks.selected_inverse(factor)
    parts = range(0, len(xy), 4096)  # 256 numbers a point: bounded memory
    return np.concatenate(
        [blocks.covariance(inverse, index[k : k + 4096], stencil[k : k + 4096], stencil[k : k + 4096]) for k in parts]
    )


def _enlarge(coarse: Float, shape: tuple[int, int]) -> Float:
    """Bilinear interpolation of a raster whose corners lie on the corners of an image of `shape`."""
    x = np.linspace(0, coarse.shape[1] - 1, shape[1], dtype=np.float32)
    y = np.linspace(0, coarse.shape[0] - 1, shape[0], dtype=np.float32)
    grid_x, grid_y = np.meshgrid(x, y)
    return cv2.remap(coarse.astype(np.float32), grid_x, grid_y, cv2.INTER_LINEAR)
