"""Registration on analytic images, whose warps, gains and derivatives are known."""

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from sftex_stages.geometry.imaging import compose
from sftex_stages.geometry.registration import (
    blur,
    channel_gains,
    compose_step,
    estimate_spread,
    explain,
    learn_variation,
    light_powers,
    make_solver,
    make_template,
    marginal_hessian,
    patch_grid,
    register,
    registration_step,
    sample,
    variation_ridge,
    without_variation,
)
from sftex_stages.geometry.texton import centre_window

HALF = 8


@pytest.fixture
def rng():
    return np.random.default_rng(7)


def texture(s):
    """A smooth element (…, 2) → (…, 3) without symmetry, in texton units; its finest wave is about 9 units long."""
    x, y = s[..., 0], s[..., 1]
    red = 1 + 0.3 * np.sin(0.45 * x + 0.2 * y) + 0.2 * np.cos(0.6 * y - 0.3 * x + 0.5)
    green = 0.8 + 0.25 * np.cos(0.5 * x - 0.35 * y) + 0.2 * np.sin(0.15 * x + 0.55 * y + 1)
    blue = 0.9 + 0.2 * np.sin(0.3 * (x + y)) + 0.003 * x * y
    return np.stack([red, green, blue], -1)


def exact_template(half=HALF):
    n = 2 * half + 1
    values = texture(patch_grid(half, 1.0).astype(float)).reshape(n, n, 3)
    return make_template(values, centre_window(half), 1.0)


def scene(frames, gains, size=140):
    """Image with one view of the element per tile: d(x) = L f(G⁻¹ (x − centre)); centres (M, 2)."""
    m = len(frames)
    y, x = np.mgrid[:size, :size].astype(float)
    image = np.zeros((size, size * m, 3), np.float32)
    centres = np.zeros((m, 2))
    for k, (frame, gain) in enumerate(zip(frames, gains, strict=True)):
        centre = np.array([size / 2 + 0.3 * k - 0.7, size / 2 - 0.2 * k])
        s = np.stack([x - centre[0], y - centre[1]], -1) @ np.linalg.inv(frame).T
        image[:, k * size : (k + 1) * size] = gain * texture(s)
        centres[k] = centre + np.array([k * size, 0])
    return image, centres


def views(rng, m):
    """Frames of 5 px a texton unit (so that bilinear sampling is nearly exact) under moderate slant."""
    return compose(rng.uniform(-3, 3, m), rng.uniform(0, 0.8, m), rng.uniform(-3, 3, m), np.full(m, 5.0))


def test_patch_grid_is_centred_and_runs_row_by_row():
    points = patch_grid(2, 0.5)
    assert points.shape == (25, 2)
    assert points[0].tolist() == [-1, -1] and points[1].tolist() == [-0.5, -1] and points[12].tolist() == [0, 0]


@pytest.mark.parametrize("channels", [1, 3])
def test_sampling_is_bilinear_interpolation_with_the_border_repeated(rng, channels):
    """Without rounding of positions either, as OpenCV does to 1/32 px in some versions and for two channels."""
    image = rng.normal(size=(40, 50, channels)).astype(np.float32)
    xy, frames, points = rng.uniform(0, 50, (30, 2)), rng.normal(size=(30, 2, 2)), patch_grid(4, 1.0)
    where = np.einsum("mij,pj->mpi", frames, points) + xy[:, None]
    got = sample(image, xy, frames, points)
    assert got.shape == (30, 81, channels) and got.dtype == np.float32
    assert (where < 0).any() and (where > 50).any()
    for c in range(channels):
        expected = map_coordinates(image[..., c].astype(float), [where[..., 1], where[..., 0]], order=1, mode="nearest")
        assert np.abs(got[..., c] - expected).max() < 1e-4


