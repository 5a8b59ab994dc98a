"""Rendered scenes agree with what they say of themselves."""

import h5py
import numpy as np
import pytest

from sftex_stages.bench import scenes
from sftex_stages.bench.scenes import Recipe
from sftex_stages.measures import relative_to_ray


def render(surface, camera, kind="dots", light="constant", seed=0, size=(150, 120)):
    return scenes.render(Recipe(surface, kind, light, camera, size, False), np.random.default_rng(seed))


@pytest.mark.parametrize("camera", ["orthographic", "strong"])
@pytest.mark.parametrize("surface", scenes.SURFACES)
def test_normals_are_those_of_the_height(surface, camera):
    view = scenes.look(Recipe(surface, "dots", "constant", camera, (150, 120), False), np.random.default_rng(0))
    points, normals, valid = view.points, view.normals, view.valid
    shrink = 1 - points[..., 2] / view.focal
    np.testing.assert_allclose(points[..., 0], view.x * shrink, atol=1e-9)
    across = np.cross(points[1:-1, 2:] - points[1:-1, :-2], points[2:, 1:-1] - points[:-2, 1:-1])
    across /= np.linalg.norm(across, axis=-1, keepdims=True)
    inner = valid[1:-1, 1:-1] & valid[1:-1, 2:] & valid[1:-1, :-2] & valid[2:, 1:-1] & valid[:-2, 1:-1]
    inner &= normals[1:-1, 1:-1, 2] > 0.4
    error = np.degrees(np.linalg.norm(across - normals[1:-1, 1:-1], axis=-1))[inner]
    assert len(error) > 1000 and np.quantile(error, 0.9) < 1.0


@pytest.mark.parametrize("camera", ["orthographic", "weak", "strong"])
def test_transforms_are_imaging_transforms_of_the_normals(camera):
    s = render("bumps", camera, "small", size=(150, 120))
    focal, centre = s.camera
    tensor, normal = s.transform @ np.swapaxes(s.transform, 1, 2), s.normal
    if np.isfinite(focal):  # seen along its own ray an element is what Lemma 1 says
        offset = (s.xy - centre) / focal
        t = np.linalg.norm(offset, axis=1)
        u, cosine = offset / t[:, None], 1 / np.sqrt(1 + t**2)
        flat = np.eye(2) + (cosine - 1)[:, None, None] * u[:, :, None] * u[:, None, :]
        tensor, normal = flat @ tensor @ flat, relative_to_ray(normal, s.xy, focal, centre)
    tensor /= np.linalg.eigvalsh(tensor)[:, 1, None, None]
    np.testing.assert_allclose(tensor, np.eye(2) - normal[:, :2, None] * normal[:, None, :2], atol=1e-6)


def test_a_dot_has_the_moments_of_its_transform():
    s = render("plane", "weak", "dots", size=(240, 180))
    focal, _ = s.camera
    assert np.isfinite(focal)
    ground = np.abs(s.rgb - np.median(s.rgb, (0, 1))).sum(-1)
    big = np.flatnonzero((s.texton == 0) & (np.abs(s.xy - [120, 90]).max(1) < 60))
    for i in big:
        x0, y0 = np.rint(s.xy[i]).astype(int) - 16
        y, x = np.mgrid[y0 : y0 + 33, x0 : x0 + 33]
        inverse = np.linalg.inv(s.transform[i])
        r = np.linalg.norm(np.stack([x, y], -1) - s.xy[i] @ np.eye(2), axis=-1)
        inside = np.linalg.norm((np.stack([x, y], -1) - s.xy[i]) @ inverse.T, axis=-1) < 1.15 * s.radius[i]
        w = ground[y, x] * inside * (r < 20)
        at = np.stack([x, y], -1) - s.xy[i]
        mean = (w[..., None] * at).sum((0, 1)) / w.sum()
        moments = np.einsum("yx,yxi,yxj->ij", w, at - mean, at - mean) / w.sum()
        expected = s.transform[i] @ s.transform[i].T * (0.85 * s.radius[i]) ** 2 / 4
        # pixels and the point spread add 1/12 + 0.16 each way
        np.testing.assert_allclose(moments - 0.25 * np.eye(2), expected, rtol=0.06, atol=0.4)
        np.testing.assert_allclose(mean, 0, atol=0.4)


def test_a_scene_is_drawn_by_its_seed_and_written_as_the_benchmark_reads_it(tmp_path):
    first, again = (render("folds", "weak", "wallpaper", "near", seed=3) for _ in range(2))
    np.testing.assert_array_equal(first.rgb, again.rgb)
    assert not np.array_equal(first.rgb, render("folds", "weak", "wallpaper", "near", seed=4).rgb)
    scenes.write(first, tmp_path / "scene", "about", True, np.random.default_rng(0))
    assert (tmp_path / "scene.jpg").is_file()
    with h5py.File(tmp_path / "scene.truth.h5") as file:
        assert file.attrs["camera"] == "perspective" and file.attrs["focal_px"] == first.camera[0]
        assert file["surface/normals"].shape == (120, 150, 3) and len(file["instances/xy"]) == len(first.xy)


def test_recipes_go_through_everything():
    drawn = scenes.recipes(16, 5)
    assert {r.surface for r in drawn} == set(scenes.SURFACES) and {r.print for r in drawn} == set(scenes.PRINTS)
    assert {r.light for r in drawn} == set(scenes.LIGHTS) and drawn == scenes.recipes(16, 5)
