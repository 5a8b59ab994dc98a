"""A flat chart (u, v) of the surface, piece by piece, as isometric as its shape allows: what a print is laid on.

The surface, sampled on a grid, becomes a triangle mesh; the chart minimises the as-rigid-as-possible energy

    E = sum over triangles of area · |J − R|²,   J = d(u, v) / d(lengths in its plane),   R the rotation nearest to J

by turns over R (a closed form) and over (u, v) (one linear system whose matrix never changes), after Liu et al., *A
local/global approach to mesh parameterization* (SGP 2008), from coarse grids to fine ones. Where the surface can be unrolled
E reaches 0 and lengths, angles and areas are all kept. There is no seam within a piece. One unit of the chart is one px of
the surface seen from straight ahead.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, find_objects
from scipy.sparse.linalg import splu

Float = NDArray[np.floating]
Int = NDArray[np.integer]
Bool = NDArray[np.bool_]

COARSER = (16, 4)  # grids to start on, in steps of the final one: long waves are slow to unfold on a fine grid
STEEPEST = 0.1  # least n_z with which the surface is continued by a step past its border
SETTLED = 1e-3  # mean change of (u, v) in px at which the turns end


class Pinhole(NamedTuple):
    """Focal length (inf: orthographic) and principal point (x, y), px."""

    focal: float = np.inf
    centre: tuple[float, float] = (0.0, 0.0)

    @classmethod
    def of(cls, surface: Mapping[str, Any]) -> "Pinhole":
        """The camera of a surface stage's arrays: `focal_px` and `principal_point`."""
        x, y = np.asarray(surface["principal_point"], float)
        return cls(float(surface["focal_px"]), (float(x), float(y)))

    def points(self, xy: Float, z: Float) -> Float:
        """(…, 3) places in space of image points `xy` (…, 2) with heights `z` (…,), all in px."""
        offset = np.asarray(xy, float) - self.centre
        return np.concatenate((self.centre + offset * (1 - z / self.focal)[..., None], z[..., None]), -1)

    def on_plane(self, xy: Float, at: Float, normal: Float) -> Float:
        """Heights (…,) where the rays of `xy` (…, 2) meet the planes through points `at` (…, 3) with `normal` (…, 3)."""
        offset = np.asarray(xy, float) - self.centre
        start = np.concatenate((self.centre + offset, np.zeros((*offset.shape[:-1], 1))), -1)  # where z is 0
        slope = normal[..., 2] - (normal[..., :2] * offset).sum(-1) / self.focal
        return np.asarray((normal * (at - start)).sum(-1) / np.where(np.abs(slope) > 1e-3, slope, 1e-3))


@dataclass(frozen=True)
class Mesh:
    """Triangles over the cells of a grid of pixels that hold a valid pixel; the pieces share no vertex.

    `step` px of the grid; of every vertex (V,): `piece`, `row` and `column` on the grid, `point` (V, 3). `faces` (F, 3).
    """

    step: int
    piece: Int
    row: Int
    column: Int
    point: Float
    faces: Int

    @property
    def xy(self) -> Float:
        """Image points (V, 2) of the vertices."""
        return np.stack((self.column, self.row), 1) * float(self.step)


@dataclass(frozen=True)
class Chart:
    """`uv` (H, W, 2) px, NaN off the surface. Of every piece from 1 (rows (P, 2): median and 95th percentile over its area):
    `angular`, degrees by which the chart changes angles at most at a point, and `area`, |change of area| / area."""

    uv: Float
    angular: Float
    area: Float


def make_chart(height: Float, normals: Float, piece: Int, camera: Pinhole, vertices: int, turns: int) -> Chart:
    """The chart of a surface.

    Parameters
    ----------
    height, normals, piece : (H, W) px, (H, W, 3) in the camera's frame, (H, W) labels from 1, 0 off the surface.
    vertices, turns
        of the finest mesh, about; and the most turns on each grid.

    Returns
    -------
    Chart
        Each piece is turned to be upright (v down the image on the whole) and moved to where it is in the image.
    """
    step = max(2, int(np.ceil(np.sqrt(max((piece > 0).sum(), 1) / vertices))))
    uv, before = None, None
    for factor in (*COARSER, 1):
        if factor > 1 and (piece > 0).sum() < 200 * (factor * step) ** 2:
            continue  # hardly a cell across
        mesh = make_mesh(height, normals, piece, camera, factor * step)
        # What the coarse grid found, carried over as a displacement from the image: it is smooth, also past the border.
        start = mesh.xy if uv is None or before is None else mesh.xy + _carry(before, uv - before.xy, mesh)
        uv, before = flatten(mesh, start, turns), mesh
    assert uv is not None and before is not None
    uv = upright(before, uv)
    angles, areas, weight = distortion(before, uv)
    count = int(piece.max(initial=0))
    owner = before.piece[before.faces[:, 0]]
    rows = [owner == k + 1 for k in range(count)]
    angular = np.array([weighted_percentiles(angles[r], weight[r]) for r in rows]).reshape(count, 2)
    area = np.array([weighted_percentiles(areas[r], weight[r]) for r in rows]).reshape(count, 2)
    return Chart(to_pixels(before, uv, piece), angular, area)


