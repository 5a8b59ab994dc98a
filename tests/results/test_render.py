"""Oblique views against geometry, and against a slow z-buffer of points."""

from __future__ import annotations

import numpy as np
import pytest

from sftex_stages.geometry.chart import Pinhole
from sftex_stages.results.render import BACKGROUND, render


def plane(h: int, w: int, p: float = 0.0, q: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    y, x = np.mgrid[:h, :w].astype(np.float64)
    normal = np.array([-p, -q, 1]) / np.sqrt(1 + p * p + q * q)
    return (p * x + q * y).astype("f4"), np.tile(normal.astype("f4"), (h, w, 1)), np.ones((h, w), bool)


def covered(picture: np.ndarray) -> np.ndarray:
    return (np.abs(picture.astype(int) - BACKGROUND) > 12).any(2)


def test_seen_from_the_front_it_is_the_photograph() -> None:
    y, x = np.mgrid[:100, :140]
    photo = np.stack([80 + x, 60 + y, 100 + 0 * x], 2).astype(np.uint8)
    (view,) = render(*plane(100, 140), textures=(photo,), azimuth=0, elevation=0, size=140)
    rows, columns = (np.flatnonzero(covered(view).any(a)) for a in (1, 0))
    crop = view[rows[2] : rows[-2], columns[2] : columns[-2]].astype(float)
    assert crop.shape[1] / crop.shape[0] == pytest.approx(1.4, abs=0.05)
    across = np.polyfit(np.arange(crop.shape[1]), crop[..., 0].mean(0), 1)
    down = np.polyfit(np.arange(crop.shape[0]), crop[..., 1].mean(1), 1)
    assert across[0] > 0.9 and down[0] > 0.9  # left is left and up is up
    assert np.abs(crop[..., 0] - crop[..., 0].mean(0)).max() <= 1.5


@pytest.mark.parametrize("azimuth, elevation", [(60, 0), (-40, 0), (0, 50), (0, -30)])
def test_a_plane_foreshortens_by_the_cosine(azimuth: float, elevation: float) -> None:
    white = np.zeros((200, 200, 3), np.uint8)
    (view,) = render(*plane(200, 200), textures=(white,), azimuth=azimuth, elevation=elevation, size=400)
    seen = covered(view)
    height, width = np.ptp(np.flatnonzero(seen.any(1))), np.ptp(np.flatnonzero(seen.any(0)))
    expected = np.cos(np.radians(azimuth)) / np.cos(np.radians(elevation))
    assert width / height == pytest.approx(expected, rel=0.02)
    assert seen[view.shape[0] // 2, view.shape[1] // 2]


def test_the_camera_moves_right_and_up() -> None:
    height, normals, valid = plane(120, 120)
    height[58:63, 58:63] = 20  # a peg toward the camera, painted red on top
    photo = np.full((120, 120, 3), 60, np.uint8)
    photo[58:63, 58:63] = [250, 0, 0]

    def peg(azimuth: float, elevation: float) -> tuple[float, float]:
        (view,) = render(height, normals, valid, (photo,), azimuth, elevation, 300)
        y, x = np.nonzero((view[..., 0] > 180) & (view[..., 1] < 90))
        return x.mean() - view.shape[1] / 2, y.mean() - view.shape[0] / 2

    assert peg(30, 0)[0] < -10 and abs(peg(30, 0)[1]) < 3  # seen from the right, the peg leans left
    assert peg(-30, 0)[0] > 10
    assert peg(0, 30)[1] > 10 and abs(peg(0, 30)[0]) < 3  # seen from above, it leans down
    assert peg(0, -30)[1] < -10


def test_light_falls_from_the_upper_left_and_the_middle_is_bright() -> None:
    y, x = np.mgrid[-60:61, -60:61].astype(float)
    valid = x**2 + y**2 < 55**2
    z = np.sqrt(np.maximum(60.0**2 - x**2 - y**2, 1))
    normals = np.stack([x, y, z], 2) / 60
    (view,) = render(z, normals, valid, azimuth=0, elevation=0, size=240)
    upper_left, lower_right = view[70:80, 70:80].mean(), view[160:170, 160:170].mean()
    assert upper_left > lower_right + 40 and (view[..., 0] == view[..., 2]).mean() > 0.6


def bumpy() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    y, x = np.mgrid[:80, :100].astype(float)
    height = 18 * np.sin(x / 7) + 10 * np.cos(y / 9 + x / 15)
    q, p = np.gradient(height)
    normals = np.stack([-p, -q, np.ones_like(p)], 2) / np.sqrt(1 + p**2 + q**2)[..., None]
    valid = (x - 60) ** 2 + (y - 40) ** 2 > 90
    photo = np.stack([2 * x, 3 * y, 120 + 100 * np.sin(x / 5) * np.sin(y / 5)], 2).astype(np.uint8)
    return height, normals, valid, photo


@pytest.mark.parametrize("azimuth, elevation", [(50, 0), (35, 20), (-65, 30), (20, -60)])
def test_hidden_surfaces_are_hidden(azimuth: float, elevation: float) -> None:
    """Against points of the bilinear surface, 8 × 8 a pixel, painted from far to near into the same frame."""
    height, normals, valid, photo = bumpy()
    (view,) = render(height, normals, valid, (photo,), azimuth, elevation, 300)
    a, e = np.radians([azimuth, elevation])
    right = np.array([np.cos(a), 0, -np.sin(a)])
    near = np.array([np.sin(a) * np.cos(e), -np.sin(e), np.cos(a) * np.cos(e)])
    down = np.cross(near, right)  # x right, y down, z near is a left-handed frame
    y, x = np.nonzero(valid)
    points = np.stack([x, y, height[valid]])
    low = np.array([(right @ points).min(), (down @ points).min()])
    high = np.array([(right @ points).max(), (down @ points).max()])
    margin = 0.04 * (high - low).max() + 1
    low, high = low - margin, high + margin
    scale = 300 / (high - low).max()

    fine = np.arange(0, 79, 1 / 8)[:, None], np.arange(0, 99, 1 / 8)[None, :]
    fy, fx = (g.ravel() for g in np.broadcast_arrays(*fine))
    iy, ix = fy.astype(int), fx.astype(int)
    ty, tx = fy - iy, fx - ix

    def bilinear(field: np.ndarray) -> np.ndarray:
        t, s = (ty, tx) if field.ndim == 2 else (ty[:, None], tx[:, None])
        top = field[iy, ix] * (1 - s) + field[iy, ix + 1] * s
        return top * (1 - t) + (field[iy + 1, ix] * (1 - s) + field[iy + 1, ix + 1] * s) * t

    solid = bilinear(valid.astype(float)) == 1
    p = np.stack([fx, fy, bilinear(height)])[:, solid]
    u, v = (np.floor((axis @ p - o) * scale).astype(int) for axis, o in ((right, low[0]), (down, low[1])))
    order = np.argsort(near @ p)
    reference = np.full((*view.shape[:2], 3), np.nan)
    inside = (u[order] < view.shape[1]) & (v[order] < view.shape[0])
    reference[v[order][inside], u[order][inside]] = bilinear(photo.astype(float))[solid][order][inside]
    seen = np.isfinite(reference[..., 0])
    assert seen.mean() > 0.2
    error = np.abs(view[seen].astype(float) - reference[seen]).max(1)
    assert np.median(error) < 4 and (error < 25).mean() > 0.93  # the rest are the anti-aliased outlines
    assert (covered(view) == seen).mean() > 0.97


def test_angles_and_emptiness_are_checked() -> None:
    with pytest.raises(ValueError, match="within ±80"):
        render(*plane(5, 5), azimuth=85)
    height, normals, valid = plane(5, 5)
    with pytest.raises(ValueError, match="no pixel is valid"):
        render(height, normals, valid & False)


def test_a_perspective_surface_is_drawn_as_from_afar() -> None:
    """A plane leaning away, ruled in squares in space: seen by a pinhole camera they converge, seen from afar they do not."""
    camera = Pinhole(200.0, (60.0, 40.0))
    normal = np.array([0.0, 0.5, 1.0]) / np.sqrt(1.25)
    y, x = np.mgrid[:81, :121].astype(float)
    xy = np.dstack([x, y])
    z = camera.on_plane(xy, np.array([60.0, 40.0, 0.0]), normal)
    places = camera.points(xy, z)
    stripes = np.repeat((((places[..., 0] - 60) // 20 % 2) * 255).astype(np.uint8)[..., None], 3, 2)
    normals = np.tile(normal.astype("f4"), (81, 121, 1))
    (found,) = render(z.astype("f4"), normals, np.ones((81, 121), bool), (stripes,), 0.0, 0.0, 400, camera)
    inner = found[:, :, 0].astype(float)
    rows = (90, 125, 160)
    edges = [np.flatnonzero(np.diff(inner[r, 100:300] > 122)) for r in rows]
    for other in edges[1:]:
        assert len(other) == len(edges[0]) > 2 and np.abs(other - edges[0]).max() <= 3  # upright, all the way down
