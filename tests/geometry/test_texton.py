"""EM's parts against their formulas and limits, the domain on planted elements, and a whole texton from known frames."""

import numpy as np
import pytest

from sftex_stages.geometry.imaging import compose, normal_angle, normal_of_tensor, rotation, tensor_of
from sftex_stages.geometry.metric import gram_lift
from sftex_stages.geometry.registration import make_template, patch_grid
from sftex_stages.geometry.texton import (
    Settings,
    centre_window,
    circle_of,
    domain_weights,
    estimate_texton,
    grow,
    hold_to_manifold,
    information_centre,
    marginal_strain,
    nearest_turn,
    posterior,
    seed_members,
    strain_covariance,
    tensor_covariance,
    weighted_contrast,
    weighted_mean,
    with_tensor,
)


@pytest.fixture
def rng():
    return np.random.default_rng(21)


def grid(half):
    return patch_grid(half, 1.0).astype(float)


def glyph(s):
    """A smooth grey element (…, 2) → (…,) without symmetry, paper white (1) beyond a radius of about 7."""
    x, y = s[..., 0], s[..., 1]
    window = 1 / (1 + np.exp((np.hypot(x, y) - 6.5) / 0.7))
    return 1 - 0.7 * window * (0.5 + 0.5 * np.sin(0.9 * x + 0.3 * y) * np.cos(0.7 * y - 0.2 * x + 0.6))


def template_of(grey, half, weights=None):
    n = 2 * half + 1
    values = np.repeat(grey.reshape(-1, 1), 3, 1).reshape(n, n, 3)
    return make_template(values, centre_window(half) if weights is None else weights, 1.0)


# posterior


def test_posterior_is_bayes_rule(rng):
    noise2, contrast2, prior, samples = 0.02, 0.5, 0.7, 10.0
    residual = rng.uniform(0, 0.3, 50)

    def density(variance):
        return variance ** (-samples / 2) * np.exp(-samples * residual / (2 * variance))

    own, other = prior * density(noise2), (1 - prior) * density(contrast2)
    assert posterior(residual, noise2, contrast2, prior, samples) == pytest.approx(own / (own + other), rel=1e-9)


def test_posterior_limits():
    assert posterior(np.array([0.0]), 1e-4, 1.0, 0.5, 20)[0] > 1 - 1e-9
    assert posterior(np.array([1.0]), 1e-4, 1.0, 0.5, 20)[0] < 1e-9
    assert np.isfinite(posterior(np.array([1e9, 0.0]), 1e-12, 1.0, 0.98, 40)).all()
    # the residual at which both are equally likely: there the posterior is the prior
    noise2, spread = 0.1, 1.0
    even = np.log(spread / noise2) / (1 / noise2 - 1 / spread)
    assert posterior(np.array([even]), noise2, spread, 0.3, 25)[0] == pytest.approx(0.3)


def test_posterior_falls_with_the_residual_even_where_the_noise_exceeds_the_contrast():
    p = posterior(np.linspace(0, 3, 40), 1.0, 0.5, 0.6, 8)
    assert (np.diff(p) < 0).all()


# appearance


def test_weighted_mean_and_variance_over_instances(rng):
    patches, gain = rng.uniform(0.5, 1, (6, 11, 3)), rng.uniform(0.5, 2, 6)
    mean, var = weighted_mean(patches * gain[:, None, None], gain, np.ones(6))
    assert mean == pytest.approx(patches.mean(0))
    assert var == pytest.approx(patches.var(0, ddof=1).mean(1))
    # a weight of two is a member counted twice, a weight of zero one that is not there
    mean, _ = weighted_mean(patches, np.ones(6), np.array([2.0, 1, 0, 0, 0, 0]))
    assert mean == pytest.approx((2 * patches[0] + patches[1]) / 3)


def test_weighted_variance_is_unbiased(rng):
    weights = rng.uniform(0.1, 1, 8)
    found = [weighted_mean(rng.normal(size=(8, 500, 1)), np.ones(8), weights)[1].mean() for _ in range(20)]
    assert np.mean(found) == pytest.approx(1.0, abs=0.03)


