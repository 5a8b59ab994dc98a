"""Lemma 4 made algebra: the metric upgrade and its uncertainty, on transforms whose frontal frame is known."""

import numpy as np
import pytest
from scipy.optimize import minimize

from sftex_stages.geometry.imaging import compose, lemma1_residual, rotation, tensor_of
from sftex_stages.geometry.metric import (
    circle_metric,
    common_covariance,
    constraint_gap,
    find_relief,
    gram_lift,
    leading_bias,
    leading_eigenpair,
    linear_start,
    metric_covariance,
    metric_upgrade,
    noise_split,
    project_tensors,
    trend_basis,
    turn_variance,
)
from sftex_stages.geometry.registration import make_template, patch_grid
from sftex_stages.geometry.texton import centre_window, marginal_strain


@pytest.fixture
def rng():
    return np.random.default_rng(3)


def transforms(rng, n, shallow=5.0, steep=70.0, scale=1.0):
    slant = np.radians(rng.uniform(shallow, steep, n))
    return compose(rng.uniform(-3.2, 3.2, n), slant, rng.uniform(-3.2, 3.2, n), np.broadcast_to(scale, n))


def affine_map(rng):
    """An unknown A with a stretch of up to 2."""
    stretch = np.diag(np.exp(rng.uniform(-0.35, 0.35, 2)))
    return rng.uniform(0.5, 2) * rotation(rng.uniform(-3, 3)) @ stretch @ rotation(rng.uniform(-3, 3))


def error_of(gram, a):
    """Largest entry of A⁻¹ M A⁻ᵀ − I: zero where M = A Aᵀ, whatever the units."""
    inverse = np.linalg.inv(a)
    return np.abs(inverse @ gram @ inverse.T - np.eye(2)).max()


def upgrade_of(frames, where=None, order=0, weights=None, **rest):
    n = len(frames)
    where = np.zeros((n, 2)) if where is None else where
    return metric_upgrade(frames, where, np.ones(n) if weights is None else weights, order, **rest)


@pytest.mark.parametrize("n", [4, 6, 12, 60])
@pytest.mark.parametrize("seed", range(6))
def test_lemma4_generic_instances_fix_the_frontal_frame(n, seed):
    rng = np.random.default_rng(seed)
    a = affine_map(rng)
    got = upgrade_of(transforms(rng, n, 15, 70) @ np.linalg.inv(a))
    assert error_of(got.gram, a) < 1e-6
    assert got.residual < 1e-6 and np.abs(got.trend).max() < 1e-6


@pytest.mark.parametrize("seed", range(6))
def test_lemma4_three_instances_are_enough(seed):
    rng = np.random.default_rng(seed)
    a = affine_map(rng)
    spin = rng.uniform(0, 6) + np.array([0, 2.1, 4.2])
    t = compose(rng.uniform(-3, 3, 3), np.radians([55.0, 48, 62]), spin)
    assert error_of(upgrade_of(t @ np.linalg.inv(a)).gram, a) < 1e-6


def test_lemma4_no_other_map_leaves_four_instances_imaging_transforms(rng):
    t = transforms(rng, 4, 30, 60)
    worst = [np.abs(lemma1_residual(t @ affine_map(rng))).max() for _ in range(500)]
    assert min(worst) > 1e-3
    turned = t @ rotation(0.7) @ np.diag([1.0, -1.0])
    assert np.abs(lemma1_residual(turned)).max() < 1e-12


def second_frame(t):
    """The other M that meets det² d − tr(T M Tᵀ) + 1 = 0, d = det M, for three transforms; None if it is no frame.

    Three equations leave a line of (M, d) through (I, 1); det M = d meets it in one more point.
    """
    gtg, det2 = np.swapaxes(t, 1, 2) @ t, np.linalg.det(t) ** 2
    k = np.linalg.svd(np.stack([gtg[:, 0, 0], 2 * gtg[:, 0, 1], gtg[:, 1, 1], -det2], -1))[2][-1]
    x = -(k[0] + k[2] - k[3]) / (k[0] * k[2] - k[1] ** 2)
    gram = np.array([[1 + x * k[0], x * k[1]], [x * k[1], 1 + x * k[2]]])
    if np.linalg.eigvalsh(gram)[0] < 0.05 or abs(x) < 0.1:
        return None
    larger = np.linalg.svd(t @ np.linalg.cholesky(gram), compute_uv=False)[:, 0]
    return gram if np.abs(larger - 1).max() < 1e-9 else None


