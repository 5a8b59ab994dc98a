import dataclasses

import numpy as np
import pytest

from sftex_stages.geometry import blocks, confidence, gaussian, pooling, refine, spline, tensors
from sftex_stages.geometry.camera import ORTHOGRAPHIC

PLANE = np.array([0.8, 0.3])


def refined(rng, count=3000, textons=8, shear=0.0, noise=0.02):
    """A plane seen by textons that each err by their own constant in w: field, solution, nodes, residuals, slopes, textons."""
    xy = rng.uniform(0, 400, (count, 2))
    texton = np.arange(count) % textons
    truth = np.tile([0.8, 0.3], (count, 1))
    own = shear * rng.normal(size=(textons, 2))
    w = tensors.predict(truth)[0] + own[texton] + noise * rng.normal(size=xy.shape)
    stated = np.tile(max(noise, 1e-3) ** 2 * np.eye(2), (count, 1, 1))
    nodes = pooling.pool(xy, w, stated, np.ones(count), 25.0, 0.003)
    f = gaussian.make_field(spline.cover(np.full(2, -40.0), np.full(2, 440.0), 25.0), nodes.xy)
    start = np.tile([0.8, 0.3], (len(nodes.xy), 1))
    s = refine.refine(f, nodes.w, nodes.covariance, nodes.weight, start, gaussian.Smoothness(1.0, 60.0), 2)
    g = np.einsum("npk,nk->np", ORTHOGRAPHIC.stencil(f.grid, xy)[1], s.a[spline.stencil(f.grid, xy)[0]])
    return f, s, nodes, w, stated, xy, g, texton


def none(xy):
    """Nothing that all instances have wrong together."""
    return np.zeros((len(xy), 2, 1))


def test_shares_of_a_node_add_up_to_one():
    nodes = refined(np.random.default_rng(1), 300)[2]
    total = np.zeros((len(nodes.xy), 2, 2))
    np.add.at(total, nodes.member[nodes.member >= 0], nodes.share[nodes.member >= 0])
    assert np.allclose(total, np.eye(2), atol=1e-9)


def test_what_a_texton_has_wrong_widens_the_spread_as_much_as_it_errs():
    actual, predicted = [], []
    at = np.array([[200.0, 200.0], [100.0, 300.0]])
    for seed in range(12):
        f, s, nodes, w, stated, xy, g, texton = refined(np.random.default_rng(seed), 1000, shear=0.03, noise=0.002)
        residual, _ = confidence.residuals(w, stated, g)
        moved = confidence.influence(s, nodes, residual, texton, none(xy), xy)[:, :8] / np.sqrt(confidence.TEXTONS)
        index, stencil = ORTHOGRAPHIC.stencil(f.grid, at)
        slope = np.einsum("npk,nk->np", stencil, s.a[index])
        actual.append(((slope - PLANE) ** 2).sum(1).mean())
        predicted.append((np.einsum("npk,nkt->npt", stencil, moved[index]) ** 2).sum((1, 2)).mean())
    assert 0.5 < np.sqrt(np.mean(predicted) / np.mean(actual)) < 1.6


def test_what_all_have_wrong_together_moves_the_surface_as_if_it_were_measured():
    f, s, nodes, _, _, xy, _, texton = refined(np.random.default_rng(3), 1000)
    rng = np.random.default_rng(4)
    shear = 1e-5 * rng.normal(size=(len(xy), 2, 2))
    omega = np.linalg.inv(nodes.covariance) * (s.weight / s.noise)[:, None, None]
    before, factor, *_ = refine.step(f, nodes.w, omega, s.gradient, s.smooth)
    moved = confidence.influence(dataclasses.replace(s, factor=factor), nodes, np.zeros_like(xy), texton, shear, xy)
    assert moved.shape == (f.grid.size, 8 + 2 + 2) and not moved[:, :8].any() and not moved[:, 10:].any()
    for k in range(2):
        pooled = np.zeros_like(nodes.w)
        np.add.at(pooled, nodes.member, (nodes.share @ shear[:, :, k, None])[..., 0])
        after = refine.step(f, nodes.w + pooled, omega, s.gradient, s.smooth)[0]
        assert np.allclose(gaussian.gradients(f, after - before), gaussian.gradients(f, moved[:, 8 + k]), atol=1e-12)


def test_what_neighbours_err_in_common_is_taken_for_half_of_what_all_do():
    _, s, nodes, _, _, xy, _, texton = refined(np.random.default_rng(3), 1000)
    rng = np.random.default_rng(4)
    scattered = 0.02 * rng.normal(size=xy.shape)
    waves = 0.05 * np.sin(xy / 60 + [0.0, 1.0])
    assert confidence.misfit(xy, scattered) < 0.007
    assert confidence.misfit(xy, waves + scattered) == pytest.approx(0.05 / np.sqrt(2), rel=0.15)
    shift = confidence.MISFIT * confidence.misfit(xy, waves) * np.tile(np.eye(2), (len(xy), 1, 1))
    moved = confidence.influence(s, nodes, waves, texton, shift, xy)
    assert np.allclose(moved[:, 8:10], moved[:, 10:]) and moved[:, 10:].any()


def test_noise_nearby_widens_the_spread_and_so_does_what_is_shared():
    f, s, _, _, stated, xy, _, _ = refined(np.random.default_rng(5))
    rng = np.random.default_rng(6)
    g = np.tile(PLANE, (len(xy), 1))
    size = np.where(xy[:, 0] < 200, 0.02, 0.06)
    w = tensors.predict(g)[0] + size[:, None] * rng.normal(size=xy.shape)
    chi2 = confidence.residuals(w, stated, g)[1]
    e = confidence.Errors(xy, chi2, np.zeros((f.grid.size, 1)), f.grid, blocks.selected_inverse(s.factor))
    at = np.array([[100.0, 100], [300.0, 100], [100.0, 380]])
    quiet, noisy, _ = (np.trace(c) for c in confidence.spread(e, at))
    # three times the noise, in a place and its surroundings
    assert 4 < noisy / quiet < 13
    plain = confidence.spread(e, at)
    assert np.allclose(confidence.spread(dataclasses.replace(e, reach=4 * confidence.REACH), at), plain / 2)
    folded = [confidence.spread(dataclasses.replace(e, reach=x), at) for x in (confidence.SHORT, 1.0)]
    assert np.array_equal(*folded) and (np.trace(folded[0], axis1=1, axis2=2) > np.trace(plain, axis1=1, axis2=2)).all()
    shared = dataclasses.replace(e, influence=s.a[:, None])  # an error of the plane's own slope
    added = confidence.spread(shared, at) - confidence.spread(e, at)
    assert np.allclose(added, np.outer(PLANE, PLANE), rtol=0.1)