def test_seed_is_the_largest_group_of_similar_patches(rng):
    half = 8
    window = centre_window(half)
    smooth = [np.sin(grid(half) @ rng.normal(0, 0.5, 2) + rng.uniform(0, 6)) for _ in range(30)]
    patches = np.stack([smooth[0]] * 9 + [smooth[1]] * 4 + smooth[2:10])[..., None]
    patches = patches * rng.uniform(0.5, 2, (len(patches), 1, 1)) + rng.uniform(0, 1, (len(patches), 1, 1))
    weight = seed_members(patches + 0.05 * rng.normal(size=patches.shape), window)
    assert (weight[:9] > 0.7).all()
    assert weight[9:].max() < 0.3


# domain


def instances_of(rng, half, inside, m=40, noise=0.02):
    """Patches (m, P, 1) of an element of radius `inside` with clutter of equal contrast around it."""
    s = grid(half)
    element = np.sin(0.8 * s[:, 0] + 0.4 * s[:, 1]) + np.cos(0.7 * s[:, 1] - 0.3 * s[:, 0])
    own = np.linalg.norm(s, axis=1) <= inside
    patches = np.where(own, element, 0.0) + noise * rng.normal(size=(m, len(s)))
    for k in range(m):
        u, v = rng.normal(0, 0.6, (2, 2))
        clutter = np.sin(s @ u + rng.uniform(0, 6)) + np.cos(s @ v + rng.uniform(0, 6))
        patches[k, ~own] = clutter[~own]
    return patches[..., None]


def test_domain_grows_over_an_element_larger_than_it_and_stops_in_clutter(rng):
    agreement = 0.3

    def growing(half, inside):
        patches = instances_of(rng, half, inside)
        values, var = weighted_mean(patches, np.ones(len(patches)), np.ones(len(patches)))
        contrast2 = weighted_contrast(make_template(values.reshape(2 * half + 1, -1, 1), centre_window(half), 1.0))
        return grow(values, var, half, agreement, contrast2), domain_weights(values, var, half, 0.1, agreement)

    assert growing(8, inside=14)[0]
    more, weights = growing(14, inside=8)
    assert not more
    r = np.linalg.norm(grid(14), axis=1).reshape(29, 29)
    assert (weights[r > 10] == 0).all()
    assert (weights[r < 6] > 0.3).mean() > 0.98
    assert weights.max() <= 1


def test_domain_does_not_grow_over_plain_ground(rng):
    half = 12
    s = grid(half)
    flat = np.where(np.linalg.norm(s, axis=1) < 6, np.sin(0.9 * s[:, 0]) + np.cos(0.8 * s[:, 1]), 0.0)
    patches = flat[None, :, None] + 0.01 * rng.normal(size=(30, len(s), 1))
    values, var = weighted_mean(patches, np.ones(30), np.ones(30))
    contrast2 = weighted_contrast(make_template(values.reshape(25, 25, 1), centre_window(half), 1.0))
    assert not grow(values, var, half, 0.3, contrast2)


def test_domain_is_the_part_connected_with_the_centre(rng):
    """What agrees beyond a moat of clutter is another element at a fixed distance, not this one."""
    half = 14
    s = grid(half)
    r = np.linalg.norm(s, axis=1)
    patches = instances_of(rng, half, 6)
    patches[:, (r > 10) & (s[:, 0] > 5), 0] = np.sin(s[(r > 10) & (s[:, 0] > 5), 1])
    values, var = weighted_mean(patches, np.ones(len(patches)), np.ones(len(patches)))
    weights = domain_weights(values, var, half, 0.1, 0.3).ravel()
    assert (var[(r > 11) & (r < 14) & (s[:, 0] > 7)] < 1e-9).all()
    assert weights[r > 9].max() == 0
    assert (weights[r < 4] > 0).all()


# information