def test_lemma4_three_instances_may_allow_a_second_frame_and_a_fourth_rules_it_out(rng):
    """The lemma's three preserved directions are the same for both frames only if their images are, which need not be."""
    seen = 0
    for _ in range(60):
        t = transforms(rng, 4, 15, 70)
        other = second_frame(t[:3])
        if other is None:
            continue
        seen += 1
        root = np.linalg.cholesky(other)
        assert np.abs(lemma1_residual(t[:3] @ root)).max() < 1e-9  # exact, and yet not the frontal frame
        assert np.abs(root.T @ root - np.eye(2)).max() > 1e-3
        assert np.abs(np.linalg.svd(t[3] @ root, compute_uv=False)[0] - 1) > 1e-5
    assert seen > 10


def test_units_of_the_frames_do_not_matter(rng):
    frames = transforms(rng, 20) @ np.linalg.inv(affine_map(rng))
    assert upgrade_of(7.0 * frames).gram == pytest.approx(upgrade_of(frames).gram / 49, rel=1e-5)


def test_linear_trend_of_scale_is_recovered_with_the_frame(rng):
    where, slope = rng.uniform(-1, 1, (80, 2)), np.array([0.12, -0.07])
    a = affine_map(rng)
    frames = transforms(rng, 80, 15, 70, np.exp(where @ slope)) @ np.linalg.inv(a)
    got = upgrade_of(frames, where, order=1)
    # the prior of the trend draws it a little to zero
    assert got.trend[:2] == pytest.approx(slope, abs=2e-4) and (got.trend[2:] == 0).all()
    assert got.log_scale == pytest.approx(where @ slope, abs=3e-4)
    assert error_of(got.gram, a) < 1e-3
    assert upgrade_of(frames, where, order=0).residual > 0.03


def waved(where):
    """Log scale (N,) over a relief, up to a tenth."""
    return 0.1 * np.sin(3 * where[:, 0] + 1) * np.cos(2.5 * where[:, 1])


def test_scale_that_follows_a_relief_is_recovered_with_the_frame(rng):
    where = rng.uniform(-1, 1, (120, 2))
    a, scale = affine_map(rng), waved(where)
    frames = transforms(rng, 120, 5, 65, np.exp(scale)) @ np.linalg.inv(a)
    frames = frames * np.exp(0.003 * rng.normal(size=(120, 1, 1)))
    got = upgrade_of(frames, where, order=1)
    assert got.relief > 0 and got.residual < 0.01
    error = got.log_scale - scale
    assert (error - np.median(error)).std() < 0.01  # a constant is the frame's
    assert error_of(got.gram / np.sqrt(np.linalg.det(got.gram)), a / np.sqrt(np.linalg.det(a))) < 0.02


def test_scatter_that_does_not_follow_the_place_is_no_relief(rng):
    where = rng.uniform(-1, 1, (60, 2))
    for noise in (0.0, 0.01, 0.05):
        frames = transforms(rng, 60, 5, 65, np.exp(0.1 * where[:, 0] + noise * rng.normal(size=60)))
        assert upgrade_of(frames, where, order=1).relief == 0
    frames = transforms(rng, 60, 5, 65, np.exp(waved(where)))
    assert upgrade_of(frames, where, order=0).relief == 0  # scale that is not to vary does not


def test_noise_beside_the_relief_counts_what_the_waves_take(rng):
    where, ratio = rng.uniform(-1, 1, (80, 2)), []
    for _ in range(8):
        r = waved(where) + 0.02 * rng.normal(size=80)
        relief, noise = find_relief(r, np.zeros((80, 1)), where, np.ones(80), 1)
        assert relief > 0
        ratio.append(noise / 0.02)
    assert 0.7 < np.mean(ratio) < 1.1  # large residuals count less


def test_a_fifth_of_gross_outliers_does_no_harm(rng):
    for _ in range(5):
        a = affine_map(rng)
        t = transforms(rng, 60, 15, 70)
        t[::5] = rng.normal(size=(12, 2, 2))
        got = upgrade_of(t @ np.linalg.inv(a))
        assert error_of(got.gram, a) < 1e-3
        assert got.residual < 1e-3


def test_weight_zero_is_absence(rng):
    a = affine_map(rng)
    t = transforms(rng, 30, 15, 70)
    t[:12] *= 1.5
    weights = np.r_[np.zeros(12), np.ones(18)]
    assert error_of(upgrade_of(t @ np.linalg.inv(a), weights=weights).gram, a) < 1e-6


