import numpy as np

from sftex_stages.geometry import field, spline


def lit(n=500, textons=4, seed=0, noise=0.0):
    rng = np.random.default_rng(seed)
    xy = rng.uniform(0, 400, (n, 2))
    log_e = 0.5 * np.sin(xy[:, 0] / 90) + 0.3 * np.cos(xy[:, 1] / 70)
    texton = rng.integers(0, textons, n)
    scale = np.array([0.0, 0.7, -0.4, 1.3])[:textons]
    return rng, xy, log_e, texton, scale, log_e + scale[texton] + noise * rng.normal(size=n)


def check(result, scale, xy, log_e, tolerance):
    offset = result.offset - result.offset[0]
    assert np.abs(offset - (scale - scale[0])).max() < tolerance
    value = spline.design(result.grid, xy) @ result.a
    error = value - log_e
    assert np.median(np.abs(error - np.median(error))) < tolerance


def test_scales_and_field_from_noise_free_data():
    _, xy, log_e, texton, scale, log_l = lit()
    result = field.fit(xy, log_l, np.full(len(xy), 1e-3), texton, np.ones(len(xy)), 20.0, 0.8)
    check(result, scale, xy, log_e, 2e-3)


def test_one_texton_alone():
    _, xy, log_e, texton, scale, log_l = lit(textons=1)
    result = field.fit(xy, log_l, np.full(len(xy), 1e-3), texton, np.ones(len(xy)), 20.0, 0.8)
    check(result, scale, xy, log_e, 2e-3)


def test_highlights_and_gutters_are_let_go():
    rng, xy, log_e, texton, scale, log_l = lit(noise=0.01, seed=1)
    bad = np.arange(len(xy)) % 15 == 0
    log_l[bad] += rng.choice([-2.0, 1.5], bad.sum())
    result = field.fit(xy, log_l, np.full(len(xy), 0.01), texton, np.ones(len(xy)), 20.0, 0.8)
    check(result, scale, xy, log_e, 0.012)
    assert result.weight[bad].max() < 0.1


def test_distrusted_instances_have_no_say():
    _, xy, log_e, texton, scale, log_l = lit(seed=2)
    trust = np.where(np.arange(len(xy)) % 3 == 0, 1e-6, 1.0)
    log_l[trust < 1] += 5
    result = field.fit(xy, log_l, np.full(len(xy), 1e-3), texton, trust, 20.0, 0.8)
    check(result, scale, xy, log_e, 4e-3)
