import numpy as np
import pytest
from scipy.special import gammaln

from sftex_stages.geometry import blocks, gaussian, refine, roughness, spline, tensors

SMOOTH = gaussian.Smoothness(1.0, 20.0)


def field(cells=(100.0, 160.0), count=200, spacing=10.0):
    xy = np.random.default_rng(0).uniform(0, cells, (count, 2))
    return gaussian.make_field(spline.cover(np.zeros(2), np.array(cells), spacing), xy), xy


@pytest.mark.parametrize("size", [(100.0, 160.0), (160.0, 100.0), (35.0, 35.0)])
def test_with_all_factors_one_the_prior_is_as_it_was(size):
    f, _ = field(size)
    index = spline.cells(f.grid)
    same = roughness.shaped(f, np.ones(len(index)))
    for a, b in zip(f.energies, same.energies, strict=True):
        assert np.allclose(a, b, atol=1e-15)
    assert len(index) == np.prod(f.grid.cells)


@pytest.mark.parametrize("side", roughness.BLOCKS)
def test_a_block_is_the_cells_of_a_square(side):
    f, _ = field()
    index, block = spline.cells(f.grid), roughness.squares(f.grid, side)
    centre = np.stack(np.divmod(index[:, 5], f.grid.shape[1]), 1) - 1  # the cell's own place along outer and inner axis
    for b in range(block.max() + 1):
        assert (np.ptp(centre[block == b], axis=0) < side).all()
    assert np.bincount(block).max() == side**2 and np.bincount(block).min() > 0


def levels(grid):
    return [roughness.squares(grid, side) for side in roughness.BLOCKS]


def test_factors_follow_the_expected_energy():
    """Both levels' conditions hold together: of all factors' product with the energy, block by block."""
    f, _ = field()
    weight = np.tile(50 * np.eye(2), (len(f.index), 1, 1))
    factor = gaussian.posterior(f, weight, gaussian.prior(f, SMOOTH))
    a = np.random.default_rng(1).normal(size=f.grid.size)
    found = roughness.learn(f, a, factor, SMOOTH)
    covariance = blocks.solve(factor, np.eye(f.grid.size))
    one = sum(k * roughness.cell_energy(f.grid, m) for k, m in ((1.0, 2), (20.0**2, 3)))
    energy = np.array([a[i] @ one @ a[i] + (covariance[np.ix_(i, i)] * one).sum() for i in spline.cells(f.grid)])
    coarse, fine = levels(f.grid)
    # λ = c f with c = (ν + n_c) / (ν + Σ f E) and f = (ν + n_f) / (ν + Σ c E): solved here by plain repetition
    c, g = np.ones(coarse.max() + 1), np.ones(fine.max() + 1)
    for _ in range(200):
        c = (roughness.FREEDOM + np.bincount(coarse)) / (roughness.FREEDOM + np.bincount(coarse, g[fine] * energy))
        g = (roughness.FREEDOM + np.bincount(fine)) / (roughness.FREEDOM + np.bincount(fine, c[coarse] * energy))
    assert found.factor == pytest.approx(c[coarse] * g[fine], rel=5e-3)