def test_linear_start_is_exact_and_refuses_what_is_not_positive(rng):
    a = affine_map(rng)
    a /= np.sqrt(np.abs(np.linalg.det(a)))
    frames = transforms(rng, 9) @ np.linalg.inv(a)
    assert error_of(linear_start(frames, np.ones(9)), a) < 1e-8
    assert linear_start(frames[:3], np.ones(3)) is None
    # frames that meet the equation for M = diag(1, −½) and d = 1, to a percent
    rows = rng.normal(size=(4000, 2, 2))
    value = 1 + np.linalg.det(rows) ** 2 - (rows[:, :, 0] ** 2).sum(1) + 0.5 * (rows[:, :, 1] ** 2).sum(1)
    near = rows[np.abs(value) < 0.01]
    assert len(near) > 8 and linear_start(near, np.ones(len(near))) is None


def test_instances_that_keep_one_direction_show_in_the_covariance(rng):
    n = 40
    where, weights = rng.uniform(-1, 1, (n, 2)), np.ones(n)
    tilt, slant = rng.uniform(-3, 3, n), np.radians(rng.uniform(20, 60, n))
    generic = metric_covariance(compose(tilt, slant, rng.uniform(-3, 3, n)), where, weights, 0, 0.005)[:3, :3]
    assert np.sqrt(np.linalg.eigvalsh(generic)[-1]) < 0.01
    for spin in (0.0, 0.9):
        cov = metric_covariance(compose(tilt, slant, np.full(n, spin)), where, weights, 0, 0.005)[:3, :3]
        assert np.sqrt(np.linalg.eigvalsh(cov)[-1]) > 0.5
        # the foreshortened direction's stretch is free, that of the direction which keeps its length is known
        kept, lost = rotation(spin).T @ [0.0, 1.0], rotation(spin).T @ [1.0, 0.0]
        square = [np.array([v[0] ** 2, 2 * v[0] * v[1], v[1] ** 2]) for v in (kept, lost)]
        assert np.sqrt(square[0] @ cov @ square[0]) < 0.01
        assert np.sqrt(square[1] @ cov @ square[1]) > 0.5


def test_covariance_predicts_the_scatter_of_the_upgrade(rng):
    n, noise = 40, 0.01
    where, weights = rng.uniform(-1, 1, (n, 2)), np.ones(n)
    t = transforms(rng, n, 40, 65)
    found = []
    for _ in range(60):
        noisy = np.exp(noise * rng.normal(size=n))[:, None, None] * t
        gram = metric_upgrade(noisy, where, weights, 0).gram
        found.append([gram[0, 0], gram[0, 1], gram[1, 1]])
    scatter = np.std(found, axis=0)
    predicted = np.sqrt(np.diag(metric_covariance(t, where, weights, 0, noise))[:3])
    # independent errors: those that instances share, which this noise lacks, double the predicted deviation
    ratio = 2 * scatter / predicted
    assert ratio.min() > 0.6 and ratio.max() < 1.7


def test_covariance_of_a_circle_has_its_size_alone(rng):
    n = 40
    where, weights = rng.uniform(-1, 1, (n, 2)), np.ones(n)
    frames = compose(rng.uniform(-3, 3, n), np.radians(rng.uniform(20, 60, n)), np.zeros(n))
    cov = metric_covariance(frames, where, weights, 0, 0.005, circular=True)[:3, :3]
    assert np.linalg.matrix_rank(cov, tol=1e-12) == 1
    assert cov[0, 0] == pytest.approx(cov[2, 2]) and cov[0, 2] == pytest.approx(cov[0, 0]) and np.sqrt(cov[0, 0]) < 0.01


def test_circle_given_the_size_is_found_even_where_one_direction_is_kept(rng):
    n = 25
    a = affine_map(rng)
    frames = compose(rng.uniform(-3, 3, n), np.radians(rng.uniform(0, 60, n)), np.zeros(n)) @ np.linalg.inv(a)
    gram = a @ a.T
    got = upgrade_of(frames, circle=gram / np.sqrt(np.linalg.det(gram)))
    assert error_of(got.gram, a) < 1e-6