def test_information_centre_is_where_the_detail_lies():
    half = 12
    s = grid(half)
    spot = np.exp(-((s - [4.0, -3.0]) ** 2).sum(1) / (2 * 1.5**2))
    weights = np.ones((2 * half + 1, 2 * half + 1))
    assert information_centre(template_of(spot, half, weights)) == pytest.approx([4, -3], abs=0.02)
    # linear in |∇µ|²: a second spot of half the contrast has a quarter of the say
    second = 0.5 * np.exp(-((s - [-6.0, 5.0]) ** 2).sum(1) / (2 * 1.5**2))
    expected = 0.8 * np.array([4, -3]) + 0.2 * np.array([-6, 5])
    assert information_centre(template_of(spot + second, half, weights)) == pytest.approx(expected, abs=0.05)


def test_contrast_is_the_weighted_variance(rng):
    half = 3
    grey, weights = rng.uniform(0, 1, 49), rng.uniform(0, 1, (7, 7))
    mean = np.average(grey, weights=weights.ravel())
    expected = np.average((grey - mean) ** 2, weights=weights.ravel())
    assert weighted_contrast(template_of(grey, half, weights)) == pytest.approx(expected, rel=1e-5)


def test_circles_are_told_from_other_elements():
    half = 12
    s = grid(half)
    b = rotation(0.5) @ np.diag([1.2, 0.9]) @ rotation(-0.5)
    disc = 1 - 0.7 / (1 + np.exp((np.linalg.norm(s @ b.T, axis=1) - 7) / 1.2))
    gram = circle_of(template_of(disc, half, (centre_window(half) > 0).astype(float)))
    expected = np.linalg.inv(b.T @ b)
    assert gram == pytest.approx(expected / np.sqrt(np.linalg.det(expected)), abs=0.03)
    assert circle_of(template_of(glyph(s), half)) is None
    # an ellipse longer than six to one is a line
    line = 1 - 0.7 / (1 + np.exp((np.hypot(s[:, 0] / 4, s[:, 1]) - 2.2) / 0.4))
    assert circle_of(template_of(line, half, (centre_window(half) > 0).astype(float))) is None


def test_marginal_strain_is_what_remains_when_light_and_shift_are_solved_for(rng):
    template = template_of(glyph(grid(9)), 9)
    x = rng.normal(size=4)
    # light and tint are held by a prior: rows below the data
    prior = np.pad(np.diag(np.sqrt(template.ridge)), ((0, 0), (3, 0)))
    target = np.concatenate([template.basis[:, 1:5] @ x, np.zeros(len(template.ridge))])
    nuisance = np.concatenate([template.basis[:, np.r_[0, 5, 6, 10 : template.basis.shape[1]]], prior])
    left = target - nuisance @ np.linalg.lstsq(nuisance, target, rcond=None)[0]
    assert x @ marginal_strain(template) @ x == pytest.approx(left @ left, rel=1e-6)


def test_tensor_covariance_is_that_of_strained_frames(rng):
    """Covariance against the spread of G (I + D)(I + D)ᵀ Gᵀ/s² over random strains."""
    frames, scale = compose(np.array([0.4, 2.0]), np.radians([35.0, 60]), np.array([1.0, -2])) * 3.0, np.full(2, 3.0)
    half = 1e-3 * rng.normal(size=(4, 4))
    cov = half @ half.T
    fold = np.array([[2.0, 0, 0, 0], [0, 1, 1, 0], [0, 0, 0, 2]])
    got = tensor_covariance(frames, scale, np.tile(fold @ cov @ fold.T, (2, 1, 1)))
    strains = rng.multivariate_normal(np.zeros(4), cov, 60_000).reshape(-1, 1, 2, 2)
    spread = tensor_of(frames @ (np.eye(2) + strains), scale)
    for k in range(2):
        expected = np.cov(spread[:, k].T)
        assert np.abs(got[k] - 1e-8 * np.eye(3) - expected).max() < 0.03 * np.abs(expected).max()


