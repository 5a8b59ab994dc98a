"""Random scenes with their exact truth, for looking at what nothing was tuned to: ``python -m sftex_stages.bench.scenes``.

A scene is a surface Z(X, Y), a print of elements on it, a light and a camera, all drawn by seed. Every pixel's sight line is
met with the surface, and the albedo looked up in the element that lies there, flat on the tangent plane at its centre. Frame
and files are those of `data/examples/README.md`. The camera of perspective scenes is at (c_x, c_y, f).
"""

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import h5py
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from scipy.spatial import cKDTree

from ..detect import display

Array = NDArray[Any]
Height = Callable[[Array, Array], Array]

SURFACES = ("sphere", "ellipsoid", "saddle", "cylinder", "bumps", "folds", "sheet", "plane")
PRINTS = ("glyphs", "wallpaper", "dots", "shapes", "small", "large", "sparse", "coloured")
LIGHTS = ("distant", "near", "shadow", "constant")
CAMERAS = ("orthographic", "orthographic", "weak", "strong")
_FINE = 3  # samples a pixel along each axis
_TEXELS = 192  # width of a motif's picture; its element has radius 1 and spans 2.2
_STEEPEST = {"saddle": 55, "bumps": 52, "folds": 62, "sheet": 55}  # degrees


class Scene(NamedTuple):
    """A photograph and all that is true of it; H × W pixels, N elements."""

    rgb: Array  # (H, W, 3) linear, before noise
    height: Array  # (H, W) px
    normals: Array  # (H, W, 3)
    valid: Array  # (H, W) bool
    light: Array  # (H, W)
    xy: Array  # (N, 2) px
    transform: Array  # (N, 2, 2) frontal px to image px
    normal: Array  # (N, 3)
    texton: Array  # (N,)
    radius: Array  # (N,) frontal px
    camera: tuple[float, Array]  # focal length (inf: orthographic) and principal point, px


class Recipe(NamedTuple):
    """What is drawn for a scene."""

    surface: str
    print: str
    light: str
    camera: str
    size: tuple[int, int]  # W, H
    noise: bool