def disc_template(b, half=14, edge=1.5):
    """Disc of radius 8 with a soft edge in the coordinates B s."""
    r = np.linalg.norm(patch_grid(half, 1.0).astype(float) @ b.T, axis=1)
    n = 2 * half + 1
    values = np.repeat((1 - 0.8 / (1 + np.exp((r - 8) / edge)))[:, None], 3, 1).reshape(n, n, 3)
    return make_template(values, centre_window(half) > 0, 1.0)


@pytest.mark.parametrize("angle", [0.0, 0.6, 2.0])
def test_disc_seen_in_an_ellipses_frame_is_told_and_made_round(angle):
    b = rotation(angle) @ np.diag([1.25, 0.9]) @ rotation(-angle)
    ratio, gram = circle_metric(marginal_strain(disc_template(b)))
    assert ratio < 0.01
    expected = np.linalg.inv(b.T @ b)
    expected /= np.sqrt(np.linalg.det(expected))
    assert gram == pytest.approx(expected, abs=0.02)


def test_other_elements_are_no_circles():
    half = 14
    s = patch_grid(half, 1.0).astype(float)
    n = 2 * half + 1

    def strain(grey):
        values = np.repeat(grey[:, None], 3, 1).reshape(n, n, 3)
        return marginal_strain(make_template(values, centre_window(half) > 0, 1.0))

    def step(d):
        return 1 / (1 + np.exp(-d / 0.8))

    bar = 1 - 0.8 * step(3 - np.abs(s[:, 0])) * step(9 - np.abs(s[:, 1]))
    cross = 1 - 0.8 * np.maximum(bar < 0.6, (step(3 - np.abs(s[:, 1])) * step(9 - np.abs(s[:, 0]))) > 0.5)
    corner = 1 - 0.8 * step(s[:, 0]) * step(s[:, 1])
    for grey in (bar, cross, corner):
        ratio, gram = circle_metric(strain(grey))
        assert ratio > 0.03 or gram is None or np.linalg.cond(gram) > 6
    # an edge slides along itself: its weakest strain is a shear, no turn
    _, gram = circle_metric(strain(step(s @ [0.8, 0.6])))
    assert gram is None or np.linalg.cond(gram) > 6


def test_leading_eigenpair_is_that_of_a_dense_solver(rng):
    half = rng.normal(size=(200, 2, 2))
    mats = half + np.swapaxes(half, 1, 2)
    l1, l2, u = leading_eigenpair(mats)
    values, vectors = np.linalg.eigh(mats)
    assert np.stack([l2, l1], -1) == pytest.approx(values, abs=1e-12)
    assert np.abs(np.einsum("ni,ni->n", u, vectors[:, :, 1])) == pytest.approx(np.ones(200))


def test_trend_basis_by_order():
    where = np.array([[2.0, 3.0]])
    assert trend_basis(where, 2).tolist() == [[2, 3, 4, 6, 9]]
    assert trend_basis(where, 1).tolist() == [[2, 3, 0, 0, 0]]
    assert trend_basis(where, 0).tolist() == [[0, 0, 0, 0, 0]]


def test_gram_lift_is_the_congruence(rng):
    g, half = rng.normal(size=(50, 2, 2)), rng.normal(size=(50, 2, 2))
    e = half + np.swapaxes(half, 1, 2)
    lifted = np.einsum("nij,nj->ni", gram_lift(g), np.stack([e[:, 0, 0], e[:, 0, 1], e[:, 1, 1]], -1))
    product = g @ e @ np.swapaxes(g, 1, 2)
    assert lifted == pytest.approx(np.stack([product[:, 0, 0], product[:, 0, 1], product[:, 1, 1]], -1))


def test_waves_are_scaled_to_the_prior_of_the_trend():
    where = np.random.default_rng(0).uniform(-1, 1, (50, 2))
    plain, waved = trend_basis(where, 1), trend_basis(where, 1, 0.3)
    assert (waved[:, :5] == plain).all() and waved.shape[1] > 30
    assert trend_basis(where, 1, 0.6)[:, 5:] == pytest.approx(2 * waved[:, 5:])
    assert np.abs(waved[:, 5:]).max() <= 0.3 / 0.1 + 1e-12


