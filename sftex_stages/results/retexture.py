"""A new print on the surface: a picture, repeated, looked up through the chart and filtered as a lens would.

Every pixel is the mean of `SAMPLES`² samples; each takes from a pyramid of the print the two levels on either side of its own
footprint (trilinear mip maps, Williams, *Pyramidal Parametrics*, SIGGRAPH 1983), so that the print turns to its mean, not to
moiré, where it is small or steep.
"""

from __future__ import annotations

import cv2
import numpy as np

SAMPLES = 3
FARTHEST = 1e7  # px of a chart: beyond, a file says nonsense
_BAND = 256  # rows at a time: memory
_RIM = 3  # px of wrapped print around each level


def print_on(
    chart: np.ndarray,
    valid: np.ndarray,
    picture: np.ndarray,
    tile_px: float | None = None,
    turn: float = 0.0,
    shift: tuple[float, float] = (0.0, 0.0),
) -> np.ndarray:
    """The print at every pixel, (H, W, C) float32, 0 off the surface.

    Parameters
    ----------
    chart, valid : (H, W, 2) px of the surface, (H, W) bool
        pixels without a finite chart count as not valid.
    picture : (h, w, C) float32, linear; C at most 4.
    tile_px
        width of one repetition on the surface, px; default: a pixel of the picture for a px of the surface.
    turn, shift
        degrees clockwise, and then px to the right and down, that the print is moved by on the chart.
    """
    h, w = picture.shape[:2]
    scale = w / (tile_px or w)
    c, s = np.cos(np.radians(turn)) * scale, np.sin(np.radians(turn)) * scale
    back = np.array([[c, s], [-s, c]])  # from chart to print
    levels = _pyramid(picture)
    out = np.zeros((*valid.shape, picture.shape[2]), np.float32)
    for top in range(0, len(chart), _BAND):
        low, high = max(top - 1, 0), min(top + _BAND + 1, len(chart))
        good = valid[low:high] & (np.abs(chart[low:high]) < FARTHEST).all(2)  # False for NaN
        if good.any():
            at = ((chart[low:high].astype(np.float64) - shift) @ back.T + 0.5).transpose(2, 0, 1)
            at[:, ~good] = np.nan
            rows = slice(top - low, min(top + _BAND, len(chart)) - low)
            out[top : top + _BAND] = _sample(levels, at, good, (h, w))[rows]
    return out


def _pyramid(picture: np.ndarray) -> list[np.ndarray]:
    """The picture at full, half, quarter … size, each with a rim of its own other side."""
    levels, level = [], np.ascontiguousarray(picture, np.float32)
    while True:
        rim = np.pad(level, ((_RIM, _RIM), (_RIM, _RIM), (0, 0)), mode="wrap")
        levels.append(np.ascontiguousarray(rim))
        h, w = level.shape[:2]
        if max(h, w) == 1:
            return levels
        half = cv2.resize(level, (-(-w // 2), -(-h // 2)), interpolation=cv2.INTER_AREA)
        level = half.reshape(*half.shape[:2], -1)


def _sample(levels: list[np.ndarray], at: np.ndarray, good: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Means over the pixels (H, W, C) of the print at places `at` (2, H, W) px; where not `good`, 0, and `at` NaN."""
    steps = [[_slope(place, axis) for place in at] for axis in (1, 0)]  # d at / dx, d at / dy
    foot = np.maximum(*(np.hypot(*s) for s in steps)) / np.float32(SAMPLES)
    depth = np.clip(np.log2(np.maximum(foot, np.float32(1e-9))), 0, len(levels) - 1)
    first = np.unique(np.floor(depth[good])).astype(int)
    weights = {k: np.maximum(1 - np.abs(depth - k), 0) * good for n in first for k in (n, n + 1) if k < len(levels)}
    sharp = float(np.median(foot[good])) * SAMPLES < 1  # enlarged: interpolate smoothly
    wide = size[1], size[0]
    at = np.where(good, np.stack([place / n % 1.0 for place, n in zip(at, wide, strict=True)]), 0).astype(np.float32)
    steps = [[slope / np.float32(n) for slope, n in zip(s, wide, strict=True)] for s in steps]
    total = np.zeros((*good.shape, levels[0].shape[2]), np.float32)
    offsets = (np.arange(SAMPLES, dtype=np.float32) + np.float32(0.5)) / np.float32(SAMPLES) - np.float32(0.5)
    for dy in offsets:
        for dx in offsets:
            x, y = (at[k] + dx * steps[0][k] + dy * steps[1][k] for k in (0, 1))
            x -= np.floor(x)
            y -= np.floor(y)
            for k, weight in weights.items():
                total += weight[..., None] * _look_up(levels[k], x, y, sharp and k == 0)
    return total / np.float32(SAMPLES**2)


def _look_up(level: np.ndarray, x: np.ndarray, y: np.ndarray, sharp: bool) -> np.ndarray:
    """A level of the pyramid at x, y in 0…1."""
    h, w = level.shape[0] - 2 * _RIM, level.shape[1] - 2 * _RIM
    across, down = x * np.float32(w) + np.float32(_RIM - 0.5), y * np.float32(h) + np.float32(_RIM - 0.5)
    found = cv2.remap(level, across, down, cv2.INTER_CUBIC if sharp else cv2.INTER_LINEAR).reshape(*x.shape, -1)
    return np.maximum(found, 0) if sharp else found  # cubic interpolation undershoots


def _slope(place: np.ndarray, axis: int) -> np.ndarray:
    """Derivative (H, W) float32 of `place` (H, W) along an image axis, from the neighbours there are; 0 without any."""
    forward = np.diff(place, axis=axis).astype(np.float32)
    end = np.full_like(place.take([0], axis), np.nan, dtype=np.float32)
    before, after = np.concatenate([end, forward], axis), np.concatenate([forward, end], axis)
    mean = np.where(np.isfinite(before), np.where(np.isfinite(after), (before + after) / 2, before), after)
    return np.where(np.isfinite(mean), mean, np.float32(0))