def test_the_bound_is_that_of_gamma_priors():
    """KL of the factors' distribution to the prior, by quadrature, level by level."""
    f, _ = field((35.0, 35.0), 20)
    factor = gaussian.posterior(f, np.tile(np.eye(2), (20, 1, 1)), gaussian.prior(f, SMOOTH))
    found = roughness.learn(f, np.zeros(f.grid.size), factor, SMOOTH)
    coarse, fine = levels(f.grid)
    assert coarse.max() == 0  # one block of it: its factor and theirs can be told from the products, given the rate of either
    covariance = blocks.solve(factor, np.eye(f.grid.size))
    one = sum(k * roughness.cell_energy(f.grid, m) for k, m in ((1.0, 2), (20.0**2, 3)))
    energy = np.array([(covariance[np.ix_(i, i)] * one).sum() for i in spline.cells(f.grid)])
    nu, c, g = roughness.FREEDOM, 1.0, np.ones(fine.max() + 1)
    for _ in range(roughness.SWEEPS):
        c = (nu + len(fine)) / (nu + (g[fine] * energy).sum())
        g = (nu + np.bincount(fine)) / (nu + c * np.bincount(fine, energy))
    x = np.geomspace(1e-4, 60, 200_001)
    prior, expected = nu / 2, 0.0
    for n, mean in [(len(fine), c), *zip(np.bincount(fine), g, strict=True)]:
        shape, rate = prior + n / 2, (prior + n / 2) / mean
        log_q = shape * np.log(rate) - gammaln(shape) + (shape - 1) * np.log(x) - rate * x
        log_p = prior * np.log(prior) - gammaln(prior) + (prior - 1) * np.log(x) - prior * x
        q = np.exp(log_q)
        expected += np.trapezoid(q * (0.5 * n * (np.log(x) - np.log(mean)) - log_q + log_p), x)
    assert found.bound == pytest.approx(expected, rel=1e-4)


def test_a_fold_beside_flat_cloth_is_rough_and_the_cloth_is_not():
    size = (200.0, 120.0)
    f, xy = field(size, 700, 8.0)
    g = np.zeros((len(xy), 2))
    fold = xy[:, 0] > 120
    g[fold, 0] = 1.2 * np.sin((xy[fold, 0] - 120) / 4.5)
    rng = np.random.default_rng(2)
    w = tensors.predict(g + 0.5)[0] + 0.03 * rng.normal(size=g.shape)
    covariance = np.tile(0.03**2 * np.eye(2), (len(xy), 1, 1))
    plain = refine.refine(f, w, covariance, np.ones(len(xy)), g + 0.5, SMOOTH, 4)
    local = refine.refine_locally(w, covariance, np.ones(len(xy)), plain)
    factor = roughness.learn(f, local.a, local.factor, local.smooth).factor
    index = spline.cells(f.grid)
    outer = f.grid.origin[0] + (np.divmod(index[:, 5], f.grid.shape[1])[0] - 0.5) * f.grid.spacing
    assert f.grid.outer == 0
    rough, even = (outer > 125) & (outer < 195), outer < 100
    assert np.median(factor[rough]) < 0.5 * np.median(factor[even])
    assert local.evidence > plain.evidence and (local.smooth, local.noise) == (plain.smooth, plain.noise)
    off = [np.linalg.norm(s.gradient - g - 0.5, axis=1) for s in (plain, local)]
    assert np.median(off[1][~fold]) < np.median(off[0][~fold])
    assert np.isfinite(local.field.energies[2]).all()


def test_stiff_priors_stay_within_double_precision():
    """A plane is as stiff as may be: the lean, which only weak terms hold, must not be lost in rounding."""
    side, count = 15.0, 80
    rng = np.random.default_rng(5)
    xy = rng.uniform(0, side * count, (400, 2))
    f = gaussian.make_field(spline.cover(np.zeros(2), np.full(2, side * count), side), xy)
    stiff = gaussian.Smoothness(1e5, 0.6 * side * count)
    everywhere = roughness.shaped(f, np.full(len(spline.cells(f.grid)), 36.0))
    assert not gaussian.holds(everywhere, stiff) and not gaussian.reasonable(everywhere, 1e5, 0.6 * side * count)
    assert gaussian.holds(everywhere, gaussian.softened(everywhere, stiff))
    g = np.tile([0.8, 0.2], (len(xy), 1))
    w, stated = tensors.predict(g)[0], np.tile(1e-4 * np.eye(2), (len(xy), 1, 1))
    s = refine.refine(everywhere, w, stated, np.ones(len(xy)), g, stiff, 1, tune=False)
    assert np.abs(s.gradient - g).max() < 1e-3
    factor = gaussian.posterior(f, np.tile(1e4 * np.eye(2), (len(xy), 1, 1)), gaussian.prior(f, s.smooth))
    learned = roughness.learn(f, np.zeros(f.grid.size), factor, s.smooth)
    assert gaussian.holds(roughness.shaped(f, learned.factor), s.smooth)
