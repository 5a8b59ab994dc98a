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
    _, block = roughness.cells(f.grid)
    same = roughness.shaped(f, np.ones(block.max() + 1))
    for a, b in zip(f.energies, same.energies, strict=True):
        assert np.allclose(a, b, atol=1e-15)
    assert roughness.shaped(f, None) is f
    assert np.bincount(block).max() == roughness.BLOCK**2 and block.size == np.prod(f.grid.cells)


def test_a_block_is_the_cells_of_a_square():
    f, _ = field()
    index, block = roughness.cells(f.grid)
    centre = np.stack(np.divmod(index[:, 5], f.grid.shape[1]), 1) - 1  # the cell's own place along outer and inner axis
    for b in np.unique(block):
        assert (np.ptp(centre[block == b], axis=0) < roughness.BLOCK).all()


def test_factors_follow_the_expected_energy():
    f, _ = field()
    weight = np.tile(50 * np.eye(2), (len(f.index), 1, 1))
    factor = gaussian.posterior(f, weight, gaussian.prior(f, SMOOTH))
    a = np.random.default_rng(1).normal(size=f.grid.size)
    found = roughness.learn(f, a, factor, SMOOTH)
    energy = sum(k * spline.energy(f.grid, m).toarray() for k, m in ((1.0, 2), (20.0**2, 3)))
    identity = np.eye(f.grid.size)
    covariance = blocks.solve(factor, identity)
    total = float(a @ energy @ a + np.trace(energy @ covariance))
    number = np.bincount(roughness.cells(f.grid)[1])
    rate = (roughness.FREEDOM + number) / found.factor
    assert (rate - roughness.FREEDOM).sum() == pytest.approx(total, rel=1e-6)


def test_the_bound_is_that_of_a_gamma_prior(monkeypatch):
    """KL of the factors' distribution to the prior, by quadrature."""
    f, _ = field((35.0, 35.0), 20)
    factor = gaussian.posterior(f, np.tile(np.eye(2), (20, 1, 1)), gaussian.prior(f, SMOOTH))
    found = roughness.learn(f, np.zeros(f.grid.size), factor, SMOOTH)
    number = np.bincount(roughness.cells(f.grid)[1])
    expected = 0.0
    x = np.geomspace(1e-4, 60, 200_001)
    prior = roughness.FREEDOM / 2
    for n, mean in zip(number, found.factor, strict=True):
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
    shaped, local = refine.refine_locally(f, w, covariance, np.ones(len(xy)), plain)
    _, block = roughness.cells(f.grid)
    factor = roughness.learn(f, local.a, local.factor, local.smooth).factor
    index, _ = roughness.cells(f.grid)
    outer = f.grid.origin[0] + (np.divmod(index[:, 5], f.grid.shape[1])[0] - 0.5) * f.grid.spacing
    assert f.grid.outer == 0
    rough, even = (outer > 125) & (outer < 195), outer < 100
    assert np.median(factor[block[rough]]) < 0.5 * np.median(factor[block[even]])
    assert local.evidence > plain.evidence and (local.smooth, local.noise) == (plain.smooth, plain.noise)
    off = [np.linalg.norm(s.gradient - g - 0.5, axis=1) for s in (plain, local)]
    assert np.median(off[1][~fold]) < np.median(off[0][~fold])
    assert np.isfinite(shaped.energies[2]).all()
