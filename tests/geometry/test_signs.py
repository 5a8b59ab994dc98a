from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from sftex_stages.geometry import gaussian, perspective, shading, sign_search, signs, spline, surface_em, tensors
from sftex_stages.geometry.camera import Camera


def problem(n, seed, noise=0.05, extent=100.0, bend=60.0):
    rng = np.random.default_rng(seed)
    xy = rng.uniform(0, extent, (n, 2))
    g = np.stack((0.9 * np.sin(xy[:, 0] / bend), 0.9 * np.cos(xy[:, 1] / bend)), 1)
    truth = rng.choice([-1.0, 1.0], n)
    d = truth[:, None] * (g + noise * rng.normal(size=g.shape))
    return xy, d, np.tile(noise**2 * np.eye(2), (n, 1, 1)), truth, g


def data_of(xy, d, covariance, cue=None):
    return sign_search.Data(xy, d, covariance, np.ones(len(d)), np.full(len(d), -3.0), cue)


@pytest.mark.parametrize("seed", range(6))
def test_search_finds_the_best_of_all_patterns(seed):
    xy, d, covariance, _, _ = problem(12, seed, noise=0.15)
    bias = 0.3 * np.random.default_rng(seed).normal(size=12)
    f = gaussian.make_field(spline.cover(np.full(2, -20.0), np.full(2, 120.0), 20.0), xy)
    c = signs.coupling(f, d, np.linalg.inv(covariance), gaussian.Smoothness(0.5, 40.0))
    everything = np.array(list(product([-1.0, 1.0], repeat=12))).T
    best = signs.energies(c, everything, np.tile(bias[:, None], (1, everything.shape[1]))).min()
    starts = np.concatenate((sign_search.starts(data_of(xy, d, covariance))[0], signs.spectral_starts(c, 3)), 1)
    starts = np.concatenate((starts, -starts), 1)
    fields = np.tile(bias[:, None], (1, starts.shape[1]))
    found = signs.descend(c, signs.anneal(c, 0.7 * starts, fields, np.geomspace(0.02, 1, 24)), fields)
    assert signs.energies(c, found, fields).min() == pytest.approx(best, abs=1e-6)


def test_energy_is_the_marginal_likelihood_up_to_a_constant():
    xy, d, covariance, _, _ = problem(15, 3)
    f = gaussian.make_field(spline.cover(np.zeros(2), np.full(2, 100.0), 20.0), xy)
    weight, smooth = np.linalg.inv(covariance), gaussian.Smoothness(1.0, 30.0)
    c = signs.coupling(f, d, weight, smooth)
    s = np.random.default_rng(0).choice([-1.0, 1.0], (15, 4))
    energy = signs.energies(c, s, np.zeros_like(s))
    evidence = [gaussian.log_evidence(f, weight, c.pull * s[:, k, None], smooth) for k in range(4)]
    assert np.allclose(energy + evidence, 0.5 * c.log_det, atol=1e-6)
    unit = np.eye(15)
    assert np.allclose(np.diag(signs.product(c, unit)), c.own)


def test_descent_and_region_moves_never_raise_the_energy():
    xy, d, covariance, _, _ = problem(200, 1)
    f = gaussian.make_field(spline.cover(np.zeros(2), np.full(2, 100.0), 10.0), xy)
    c = signs.coupling(f, d, np.linalg.inv(covariance), gaussian.Smoothness(1.0, 20.0))
    s = np.random.default_rng(0).choice([-1.0, 1.0], (200, 5))
    zero = np.zeros_like(s)
    after = signs.descend(c, s, zero)
    assert (signs.energies(c, after, zero) < signs.energies(c, s, zero)).all()
    region = (xy[:, 0] > 50).astype(np.int64)
    moved = signs.flip_regions(c, after[:, 0], zero[:, 0], region)
    assert signs.energies(c, moved[:, None], zero[:, :1])[0] <= signs.energies(c, after[:, :1], zero[:, :1])[0] + 1e-6


def test_region_move_mends_a_flipped_half():
    xy, d, covariance, truth, _ = problem(200, 2)
    f = gaussian.make_field(spline.cover(np.zeros(2), np.full(2, 100.0), 10.0), xy)
    c = signs.coupling(f, d, np.linalg.inv(covariance), gaussian.Smoothness(1.0, 40.0))
    region = (xy[:, 1] > 50).astype(np.int64)
    mended = signs.flip_regions(c, truth * np.where(region == 1, -1, 1), np.zeros(200), region)
    assert abs((mended * truth).mean()) == 1


