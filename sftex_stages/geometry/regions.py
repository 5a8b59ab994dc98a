"""Affine-covariant regions: dots, holes and printed shapes that stand out from their surroundings.

Polka dots and holes need regions as well as interest points: a descriptor's window around a dot reaches the neighbouring
dots. A region's second moments give an affine frame at once (Mikolajczyk et al., A comparison of affine region detectors,
IJCV 2005, section 2.4).
"""

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating]

_PATCH = 48  # pixels of a normalised patch in the descriptor's mosaic
_REACH = 1.8  # half width of that patch, in radii of the region


def find_regions(grey: Array, mask: Array, windows: tuple[int, ...], contrast: float, smallest: float) -> tuple[Array, Array]:
    """Connected regions darker or lighter than their surroundings, in an 8-bit image (H, W).

    A pixel belongs to a region where it differs from the mean over a window by more than `contrast` × the local standard
    deviation. Each connected set is replaced by its convex hull (highlights in a hole do not break it). `smallest` is the
    least semi-axis in px. Returns centres (N, 2) and frames (N, 2, 2), the symmetric roots that take the unit disc to the
    ellipse of equal moments.
    """
    image = grey.astype(np.float32)
    found: list[tuple[float, float, float, float, float, float]] = []
    for window in windows:
        mean = cv2.blur(image, (window, window))
        deviation = np.sqrt(np.maximum(cv2.blur(image**2, (window, window)) - mean**2, 0))
        margin = np.maximum(contrast * deviation, 4.0)
        for sign in (1, -1):
            binary = ((sign * (image - mean) > margin) & mask).astype(np.uint8)
            contours, _ = cv2.findContours(binary, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
            for contour in contours:
                if len(contour) < 8 or len(contour) > 8 * window:
                    continue
                x, y, w, h = cv2.boundingRect(contour)
                if max(w, h) > window or x <= 1 or y <= 1 or x + w >= grey.shape[1] - 1 or y + h >= grey.shape[0] - 1:
                    continue
                hull = cv2.convexHull(contour)
                m = cv2.moments(hull)
                if m["m00"] < 8:
                    continue
                # a contour runs through pixel centres: the region reaches half a pixel further
                grow = 0.5
                cxx, cxy, cyy = m["mu20"] / m["m00"], m["mu11"] / m["m00"], m["mu02"] / m["m00"]
                found.append((m["m10"] / m["m00"], m["m01"] / m["m00"], cxx, cxy, cyy, grow))
    if not found:
        return np.zeros((0, 2)), np.zeros((0, 2, 2))
    rows = np.array(found)
    moments = np.stack([rows[:, 2], rows[:, 3], rows[:, 3], rows[:, 4]], -1).reshape(-1, 2, 2)
    values, vectors = np.linalg.eigh(moments)
    axes = 2 * np.sqrt(np.maximum(values, 0)) + rows[:, 5:6]
    frames = (vectors * axes[:, None, :]) @ np.swapaxes(vectors, 1, 2)
    keep = (axes[:, 0] >= smallest) & (axes[:, 0] > 0.15 * axes[:, 1])
    return drop_repeats(rows[keep, :2], frames[keep])


def drop_repeats(xy: Array, frames: Array) -> tuple[Array, Array]:
    """One of the regions found again through another window: same centre within a quarter radius, size within 20 %."""
    size = np.sqrt(np.linalg.det(frames))
    cell = np.round(np.log(size) / 0.2).astype(int)
    order = np.lexsort((xy[:, 0], xy[:, 1], -size))
    kept: list[int] = []
    grid: dict[tuple[int, int, int], list[int]] = {}
    for i in order:
        reach = 0.25 * size[i]
        gx, gy = int(xy[i, 0] // 8), int(xy[i, 1] // 8)
        ring = int(np.ceil(reach / 8))
        near = [
            j
            for c in (cell[i] - 1, cell[i], cell[i] + 1)
            for a in range(gx - ring, gx + ring + 1)
            for b in range(gy - ring, gy + ring + 1)
            for j in grid.get((c, a, b), ())
        ]
        if any(np.hypot(*(xy[j] - xy[i])) < reach and abs(np.log(size[j] / size[i])) < 0.2 for j in near):
            continue
        kept.append(int(i))
        grid.setdefault((int(cell[i]), gx, gy), []).append(int(i))
    return xy[kept], frames[kept]


def orient_and_describe(grey: Array, xy: Array, frames: Array) -> tuple[Array, Array]:
    """Turn each frame to its patch's dominant gradient and describe the normalised patch by SIFT (128 numbers, RootSIFT).

    Returns frames (N, 2, 2) and descriptors (N, 128) float32.
    """
    if len(xy) == 0:
        return frames, np.zeros((0, 128), np.float32)
    axis = (np.arange(_PATCH, dtype=np.float32) + 0.5) / _PATCH * 2 - 1
    gx, gy = np.meshgrid(axis * _REACH, axis * _REACH)
    points = np.stack([gx.ravel(), gy.ravel()], -1)
    image = grey.astype(np.float32)

    def normalised(f: Array) -> Array:
        where = np.einsum("nij,pj->npi", f, points) + xy[:, None]
        return np.concatenate(
            [
                cv2.remap(
                    image,
                    np.ascontiguousarray(part[..., 0], np.float32),
                    np.ascontiguousarray(part[..., 1], np.float32),
                    cv2.INTER_LINEAR,
                    borderMode=cv2.BORDER_REPLICATE,
                )
                for part in np.array_split(where, max(1, len(where) // 4000))
            ]
        ).reshape(-1, _PATCH, _PATCH)

    patches = normalised(frames)
    dy, dx = np.gradient(patches, axis=(1, 2))
    window = np.exp(-(gx**2 + gy**2) / 1.5)
    magnitude = np.hypot(dx, dy) * window
    bins = 36
    index = np.floor((np.arctan2(dy, dx) / (2 * np.pi) + 1) * bins).astype(int) % bins
    flat = (np.arange(len(patches))[:, None, None] * bins + index).ravel()
    histogram = np.bincount(flat, magnitude.ravel(), len(patches) * bins).reshape(-1, bins)
    smooth = np.sum([np.roll(histogram, k, 1) for k in (-2, -1, 0, 1, 2)], axis=0)
    angle = (smooth.argmax(1) + 0.5) * 2 * np.pi / bins
    c, s = np.cos(angle), np.sin(angle)
    frames = frames @ np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], -2)

    patches = normalised(frames)
    low, high = patches.min((1, 2), keepdims=True), patches.max((1, 2), keepdims=True)
    stretched = (255 * (patches - low) / np.maximum(high - low, 1)).astype(np.uint8)
    across = 16
    rows = -(-len(stretched) // across)
    mosaic = np.zeros((rows * _PATCH, across * _PATCH), np.uint8)
    points_: list[cv2.KeyPoint] = []
    for k, patch in enumerate(stretched):
        r, q = divmod(k, across)
        mosaic[r * _PATCH : (r + 1) * _PATCH, q * _PATCH : (q + 1) * _PATCH] = patch
        # SIFT's 4 × 4 cells of 3 σ (σ = size / 2) then cover the patch
        points_.append(cv2.KeyPoint(q * _PATCH + _PATCH / 2, r * _PATCH + _PATCH / 2, _PATCH / 6.5, 0.0, 0.0, 0, k))
    points_, descriptors = cv2.SIFT_create().compute(mosaic, points_)
    order = np.argsort([p.class_id for p in points_])
    descriptors = descriptors[order]
    root = np.sqrt(descriptors / np.maximum(descriptors.sum(1, keepdims=True), 1e-9))
    return frames, root.astype(np.float32)
