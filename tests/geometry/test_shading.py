import numpy as np

from sftex_stages.geometry import shading, sign_search, tensors


def scene(seed, count=400, dark=0):
    """Places, normals, and irradiance under one light, of which `dark` nodes, all in a corner, see only the ambient 0.25."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform(0, 100, (count, 2))
    n = tensors.normals(rng.normal(size=(count, 2)) * 0.5)
    e = 0.4 + 0.6 * n[:, 2] + 0.5 * n[:, 0] + 0.01 * rng.normal(size=count)
    shaded = np.argsort(xy.sum(1))[:dark]
    e[shaded] = 0.25 * np.exp(0.05 * rng.normal(size=dark))
    return shading.make_shading(xy, e, np.full(count, 1e-4), n), xy, n, shaded


def test_light_is_recovered_and_pulls_toward_the_true_signs():
    data, _, n, _ = scene(5)
    data.e[::20] *= 0.3  # here and there something dark
    light = shading.fit(data, np.ones(400), rounds=10)
    assert np.allclose(light.direction[2:], [0.5, 0.0], atol=0.03)
    far = (np.abs(n[:, 0]) > 0.1) & (np.arange(400) % 20 > 0)
    assert (shading.pull(data, light)[far] > 0).mean() > 0.97
    null = shading.fit(data, np.zeros(400), directed=False, rounds=10)
    assert light.log_likelihood > null.log_likelihood + 100


def test_constant_irradiance_says_nothing():
    data, xy, n, _ = scene(6)
    rng = np.random.default_rng(6)
    data = shading.make_shading(xy, 1 + 0.01 * rng.normal(size=400), np.full(400, 1e-4), n)
    value, _ = sign_search.shade_of(
        sign_search.Data(xy, n[:, :2], np.ones((400, 2, 2)), np.ones(400), xy[:, 0], data), np.ones(400)
    )
    assert value < 3


def test_a_cast_shadow_is_told_from_the_light_and_says_nothing_of_signs():
    data, _, _, shaded = scene(7, dark=60)
    light = shading.settled(data, np.ones(400))
    rest = np.setdiff1d(np.arange(400), shaded)
    assert (light.lit[shaded] < 0.1).mean() > 0.9 and (light.lit[rest] > 0.9).mean() > 0.98
    assert np.allclose(light.direction[2:], [0.5, 0.0], atol=0.02)
    pull = np.abs(shading.pull(data, light))
    assert np.median(pull[shaded]) < 0.01 * np.median(pull[rest])


def test_signs_in_a_shadow_do_not_matter_and_those_in_the_light_do():
    data, _, n, shaded = scene(8, dark=60)
    away = np.ones(400)
    away[shaded] = np.where(n[shaded, 0] < 0, 1.0, -1.0)  # all turned away from the light
    loss = shading.settled(data, np.ones(400)).log_likelihood - shading.settled(data, away).log_likelihood
    without = [shading.fit(data, s, rounds=shading.SETTLED).log_likelihood for s in (np.ones(400), away)]
    assert loss > -10 and without[1] - without[0] > 20  # one light for all would have them turned
    wrong = np.ones(400)
    wrong[np.setdiff1d(np.arange(400), shaded)[:60]] = -1.0
    assert shading.settled(data, np.ones(400)).log_likelihood > shading.settled(data, wrong).log_likelihood + 100


def test_no_shadow_is_believed_where_one_light_explains_all():
    for data in (scene(9)[0], scene(10, dark=shading.FEWEST - 1)[0]):
        light = shading.settled(data, np.ones(400))
        plain = shading.fit(data, np.ones(400), rounds=shading.SETTLED)
        assert (light.lit == 1).all() and light.log_likelihood == plain.log_likelihood


def test_densities_integrate_to_one():
    r = np.linspace(-400, 400, 800_001)
    assert np.isclose(np.exp(shading.student(r**2, np.array(0.7))).sum() * (r[1] - r[0]), 1, atol=1e-4)
    e = np.linspace(1e-4, 40, 400_001)
    lit = np.where(np.arange(len(e)) % 4 > 0, 1.0, 0.0)  # a quarter lies in shadow: its density has as much of the whole
    mixed, after = shading.cast(e, e - 5.0, (e - 5.0) ** 2, np.full(len(e), 0.3**2), lit)
    whole = np.exp(mixed) * (e[1] - e[0])
    assert np.isclose(whole.sum(), 1, atol=1e-3) and np.isclose(whole @ (1 - after), 0.25, atol=1e-3)