def test_strain_covariance_is_that_of_white_noise(rng):
    """With independent samples and uniform weights the least-squares strain scatters as the inverse Hessian says."""
    half, sigma = 9, 0.01
    template = template_of(glyph(grid(half)), half, (centre_window(half) > 0).astype(float))
    noise = sigma * rng.normal(size=(len(template.basis), 4000)) * (np.abs(template.basis).max(1) > 0)[:, None]
    solution = np.linalg.lstsq(template.basis[:, [*range(7), 10, 11]], noise, rcond=None)[0][1:5]
    fold = np.array([[2.0, 0, 0, 0], [0, 1, 1, 0], [0, 0, 0, 2]])
    expected = np.cov(fold @ solution)
    got = strain_covariance(template, np.array([sigma**2, 4 * sigma**2]))
    assert np.abs(got[0] - expected).max() < 0.1 * np.abs(expected).max()
    assert got[1] == pytest.approx(4 * got[0], rel=1e-3)


# the manifold


def test_nearest_turn_is_the_polar_factor(rng):
    m = rng.normal(size=(200, 2, 2))
    p, _, qt = np.linalg.svd(m)
    assert np.abs(nearest_turn(m) - p @ qt).max() < 1e-9
    assert (np.linalg.det(m) < 0).any()


def random_frames(rng, n, strain=0.05):
    slant = np.radians(rng.uniform(10, 65, n))
    scale = rng.uniform(0.7, 1.4, n)
    true = compose(rng.uniform(-3, 3, n), slant, rng.uniform(-3, 3, n), scale)
    return true @ (np.eye(2) + strain * rng.normal(size=(n, 2, 2))), scale, true


def test_with_tensor_gives_the_tensor_and_turns_as_little_as_it_can(rng):
    frames, scale, true = random_frames(rng, 40)
    tensor = tensor_of(true, scale)
    got = with_tensor(frames, tensor, scale)
    assert tensor_of(got, scale) == pytest.approx(tensor, abs=1e-9)
    assert (np.linalg.det(got) > 0).all()
    assert np.abs(with_tensor(true, tensor, scale) - true).max() < 1e-9
    # the turn that aligns root · R best with the frame, in the sense of orthogonal Procrustes
    root = got @ np.swapaxes(got, 1, 2)
    values, vectors = np.linalg.eigh(root)
    root = vectors @ (np.sqrt(values)[..., None] * np.swapaxes(vectors, 1, 2))
    best = np.linalg.norm(got - scale[:, None, None] * frames, axis=(1, 2))
    for angle in np.linspace(-0.2, 0.2, 21):
        turned = root @ rotation(angle) @ np.linalg.solve(root, got)
        assert (np.linalg.norm(turned - scale[:, None, None] * frames, axis=(1, 2)) >= best - 1e-9).all()


def test_with_tensor_clips_impossible_slants(rng):
    got = with_tensor(np.tile(np.eye(2), (2, 1, 1)), np.array([[1.0, 0, -0.2], [1.0, 0, 1.3]]), np.ones(2))
    assert np.linalg.svd(got[0], compute_uv=False) == pytest.approx([1, 0.1])
    assert np.linalg.svd(got[1], compute_uv=False)[1] <= 1


def test_holding_to_the_manifold_gives_texture_imaging_transforms(rng):
    frames, scale, true = random_frames(rng, 60, strain=0.02)
    template = template_of(glyph(grid(9)), 9)
    held = hold_to_manifold(frames, scale, template, np.full(60, 1e-4))
    sigma = np.linalg.svd(held / scale[:, None, None], compute_uv=False)
    assert np.abs(sigma[:, 0] - 1).max() < 1e-3
    # the constraint is information: the tensors come nearer to the truth
    before, after = (np.linalg.norm(tensor_of(f, scale) - tensor_of(true, scale), axis=1) for f in (frames, held))
    assert (after**2).mean() < (before**2).mean()
    exact = hold_to_manifold(true, scale, template, np.full(60, 1e-4))
    assert np.abs(exact - true).max() < 1e-6


def test_gram_lift_propagates_the_folded_strain(rng):
    """The convention both sides share: (2 d11, d12 + d21, 2 d22) are the entries of D + Dᵀ."""
    g, d = rng.normal(size=(5, 2, 2)), rng.normal(size=(2, 2))
    folded = np.array([2 * d[0, 0], d[0, 1] + d[1, 0], 2 * d[1, 1]])
    product = g @ (d + d.T) @ np.swapaxes(g, 1, 2)
    assert gram_lift(g) @ folded == pytest.approx(np.stack([product[:, 0, 0], product[:, 0, 1], product[:, 1, 1]], -1))


