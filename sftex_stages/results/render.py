"""Oblique views of a height field: orthographic, hidden surfaces removed, anti-aliased, NumPy and OpenCV alone.

Seen from any direction, height moves a point along one direction of the screen. Sampled along lines parallel to that
direction, the surface falls apart into independent plane curves, each in one column of a sheared screen: there are no
gaps sideways, and along it every segment of the curve is filled in whole. So the z-buffer is exact at its resolution
and there is no loop over pixels. Colours are looked up afterwards, once for each pixel that is seen.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from scipy.ndimage import distance_transform_edt

from ..geometry.chart import Pinhole
from .exports import to_display
from .mesh import STEEPEST

BACKGROUND = (244, 244, 246)
SUPERSAMPLING = 2
ORTHOGRAPHIC = Pinhole()


class _View(NamedTuple):
    """An orthographic camera, as linear forms of (x, y, z) in the image's frame, all in px."""

    right: np.ndarray  # (3,) screen, to the right
    down: np.ndarray  # (3,) screen, downward
    near: np.ndarray  # (3,) toward the camera


def render(
    height: np.ndarray,
    normals: np.ndarray,
    valid: np.ndarray,
    textures: Sequence[np.ndarray | None] = (None,),
    azimuth: float = -35.0,
    elevation: float = 20.0,
    size: int = 840,
    camera: Pinhole = ORTHOGRAPHIC,
) -> list[np.ndarray]:
    """Pictures of a height field from one direction, each (h, w, 3) uint8 RGB, the longer side `size` pixels.

    height (H, W) px, normals (H, W, 3) and valid (H, W) in the image's frame (x right, y down, z toward the camera).
    One picture for each of `textures`: (H, W, 3) uint8 sRGB, or None: grey in a light from the upper left. The camera
    moves to the right by `azimuth` and up by `elevation` degrees (|angles| < 80) from the photograph's own view. Where
    the back of the surface shows, it is lit like its front, but darker. A surface seen by a perspective `camera` is first drawn
    as it would look from afar.
    """
    view = _camera(azimuth, elevation)
    valid = valid & np.isfinite(height) & np.isfinite(normals).all(axis=2)
    if not valid.any():
        raise ValueError("nothing to render: no pixel is valid")
    if np.isfinite(camera.focal):
        height, normals, valid, textures = _from_afar(height, normals, valid, textures, camera)
    y, x = np.nonzero(valid)
    points = np.stack([x, y, height[valid]]).astype(np.float64)
    low, high = (np.array([f(view.right @ points), f(view.down @ points)]) for f in (np.min, np.max))
    margin = 0.04 * (high - low).max() + 1
    low, high = low - margin, high + margin
    pitch = float((high - low).max() / size / SUPERSAMPLING)  # px of the photograph per sample

    cross, along = _shear(view)
    across = _plane(view, cross)  # unit vector in the photograph on which `cross` grows; height does not matter there
    follow = np.array([-across[1], across[0]])
    a = np.arange(*_extent(across @ points[:2], pitch), pitch)
    b = np.arange(*_extent(follow @ points[:2], pitch), pitch)
    sx, sy = (np.add.outer(b * follow[i], a * across[i]).astype(np.float32) for i in (0, 1))
    z, solid = _sample_height(height, valid, sx, sy)
    column = _form((along[0] * view.right + along[1] * view.down) / pitch, sx, sy, z)  # where a point lies along it
    top = float(np.floor(column[solid].min())) - 1
    column -= np.float32(top)
    winner, fraction = _visible(column, _form(view.near, sx, sy, z), z, solid, pitch)

    seen = winner >= 0
    i, j = np.divmod(winner, len(a))
    bb, aa = b.astype(np.float32)[i] + fraction * np.float32(pitch), a.astype(np.float32)[j]
    px, py = (bb * np.float32(follow[k]) + aa * np.float32(across[k]) for k in (0, 1))
    pictures = []
    for texture in textures:
        color = _shade(normals, valid, view, px, py) if texture is None else _look_up(texture, px, py, pitch)
        layers = np.dstack([color, np.full(seen.shape, 255, np.uint8)])
        layers[~seen] = 0
        pictures.append(_develop(layers, cross, along, np.array([a[0], top * pitch]), low, high, pitch))
    return pictures