def make_mesh(height: Float, normals: Float, piece: Int, camera: Pinhole, step: int) -> Mesh:
    """The mesh on every `step`-th pixel. It covers every valid pixel: vertices past the border continue the surface."""
    h, w = piece.shape
    rows, columns = -(-h // step), -(-w // step)  # cells
    y, x = np.nonzero(piece)
    cell = (piece[y, x].astype(np.int64) * rows + y // step) * columns + x // step
    label, place = np.divmod(np.unique(cell), rows * columns)
    r, c = np.divmod(place, columns)
    size = (rows + 1) * (columns + 1)
    a = label * size + r * (columns + 1) + c
    b, below, d = a + 1, a + columns + 1, a + columns + 2
    used, index = np.unique(np.stack((a, b, below, d)), return_inverse=True)
    a, b, below, d = index.reshape(4, -1)
    faces = np.concatenate((np.stack((a, b, below), 1), np.stack((b, d, below), 1)))
    label, place = used // size, used % size
    row, column = place // (columns + 1), place % (columns + 1)
    xy = np.stack((column, row), 1) * float(step)
    point = np.zeros((len(used), 3))
    for k in np.unique(label):
        of = label == k
        point[of] = _continued(height, normals, piece, k, camera, xy[of])
    return Mesh(step, label, row, column, point, faces)


def _continued(height: Float, normals: Float, piece: Int, label: int, camera: Pinhole, xy: Float) -> Float:
    """Points (V, 3) of a piece at whole pixels `xy` (V, 2); off it, of the tangent plane at its nearest pixel."""
    h, w = piece.shape
    at = np.clip(xy.astype(int), 0, [w - 1, h - 1])
    (left, top), (right, bottom) = at.min(0), at.max(0) + 1
    inside = piece[top:bottom, left:right] == label
    nearest = distance_transform_edt(~inside, return_distances=False, return_indices=True)
    row, column = (nearest[k][at[:, 1] - top, at[:, 0] - left] + (top, left)[k] for k in (0, 1))
    n = normals[row, column].astype(float)
    n[:, 2] = np.maximum(n[:, 2], STEEPEST)
    there = camera.points(np.stack((column, row), 1), height[row, column].astype(float))
    return camera.points(xy, camera.on_plane(xy, there, n))


def flatten(mesh: Mesh, start: Float, turns: int) -> Float:
    """(u, v) (V, 2) of least ARAP energy, from `start` (V, 2)."""
    gradient, area = _gradients(mesh)
    f, v = len(mesh.faces), len(mesh.point)
    weight = np.repeat(area, 2)
    # The energy knows no place: a touch of inertia keeps each piece where it is.
    inertia = 1e-9 * weight.mean()
    weighted = sp.diags(weight) @ gradient
    solve = splu((gradient.T @ weighted + inertia * sp.identity(v)).tocsc(), permc_spec="MMD_AT_PLUS_A").solve
    right = weighted.T.tocsr()
    uv = np.array(start, float)
    for _ in range(turns):
        rotation = _nearest_rotation((gradient @ uv).reshape(f, 2, 2))
        new = solve(right @ rotation.reshape(2 * f, 2) + inertia * uv)
        moved = float(np.abs(new - uv).mean())
        uv = new
        if moved < SETTLED:
            break
    return uv


def _gradients(mesh: Mesh) -> tuple[sp.csr_matrix, Float]:
    """Sparse (2 F, V): derivatives of a function at the vertices along two unit vectors in each triangle; areas (F,)."""
    p = mesh.point[mesh.faces]
    along, other = p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]
    length = np.linalg.norm(along, axis=1)
    x2 = (along * other).sum(1) / length
    y2 = np.maximum(np.linalg.norm(np.cross(along, other), axis=1) / length, 1e-9)
    # In the triangle's plane: (0, 0), (length, 0), (x2, y2).
    slope = np.zeros((len(p), 2, 3))
    slope[:, 0, 0], slope[:, 0, 1] = -1 / length, 1 / length
    slope[:, 1, 1], slope[:, 1, 2] = -x2 / (length * y2), 1 / y2
    slope[:, 1, 0] = -slope[:, 1, 1] - slope[:, 1, 2]
    columns = np.repeat(mesh.faces, 2, axis=0).ravel()
    rows = np.arange(0, 6 * len(p) + 1, 3)
    return sp.csr_matrix((slope.ravel(), columns, rows), shape=(2 * len(p), len(mesh.point))), length * y2 / 2


def _nearest_rotation(j: Float) -> Float:
    """The rotations nearest to matrices (F, 2, 2)."""
    c, s = j[:, 0, 0] + j[:, 1, 1], j[:, 0, 1] - j[:, 1, 0]
    length = np.maximum(np.hypot(c, s), 1e-12)
    c, s = c / length, s / length
    return np.stack((c, s, -s, c), 1).reshape(-1, 2, 2)


def _carry(coarse: Mesh, value: Float, fine: Mesh) -> Float:
    """`value` (V, 2) of a coarse mesh at the vertices of a finer one of the same pieces, (V', 2)."""
    out = np.zeros((len(fine.point), 2))
    for k in np.unique(fine.piece):
        of = fine.piece == k
        out[of] = _interpolate(coarse, value, k, fine.xy[of])
    return out


def _interpolate(mesh: Mesh, value: Float, label: int, xy: Float) -> Float:
    """Bilinear interpolation (N, 2) at image points `xy` (N, 2); off the mesh, from the nearest of its vertices."""
    of = mesh.piece == label
    low = np.array([mesh.column[of].min(), mesh.row[of].min()])
    shape = (int(np.ptp(mesh.row[of])) + 1, int(np.ptp(mesh.column[of])) + 1)
    raster, known = np.zeros((*shape, 2)), np.zeros(shape, bool)
    place = mesh.row[of] - low[1], mesh.column[of] - low[0]
    raster[place], known[place] = value[of], True
    near = distance_transform_edt(~known, return_distances=False, return_indices=True)
    raster = raster[near[0], near[1]]
    at = np.clip(xy / mesh.step - low, 0, [shape[1] - 1, shape[0] - 1])
    first = np.minimum(at.astype(int), [shape[1] - 2, shape[0] - 2])
    (x, y), (fx, fy) = first.T, (at - first).T[..., None]
    top = raster[y, x] * (1 - fx) + raster[y, x + 1] * fx
    return np.asarray(top * (1 - fy) + (raster[y + 1, x] * (1 - fx) + raster[y + 1, x + 1] * fx) * fy)


def upright(mesh: Mesh, uv: Float) -> Float:
    """Every piece turned and moved, stiffly, to where it lies in the image, by least squares."""
    out = np.empty_like(uv)
    for k in np.unique(mesh.piece):
        of = mesh.piece == k
        a, b = uv[of] - uv[of].mean(0), mesh.xy[of] - mesh.xy[of].mean(0)
        turn = _nearest_rotation((a.T @ b)[None])[0]
        out[of] = a @ turn + mesh.xy[of].mean(0)
    return out


def distortion(mesh: Mesh, uv: Float) -> tuple[Float, Float, Float]:
    """Of every triangle (F,): degrees by which the chart changes an angle at most, |change of area| / area; and its area."""
    gradient, area = _gradients(mesh)
    return *stretch((gradient @ uv).reshape(-1, 2, 2)), area


def stretch(j: Float) -> tuple[Float, Float]:
    """What maps with Jacobians j (…, 2, 2) between lengths do: the greatest change of an angle, degrees (Tissot's
    2 arcsin((σ1 − σ2) / (σ1 + σ2))), and |σ1 σ2 − 1|."""
    c, s = j[..., 0, 0] + j[..., 1, 1], j[..., 0, 1] - j[..., 1, 0]
    d, e = j[..., 0, 0] - j[..., 1, 1], j[..., 0, 1] + j[..., 1, 0]
    total, difference = np.hypot(c, s), np.hypot(d, e)  # σ1 + σ2, σ1 − σ2 (of a map that keeps its sense)
    angle = np.degrees(2 * np.arcsin(np.clip(difference / np.maximum(total, 1e-12), 0, 1)))
    return angle, np.abs((total**2 - difference**2) / 4 - 1)


def weighted_percentiles(value: Float, weight: Float, q: tuple[float, ...] = (50, 95)) -> Float:
    """Percentiles (len(q),) of `value` (N,) counted by `weight` (N,)."""
    order = np.argsort(value)
    total = np.cumsum(weight[order])
    found = np.searchsorted(total, np.array(q) / 100 * total[-1])
    return np.asarray(value[order][np.minimum(found, len(value) - 1)])


def to_pixels(mesh: Mesh, uv: Float, piece: Int) -> Float:
    """The chart (H, W, 2) at every pixel of a piece, NaN elsewhere."""
    out = np.full((*piece.shape, 2), np.nan)
    for k, box in enumerate(find_objects(piece), 1):
        if box is not None:
            y, x = np.nonzero(piece[box] == k)
            at = np.stack((x + box[1].start, y + box[0].start), 1).astype(float)
            out[box][y, x] = at + _interpolate(mesh, uv - mesh.xy, k, at)
    return out