# all together


def sheet(rng, side=7, pitch=44, size=1.6):
    """Image of side² glyphs on white, each through its own transform `size` · T; (image, centres, transforms, lights)."""
    n = side * side
    t = compose(rng.uniform(-3, 3, n), np.radians(rng.uniform(5, 60, n)), rng.uniform(-3, 3, n))
    light = rng.uniform(0.5, 1.5, n)
    image = np.ones((side * pitch, side * pitch, 3), np.float32)
    fine = (np.arange(pitch * 3) - 1) / 3  # three samples a pixel, pixel centres at integers
    centres = np.zeros((n, 2))
    for k in range(n):
        row, column = divmod(k, side)
        offset = pitch / 2 - 0.5 + rng.uniform(-2, 2, 2)
        s = np.stack(np.meshgrid(fine, fine), -1) - offset
        values = light[k] * glyph(s @ np.linalg.inv(size * t[k]).T)
        tile = values.reshape(pitch, 3, pitch, 3).mean((1, 3))
        image[row * pitch : (row + 1) * pitch, column * pitch : (column + 1) * pitch] = tile[..., None]
        centres[k] = offset + np.array([column * pitch, row * pitch])
    return image, centres, t, light


SETTINGS = Settings(
    half=8, half_limit=18, iterations=20, affine_iterations=6, noise_floor=0.01, trend_order=0, agreement=0.3,
    spread=0.25, fit_spread=True,
)


def test_texton_from_detector_frames_finds_normals_and_outliers(rng):
    image, xy, t, _ = sheet(rng)
    n = len(xy)
    # detector frames know neither slant nor the exact turn, and a fifth lie on nothing
    turn = np.linalg.svd(t)
    start = 1.4 * (turn[0] @ turn[2]) @ rotation(rng.normal(0, 0.1, n))
    start_xy = xy + rng.normal(0, 0.7, (n, 2))
    wrong = np.arange(n) % 5 == 0
    start_xy[wrong] += 22.0
    texton = estimate_texton(image, start_xy, start, np.zeros((n, 2)), SETTINGS)
    assert texton is not None
    # what lies on nothing is left out of the founders, or not believed
    wrong, t = wrong[texton.founders], t[texton.founders]
    right = ~wrong & (texton.inlier > 0.8)
    assert right.sum() > 0.85 * (n - n // 5) and texton.inlier[wrong].max(initial=0) < 0.2
    scale = np.median(np.linalg.svd(texton.frames[right], compute_uv=False)[:, 0])
    found, truth = (normal_of_tensor(tensor_of(f)) for f in (texton.frames[right] / scale, t[right]))
    error = np.minimum(normal_angle(found, truth), normal_angle(found * [-1, -1, 1], truth))
    assert np.median(error) < 1.0
    assert [h[0] for h in texton.history] == [1, 5, 10, 20]


def test_a_texton_is_carried_on_by_the_most_copies_that_are_asked_for(rng):
    image, xy, t, _ = sheet(rng)
    turn = np.linalg.svd(t)
    start = 1.4 * (turn[0] @ turn[2])
    texton = estimate_texton(image, xy, start, np.zeros((len(xy), 2)), SETTINGS._replace(most=20))
    assert texton is not None
    assert len(np.unique(texton.founders)) == len(texton.founders) == len(texton.xy) == len(texton.inlier) == 20
    assert np.linalg.norm(texton.xy - xy[texton.founders], axis=1).max() < 4
    assert all(len(a) == 20 for state in texton.history for a in state[1:])


def test_no_texton_where_no_three_patches_are_alike(rng):
    image = rng.uniform(0, 1, (200, 200, 3)).astype(np.float32)
    xy = rng.uniform(20, 180, (12, 2))
    assert estimate_texton(image, xy, np.tile(np.eye(2), (12, 1, 1)), np.zeros((12, 2)), SETTINGS) is None
