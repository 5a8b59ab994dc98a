import numpy as np
import pytest

from sftex_stages.geometry.chart import Pinhole, make_chart, stretch

H, W = 120, 160


def surface(z, p, q):
    """height, normals and one piece, of a height field with its slopes."""
    normals = np.stack([-p, -q, np.ones_like(z)], -1) / np.sqrt(1 + p**2 + q**2)[..., None]
    return z, normals, np.ones(z.shape, np.int32)


def grid():
    y, x = np.mgrid[:H, :W].astype(float)
    return x, y


def cylinder(radius=90.0):
    """About a vertical axis: arc length is known in closed form."""
    x, y = grid()
    z = np.sqrt(radius**2 - (x - 80) ** 2)
    return surface(z, -(x - 80) / z, np.zeros_like(z)), radius * np.arcsin((x - 80) / radius), y


def flat(s, **more):
    return make_chart(*s, **{"camera": Pinhole(), "vertices": 2000, "turns": 60} | more)


def test_a_cylinder_unrolls_to_its_arc_lengths_upright():
    s, u, v = cylinder()
    found = flat(s)
    error = found.uv - np.stack([u, v], -1)
    error -= error.mean((0, 1))
    assert np.abs(error).max() < 0.5
    assert found.angular[0, 1] < 0.3 and found.area[0, 1] < 0.005
    assert abs(found.uv[..., 1].mean() - v.mean()) < 1  # where it is in the image


def test_a_tilted_plane_in_perspective_is_itself():
    focal, centre = 300.0, (80.0, 60.0)
    camera = Pinhole(focal, centre)
    x, y = grid()
    normal = np.array([0.3, -0.4, 1.0]) / np.sqrt(1.25)
    z = camera.on_plane(np.stack([x, y], -1), np.array([80.0, 60.0, 0.0]), normal)
    points = camera.points(np.stack([x, y], -1), z)
    assert np.abs((points - [80, 60, 0]) @ normal).max() < 1e-9
    s = z, np.tile(normal, (H, W, 1)), np.ones((H, W), np.int32)
    found = flat(s, camera=camera)
    pairs = np.random.default_rng(0).integers(0, [H, W], (200, 2, 2))
    lengths = [np.linalg.norm(np.diff(a[pairs[..., 0], pairs[..., 1]], axis=1)[:, 0], axis=1) for a in (points, found.uv)]
    np.testing.assert_allclose(lengths[1], lengths[0], atol=0.3)


def test_a_ball_is_stretched_little_and_not_torn():
    x, y = grid()
    z = np.sqrt(100.0**2 - (x - 80) ** 2 - ((y - 60) / 1.0) ** 2 + 4000)
    found = flat(surface(z, -(x - 80) / z, -(y - 60) / z))
    slopes = np.stack(np.gradient(found.uv, axis=(1, 0)), -1)
    assert (np.linalg.det(slopes) > 0.5).all()  # no fold, no seam
    assert found.area[0, 0] < 0.05 and found.angular[0, 0] < 5


def test_pieces_have_charts_of_their_own_and_holes_none():
    (z, normals, piece), u, _ = cylinder()
    piece[:, 78:84] = 0
    piece[:, 84:] *= 2
    piece[40:50, 20:30] = 0
    found = flat((np.where(piece > 0, z, np.nan), np.where(piece[..., None] > 0, normals, np.nan), piece))
    assert np.array_equal(np.isfinite(found.uv[..., 0]), piece > 0) and found.angular.shape == (2, 2)
    for k in (1, 2):
        error = (found.uv[..., 0] - u)[piece == k]
        assert np.ptp(error) < 1
    assert found.area.max() < 0.02


def test_slivers_and_single_pixels_have_a_chart_too():
    s, _, _ = cylinder()
    piece = np.zeros((H, W), np.int32)
    piece[3, 4], piece[-1, -1], piece[60, 20:90] = 1, 2, 3
    found = flat((s[0], s[1], piece))
    assert np.isfinite(found.uv[piece > 0]).all()
    assert np.ptp(found.uv[60, 20:90, 0]) == pytest.approx(90 * (np.arcsin(9 / 90) + np.arcsin(60 / 90)), rel=0.02)


def test_stretch_is_tissots():
    angle, area = stretch(np.array([[[2.0, 0], [0, 1]], [[0, -1], [1, 0]]]))
    np.testing.assert_allclose(angle, [np.degrees(2 * np.arcsin(1 / 3)), 0], atol=1e-9)
    np.testing.assert_allclose(area, [1, 0], atol=1e-12)