def test_common_covariance_against_finite_differences(rng):
    n, order = 12, 2
    where, scale = rng.uniform(-1, 1, (n, 2)), rng.uniform(0.8, 1.2, n)
    frames = transforms(rng, n, scale=1.0) * scale[:, None, None]
    half = rng.normal(size=(8, 8))
    cov = half @ half.T

    def tensors(theta):
        m = np.array([[1 + theta[0], theta[1]], [theta[1], 1 + theta[2]]])
        s = scale * np.exp(trend_basis(where, order) @ theta[3:])
        full = frames @ m @ np.swapaxes(frames, 1, 2) / s[:, None, None] ** 2
        return np.stack([full[:, 0, 0], full[:, 0, 1], full[:, 1, 1]], -1)

    jac = np.stack([(tensors(e) - tensors(-e)) / 2e-6 for e in 1e-6 * np.eye(8)], -1)
    expected = jac @ cov @ np.swapaxes(jac, 1, 2)
    assert common_covariance(frames, where, scale, order, cov) == pytest.approx(expected, rel=1e-5, abs=1e-6)


def test_constraint_gap_and_its_variance_against_finite_differences(rng):
    tensor = tensor_of(transforms(rng, 30, 20, 70)) + 0.05 * rng.normal(size=(30, 3))

    def largest(t):
        return np.linalg.eigvalsh(np.stack([t[:, 0], t[:, 1], t[:, 1], t[:, 2]], -1).reshape(-1, 2, 2))[:, 1]

    grad = np.stack([(largest(tensor + e) - largest(tensor - e)) / 2e-6 for e in 1e-6 * np.eye(3)], -1)
    half = rng.normal(size=(30, 3, 3))
    cov = half @ np.swapaxes(half, 1, 2)
    gap, variance = constraint_gap(tensor, cov)
    assert gap == pytest.approx(largest(tensor) - 1)
    assert variance == pytest.approx(np.einsum("ni,nij,nj->n", grad, cov, grad), rel=1e-6)


@pytest.mark.parametrize("cos, noise", [(0.9, 0.02), (0.7, 0.05), (0.4, 0.05)])
def test_bias_of_the_larger_eigenvalue_is_that_of_sampling(rng, cos, noise):
    tensor = np.array([cos**2, 0.0, 1.0]) + noise * rng.normal(size=(100_000, 3))
    gap, _ = constraint_gap(tensor, np.tile(np.eye(3), (len(tensor), 1, 1)))
    assert leading_bias(tensor, np.full(len(tensor), noise**2)).mean() == pytest.approx(gap.mean(), rel=0.15)


def test_bias_of_a_frontal_instance_is_never_overdone(rng):
    """Where the second order fails, the bias is of the order of the noise and less than it really is."""
    tensor = np.array([1.0, 0.0, 1.0]) + 0.02 * rng.normal(size=(100_000, 3))
    gap, _ = constraint_gap(tensor, np.tile(np.eye(3), (len(tensor), 1, 1)))
    assert 0.25 * gap.mean() < leading_bias(tensor, np.full(len(tensor), 4e-4)).mean() < gap.mean()


@pytest.mark.parametrize("factor, scale", [(20.0, 0.05), (4.0, 0.1), (60.0, 0.0), (2.0, 0.0)])
def test_noise_split_recovers_what_was_planted(rng, factor, scale):
    variance = np.exp(rng.uniform(np.log(1e-6), np.log(1e-3), 600))
    heavy = rng.standard_t(4, 600) / np.sqrt(2)  # of variance 1
    gap = heavy * np.sqrt(factor * variance + scale**2)
    got_factor, got_scale = noise_split(gap, variance, np.ones(600))
    if scale:
        assert np.sqrt(got_scale) == pytest.approx(scale, rel=0.35)
    else:
        assert np.sqrt(got_scale) < 0.006
    assert np.log(got_factor / factor) == pytest.approx(0, abs=np.log(2.5))


def test_noise_split_without_data_keeps_to_the_guess():
    factor, scale = noise_split(np.ones(5), np.ones(5), np.zeros(5))
    # ten correlated samples to an independent one, more or less
    assert 5 < factor < 20 and scale == 0