def test_search_recovers_signs_from_all_cues_and_ranks_by_evidence():
    xy, d, covariance, truth, g = problem(250, 4, noise=0.04, extent=300.0)
    n = tensors.normals(g)
    rng = np.random.default_rng(1)
    light = 0.5 + 0.4 * n[:, 2] + 0.3 * n[:, 0] - 0.2 * n[:, 1] + 0.01 * rng.normal(size=250)
    cue = shading.make_shading(xy, light / light.mean(), np.full(250, 1e-4), tensors.normals(d))
    f = gaussian.make_field(spline.cover(np.full(2, -20.0), np.full(2, 320.0), 20.0), xy)
    found = sign_search.search(data_of(xy, d, covariance, cue), f, 19.0, 3)
    sloped = np.linalg.norm(g, axis=1) > 0.15
    assert abs((found[0].s * truth)[sloped].mean()) > 0.99
    tuned = [c.evidence for c in found if c.tuned]
    assert tuned == sorted(tuned, reverse=True) and len(tuned) <= 2 * 3 * sign_search.MORE  # before and after second thoughts
    direction = found[0].light.direction[2:] * np.sign((found[0].s * truth).sum())
    assert np.allclose(direction / np.linalg.norm(direction), np.array([3, -2]) / np.sqrt(13), atol=0.1)


def test_em_raises_its_posterior_and_solves_a_cylinder():
    rng = np.random.default_rng(0)
    xy = rng.uniform(0, 100, (120, 2))
    g = surface_em.cylinder(xy, 0.3)
    truth = rng.choice([-1.0, 1.0], 120)
    d = truth[:, None] * g + 0.05 * rng.normal(size=g.shape)
    d[:6] = rng.normal(size=(6, 2)) * 3
    covariance = np.tile(0.01 * np.eye(2), (120, 1, 1))
    result = surface_em.run(xy, d, covariance, np.full(120, -4.0), surface_em.cylinder(xy, 0.0), 25.0)
    assert (np.diff(result.history) > -1e-9 * np.abs(result.history[:-1])).all()
    assert result.history[-1] > result.history[0] + 10
    sign = np.where(result.state[:, 0] > result.state[:, 1], 1, -1)
    steep = np.linalg.norm(g, axis=1) > 0.3
    steep[:6] = False
    assert (sign == truth)[steep].mean() > 0.95
    assert np.allclose(result.state.sum(1), 1)


def test_radial_gradient_against_finite_differences():
    rng = np.random.default_rng(1)
    xy, centres = rng.uniform(0, 100, (10, 2)), rng.uniform(0, 100, (7, 2))
    gradient = surface_em.radial_gradient(xy, centres, 20.0)
    for k in range(2):
        e = 1e-5 * np.eye(2)[k]
        numeric = (surface_em.radial(xy + e, centres, 20.0) - surface_em.radial(xy - e, centres, 20.0)) / 2e-5
        assert np.abs(numeric - gradient[:, k]).max() < 1e-9


def test_patterns_that_are_wrong_in_different_places_mend_one_another():
    xy, d, covariance, truth, _ = problem(200, 2)
    f = gaussian.make_field(spline.cover(np.zeros(2), np.full(2, 100.0), 10.0), xy)
    data = data_of(xy, d, covariance, None)
    pairs = sign_search.neighbours(xy)
    low, left = np.where(xy[:, 1] > 60, -1.0, 1.0), np.where(xy[:, 0] < 30, -1.0, 1.0)
    patterns = np.stack((truth * low, -truth * left), 1)
    label = sign_search.disputed(patterns, data.trust, pairs)
    wrong = low * left < 0  # where they differ, the whole turned
    assert all(len(set(wrong[label == k])) == 1 for k in np.unique(label)) and label.max() >= 1
    smooth = gaussian.Smoothness(1.0, 40.0)
    given = [sign_search.judge(data, f, s, smooth, 1.0, 2, "given") for s in patterns.T]
    found = sign_search.reconsider(given, pairs)
    assert all(abs((x.s * truth).mean()) > 0.99 for x in found)
    assert all(x.evidence > y.evidence for x, y in zip(found, given, strict=True))


def test_roughness_of_its_own_is_in_a_candidates_coupling():
    xy, d, covariance, truth, _ = problem(200, 2)
    f = gaussian.make_field(spline.cover(np.zeros(2), np.full(2, 100.0), 10.0), xy)
    data = data_of(xy, d, covariance, None)
    plain = sign_search.judge(data, f, truth, gaussian.Smoothness(1.0, 40.0), 1.0, 1, "truth")
    found = sign_search.reconsider([plain], sign_search.neighbours(xy))[0]
    c = sign_search.own_coupling(found)
    assert np.allclose(signs.surface_of(c, found.s), found.a, rtol=0.05, atol=0.05 * np.abs(found.a).max())
    assert not np.allclose(c.factor.band, sign_search.own_coupling(plain).factor.band)


