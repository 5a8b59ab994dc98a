"""The direct method on a small rendered surface: what the true slants and tilts say of every instance."""

import numpy as np
import pytest
from synthetic import glyph, render

from sftex_stages.geometry import direct, imaging, pyramid, registration
from sftex_stages.geometry.camera import ORTHOGRAPHIC, Camera

HALF, RADIUS = 14, 17.0
SKEW = np.array([[1.04, 0.03], [0.0, 0.95]])  # of the frame that the appearance is drawn in


@pytest.fixture(scope="module")
def scene():
    return render(radius=RADIUS, pitch=40, size=360)


@pytest.fixture(scope="module")
def element():
    """The glyph as it is, drawn in a skewed frame."""
    spacing = 1.1 * RADIUS / HALF
    points = registration.patch_grid(HALF, spacing).reshape(2 * HALF + 1, -1, 2) @ SKEW.T / RADIUS
    domain = np.where(np.linalg.norm(points, axis=-1) < 1.05, 1.0, 0.0)
    return glyph(points), domain, spacing


def slopes(scene):
    return -scene.normal[:, :2] / scene.normal[:, 2:]


def foreshortening(scene):
    return direct.foreshortening(slopes(scene), ORTHOGRAPHIC, scene.xy)


def test_foreshortening_is_that_of_the_surface_as_the_ray_sees_it(scene):
    camera = Camera((180.0, 180.0), 1 / 400)
    p = direct.foreshortening(slopes(scene), camera, scene.xy)
    seen = camera.flatten(scene.xy) @ p
    assert np.allclose(imaging.tensor_of(seen), imaging.tensor_of_normal(scene.normal), atol=1e-12)
    level = direct.foreshortening(np.zeros((1, 2)), ORTHOGRAPHIC, np.zeros((1, 2)))
    assert np.allclose(level, np.eye(2))


def test_nearest_similarity():
    rng = np.random.default_rng(0)
    turned = 1.7 * imaging.rotation(rng.uniform(-3, 3, 5))
    assert np.allclose(direct.similar(turned), turned)
    assert np.allclose(direct.similar(turned @ np.diag([1.2, 0.8])), turned)  # the part that stretches is left out


@pytest.mark.parametrize("mirrored", [1.0, -1.0])
def test_frame_that_the_appearance_is_drawn_in_is_found(scene, mirrored):
    rng = np.random.default_rng(1)
    shape = SKEW @ np.diag([1.0, mirrored])
    turn = rng.uniform(0.7, 1.4, len(scene.xy))[:, None, None] * imaging.rotation(rng.uniform(-3, 3, len(scene.xy)))
    p = foreshortening(scene)
    frames = p @ turn @ shape
    frames[::9] = frames[::9] @ np.array([[1.0, 0.5], [0.0, 1.0]])  # some that went astray
    found = direct.fit_shape(p, frames, np.ones(len(p)))
    gram, true = found.T @ found, shape.T @ shape
    assert np.allclose(gram / np.trace(gram), true / np.trace(true), atol=2e-3)
    assert np.sign(np.linalg.det(found)) == mirrored


def test_registration_with_foreshortening_held_finds_scale_turn_and_place(scene, element):
    rng = np.random.default_rng(2)
    template = registration.make_template(*element)
    p, n = foreshortening(scene), len(scene.xy)
    true = scene.transform / RADIUS
    off = np.exp(0.06 * rng.normal(size=n))[:, None, None] * imaging.rotation(0.1 * rng.normal(size=n))
    xy = scene.xy + rng.normal(size=(n, 2))
    got = direct.register_held(scene.rgb, template, xy, true @ off @ SKEW, p, SKEW)
    inner = np.linalg.solve(p, got.frames) @ np.linalg.inv(SKEW)
    assert np.allclose(inner, direct.similar(inner), atol=1e-9)  # nothing but scale and turn has moved
    wrong = np.linalg.solve(true, got.frames @ np.linalg.inv(SKEW)) - np.eye(2)
    assert np.median(np.abs(wrong).max((1, 2))) < 0.01
    assert np.median(np.linalg.norm(got.xy - scene.xy, axis=1)) < 0.1
    free = registration.register(scene.rgb, template, got.xy, got.frames, steps=6)
    assert np.median(got.residual / free.residual) < 1.3


def delivered(scene, element, skew):
    """Transforms as a frontal stage gives them, without the frame's own `skew`, and places of the detail's centre."""
    template = registration.make_template(*element)
    centre = direct.texton.information_centre(template)
    transform = scene.transform / RADIUS
    return scene.xy + transform @ (skew @ centre), transform


def test_what_the_surface_does_not_show_is_no_instance(scene, element):
    xy, transform = delivered(scene, element, SKEW)
    image, p = scene.rgb.copy(), foreshortening(scene)
    rng = np.random.default_rng(3)
    gone, astray = np.arange(4), np.arange(10, 14)
    for x, y in np.rint(scene.xy[gone]).astype(int):  # something else is there
        image[y - 16 : y + 17, x - 16 : x + 17] = rng.uniform(0.1, 0.8, (33, 33, 1))
    start = transform.copy()
    start[astray] = start[astray] @ np.array([[1.15, 0.12], [0.0, 0.9]])
    inlier = np.where(np.isin(np.arange(len(xy)), astray), 0.4, 0.95)
    inlier[20] = 0.0  # lies on another one
    mean_blur = registration.blur(transform @ SKEW).mean(0)
    template = registration.make_template(*element, pyramid.sampling_spread(1.0), mean_blur)
    seen = direct.look_again(image, 1.0, template, xy, start @ SKEW, inlier, p, 0.8)
    assert (seen.inlier[gone] < 0.2).all() and seen.inlier[20] == 0
    rest = np.setdiff1d(np.arange(len(xy)), [*gone, 20])
    assert (seen.inlier[rest] > 0.8).mean() > 0.95
    assert np.array_equal(np.flatnonzero(seen.moved), astray)  # measured again from where the surface puts them
    true = imaging.tensor_of_normal(scene.normal[astray])
    s = seen.transform[astray] @ np.linalg.inv(SKEW)
    tensor = imaging.tensor_of(s, np.linalg.svd(s, compute_uv=False)[:, 0])
    before = imaging.tensor_of(start[astray], np.linalg.svd(start[astray], compute_uv=False)[:, 0])
    assert np.abs(tensor - true).max() < 0.06 < np.abs(before - true).max()
    assert np.abs(seen.xy[astray] - xy[astray]).max() < 0.5
    still = ~seen.moved
    assert np.array_equal(seen.transform[still], (start @ SKEW)[still]) and np.array_equal(seen.xy[still], xy[still])


def test_too_few_instances_fix_no_frame(scene, element):
    xy, transform = delivered(scene, element, SKEW)
    inlier = np.where(np.arange(len(xy)) < 3, 0.9, 0.2)
    p = foreshortening(scene)
    assert direct.look_again(scene.rgb, 1.0, registration.make_template(*element), xy, transform, inlier, p, 0.8) is None