def recipes(count: int, seed: int) -> list[Recipe]:
    """`count` recipes that go through all surfaces, prints, lights and cameras as evenly as they can."""
    rng = np.random.default_rng(seed)

    def deal(names: tuple[str, ...]) -> list[str]:
        rounds = [names[i] for _ in range(-(-count // len(names))) for i in rng.permutation(len(names))]
        return rounds[:count]

    dealt = zip(deal(SURFACES), deal(PRINTS), deal(LIGHTS), deal(CAMERAS), strict=True)
    sizes = rng.integers(500, 1150, (count, 2))
    return [Recipe(*d, (int(max(s)), int(min(s))), i % 4 == 3) for i, (d, s) in enumerate(zip(dealt, sizes, strict=True))]


# ------------------------------------------------------------------------------------------------------------- surface


def surface(name: str, size: tuple[int, int], rng: np.random.Generator) -> tuple[Height, Height]:
    """Z(X, Y), px, and where there is a surface (positive); both take positions from the image's centre."""
    half = min(size) / 2
    turn = rng.uniform(0, np.pi)
    c, s = np.cos(turn), np.sin(turn)
    lean = np.tan(np.radians(rng.uniform(10, 25))) * np.array([np.cos(3 * turn), np.sin(3 * turn)])
    phase, span = rng.uniform(0, 6.28, 4), rng.uniform(0.7, 1.1) * half
    spots = rng.uniform(-1.3, 1.3, (9, 2)) * np.array(size) / 2
    wide, tall = rng.uniform(0.28, 0.5, 9) * half, rng.choice([-1.0, 1.0], 9) * rng.uniform(0.6, 1, 9)

    def everywhere(x: Array, y: Array) -> Array:
        return np.ones_like(x)

    def ball(x: Array, y: Array, r: float, flat: float = 1.0, wide: float = 1.0) -> Array:
        u, v = (c * x + s * y) / wide, -s * x + c * y
        return flat * np.sqrt(np.maximum(r * r - u * u - v * v, 1e-6))

    if name == "sphere":
        return lambda x, y: ball(x, y, 0.92 * half), lambda x, y: (0.9 * half) ** 2 - x * x - y * y
    if name == "ellipsoid":  # fills the picture
        return lambda x, y: ball(x, y, 1.35 * float(np.hypot(*size)) / 2, 0.9, 1.4), everywhere
    if name == "cylinder":
        r = 0.8 * half
        return (
            lambda x, y: np.sqrt(np.maximum(r * r - (c * x + s * y) ** 2, 1e-6)) + 0.2 * (c * y - s * x),
            lambda x, y: (0.97 * r) ** 2 - (c * x + s * y) ** 2,
        )
    if name == "plane":
        steep = np.tan(np.radians(rng.uniform(35, 50)))
        return lambda x, y: steep * (c * x + s * y), everywhere

    def shape(x: Array, y: Array) -> Array:
        u, v = c * x + s * y, -s * x + c * y
        if name == "saddle":
            return (u * u - v * v) / half
        if name == "sheet":
            return np.sin(2 * np.pi * u / span + phase[0]) * span + 0.4 * u
        if name == "folds":
            bent = u + 0.12 * span * np.sin(2 * np.pi * v / (1.7 * span) + phase[1])
            deep = 1 + 0.5 * np.sin(2 * np.pi * v / (2.6 * span) + phase[2])
            return deep * (np.sin(2 * np.pi * bent / span + phase[0]) + 0.2 * np.sin(4.4 * np.pi * bent / span)) * span
        rows = zip(spots, wide, tall, strict=True)
        return sum(h * w * np.exp(-((x - p[0]) ** 2 + (y - p[1]) ** 2) / (2 * w * w)) for p, w, h in rows) + np.zeros_like(x)

    y, x = np.mgrid[-0.5:0.5:60j, -0.5:0.5:60j] * np.array([size[1], size[0]])[:, None, None]
    steepest = np.quantile(np.hypot(*slopes(shape, x, y)), 0.98)
    factor = np.tan(np.radians(_STEEPEST[name])) / steepest
    tilted = lean if rng.random() < 0.5 and name != "sheet" else np.zeros(2)
    return lambda x, y: factor * shape(x, y) + tilted[0] * x + tilted[1] * y, everywhere


def slopes(z: Height, x: Array, y: Array) -> tuple[Array, Array]:
    """∂Z/∂X and ∂Z/∂Y by central differences."""
    e = 1e-3
    return (z(x + e, y) - z(x - e, y)) / (2 * e), (z(x, y + e) - z(x, y - e)) / (2 * e)


def meet(z: Height, focal: float, x: Array, y: Array) -> tuple[Array, Array]:
    """Points (…, 3) in which the sight lines of pixels (x, y) from the centre meet the surface, by Newton; where they do."""
    height = z(x, y)
    if np.isinf(focal):
        return np.stack([x, y, height], -1), np.ones(x.shape, bool)
    for _ in range(25):
        shrink = 1 - height / focal
        p, q = slopes(z, x * shrink, y * shrink)
        miss = height - z(x * shrink, y * shrink)
        height = height - miss / np.maximum(1 + (p * x + q * y) / focal, 0.2)
        height = np.clip(height, -3 * focal, 0.8 * focal)
    shrink = 1 - height / focal
    return np.stack([x * shrink, y * shrink, height], -1), np.abs(height - z(x * shrink, y * shrink)) < 1e-3


# --------------------------------------------------------------------------------------------------------------- print


def motif(kind: str, ground: Array, ink: Array, rng: np.random.Generator) -> Array:
    """Picture (_TEXELS, _TEXELS, 3) of linear albedo of one element on its ground; the disc of radius 1 spans 1/1.1 of it."""
    big = 4 * _TEXELS
    picture = np.zeros((big, big), np.uint8)
    unit = big / 2.2

    def at(x: float, y: float) -> tuple[int, int]:
        return int(big / 2 + unit * x), int(big / 2 + unit * y)

    def polygon(points: Array, level: int = 255) -> None:
        cv2.fillPoly(picture, [np.array([at(*p) for p in points], np.int32)], level)

    angle = np.linspace(0, 2 * np.pi, 240, endpoint=False)
    around = np.stack([np.cos(angle), np.sin(angle)], -1)
    thick = int(unit * rng.uniform(0.16, 0.26))
    if kind == "dot":
        polygon(0.85 * around)
    elif kind == "ring":
        polygon(0.9 * around)
        polygon(0.5 * around, 0)
    elif kind == "square":
        polygon(0.65 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]))
    elif kind == "cross":
        for a, b in (((-0.8, 0), (0.8, 0)), ((0, -0.8), (0, 0.8))):
            cv2.line(picture, at(*a), at(*b), 255, thick)
    elif kind == "letter":
        sign, font = str(rng.choice(list("AEFGJKPQRY2457"))), cv2.FONT_HERSHEY_DUPLEX
        (w, h), _ = cv2.getTextSize(sign, font, unit / 15, thick)
        cv2.putText(picture, sign, (big // 2 - w // 2, big // 2 + h // 2), font, unit / 15, 255, thick)
    elif kind == "flower":
        petals = rng.integers(4, 8)
        polygon(around * (0.6 + 0.3 * np.cos(petals * angle))[:, None])
        polygon(around * 0.2 + rng.uniform(-0.15, 0.15, 2), 90)
    else:  # a glyph of a few strokes
        for _ in range(rng.integers(3, 6)):
            a, b = rng.uniform(-0.7, 0.7, (2, 2))
            cv2.line(picture, at(*a), at(*b), int(rng.integers(140, 256)), thick)
        polygon(0.2 * around + rng.uniform(-0.5, 0.5, 2))
    part = cv2.resize(picture, (_TEXELS, _TEXELS), interpolation=cv2.INTER_AREA)[..., None] / 255.0
    return (1 - part) * ground + part * ink


class Print(NamedTuple):
    """What is printed and how."""

    motifs: list[Array]
    radius: float  # px
    factors: Array  # (K,) sizes of the motifs
    pitch: float  # px between neighbours
    aligned: bool
    ground: Array  # (3,)


def make_print(name: str, rng: np.random.Generator) -> Print:
    """The print of that name."""
    light, dark = rng.uniform(0.55, 0.85, 3), rng.uniform(0.04, 0.25, 3)
    ground, ink = (light, dark) if rng.random() < 0.7 else (dark, light)
    if name == "coloured":  # of nearly one luminance
        grey = np.array([0.2126, 0.7152, 0.0722])
        ground, ink = np.array([0.55, 0.12, 0.1]), np.array([0.08, 0.22, 0.5])
        ink = ink * (1.12 * (ground @ grey) / (ink @ grey))
    kinds = {
        "glyphs": ["glyph"] * 4, "wallpaper": ["flower", "glyph", "letter"], "dots": ["dot", "dot"],
        "shapes": ["ring", "square", "cross"], "small": ["letter", "glyph"], "large": ["letter", "flower", "glyph"],
        "sparse": ["letter", "letter"], "coloured": ["glyph", "flower"],
    }[name]  # fmt: skip
    width = {"small": 15.0, "large": 50.0}.get(name, rng.uniform(22, 34))
    gap = {"sparse": 2.6, "dots": 1.35, "wallpaper": 1.3}.get(name, rng.uniform(1.15, 1.5))
    factors = np.array([1.0, 0.6]) if name == "dots" else np.ones(len(kinds))
    motifs = [motif(k, ground, np.clip(ink * rng.uniform(0.85, 1.15, 3), 0.02, 0.95), rng) for k in kinds]
    return Print(motifs, width / 2, factors, gap * width, name == "wallpaper", ground)


def place(design: Print, points: Array, normals: Array, valid: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """Pixels (N,), as flat indices, at which elements lie, and their motifs (N,).

    Aligned ones on a lattice of arc lengths along rows and columns; else thrown at random, none nearer than the pitch.
    """
    flat, steep = points.reshape(-1, 3), normals[..., 2].ravel()
    allowed = np.flatnonzero(valid.ravel() & (steep > np.cos(np.radians(80))))
    if design.aligned:
        u, v = (np.cumsum(np.pad(_gaps(points, valid, k), ((0, 0),) * 2), k) for k in (1, 0))
        u, v = u - u[:, [u.shape[1] // 2]], v - v[[v.shape[0] // 2]]
        uv = np.stack([u.ravel(), v.ravel()], -1)[allowed] / design.pitch
        node = np.rint(uv)
        candidates = np.flatnonzero(np.abs(uv - node).max(1) < 1.0 / design.pitch)
        which = ((node[:, 0] + 2 * node[:, 1]) % len(design.motifs)).astype(int)
        order = candidates[np.argsort(np.abs(uv - node)[candidates].max(1), kind="stable")]
        least = 0.8 * design.pitch
    else:
        area = 1 / steep[allowed]
        enough = int(60 * area.sum() / design.pitch**2)
        order = rng.choice(len(allowed), min(len(allowed), 40000, enough), replace=False, p=area / area.sum())
        which = rng.integers(len(design.motifs), size=len(allowed))
        least = design.pitch
    near = cKDTree(flat[allowed[order]]).query_ball_point(flat[allowed[order]], least)
    free = np.ones(len(order), bool)
    taken = []
    for i, close in enumerate(near):
        if free[i]:
            taken.append(order[i])
            free[close] = False
    at = np.array(taken)
    return allowed[at], which[at]


def _gaps(points: Array, valid: Array, axis: int) -> Array:
    """Distances between surface points of neighbouring pixels along `axis`; 0 before the first and off the surface."""
    step = np.linalg.norm(np.diff(points, axis=axis, prepend=points.take([0], axis)), axis=-1)
    return np.where(valid & np.isfinite(step), step, 0)


def tangents(normal: Array, spin: Array) -> Array:
    """Axes (N, 3, 2) of the elements' frames on the surface: x of the image laid on it, turned by `spin`."""
    first = np.array([1.0, 0, 0]) - normal * normal[:, :1]
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(normal, first)
    second *= np.where(second[:, 1:2] < 0, -1, 1)
    c, s = np.cos(spin)[:, None], np.sin(spin)[:, None]
    return np.stack([c * first + s * second, -s * first + c * second], -1)


# --------------------------------------------------------------------------------------------------------------- light


def illuminate(name: str, points: Array, normals: Array, size: tuple[int, int], rng: np.random.Generator) -> Array:
    """Irradiance (H, W) ≥ 0 at points (H, W, 3)."""
    around, up = rng.uniform(0, 2 * np.pi), np.radians(rng.uniform(35, 60))
    toward = np.array([np.cos(around) * np.cos(up), np.sin(around) * np.cos(up), np.sin(up)])
    if name == "constant":
        return np.ones(points.shape[:2])
    if name == "near":
        d = toward * 1.1 * max(size) - points
        distance = np.linalg.norm(d, axis=-1)
        return 0.15 + np.maximum((d * normals).sum(-1), 0) / distance * (max(size) / distance) ** 2
    direct = np.maximum(normals @ toward, 0)
    if name == "distant":
        return 0.12 + direct
    edge = np.cos(around + 1) * points[..., 0] + np.sin(around + 1) * points[..., 1]
    edge = edge + 0.15 * min(size) * np.sin(edge[::-1] / min(size) * 5) - rng.uniform(-0.2, 0.2) * min(size)
    return 0.35 + direct / (1 + np.exp(-np.clip(edge / (0.03 * min(size)), -40, 40)))  # the edge of something's shadow


# -------------------------------------------------------------------------------------------------------------- scene


class View(NamedTuple):
    """A surface as the camera sees it."""

    z: Height
    focal: float  # px; inf: orthographic
    x: Array  # (H, W) px from the centre
    y: Array  # (H, W)
    points: Array  # (H, W, 3)
    normals: Array  # (H, W, 3)
    valid: Array  # (H, W)


def look(recipe: Recipe, rng: np.random.Generator) -> View:
    """The surface of a recipe; the point on the axis is at the distance f."""
    w, h = recipe.size
    focal = {"weak": rng.uniform(2, 3), "strong": rng.uniform(1, 1.4)}.get(recipe.camera, np.inf) * w
    shape, there = surface(recipe.surface, recipe.size, rng)
    level = shape(np.zeros(1), np.zeros(1))

    def z(x: Array, y: Array) -> Array:
        return shape(x, y) - level

    y, x = np.mgrid[0:h, 0:w] - np.array([(h - 1) / 2, (w - 1) / 2])[:, None, None]
    points, valid = meet(z, focal, x, y)
    normals = _normals(z, points)
    to_camera = np.array([0, 0, 1.0]) if np.isinf(focal) else np.array([0, 0, focal]) - points
    facing = (normals * to_camera).sum(-1) / np.linalg.norm(to_camera, axis=-1)
    return View(z, focal, x, y, points, normals, valid & (there(points[..., 0], points[..., 1]) > 0) & (facing > 0.05))


def render(recipe: Recipe, rng: np.random.Generator) -> Scene:
    """The scene of a recipe."""
    w, h = recipe.size
    centre = np.array([(w - 1) / 2, (h - 1) / 2])
    z, focal, x, y, points, normals, valid = look(recipe, rng)
    design = make_print(recipe.print, rng)
    at, which = place(design, points, normals, valid, rng)
    middle, normal = points.reshape(-1, 3)[at], normals.reshape(-1, 3)[at]
    spin = np.full(len(at), rng.uniform(-0.4, 0.4)) if design.aligned else rng.uniform(-np.pi, np.pi, len(at))
    axes, radius = tangents(normal, spin), design.radius * design.factors[which]
    xy = np.stack([x.ravel()[at], y.ravel()[at]], -1)
    shrink = 1 - middle[:, 2] / focal
    project = (axes[:, :2] + xy[:, :, None] * axes[:, 2:] / focal) / shrink[:, None, None]
    reflect = albedo(z, focal, recipe.size, design, which, middle, normal, axes, radius, project, xy + centre)
    light = np.where(valid, illuminate(recipe.light, points, normals, recipe.size, rng), 0)
    behind = rng.uniform(0.05, 0.4) * (0.6 + 0.8 * gaussian_filter(rng.random((h, w, 3)), (25, 25, 0)))
    rgb = np.where(valid[..., None], reflect * light[..., None], behind * np.median(light[valid]))
    rgb = gaussian_filter(rgb / np.quantile(rgb, 0.998), (0.4, 0.4, 0))
    keep = radius[:, None] < np.minimum(xy + centre, np.array(recipe.size) - 1 - xy - centre)
    k = keep.all(1)
    return Scene(
        rgb, points[..., 2], normals, valid, light,
        (xy + centre)[k], project[k], normal[k], which[k], radius[k], (focal, centre),
    )  # fmt: skip


def _normals(z: Height, points: Array) -> Array:
    p, q = slopes(z, points[..., 0], points[..., 1])
    n = np.stack([-p, -q, np.ones_like(p)], -1)
    return n / np.linalg.norm(n, axis=-1, keepdims=True)


def albedo(
    z: Height, focal: float, size: tuple[int, int], design: Print, which: Array, middle: Array, normal: Array,
    axes: Array, radius: Array, project: Array, xy: Array,
) -> Array:  # fmt: skip
    """Albedo (H, W, 3), averaged over each pixel: ground, and over it the elements."""
    w, h = size
    centre = np.array([(w - 1) / 2, (h - 1) / 2])
    out = np.empty((h, w, 3))
    out[:] = design.ground
    smooth = [
        gaussian_filter(m, (s, s, 0))
        for m, f in zip(design.motifs, design.factors, strict=True)
        for s in [_TEXELS / 2.2 / (design.radius * f) / (2 * _FINE)]
    ]
    offset = (np.arange(_FINE) + 0.5) / _FINE - 0.5
    reach = np.ceil(1.25 * radius[:, None] * np.abs(project).sum(-1) + 1).astype(int)
    for k in range(len(xy)):
        low = np.maximum(np.rint(xy[k]).astype(int) - reach[k], 0)
        high = np.minimum(np.rint(xy[k]).astype(int) + reach[k] + 1, [w, h])
        cols, rows = ((np.arange(a, b)[:, None] + offset).ravel() for a, b in zip(low, high, strict=True))
        x, y = np.meshgrid(cols - centre[0], rows - centre[1])
        points, met = meet(z, focal, x, y)
        off = points - middle[k]
        s = off @ axes[k]
        flat = np.linalg.norm(s, axis=-1)
        far = np.linalg.norm(off, axis=-1)  # chords, not their projections, are nearly lengths on the surface
        s *= (far / np.maximum(flat, 1e-9) / radius[k])[..., None]
        inside = met & (far < 1.1 * radius[k]) & (np.abs(off @ normal[k]) < 0.7 * far + 0.1)
        place_ = ((s + 1.1) / 2.2 * _TEXELS - 0.5).astype(np.float32)
        seen = cv2.remap(smooth[which[k]], place_[..., 0], place_[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        change = np.where(inside[..., None], seen - design.ground, 0)
        shape = (high[1] - low[1], _FINE, high[0] - low[0], _FINE, 3)
        out[low[1] : high[1], low[0] : high[0]] += change.reshape(shape).mean((1, 3))
    return out


# --------------------------------------------------------------------------------------------------------------- files


def write(scene: Scene, path: Path, about: str, noise: bool, rng: np.random.Generator) -> None:
    """PATH.png (or PATH.jpg with noise) and PATH.truth.h5."""
    rgb = scene.rgb
    if noise:
        rgb = rgb + 0.01 * rng.normal(size=rgb.shape) * np.sqrt(0.2 + np.maximum(rgb, 0))
    eight = np.round(255 * display(rgb)).astype(np.uint8)[..., ::-1]
    suffix = ".jpg" if noise else ".png"
    cv2.imwrite(str(path.with_name(path.name + suffix)), eight, [cv2.IMWRITE_JPEG_QUALITY, 85] if noise else [])
    focal, centre = scene.camera
    valid = scene.valid
    with h5py.File(path.with_name(path.name + ".truth.h5"), "w") as file:
        file.attrs["schema"] = "sftex-truth-1"
        file.attrs["about"] = about
        file.attrs["axes"] = "x right, y down, z toward the camera; pixel centres at integers"
        file.attrs["camera"] = "orthographic" if np.isinf(focal) else "perspective"
        if np.isfinite(focal):
            file.attrs["focal_px"], file.attrs["principal_point"] = focal, centre
        arrays = {
            "surface/height": np.where(valid, scene.height, np.nan).astype(np.float32),
            "surface/normals": np.where(valid[..., None], scene.normals, 0).astype(np.float32),
            "surface/valid": valid,
            "irradiance/map": np.where(valid, scene.light, 0).astype(np.float32),
            "instances/xy": scene.xy.astype(np.float32),
            "instances/transform": scene.transform.astype(np.float32),
            "instances/normal": scene.normal.astype(np.float32),
            "instances/texton": scene.texton.astype(np.int32),
            "instances/radius_px": scene.radius.astype(np.float32),
        }
        for name, array in arrays.items():
            file.create_dataset(name, data=array, compression="gzip", shuffle=True)


def main() -> None:
    """Write scenes to a folder."""
    parser = argparse.ArgumentParser(prog="python -m sftex_stages.bench.scenes", description="Random scenes with their truth.")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--count", type=int, default=12)
    args = parser.parse_args()
    args.folder.mkdir(parents=True, exist_ok=True)
    for i, recipe in enumerate(recipes(args.count, args.seed)):
        rng = np.random.default_rng([args.seed, i])
        scene = render(recipe, rng)
        parts = [f"s{args.seed}-{i:02d}", recipe.surface, recipe.print, recipe.light]
        parts += [] if recipe.camera == "orthographic" else [recipe.camera]
        write(scene, args.folder / "_".join(parts), str(recipe._asdict()), recipe.noise, rng)
        print(f"{'_'.join(parts)}: {recipe.size[0]} x {recipe.size[1]}, {len(scene.xy)} elements", flush=True)


if __name__ == "__main__":
    main()