def folds(count, seed, noise):
    """Folds as a pinhole camera shows them: nodes and the sizes of their elements, a grid, heights, signs, which are steep."""
    rng = np.random.default_rng(seed)
    camera = Camera((200.0, 200.0), 1 / 1200)
    xy = rng.uniform(0, 400, (count, 2))
    h = 15 * np.sin(xy[:, 0] / 25) + 10 * np.cos(xy[:, 1] / 40)
    g = np.stack((15 / 25 * np.cos(xy[:, 0] / 25), -10 / 40 * np.sin(xy[:, 1] / 40)), 1)
    stated = np.tile(1e-4 * np.eye(2), (count, 1, 1))
    # w and sizes of the image: flattening undoes what the camera does to those of the rays
    seen, w = tensors.predict(camera.slopes(xy, g))[0], tensors.predict(g)[0]
    for _ in range(30):
        flat, _, change = perspective.flatten_tensors(camera, xy, w, stated)
        w = w + seen - flat
    w = w + 0.01 * rng.normal(size=w.shape)
    value = h * camera.bend - change + noise * rng.normal(size=count)
    sizes = perspective.Sizes(value, np.full(count, noise**2), np.ones(count))
    d, covariance = tensors.gradient(w, stated)
    data = sign_search.Data(xy, d, covariance, np.ones(count), np.full(count, -3.0), None)
    grid = spline.cover(np.full(2, -20.0), np.full(2, 420.0), 18.0)
    view = sign_search.seen_by(data, grid, perspective.view(camera, xy, w, stated, sizes))
    return replace(data, views=(view,)), grid, h, np.where((g * d).sum(1) < 0, -1.0, 1.0), np.linalg.norm(g, axis=1) > 0.2


def test_sizes_tell_the_signs_of_folds():
    data, _, h, truth, steep = folds(900, 5, 1e-3)
    smooth = gaussian.Smoothness(1.0, 2 * 18.0)
    found = sign_search.from_sizes(data.views[0], smooth, [], 0.1)
    assert found.shape == (900, 1) and (found[:, 0] == truth)[steep].mean() > 0.99
    nats, view, sign = sign_search.size_of(data, h)
    assert nats > 100 and view is data.views[0] and sign == 1
    assert sign_search.size_of(data, -h) == (nats, view, -1)
    assert sign_search.size_of(data, 15 * np.random.default_rng(0).normal(size=900)) == (0, None, 1)
    assert sign_search.size_of(replace(data, views=()), h) == (0, None, 1)


def test_search_by_sizes_finds_folds_that_smoothness_does_not():
    data, grid, _, truth, steep = folds(60, 6, 1e-3)
    f = gaussian.make_field(grid, data.xy)
    best = sign_search.search(data, f, 45.0, 2)[0]
    assert best.view is not None and best.size > 50 and (best.s == truth)[steep].mean() > 0.95
    blind = sign_search.search(replace(data, views=()), f, 45.0, 2)[0]
    assert blind.view is None and abs((blind.s * truth)[steep].mean()) < 0.8


def test_measured_heights_are_in_the_energy_as_in_the_marginal_likelihood():
    xy, d, covariance, _, _ = problem(15, 3)
    rng = np.random.default_rng(1)
    f = gaussian.make_field(spline.cover(np.zeros(2), np.full(2, 100.0), 20.0), xy)
    weight, smooth = np.linalg.inv(covariance), gaussian.Smoothness(1.0, 30.0)
    height = gaussian.Heights(
        5 * rng.normal(size=15), rng.uniform(0.1, 1.0, 15), np.zeros((15, 1)), np.ones(1), np.ones(15)
    )
    c = signs.coupling(f, d, weight, smooth, height)
    s = rng.choice([-1.0, 1.0], (15, 4))
    energy = signs.energies(c, s, np.tile(c.lift[:, None], (1, 4)))
    evidence = [gaussian.log_evidence(f, weight, c.pull * s[:, k, None], smooth, height) for k in range(4)]
    assert np.ptp(energy + evidence) < 1e-6
    factor = gaussian.posterior(f, weight, gaussian.prior(f, smooth), height.precision)
    mean = gaussian.solve(f, factor, c.pull * s[:, 0, None], height)[0]
    assert np.allclose(signs.surface_of(c, s[:, 0]), mean, atol=1e-8)
    assert np.allclose(signs.surface_of(c, s)[:, 0], mean, atol=1e-8)


def test_sizes_rank_what_em_finds():
    data, grid, _, truth, steep = folds(300, 5, 1e-3)
    f = gaussian.make_field(grid, data.xy)
    best, *others = sign_search.by_em(data, f, 23.0, 4)
    assert best.view is data.views[0] and best.size > 50 and (best.s == truth)[steep].mean() > 0.6
    assert all(x.evidence < best.evidence for x in others)
    blind = sign_search.by_em(replace(data, views=()), f, 23.0, 4)
    assert all(x.view is None and x.size == 0 for x in blind)


def test_a_mirrored_pattern_is_judged_with_the_sign_of_the_sizes():
    data, grid, _, truth, steep = folds(60, 6, 1e-3)
    f = gaussian.make_field(grid, data.xy)
    found = sign_search.judge_as_seen(data, f, -truth, gaussian.Smoothness(1.0, 90.0), 1, "mirrored")
    assert found.view is data.views[0] and found.size > 50 and (found.s == truth)[steep].all()