def test_projection_is_the_constrained_least_squares_solution(rng):
    truth = tensor_of(transforms(rng, 12, 25, 70))
    half = 0.04 * rng.normal(size=(12, 3, 3))
    cov = half @ np.swapaxes(half, 1, 2) + 1e-5 * np.eye(3)
    tensor = truth + 0.04 * rng.normal(size=(12, 3))
    projected, left, chi2 = project_tensors(tensor, cov, steps=30)

    def largest(t):
        return np.linalg.eigvalsh([[t[0], t[1]], [t[1], t[2]]])[1]

    for k in range(12):
        precision = np.linalg.inv(cov[k])
        reference = minimize(
            lambda t, k=k, precision=precision: (t - tensor[k]) @ precision @ (t - tensor[k]),
            truth[k],
            constraints={"type": "eq", "fun": lambda t: largest(t) - 1},
            method="SLSQP",
            options={"ftol": 1e-14, "maxiter": 500},
        )
        assert projected[k] == pytest.approx(reference.x, abs=2e-4)
        assert largest(projected[k]) == pytest.approx(1, abs=1e-6)
        assert chi2[k] == pytest.approx(reference.fun, rel=1e-3, abs=1e-6)
    # nothing is left of the variance across the constraint, all of it along
    u = leading_eigenpair(projected[:, [0, 1, 1, 2]].reshape(-1, 2, 2))[2]
    grad = np.stack([u[:, 0] ** 2, 2 * u[:, 0] * u[:, 1], u[:, 1] ** 2], -1)
    assert np.abs(np.einsum("nij,nj->ni", left, grad)).max() < 1e-6
    assert np.linalg.eigvalsh(left)[:, 1].min() > 0


def test_projection_leaves_valid_tensors_alone_and_its_usual_steps_suffice(rng):
    truth = tensor_of(transforms(rng, 50, 20, 70))
    cov = np.tile(np.diag([1e-3, 5e-4, 1e-3]), (50, 1, 1))
    projected, _, chi2 = project_tensors(truth, cov)
    assert np.abs(projected - truth).max() < 1e-9 and chi2.max() < 1e-9
    noisy = truth + 0.02 * rng.normal(size=truth.shape)
    four, many = project_tensors(noisy, cov)[0], project_tensors(noisy, cov, steps=50)[0]
    assert np.abs(four - many).max() < 1e-3


def test_chi2_of_the_distance_has_one_degree_of_freedom(rng):
    n = 3000
    truth = tensor_of(transforms(rng, n, 30, 60))
    cov = np.tile(1e-4 * np.array([[4, 0.5, 1], [0.5, 2, 0.3], [1, 0.3, 3]]), (n, 1, 1))
    noisy = truth + rng.multivariate_normal(np.zeros(3), cov[0], n)
    chi2 = project_tensors(noisy, cov)[2]
    assert chi2.mean() == pytest.approx(1, abs=0.1)
    assert (chi2 > 3.841).mean() == pytest.approx(0.05, abs=0.02)


def test_directions_that_differ_by_noise_alone_are_one_direction(rng):
    n, noise = 60, 0.02
    where, weights = rng.uniform(-1, 1, (n, 2)), np.ones(n)
    tilted = compose(np.full(n, 0.4), np.full(n, np.radians(25)), np.zeros(n))
    noisy = tilted @ (np.eye(2) + noise * rng.normal(size=(n, 2, 2)))
    strain = np.tile(noise**2 * np.diag([4.0, 2, 4]), (n, 1, 1))
    lift = gram_lift(noisy)
    turn = turn_variance(tensor_of(noisy), lift @ strain @ np.swapaxes(lift, 1, 2))
    found = metric_covariance(noisy, where, weights, 0, 0.002, turn)[:3, :3]
    assert np.sqrt(np.linalg.eigvalsh(found)[-1]) > 0.3
    generic = transforms(rng, n, 20, 60)
    before, after = (
        metric_covariance(generic, where, weights, 0, 0.005, t)[:3, :3] for t in (0.0, np.full(n, 0.05**2))
    )
    assert after == pytest.approx(before, rel=0.1, abs=1e-6)


def test_turn_variance_is_the_scatter_of_the_direction(rng):
    t = compose(0.7, np.radians(40), 1.0)
    cov = 1e-4 * np.array([[4, 0.5, 1], [0.5, 2, 0.3], [1, 0.3, 3]])
    tensor = tensor_of(t) + rng.multivariate_normal(np.zeros(3), cov, 20_000)
    u = leading_eigenpair(tensor[:, [0, 1, 1, 2]].reshape(-1, 2, 2))[2]
    across = np.array([np.cos(0.7), np.sin(0.7)])  # the tilt; the leading direction is square to it
    angle = np.arcsin(u @ across * np.sign(u @ [-across[1], across[0]]))
    assert turn_variance(tensor_of(t)[None], cov[None])[0] == pytest.approx(angle.var(), rel=0.1)
    assert turn_variance(np.array([[1.0, 0, 1]]), cov[None])[0] == 0.5