def _from_afar(
    height: np.ndarray,
    normals: np.ndarray,
    valid: np.ndarray,
    textures: Sequence[np.ndarray | None],
    camera: Pinhole,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[np.ndarray | None]]:
    """The maps of a perspective photograph as an orthographic one of the same surface, on a grid of px of the distance f."""
    row, column = distance_transform_edt(~valid, return_distances=False, return_indices=True)
    whole = height[row, column].astype(np.float32)
    y, x = np.nonzero(valid)
    points = camera.points(np.stack([x, y], 1), height[valid].astype(float))
    low, high = np.floor(points[:, :2].min(0)), np.ceil(points[:, :2].max(0))
    step = max(1.0, float((high - low).max() / (2 * max(valid.shape))))  # a hostile height must not ask for a huge picture
    there = np.stack(np.meshgrid(*(np.arange(low[k], high[k] + step, step) for k in (0, 1))), -1) - camera.centre
    at = there.copy()
    for _ in range(20):  # the point whose ray passes here lies at x = c + (X − c) / (1 − z(x) / f)
        place = (at + camera.centre).astype(np.float32)
        z = cv2.remap(whole, place[..., 0], place[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        at = there / np.maximum(1 - z / camera.focal, 0.05)[..., None]
    place = (at + camera.centre).astype(np.float32)

    def moved(values: np.ndarray) -> np.ndarray:
        return cv2.remap(values, place[..., 0], place[..., 1], cv2.INTER_LINEAR)

    seen = moved(valid.astype(np.float32)) > 0.5
    turned = moved(np.ascontiguousarray(normals[row, column], np.float32))
    turned /= np.maximum(np.linalg.norm(turned, axis=2, keepdims=True), 1e-6)
    return moved(whole) / step, turned, seen, [None if t is None else moved(t) for t in textures]


def _form(f: np.ndarray, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    """f · (x, y, z) in float32."""
    out = np.float32(f[0]) * x
    out += np.float32(f[1]) * y
    out += np.float32(f[2]) * z
    return out


def _camera(azimuth: float, elevation: float) -> _View:
    if max(abs(azimuth), abs(elevation)) >= 80:
        raise ValueError(f"azimuth {azimuth} and elevation {elevation} must lie within ±80 degrees")
    sa, ca = math.sin(math.radians(azimuth)), math.cos(math.radians(azimuth))
    se, ce = math.sin(math.radians(elevation)), math.cos(math.radians(elevation))
    return _View(
        right=np.array([ca, 0.0, -sa]), down=np.array([se * sa, ce, se * ca]), near=np.array([sa * ce, -se, ca * ce])
    )


def _shear(view: _View) -> tuple[np.ndarray, np.ndarray]:
    """Unit vectors of the screen: across the direction in which height moves points, and along it."""
    move = np.array([view.right[2], view.down[2]])
    length = np.linalg.norm(move)
    along = move / length if length > 1e-9 else np.array([0.0, 1.0])
    return np.array([along[1], -along[0]]), along


def _plane(view: _View, screen: np.ndarray) -> np.ndarray:
    return (screen[0] * view.right + screen[1] * view.down)[:2]


def _extent(values: np.ndarray, pitch: float) -> tuple[float, float]:
    return float(values.min()) - 2 * pitch - 1, float(values.max()) + 2 * pitch + 1


def _sample_height(
    height: np.ndarray, valid: np.ndarray, sx: np.ndarray, sy: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Height at sample positions, from valid pixels alone, and whether most of the weight there is valid."""
    weight = cv2.remap(valid.astype(np.float32), sx, sy, cv2.INTER_LINEAR, borderValue=0)
    filled = np.where(valid, height, 0).astype(np.float32)
    z = cv2.remap(filled, sx, sy, cv2.INTER_LINEAR, borderValue=0)
    return z / np.maximum(weight, 1e-6), weight >= 0.5


def _visible(
    column: np.ndarray, depth: np.ndarray, z: np.ndarray, solid: np.ndarray, pitch: float
) -> tuple[np.ndarray, np.ndarray]:
    """Hidden-surface removal. column (n, m): position along column j of curve point i, in samples, ≥ 1 where solid.

    Returns winner (rows, m), the flat index of the point that begins the nearest segment, -1 where there is none, and
    the fraction of the way to the next point.
    """
    m = column.shape[1]
    first, last = column[:-1], column[1:]
    whole = solid[:-1] & solid[1:] & (np.abs(np.diff(z, axis=0)) <= STEEPEST * pitch)
    low = np.floor(np.minimum(first, last))
    count = np.where(whole, np.floor(np.maximum(first, last)) - low, 0).astype(np.int32)  # rows in (low, high]
    rows = int(column[solid].max()) + 2
    nearest = np.zeros(rows * m, np.int64)
    near, far = float(depth[solid].max()), float(depth[solid].min())
    scale = (2**30 - 2) / max(near - far, 1e-9)
    todo = np.flatnonzero(count)
    flat_low, flat_count = low.ravel(), count.ravel()
    start, end = first.ravel(), last.ravel()
    d0, d1 = depth[:-1].ravel(), depth[1:].ravel()
    step = 1
    while len(todo):
        row = flat_low[todo] + step
        t = (row - start[todo]) / (end[todo] - start[todo])
        level = ((d0[todo] + t * (d1[todo] - d0[todo]) - far) * scale).astype(np.int64) + 1
        # One number holds depth and, below it, who was there: the largest wins, ties by index, whatever the order.
        np.maximum.at(nearest, row.astype(np.int64) * m + todo % m, (level << 32) | todo)
        step += 1
        todo = todo[flat_count[todo] >= step]
    nearest = nearest.reshape(rows, m)
    winner = np.where(nearest > 0, nearest & 0xFFFFFFFF, -1)
    at = np.maximum(winner, 0)
    span = end[at] - start[at]
    row = np.arange(rows, dtype=np.float32)[:, None]
    span[span == 0] = 1
    return winner, np.clip((row - start[at]) / span, 0, 1)


def _shade(normals: np.ndarray, valid: np.ndarray, view: _View, px: np.ndarray, py: np.ndarray) -> np.ndarray:
    """Grey of a matt surface lit from the viewer's upper left, from the viewer and from the sky, (h, w, 3) uint8."""
    field = np.where(valid[..., None], normals, 0).astype(np.float32)
    light = -0.45 * view.right - 0.45 * view.down + 0.9 * view.near
    light /= np.linalg.norm(light)
    # The three cosines that matter, looked up instead of the normal; its length, under 1 in between, divides out.
    axes = np.stack([light, view.down, view.near], 1).astype(np.float32)
    cosines = cv2.remap(np.dstack([field @ axes]), px, py, cv2.INTER_LINEAR)
    length = cv2.remap(np.sqrt((field**2).sum(2)), px, py, cv2.INTER_LINEAR)
    front = cosines[..., 2] >= 0
    sign = np.where(front, 1, -1) / np.maximum(length, np.float32(1e-6))
    diffuse = np.maximum(cosines[..., 0] * sign, 0)
    down, near = cosines[..., 1] * sign, cosines[..., 2] * sign
    linear = (0.03 + 0.58 * diffuse + 0.08 * near - 0.04 * down) * np.where(front, 1, 0.45)
    return cv2.merge([to_display(linear.astype(np.float32), 1.0)] * 3)


def _look_up(texture: np.ndarray, px: np.ndarray, py: np.ndarray, pitch: float) -> np.ndarray:
    if pitch > 1:  # the picture is smaller than the photograph: average first, or fine texture turns into moiré
        h, w = texture.shape[:2]
        texture = cv2.resize(texture, None, fx=1 / pitch, fy=1 / pitch, interpolation=cv2.INTER_AREA)
        kx, ky = texture.shape[1] / w, texture.shape[0] / h
        px, py = (px + 0.5) * kx - 0.5, (py + 0.5) * ky - 0.5
    return cv2.remap(
        texture, px.astype(np.float32), py.astype(np.float32), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )


def _develop(
    layers: np.ndarray,
    cross: np.ndarray,
    along: np.ndarray,
    origin: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    pitch: float,
) -> np.ndarray:
    """From the sheared screen (colour × coverage, coverage) to the picture: turn, average, lay on the background."""
    w, h = (math.ceil(v / SUPERSAMPLING) for v in (high - low) / pitch)
    # Sample (u, v) of the picture is the screen's point low + pitch (u, v); its place in `layers` follows.
    turn = np.stack([cross, along])
    shift = (turn @ low - origin) / pitch
    big = cv2.warpAffine(
        layers,
        np.column_stack([turn, shift]),
        (w * SUPERSAMPLING, h * SUPERSAMPLING),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
    )
    small = cv2.resize(big, (w, h), interpolation=cv2.INTER_AREA)
    back = np.array(BACKGROUND, np.float32) * (1 - small[..., 3:] / np.float32(255))
    return np.clip(small[..., :3] + back + np.float32(0.5), 0, 255).astype(np.uint8)
