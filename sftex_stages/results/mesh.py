"""The surface as triangles, and its albedo drawn flat on the chart: what 3-D programs take.

Meshes are in the frame of 3-D viewers: x right, y up, z toward the viewer, that is (x, -y, z) of the image's frame, so
that the surface stands upright and faces the viewer. Their unit is the pixel.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from scipy.ndimage import distance_transform_edt

from ..errors import StageError
from ..geometry.chart import Pinhole

MAX_TRIANGLES = 100_000
MAX_TEXTURE = 2048  # px a side; keeps a GLB under 10 MB
#: A cell of the mesh rising more than this many times its width is a tear between two pieces, not a surface: that slant
#: of 85° is far beyond what can be measured (the detector itself loses elements near 60°).
STEEPEST = 12.0
_GUTTER = 8.0  # px of the texture between pieces
_CHUNK = 20_000  # triangles drawn at a time: memory


class Mesh(NamedTuple):
    """Triangles in the viewers' frame: vertices (V, 3) px, normals (V, 3), uv (V, 2) in 0…1 from the texture's top left
    corner, faces (F, 3) counter-clockwise seen from the viewer; pixel (V, 2), where in the image a vertex is. `size`, px of
    the texture (height, width); `unit` (2,), px of the surface to a unit of u and of v."""

    vertices: np.ndarray
    normals: np.ndarray
    uv: np.ndarray
    faces: np.ndarray
    pixel: np.ndarray
    size: tuple[int, int]
    unit: np.ndarray


def mesh(
    height: np.ndarray,
    normals: np.ndarray,
    piece: np.ndarray,
    chart: np.ndarray,
    camera: Pinhole,
    max_triangles: int = MAX_TRIANGLES,
) -> Mesh:
    """Triangulate a surface on a regular grid of pixels coarse enough for `max_triangles`, with its chart as texture.

    height (H, W) px, normals (H, W, 3), piece (H, W) labels from 1, chart (H, W, 2) px. A cell is filled only if every pixel
    that it covers is of one piece: holes stay open and separate pieces are not joined. Raises StageError if no cell is.
    """
    h, w = height.shape
    valid = (piece > 0) & np.isfinite(height) & np.isfinite(normals).all(axis=2) & np.isfinite(chart).all(axis=2)
    step = max(1, int(np.ceil(np.sqrt(2 * valid.sum() / max_triangles))))
    ys = np.arange((h - 1) % step // 2, h, step)
    xs = np.arange((w - 1) % step // 2, w, step)
    grid = np.ix_(ys, xs)
    # Minimum over the (step + 1)² pixels right of and below each corner.
    filled = cv2.erode(valid.astype(np.uint8), np.ones((step + 1, step + 1), np.uint8), anchor=(0, 0)) > 0
    corners, labels = (_corners(np.where(valid, a, 0)[grid]) for a in (height, piece))
    cells = filled[grid][:-1, :-1] & (np.ptp(corners, axis=0) <= STEEPEST * step) & (np.ptp(labels, axis=0) == 0)
    r, c = np.nonzero(cells)
    a = r * len(xs) + c  # top left; seen from the viewer, y up, counter-clockwise is down first
    b, below, d = a + 1, a + len(xs), a + len(xs) + 1
    faces = np.concatenate([np.stack([a, below, b], 1), np.stack([b, below, d], 1)])
    if not len(faces):
        raise StageError(f"the supported surface ({int(valid.sum())} pixels) is too small or too thin for a mesh")
    here = np.zeros(len(ys) * len(xs), bool)
    here[faces] = True
    used, faces = np.flatnonzero(here), (np.cumsum(here) - 1)[faces]
    y, x = ys[used // len(xs)], xs[used % len(xs)]
    pixel = np.stack([x, y], 1)
    uv, size, unit = _pack(chart[y, x].astype(float), piece[y, x])
    up = np.array([1, -1, 1])
    return Mesh(
        (camera.points(pixel, height[y, x].astype(float)) * up).astype(np.float32),
        (normals[y, x] * up).astype(np.float32),
        uv.astype(np.float32),
        faces.astype(np.uint32),
        pixel,
        size,
        unit,
    )


def _corners(values: np.ndarray) -> np.ndarray:
    return np.stack([values[:-1, :-1], values[:-1, 1:], values[1:, :-1], values[1:, 1:]])


def _pack(uv: np.ndarray, label: np.ndarray) -> tuple[np.ndarray, tuple[int, int], np.ndarray]:
    """Charts (V, 2) px of pieces side by side in one texture: coordinates 0…1, its size (height, width), px a unit (2,)."""
    names, index = np.unique(label, return_inverse=True)
    low = np.array([uv[index == k].min(0) for k in range(len(names))])
    extent = np.array([np.ptp(uv[index == k], axis=0) for k in range(len(names))])
    scale = 1.0
    for _ in range(50):  # shelves of boxes, the highest first; smaller until they fit
        box = extent * scale + 2 * _GUTTER
        width = max(float(box[:, 0].max()), min(1.05 * float(np.sqrt(box.prod(1).sum())), MAX_TEXTURE))
        place, x, y, shelf = np.zeros_like(box), 0.0, 0.0, 0.0
        for k in np.argsort(-box[:, 1], kind="stable"):
            if x and x + box[k, 0] > width:
                x, y, shelf = 0.0, y + shelf, 0.0
            place[k] = x, y
            x, shelf = x + box[k, 0], max(shelf, float(box[k, 1]))
        size = np.ceil((place + box).max(0)).astype(int)
        if size.max() <= MAX_TEXTURE:
            break
        scale *= min(0.98, MAX_TEXTURE / float(size.max()))
    at = (uv - low[index]) * scale + place[index] + _GUTTER
    return at / size, (int(size[1]), int(size[0])), size / scale


def bake(surface: Mesh, picture: np.ndarray) -> np.ndarray:
    """The picture (H, W, 3), NaN where it shows nothing, laid flat on the mesh's texture: (h, w, 3), without gaps."""
    h, w = surface.size
    at = surface.uv * np.array([w, h], np.float64) - 0.5  # pixel centres at integers
    source = np.full((h, w, 2), np.nan, np.float32)
    for first in range(0, len(surface.faces), _CHUNK):
        f = surface.faces[first : first + _CHUNK]
        y, x, inside = _draw(at[f], surface.pixel[f].astype(float))
        source[y, x] = inside
    missing = np.isnan(source[..., 0])
    row, column = distance_transform_edt(missing, return_distances=False, return_indices=True)
    source = source[row, column]  # beyond the border too, so that no filter mixes in what is not surface
    gap = ~np.isfinite(picture).all(axis=2)
    row, column = distance_transform_edt(gap, return_distances=False, return_indices=True)
    whole = picture[row, column].astype(np.float32)
    return cv2.remap(whole, source[..., 0], source[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def _draw(corner: np.ndarray, value: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pixels of triangles with corners (F, 3, 2): rows, columns, and values (N, 2) interpolated between those (F, 3, 2)."""
    low, high = np.ceil(corner.min(1)).astype(int), np.floor(corner.max(1)).astype(int)
    wide = np.maximum(high - low + 1, 0)
    count = wide.prod(1)
    owner = np.repeat(np.arange(len(corner)), count)
    number = np.arange(len(owner)) - np.repeat(np.cumsum(count) - count, count)
    x, y = low[owner, 0] + number % wide[owner, 0], low[owner, 1] + number // wide[owner, 0]
    a, b, c = (corner[owner, k] for k in range(3))
    p = np.stack([x, y], 1)

    def cross(u: np.ndarray, v: np.ndarray) -> np.ndarray:
        return u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]

    area = cross(b - a, c - a)
    area[area == 0] = np.inf
    share = np.stack([cross(b - p, c - p), cross(c - p, a - p), cross(a - p, b - p)], 1) / area[:, None]
    inside = (share >= -1e-6).all(1) & np.isfinite(area)
    return y[inside], x[inside], np.einsum("nk,nkd->nd", share[inside], value[owner[inside]])
