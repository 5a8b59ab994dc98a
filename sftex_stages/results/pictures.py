"""The PNGs that a person looks at first. Every function returns a picture, (h, w, 3) uint8 RGB."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence

import cv2
import numpy as np

from ..engine.stage import Arrays
from .exports import to_display
from .render import BACKGROUND

INK = (40, 40, 46)
FAINT = (120, 120, 128)
WARNING = (170, 60, 30)
_SUB = 4  # binary digits after the point of OpenCV's drawing coordinates


def instances(photo: np.ndarray, surface: Arrays, size: int = 1600) -> np.ndarray:
    """The instances as small circles lying on the surface, seen at their slant and tilt (the paper's Fig. 2, 11).

    photo (H, W, 3) uint8; surface: the stage's `instance/*`. Each circle is the image T · (unit circle) of one common
    radius, with a stroke along its normal; green: surely an instance and on the surface, red: surely not. Where they
    would cover each other, some are left out, without regard to their colour.
    """
    h, w = photo.shape[:2]
    zoom = float(np.clip(size / max(h, w), 0.05, 4))
    picture = cv2.resize(photo, None, fx=zoom, fy=zoom, interpolation=cv2.INTER_AREA if zoom < 1 else cv2.INTER_CUBIC)
    grey = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)[..., None]
    picture = (0.25 * picture + 0.45 * grey + 50).astype(np.uint8)  # pale, so that the circles stand out
    radius = _radius(surface["instance/xy"], (h, w))
    some = _apart(surface["instance/xy"], 2 * radius)
    xy, transform, normal = (surface[f"instance/{name}"][some] for name in ("xy", "transform", "normal"))
    trust = surface["instance/inlier"][some]
    sizes = np.linalg.svd(transform, compute_uv=False)[:, :1, None]
    typical = np.median(sizes) if len(sizes) else 1.0  # the unit disc's own size means nothing to a reader
    transform = transform / np.clip(sizes, typical / 2, typical * 2) * np.clip(sizes / typical, 0.5, 2)
    angle = np.linspace(0, 2 * np.pi, 33)
    circle = radius * np.stack([np.cos(angle), np.sin(angle)])
    rings = _pixels(xy[:, None] + (transform @ circle).transpose(0, 2, 1), zoom)
    strokes = _pixels(np.stack([xy, xy + 1.25 * radius * normal[:, :2]], 1), zoom)
    # Twenty shades, drawn shade by shade, the sure ones last and so on top; a dark rim keeps them legible on any print.
    shade = np.clip((trust * 20).astype(int), 0, 19)
    width = 2 if radius * zoom > 7 else 1
    for lines, closed in ((rings, True), (strokes, False)):
        cv2.polylines(picture, list(lines), closed, (25, 25, 25), width + 2, cv2.LINE_AA, _SUB)
    for k in np.unique(shade):
        for lines, closed in ((rings, True), (strokes, False)):
            cv2.polylines(
                picture, list(lines[shade == k]), closed, _traffic_light((k + 0.5) / 20), width, cv2.LINE_AA, _SUB
            )
    used = len(np.unique(surface["instance/texton"]))
    n = len(surface["instance/xy"])
    count = f"{n} instances" if len(some) == n else f"{len(some)} of {n} instances"
    words = f"{count} of {used} texton{'s' * (used != 1)}, as circles on the surface with their normals"
    return _legend(picture, words, [("sure", 1.0), ("doubtful", 0.5), ("rejected", 0.0)])


def textons(frontal: Sequence[Arrays], counts: np.ndarray) -> np.ndarray:
    """The frontal textons and how EM sharpened them (Fig. 4): a row each, columns after 1, 5, 10, 20 iterations.

    counts (K,): instances that entered the surface. Usable textons first, the larger ones before; textons that never
    got an appearance are summed up at the end, by their reason.
    """
    shown = [k for k, t in enumerate(frontal) if t["appearance"].size]
    shown.sort(key=lambda k: (not frontal[k]["usable"], -int(counts[k]), -len(frontal[k]["xy"]), k))
    tile, gap, words_width = 76, 6, 170
    cell = np.array([4 * (tile + gap) + words_width + 24, tile + gap])
    columns = int(np.clip(round(np.sqrt(len(shown) * cell[1] / cell[0] * 1.3)), 1, 5))
    rows = -(-len(shown) // columns) if shown else 0
    missing = _missing([t for t in frontal if not t["appearance"].size])
    top, bottom = 64, 20 * len(missing) + (16 if missing else 0)
    picture = np.full((top + rows * cell[1] + bottom + 10, max(columns * cell[0] + 16, 720), 3), BACKGROUND, np.uint8)
    usable = sum(bool(t["usable"]) for t in frontal)
    _write(picture, f"{len(frontal)} textons, {usable} usable, {int(np.sum(counts))} instances", (16, 28), 20, INK, 600)
    for place, k in enumerate(shown):
        x0, y0 = 16 + place // rows * cell[0], top + place % rows * cell[1]
        if place % rows == 0:
            for i, n in enumerate(frontal[k]["progress_iterations"]):
                label = f"after {n}" if i == 0 else f"{n} iterations" if i == 3 else str(n)
                _write(picture, label, (x0 + i * (tile + gap), top - 8), 13, FAINT)
        for i, view in enumerate(_tiles(frontal[k], tile)):
            x = x0 + i * (tile + gap)
            picture[y0 : y0 + tile, x : x + tile] = view
        _caption(picture, frontal[k], k, int(counts[k]), (x0 + 4 * (tile + gap) + 4, y0 + 15))
    for i, line in enumerate(missing):
        _write(picture, line, (16, top + rows * cell[1] + 22 + 20 * i), 14, FAINT)
    return picture


def normal_map(normals: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Normals in the usual colours: red to the right, green up, blue toward the viewer; 128 is 0."""
    n = np.where(valid[..., None], normals, 0) * np.array([1, -1, 1], np.float32)
    picture = ((n * 0.5 + 0.5) * 255 + 0.5).astype(np.uint8)
    picture[~valid] = BACKGROUND
    return picture


def irradiance(field: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """The relative irradiance map (H, W) in colours, logarithmic, with its colour bar (Fig. 10)."""
    valid = valid & np.isfinite(field)
    log = np.log2(np.maximum(field[valid], 1e-6))
    low, high = np.percentile(log, [0.5, 99.5])
    # At least 20 % of range: a constant field must not show its noise in full colour.
    middle, half = (low + high) / 2, max((high - low) / 2, 0.13)
    low, high = middle - half, middle + half
    h = len(field)
    level = (np.log2(np.maximum(np.where(valid, field, 1), 1e-6)) - low) / (high - low)
    picture = _colors(level)
    picture[~valid] = BACKGROUND
    unit = max(h / 700, 0.35)  # letters grow with the picture
    bar_x, bar_w, bar_h = int(24 * unit), int(26 * unit), int(0.8 * h)
    side = np.full((h, int(128 * unit), 3), BACKGROUND, np.uint8)
    y0 = (h - bar_h) // 2
    ramp = _colors(np.linspace(1, 0, bar_h)[:, None])
    side[y0 : y0 + bar_h, bar_x : bar_x + bar_w] = ramp
    for tick in _ticks(2**low, 2**high):
        y = int(y0 + bar_h * (1 - (np.log2(tick) - low) / (high - low)))
        cv2.line(side, (bar_x + bar_w, y), (bar_x + bar_w + int(6 * unit), y), INK, max(1, int(unit)))
        _write(side, f"{tick:g}", (bar_x + bar_w + int(11 * unit), y + int(6 * unit)), int(18 * unit), INK)
    _write(side, "irradiance", (bar_x, y0 - int(28 * unit)), int(16 * unit), INK)
    _write(side, "geom. mean 1", (bar_x, y0 - int(9 * unit)), int(13 * unit), FAINT)
    return np.hstack([picture, side])


# ---------------------------------------------------------------------------------------------------- parts


def _radius(xy: np.ndarray, shape: tuple[int, int]) -> float:
    """A radius in px at which circles fill the picture and do not overlap: 0.45 × the usual distance of neighbours."""
    if len(xy) < 2:
        return 0.03 * max(shape)
    from scipy.spatial import cKDTree

    apart = np.median(cKDTree(xy).query(xy, k=2)[0][:, 1])
    return float(np.clip(0.45 * apart, 0.011 * max(shape), 0.03 * max(shape)))


def _apart(xy: np.ndarray, distance: float) -> np.ndarray:
    """Indices of points at least about `distance` apart, in a fixed random order of preference."""
    if not len(xy):
        return np.zeros(0, int)
    cells = np.floor((xy - xy.min(0)) / distance * 8).astype(int) + 8  # eight cells to the distance
    covered = np.zeros(cells.max(0)[::-1] + 9, np.uint8)
    chosen = []
    for i in np.random.default_rng(0).permutation(len(xy)):
        x, y = map(int, cells[i])
        if not covered[y, x]:
            cv2.circle(covered, (x, y), 8, 1, cv2.FILLED)
            chosen.append(i)
    return np.sort(np.array(chosen))


def _pixels(points: np.ndarray, zoom: float) -> np.ndarray:
    """Photograph px to drawing coordinates in the enlarged picture; pixel centres are at integers in both."""
    return np.round(((points + 0.5) * zoom - 0.5) * 2**_SUB).astype(np.int32)


def _traffic_light(p: float) -> tuple[int, int, int]:
    """Green for 1, yellow for a half, red for 0."""
    red, yellow, green = np.array([[226, 44, 52], [247, 198, 40], [38, 200, 92]])
    r, g, b = yellow + ((green - yellow) * (2 * p - 1) if p > 0.5 else (red - yellow) * (1 - 2 * p))
    return int(r), int(g), int(b)


def _legend(picture: np.ndarray, words: str, colors: list[tuple[str, float]]) -> np.ndarray:
    strip = np.full((44, picture.shape[1], 3), BACKGROUND, np.uint8)
    x = _write(strip, words, (14, 28), 18, INK) + 26
    for name, p in colors:
        cv2.circle(strip, (x, 22), 7, _traffic_light(p), 3, cv2.LINE_AA)
        x = _write(strip, name, (x + 14, 28), 18, INK) + 26
    return np.vstack([picture, strip])


def _tiles(texton: Arrays, tile: int) -> list[np.ndarray]:
    """The appearance after 1, 5, 10, 20 iterations, one exposure for all, fading where the texton's domain ends."""
    domain = np.clip(texton["domain"] / max(float(texton["domain"].max(initial=0)), 1e-6), 0, 1)
    y, x = np.nonzero(domain > 0.15)
    box: tuple[slice, slice] = (slice(None), slice(None))
    if len(y):  # the grid may be far larger than what was learnt to be the element
        side = max(int(np.ptp(y)), int(np.ptp(x)), 8) // 2 + 1
        cy, cx = int(y.min() + y.max()) // 2, int(x.min() + x.max()) // 2
        box = (slice(max(cy - side, 0), cy + side + 1), slice(max(cx - side, 0), cx + side + 1))
    domain = domain[box]
    inside = texton["appearance"][box][domain > 0.3]
    bright = float(np.percentile(inside[np.isfinite(inside)], 99)) if np.isfinite(inside).any() else 1.0
    fit = tile / max(domain.shape)
    alpha = cv2.resize(np.sqrt(domain).astype(np.float32), None, fx=fit, fy=fit)[..., None]
    tiles = []
    for view in texton["progress"]:
        large = cv2.resize(np.nan_to_num(view[box]), alpha.shape[1::-1], interpolation=cv2.INTER_CUBIC)
        color = to_display(large, 0.9 / max(bright, 1e-6))
        blended = (alpha * color + (1 - alpha) * np.array(BACKGROUND) + 0.5).astype(np.uint8)
        blank = np.full((tile, tile, 3), BACKGROUND, np.uint8)
        y0, x0 = (tile - alpha.shape[0]) // 2, (tile - alpha.shape[1]) // 2
        blank[y0 : y0 + alpha.shape[0], x0 : x0 + alpha.shape[1]] = blended
        tiles.append(blank)
    return tiles


def _caption(picture: np.ndarray, texton: Arrays, number: int, count: int, at: tuple[int, int]) -> None:
    x, y = at
    _write(picture, f"texton {number}", (x, y), 15, INK, 600)
    if texton["usable"]:
        _write(picture, f"{count} instances", (x, y + 19), 14, INK)
        if np.isfinite(texton["metric_residual"]):
            _write(picture, f"residual {float(texton['metric_residual']):.3f}", (x, y + 37), 13, FAINT)
        return
    for i, line in enumerate(textwrap.wrap(str(texton["reason"]) or "not usable", 29, max_lines=4, placeholder=" …")):
        _write(picture, line, (x, y + 16 + 15 * i), 12, WARNING)


def _missing(frontal: list[Arrays]) -> list[str]:
    reasons: dict[str, int] = {}
    for texton in frontal:
        reason = str(texton["reason"]) or "no reason given"
        reasons[reason] = reasons.get(reason, 0) + 1
    ordered = sorted(reasons.items(), key=lambda r: -r[1])
    lines = [f"not shown: {n} cluster{'s' * (n != 1)} without an appearance ({reason})" for reason, n in ordered[:6]]
    rest = sum(n for _, n in ordered[6:])
    return lines + ([f"and {rest} more, for other reasons"] if rest else [])


def _colors(level: np.ndarray) -> np.ndarray:
    """0…1 to colours, (h, w, 3) RGB."""
    return cv2.applyColorMap((np.clip(level, 0, 1) * 255 + 0.5).astype(np.uint8), cv2.COLORMAP_INFERNO)[
        ..., ::-1
    ].copy()


def _ticks(low: float, high: float) -> list[float]:
    """A few round numbers in a range of ratios: evenly spaced in a narrow range, by decades and their parts in a wide one."""
    if high < 3 * low:
        step = 10.0 ** np.floor(np.log10(high - low))
        step *= next(m for m in (0.2, 0.5, 1, 2) if (high - low) / (m * step) <= 8)
        ticks = np.arange(np.ceil(low / step), np.floor(high / step) + 1) * step
    else:
        decades = 10.0 ** np.arange(-7, 8)[:, None]
        for parts in ([1, 1.5, 2, 3, 5, 7], [1, 2, 5], [1]):
            ticks = np.ravel(decades * parts)
            ticks = ticks[(ticks >= low) & (ticks <= high)]
            if len(ticks) <= 9:
                break
    return [float(f"{t:.4g}") for t in ticks]


def _write(
    picture: np.ndarray, text: str, at: tuple[int, int], size: int, color: tuple[int, int, int], weight: int = 400
) -> int:
    """Write text with its base line's left end `at`, in place; returns the x where it ends."""
    return int(cv2.putText(picture, text, at, color, cv2.FontFace("sans"), size, weight)[0][0])
