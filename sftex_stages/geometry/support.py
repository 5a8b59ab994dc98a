"""The dense surface: height, normals, their uncertainty, and where measurements support them."""

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, cKDTree

from sftex_stages.geometry import confidence, spline, tensors

Float = NDArray[np.floating]

GAPS = 4.0  # reach of a measurement, in the typical (median) distance of a point from its nearest measurement
BEYOND = 0.5  # of that reach, where measurements lie on one side only: past a border, or a silhouette
ENCLOSED = 2.0  # the same where the surface is supported all around
WORST = 20.0  # degrees; a normal less certain than this is not reported


def typical_gap(xy: Float, spacing: float) -> float:
    """Median distance from the nearest of `xy` (N, 2) over the convex hull of them, px; large holes hardly count."""
    if len(xy) < 4:
        return spacing
    low, high = xy.min(0), xy.max(0)
    axes = [np.linspace(low[k], high[k], 60) for k in range(2)]
    points = np.stack(np.meshgrid(*axes), -1).reshape(-1, 2)
    sides = ConvexHull(xy, qhull_options="QJ").equations
    inside = (points @ sides[:, :2].T + sides[:, 2] <= 0).all(1)
    if not inside.any():
        return spacing
    return float(np.quantile(cKDTree(xy).query(points[inside])[0], 0.5))


def reach(xy: Float, spacing: float) -> float:
    """How far, px along the surface, measurements at `xy` (N, 2), pooled with that spacing, speak for it."""
    return GAPS * max(typical_gap(xy, spacing), 0.4 * spacing)


def distance(seen: Float, at: Float) -> Float:
    """Distance (P,) px of points `at` (P, 3) = (x, y, h) from the nearest of `seen` (N, 3), along the surface.

    In space rather than in the image: toward a rim an image pixel is a long way on the surface, and what is seen of the
    next element there says little about it.
    """
    return np.asarray(cKDTree(seen).query(at)[0])


def surrounded(xy: Float, at: Float, count: int = 24) -> NDArray[np.bool_]:
    """Whether points `at` (P, 2) lie in the convex hull of their `count` nearest of `xy` (N, 2)."""
    offset = xy[cKDTree(xy).query(at, min(count, len(xy)))[1].reshape(len(at), -1)] - at[:, None]
    angle = np.sort(np.arctan2(offset[..., 1], offset[..., 0]), 1)
    gap = np.diff(angle, axis=1, append=angle[:, :1] + 2 * np.pi)
    return np.asarray(gap.max(1) < np.pi)


def dense(
    grid: spline.Grid,
    a: Float,
    shape: tuple[int, int],
    xy: Float,
    spacing: float,
    errors: confidence.Errors,
    reach: float,
) -> dict[str, NDArray]:
    """Maps of an image of `shape` (H, W): `height` px, `normals` (H, W, 3), `sigma` degrees, `supported`, and `closable`: where
    support all around would do.

    `xy` (N, 2) are the measurements believed, which speak for the surface up to `reach` px along it, `errors` what is known
    of the surface's errors. Height and gradient are exact at every pixel; what varies slowly (variance, support) is
    evaluated on a coarse raster and interpolated.
    """
    rows, columns = np.arange(shape[0], dtype=float), np.arange(shape[1], dtype=float)
    g = np.stack([spline.evaluate(grid, a, columns, rows, *d) for d in ((1, 0), (0, 1))], -1)
    pixels = np.stack(np.meshgrid(columns, rows), -1)
    camera = errors.camera
    g = camera.slopes(pixels, g)
    pace = max(spacing / 3, 1.0)
    at_x, at_y = (np.linspace(0, n - 1, max(int(np.ceil((n - 1) / pace)) + 1, 2)) for n in (shape[1], shape[0]))
    points = np.stack(np.meshgrid(at_x, at_y), -1).reshape(-1, 2)
    slope = np.stack([spline.evaluate(grid, a, at_x, at_y, *d) for d in ((1, 0), (0, 1))], -1).reshape(-1, 2)
    slope = camera.slopes(points, slope)
    spread = confidence.spread(errors, points)
    sigma = np.degrees(confidence.angle(errors, points, slope, spread)).reshape(len(at_y), len(at_x))
    height = spline.evaluate(grid, a, at_x, at_y).ravel()
    index, stencil = spline.stencil(grid, xy)
    seen = np.concatenate((xy, (stencil * a[index]).sum(1, keepdims=True)), 1)
    far = distance(seen, np.concatenate((points, height[:, None]), 1)).reshape(sigma.shape) / reach
    far /= np.where(surrounded(xy, points).reshape(far.shape), 1.0, BEYOND)
    sigma, far = (_enlarge(v, shape) for v in (sigma, far))
    return {
        "height": camera.height(pixels, spline.evaluate(grid, a, columns, rows)),
        "normals": camera.turn(pixels, tensors.normals(g)),
        "sigma": sigma,
        "supported": (far <= 1) & (sigma <= WORST),
        "closable": (far <= ENCLOSED) & (sigma <= WORST),
    }


def close_holes(supported: NDArray[np.bool_], closable: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """`supported` (H, W) with those of its holes filled that are `closable` (H, W) throughout.

    A hole ends at supported pixels everywhere: the image's border, a mask's, a gap in the surface are not closed. Between the
    crowds of instances on printed motifs lie places a little out of reach that everything around agrees on.
    """
    count, label, box, _ = cv2.connectedComponentsWithStats((~supported).astype(np.uint8), connectivity=8)
    hole = np.bincount(label[~supported & ~closable], minlength=count) == 0
    left, top, wide, high = box[:, :4].T
    hole &= (left > 0) & (top > 0) & (left + wide < supported.shape[1]) & (top + high < supported.shape[0])
    hole[0] = True  # what is supported
    return hole[label]


def pieces(valid: NDArray[np.bool_], least: float) -> NDArray[np.int32]:
    """Label (H, W) of the connected pieces of `valid`, from 1, the largest first; 0 elsewhere and on specks under `least` px².

    A depth jump parts them as well: no normal is certain enough there to be valid.
    """
    count, label, stats, _ = cv2.connectedComponentsWithStats(valid.astype(np.uint8), connectivity=4)
    area = stats[1:, cv2.CC_STAT_AREA]
    order = np.argsort(-area, kind="stable")
    new = np.zeros(count, np.int32)
    new[1 + order] = np.where(area[order] >= least, np.arange(1, count), 0)
    return new[label]


def _enlarge(coarse: Float, shape: tuple[int, int]) -> Float:
    """Bilinear interpolation of a raster whose corners lie on the corners of an image of `shape`."""
    x = np.linspace(0, coarse.shape[1] - 1, shape[1], dtype=np.float32)
    y = np.linspace(0, coarse.shape[0] - 1, shape[0], dtype=np.float32)
    grid_x, grid_y = np.meshgrid(x, y)
    return cv2.remap(coarse.astype(np.float32), grid_x, grid_y, cv2.INTER_LINEAR)