def test_sampling_of_an_affine_image_is_exact_and_of_many_patches_no_different(rng):
    y, x = np.mgrid[:60, :80]
    image = np.stack([0.3 * x - 0.2 * y + 1, 0.1 * y, 0 * x], -1).astype(np.float32)
    m = 31_000  # more than one call of remap takes
    xy, frames = rng.uniform(20, 40, (m, 2)), rng.uniform(-3, 3, (m, 2, 2))
    points = patch_grid(1, 1.0)
    where = np.einsum("mij,pj->mpi", frames, points) + xy[:, None]
    got = sample(image, xy, frames, points)
    assert np.abs(got[..., 0] - (0.3 * where[..., 0] - 0.2 * where[..., 1] + 1)).max() < 1e-4
    assert np.abs(got[..., 1] - 0.1 * where[..., 1]).max() < 1e-4
    assert (got[..., 2] == 0).all()


def test_basis_is_the_derivative_of_sampling(rng):
    """Columns of the basis against central differences of `sample` in the gain, the frame and the position."""
    spacing, half = 2.0, 6
    image = rng.normal(size=(50, 50, 3)).astype(np.float32)
    xy, points = np.array([[25.0, 24.0]]), patch_grid(half, spacing)
    frame = np.eye(2)[None]
    n = 2 * half + 1
    values = sample(image, xy, frame, points)[0]
    weights = centre_window(half)
    template = make_template(values.reshape(n, n, 3), weights, spacing)
    inside = (weights.ravel() > 0) & (np.abs(points) < half * spacing).all(1)
    root = np.sqrt(weights.ravel())[:, None]
    basis = template.basis.reshape(len(points), 3, -1)
    assert np.abs(basis[..., 0] - root * values).max() < 1e-6
    # on this grid the template's differences span 2 × spacing: so does the difference of the sampling
    for k in range(6):
        column = np.zeros((n * n, 3))
        for p, s in enumerate(points):
            direction = np.zeros(2)
            lever = 1.0
            if k < 4:
                direction[k // 2], lever = 1.0, float(s[k % 2])
            else:
                direction[k - 4] = 1.0
            ahead, behind = (sample(image, xy, frame, (s + e * spacing * direction)[None])[0, 0] for e in (1, -1))
            column[p] = lever * (ahead - behind) / (2 * spacing)
        assert np.abs(basis[inside, :, k + 1] - (root * column)[inside]).max() < 1e-4
    assert template.gram == pytest.approx(template.basis.T @ template.basis)


def test_basis_of_a_smooth_element_is_the_derivative_of_its_warp():
    """d f((I + D) s + t): with a quadratic element the template's differences are exact."""

    def quadratic(s):
        x, y = s[..., 0], s[..., 1]
        return np.stack([1 + 0.1 * x - 0.2 * y + 0.03 * x * y, 2 - 0.05 * x**2 + 0.02 * y**2 + 0.04 * x * y], -1)

    half, spacing = 5, 0.7
    n = 2 * half + 1
    points = patch_grid(half, spacing).astype(float)
    weights = centre_window(half)
    template = make_template(quadratic(points).reshape(n, n, 2), weights, spacing)
    basis = template.basis.reshape(n * n, 2, -1)
    inside = (weights.ravel() > 0) & (np.abs(points) < (half - 0.5) * spacing).all(1)
    for k in range(6):
        delta = np.zeros(6)
        delta[k] = 1e-5
        strain, shift = delta[:4].reshape(2, 2), delta[4:]
        ends = [quadratic(points @ (np.eye(2) + e * strain).T + e * shift) for e in (1, -1)]
        numeric = np.sqrt(weights.ravel())[:, None] * (ends[0] - ends[1]) / 2e-5
        assert np.abs(basis[inside, :, k + 1] - numeric[inside]).max() < 1e-5
    # ½ C : ∇∇µ of these quadratics: half of xx, the whole of xy, half of yy
    root = np.sqrt(weights.ravel())[:, None]
    second = np.array([[0, -0.05], [0.03, 0.04], [0, 0.02]])
    for k in range(3):
        assert np.abs(basis[inside, :, 7 + k] - (root * second[k])[inside]).max() < 1e-5


def own_columns(template):
    """Columns of gain and variation with the rows of the variation's prior below, (P·C + V, 1 + V)."""
    prior = np.pad(np.diag(np.sqrt(template.ridge)), ((0, 0), (1, 0)))
    return np.concatenate([template.basis[:, np.r_[0, 10 : template.basis.shape[1]]], prior])


def loose(template):
    """The template with light and tint free to vary by tenths."""
    return template._replace(ridge=np.full(len(template.ridge), 1e-3 * template.gram[0, 0]))


def test_marginal_hessian_is_what_is_left_when_gain_and_variation_are_solved_for(rng):
    template = loose(exact_template())
    x = rng.normal(size=6)
    target = np.concatenate([template.basis[:, 1:7] @ x, np.zeros(len(template.ridge))])
    design = own_columns(template)
    left = target - design @ np.linalg.lstsq(design, target, rcond=None)[0]
    assert x @ marginal_hessian(template) @ x == pytest.approx(left @ left, rel=1e-9)


def test_small_affine_warps_and_gains_are_recovered_exactly(rng):
    m = 12
    true_frames, gains = views(rng, m), rng.uniform(0.3, 2.5, m)
    image, centres = scene(true_frames, gains)
    frames = true_frames @ (np.eye(2) + rng.uniform(-0.12, 0.12, (m, 2, 2)))
    xy = centres + rng.uniform(-4, 4, (m, 2))
    got = register(image, exact_template(), xy, frames, steps=25)
    assert np.abs(got.xy - centres).max() < 1e-2  # px, of 5 px a unit
    strain = np.linalg.solve(true_frames, got.frames) - np.eye(2)
    assert np.abs(strain).max() < 1e-3
    # bilinear interpolation between the pixels of a curved profile loses up to half a percent
    assert got.gain == pytest.approx(gains, rel=5e-3)
    assert got.residual.max() < 1e-5


def test_recovery_from_exact_samples_has_no_error_of_its_own(rng):
    """The patches come from the formula instead of an image: what is left is the algorithm's own error."""
    m = 10
    truth = np.eye(2) + rng.uniform(-0.1, 0.1, (m, 2, 2))
    where, gains = rng.uniform(-0.5, 0.5, (m, 2)), rng.uniform(0.5, 2, m)
    template = exact_template()
    points = template.points.astype(float)
    xy, frames = np.zeros((m, 2)), np.tile(np.eye(2), (m, 1, 1))
    for _ in range(30):
        warped = np.einsum("mij,pj->mpi", frames, points) + xy[:, None] - where[:, None]
        patches = gains[:, None, None] * texture(np.einsum("mij,mpj->mpi", np.linalg.inv(truth), warped))
        step, light = registration_step(template, patches, frames, damping=0.0)
        xy, frames = compose_step(xy, frames, step)
    assert np.abs(xy - where).max() < 1e-5
    assert np.abs(frames - truth).max() < 1e-5
    assert light.gain == pytest.approx(gains, rel=1e-5)
    assert light.residual.max() < 1e-6


def test_steps_never_raise_the_residual_not_even_from_a_bad_start(rng):
    m = 12
    true_frames = views(rng, m)
    image, centres = scene(true_frames, np.ones(m))
    image += 0.05 * rng.normal(size=image.shape).astype(np.float32)
    frames = true_frames @ (np.eye(2) + rng.uniform(-0.5, 0.5, (m, 2, 2)))
    xy = centres + rng.uniform(-20, 20, (m, 2))
    template = exact_template()
    last = np.full(m, np.inf)
    series = []
    for steps in range(8):
        residual = register(image, template, xy, frames, steps=steps).residual
        assert (residual <= last * (1 + 1e-9)).all()
        last = residual
        series.append(residual)
    assert np.median(series[-1]) < 0.5 * np.median(series[0])


def test_reported_gain_and_residual_are_those_of_the_reported_frames(rng):
    m = 5
    image, centres = scene(views(rng, m), rng.uniform(0.5, 2, m))
    template = exact_template()
    got = register(image, template, centres + 1, views(rng, m), steps=3)
    solver = make_solver(template)
    patches = sample(image, got.xy, got.frames, template.points)
    found = explain(template, solver, patches[:, solver.used], np.zeros((m, 3)))
    assert got.gain == pytest.approx(found.gain) and got.residual == pytest.approx(found.residual)
    assert got.variation == pytest.approx(found.variation)
    design, root = own_columns(template), np.sqrt(template.weights)[:, None]
    for k in range(m):
        target = np.concatenate([(root * patches[k]).ravel(), np.zeros(len(template.ridge))])
        best, left, _, _ = np.linalg.lstsq(design, target, rcond=None)
        assert found.gain[k] == pytest.approx(best[0], rel=1e-4)
        assert found.variation[k] == pytest.approx(np.clip(best[1:] / best[0], -1, 1), abs=1e-4)
        direct = left[0] / best[0] ** 2 / (template.weights.sum() * 3)
        assert found.residual[k] == pytest.approx(direct, rel=1e-3, abs=1e-7)


def varied(points, gain, light, tint, level):
    """Patches (M, P, C) of the exact element whose light changes by `light` (M, 5), with `tint` (M, C)."""
    across = 1 + light @ light_powers(points, np.abs(points).max())
    return gain[:, None, None] * (texture(points)[None] * across[..., None] + level * tint[:, None, :])


def test_light_and_tint_of_a_copy_do_not_move_it(rng):
    """A shadow's edge, a fold's curved light, another ink: known at once, and no part of the motion."""
    m = 10
    template = exact_template()
    template = template._replace(ridge=np.full(len(template.ridge), 1e-6 * template.gram[0, 0]))
    points, still = template.points.astype(float), np.repeat(np.eye(2)[None], m, 0)
    gain, light, tint = rng.uniform(0.5, 2, m), rng.uniform(-0.15, 0.15, (m, 5)), rng.uniform(-0.1, 0.1, (m, 3))
    patches = varied(points, gain, light, tint, template.level)
    step, found = registration_step(template, patches, still, damping=0.0)
    assert np.abs(step).max() < 2e-4
    assert found.gain == pytest.approx(gain, rel=1e-3)
    assert found.variation == pytest.approx(np.concatenate([light, tint], 1), abs=2e-3)
    assert found.residual.max() < 1e-6
    even = without_variation(template, patches, points, gain, found.variation)
    assert even == pytest.approx(gain[:, None, None] * texture(points), rel=5e-3)
    coloured = gain[:, None] * np.array([1.2, 1.0, 0.7])
    patches = varied(points, np.ones(m), light, 0 * tint, template.level) * coloured[:, None]
    found = registration_step(loose(template), patches, still, damping=0.0)[1]
    assert channel_gains(template, patches, still, np.pad(light, ((0, 0), (0, 3)))) == pytest.approx(coloured, rel=1e-3)
    # left out of the model, the same light does move the element
    stiff = template._replace(ridge=np.full(len(template.ridge), 1e6 * template.gram[0, 0]))
    assert np.abs(registration_step(stiff, patches, still, damping=0.0)[0]).max() > 0.02


def test_variation_is_learned_where_there_is_some_and_given_up_where_there_is_none(rng):
    """Light that slopes along x and one channel's tint, in noise: their spread is found, all other numbers go to nothing."""
    m, sigma = 200, 0.01
    template = exact_template()
    points, still = template.points.astype(float), np.repeat(np.eye(2)[None], m, 0)
    spread = np.array([0.2, 0, 0, 0, 0, 0, 0.1, 0])
    truth = spread * rng.normal(size=(m, 8))
    patches = varied(points, np.ones(m), truth[:, :5], truth[:, 5:], template.level)
    patches = patches + sigma * rng.normal(size=patches.shape)
    noise2, channels = sigma**2 / 8 / 3, 3  # independent samples: what the ridge counts for shared noise is taken back
    variance = np.full(8, 0.1**2)
    for _ in range(12):
        template = template._replace(ridge=variation_ridge(variance, noise2, channels))
        found = registration_step(template, patches, still, damping=0.0)[1].variation
        variance = learn_variation(template, found, np.ones(m), noise2, variance)
    assert np.sqrt(variance[[0, 6]]) == pytest.approx(spread[[0, 6]], rel=0.15)
    assert np.sqrt(variance[spread == 0]).max() < 0.01


def test_compose_step_is_the_inverse_composition(rng):
    """The new patch at the warped template point is the old patch at the template point."""
    xy, frames, step = rng.normal(size=(20, 2)), rng.normal(size=(20, 2, 2)), 0.2 * rng.normal(size=(20, 6))
    new_xy, new_frames = compose_step(xy, frames, step)
    s = rng.normal(size=(9, 2))
    warped = np.einsum("mij,pj->mpi", np.eye(2) + step[:, :4].reshape(-1, 2, 2), s) + step[:, None, 4:]
    old = np.einsum("mij,pj->mpi", frames, s) + xy[:, None]
    new = np.einsum("mij,mpj->mpi", new_frames, warped) + new_xy[:, None]
    assert np.abs(new - old).max() < 1e-10


def test_long_steps_are_shortened_without_turning():
    template = exact_template()
    patches = texture(template.points.astype(float) * 1.6)[None]
    frames = np.eye(2)[None]
    free, _ = registration_step(template, patches, frames, damping=0.0, limit=1e9)
    short, _ = registration_step(template, patches, frames, damping=0.0, limit=0.1)
    unit = make_solver(template).unit
    assert np.abs(free / unit).max() > 0.1
    assert np.abs(short / unit).max() == pytest.approx(0.1)
    assert short / np.linalg.norm(short) == pytest.approx(free / np.linalg.norm(free))


def blobs(s, c):
    """An element of Gaussian blobs at s (P, 2), blurred by a Gaussian of covariance c (2, 2): exact at any blur."""
    total = np.ones(len(s))
    for x, y, width, height in ((-3, -1, 1.6, 0.8), (2, 3, 1.4, 0.6), (3, -3, 1.8, -0.5), (-1, 4, 1.5, -0.4), (0, 0, 1.7, 0.5)):
        wide = width**2 * np.eye(2) + c
        offset = s - (x, y)
        power = -0.5 * ((offset @ np.linalg.inv(wide)) * offset).sum(1)
        total += height * width**2 / np.sqrt(np.linalg.det(wide)) * np.exp(power)
    return total[:, None]


def steep_views(rng, m):
    """Frames of one pixel a texton unit, slants up to 60°."""
    return compose(rng.uniform(-3, 3, m), np.radians(rng.uniform(10, 60, m)), rng.uniform(-3, 3, m), np.ones(m))


def blurred(truth, frames, spread, points):
    """Patches seen through `frames` of instances at the origin, in an image blurred by `spread` px²."""
    out = []
    for t, f in zip(truth, frames, strict=True):
        inverse = np.linalg.inv(t)
        out.append(blobs(points @ (inverse @ f).T, spread * inverse @ inverse.T))
    return np.stack(out)


def test_pixels_do_not_make_steep_elements_look_wider(rng):
    """Registered to the mean of all, instances keep their true frames to a fifth of what the point spread would bend."""
    m, half, spread = 30, 10, 0.35
    n, points = 2 * half + 1, patch_grid(half, 1.0).astype(float)
    truth = steep_views(rng, m)
    values = blurred(truth, truth, spread, points).mean(0).reshape(n, n, 1)
    bent = []
    for known in (0.0, spread):
        template = make_template(values, centre_window(half), 1.0, known, blur(truth).mean(0))
        frames = truth
        for _ in range(20):
            step, _ = registration_step(template, blurred(truth, frames, spread, points), frames, damping=0.0)
            step[:, 4:] = 0  # the views are centred; shifts would only exercise the sampling
            frames = compose_step(np.zeros((m, 2)), frames, step)[1]
        bent.append(np.abs(np.linalg.solve(truth, frames) - np.eye(2)).max((1, 2)))
    assert np.median(bent[0]) > 0.004
    assert np.median(bent[1]) < 0.2 * np.median(bent[0])


def test_point_spread_is_found_from_how_instances_differ(rng):
    m, half = 40, 10
    n, points = 2 * half + 1, patch_grid(half, 1.0).astype(float)
    truth = steep_views(rng, m)
    for spread in (0.15, 0.35, 0.7):
        patches = blurred(truth, truth, spread, points)
        patches *= rng.uniform(0.5, 2, m)[:, None, None]
        gain = patches.mean((1, 2)) / patches.mean()
        values = (patches / gain[:, None, None]).mean(0).reshape(n, n, 1)
        template = make_template(values, centre_window(half), 1.0, 0.35, blur(truth).mean(0))
        found = estimate_spread(template, patches, truth, np.ones(m), 1e-8, prior=0.35)
        assert found == pytest.approx(spread, rel=0.25)
