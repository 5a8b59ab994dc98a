"""A small textured surface with everything about it known: each instance's transform, centre, normal and light."""

from typing import NamedTuple

import numpy as np

from sftex_stages.geometry.imaging import compose

PAPER = 0.8  # albedo between the elements


class Scene(NamedTuple):
    rgb: np.ndarray  # (H, W, 3) float32 linear
    xy: np.ndarray  # (N, 2)
    transform: np.ndarray  # (N, 2, 2) element units → px
    normal: np.ndarray  # (N, 3)
    light: np.ndarray  # (N,)


def glyph(s):
    """Albedo (..., 3) of an element without symmetry, of radius 1, at (..., 2): four soft strokes on paper."""
    ink = np.zeros(s.shape[:-1])
    for (x, y), (dx, dy), width in (
        ((-0.35, 0.0), (0.0, 0.6), 0.16),
        ((0.15, -0.55), (0.45, 0.0), 0.14),
        ((0.05, 0.0), (0.35, 0.1), 0.12),
        ((0.42, 0.47), (0.1, 0.14), 0.14),
    ):
        d = s - np.array([x, y])
        along = np.clip((d * [dx, dy]).sum(-1) / (dx * dx + dy * dy), -1, 1)
        far = np.linalg.norm(d - along[..., None] * np.array([dx, dy]), axis=-1)
        ink = np.maximum(ink, 1 / (1 + np.exp(np.minimum((far - width) / 0.03, 40))))
    return PAPER - ink[..., None] * np.array([0.65, 0.55, 0.4])


def sphere(xy, size=320, steep=62.0):
    """Normals (N, 3) of a cap that fills the image and reaches `steep` degrees at the middle of its sides."""
    p = (np.asarray(xy, float) - (size - 1) / 2) / (size / 2) * np.sin(np.radians(steep))
    return np.concatenate([p, np.sqrt(np.maximum(1 - (p**2).sum(-1, keepdims=True), 1e-3))], -1)


def plane(xy, slant=45.0, tilt=30.0):
    """Normals (N, 3) of a plane."""
    s, t = np.radians([slant, tilt])
    return np.tile([np.sin(s) * np.cos(t), np.sin(s) * np.sin(t), np.cos(s)], (len(xy), 1))


def sideways(xy, size=320):
    """Smooth irradiance (N,) that falls to a third from left to right."""
    return 1.2 - 0.8 * np.asarray(xy, float)[:, 0] / size


def render(
    normals=sphere, light=sideways, element=glyph, radius=13.0, pitch=32.0, size=320, aligned=False, seed=0, samples=3
) -> Scene:
    """Elements of `radius` px on a jittered raster, orthographic, each flat, box-filtered over its pixels.

    `normals` and `light` take positions (N, 2). `aligned` prints all with the tilt along one axis of their own.
    """
    rng = np.random.default_rng(seed)
    axis = np.arange(pitch / 2 + 2, size - pitch / 2, pitch)
    xy = np.stack(np.meshgrid(axis, axis), -1).reshape(-1, 2) + rng.uniform(-1.5, 1.5, (len(axis) ** 2, 2))
    normal = normals(xy)
    keep = (normal[:, :2] ** 2).sum(1) < np.sin(np.radians(68)) ** 2
    xy, normal = xy[keep], normal[keep]
    n = len(xy)
    tilt, slant = np.arctan2(normal[:, 1], normal[:, 0]), np.arccos(normal[:, 2])
    spin = np.zeros(n) if aligned else rng.uniform(-np.pi, np.pi, n)
    transform = compose(tilt, slant, spin, np.full(n, radius))
    ground = np.stack(np.meshgrid(np.arange(size), np.arange(size)), -1).reshape(-1, 2)
    image = (PAPER * light(ground)).reshape(size, size, 1) * np.ones(3)
    brightness = light(xy)
    half = int(np.ceil(radius * 1.25))
    fine = (np.arange((2 * half + 1) * samples) + 0.5) / samples - 0.5 - half
    for k in range(n):
        at = np.round(xy[k]).astype(int)
        s = (np.stack(np.meshgrid(fine, fine), -1) - (xy[k] - at)) @ np.linalg.inv(transform[k]).T
        cell = element(s).reshape(2 * half + 1, samples, 2 * half + 1, samples, 3).mean((1, 3))
        x0, y0 = np.maximum(at - half, 0)
        x1, y1 = np.minimum(at + half + 1, size)
        part = cell[y0 - at[1] + half : y1 - at[1] + half, x0 - at[0] + half : x1 - at[0] + half]
        # beyond the element is paper, so that overlapping squares do not erase one another
        image[y0:y1, x0:x1] *= part / PAPER
    return Scene(image.astype(np.float32), xy, transform, normal, brightness)


def image_of(scene):
    """The artefact of the image stage."""
    return {"rgb": scene.rgb, "mask": np.ones(scene.rgb.shape[:2], bool)}


def detect_of(scene, rng, turn=0.12, shift=1.0, size=0.1, radius=4.5):
    """What a detector reports of the true elements: frames without slant, a little off in turn, size and place.

    `radius` is the first domain's in detector sizes: an element of radius 1 fills it.
    """
    n = len(scene.xy)
    u, sigma, vt = np.linalg.svd(scene.transform)
    scale = np.sqrt(sigma.prod(1)) * np.exp(size * rng.normal(size=n)) / radius
    c, s = np.cos(a := turn * rng.normal(size=n)), np.sin(a)
    frame = scale[:, None, None] * (u @ vt) @ np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], -2)
    return {
        "xy": (scene.xy + shift * rng.normal(size=(n, 2))).astype(np.float32),
        "frame": frame.astype(np.float32),
        "descriptor": np.zeros((n, 128), np.float32),
        "kind": np.zeros(n, np.uint8),
    }
