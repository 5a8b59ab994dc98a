import numpy as np
import pytest
from scipy.linalg import LinAlgError

from sftex_stages.geometry import blocks, gaussian, spline

GRID = spline.cover(np.array([0.0, 0.0]), np.array([100.0, 80.0]), 10.0)


@pytest.fixture(params=[(100.0, 80.0), (70.0, 120.0)], ids=["wide", "tall"])
def setting(request):
    rng = np.random.default_rng(1)
    high = np.array(request.param)
    grid = spline.cover(np.zeros(2), high, 10.0)
    return rng, grid, rng.uniform(0, high, (50, 2)), rng.normal(size=grid.size)


def test_derivatives_are_those_of_the_value(setting):
    _, grid, xy, a = setting
    for d in ((1, 0), (0, 1)):
        e = 1e-4 * np.array(d)
        numeric = (spline.design(grid, xy + e) @ a - spline.design(grid, xy - e) @ a) / 2e-4
        assert np.abs(numeric - spline.design(grid, xy, *d) @ a).max() < 1e-8
    g = gaussian.gradients(gaussian.make_field(grid, xy), a)
    assert np.allclose(g[:, 0], spline.design(grid, xy, 1, 0) @ a)
    assert np.allclose(g[:, 1], spline.design(grid, xy, 0, 1) @ a)


def test_raster_and_points_agree(setting):
    _, grid, _, a = setting
    x, y = np.arange(3.0, 65.0), np.arange(5.0, 75.0)
    points = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    for d in ((0, 0), (1, 0), (0, 1)):
        assert np.allclose(spline.evaluate(grid, a, x, y, *d).ravel(), spline.design(grid, points, *d) @ a)


def test_energies_are_the_integrals_of_squared_derivatives(setting):
    _, grid, _, _ = setting
    # h = x² + 3xy is in the span; E2 = ∫ 2² + 2·3² + 0, E3 = 0, E1 of y is the area.
    fit_x = np.linspace(grid.origin[0], grid.origin[0] + grid.cells[0] * grid.spacing, 40)
    fit_y = np.linspace(grid.origin[1], grid.origin[1] + grid.cells[1] * grid.spacing, 40)
    points = np.stack(np.meshgrid(fit_x, fit_y), -1).reshape(-1, 2)
    design = spline.design(grid, points).toarray()
    area = np.prod(grid.cells) * grid.spacing**2
    a = np.linalg.lstsq(design, points[:, 0] ** 2 + 3 * points[:, 0] * points[:, 1], rcond=None)[0]
    assert a @ spline.energy(grid, 2) @ a == pytest.approx(22 * area, rel=1e-6)
    assert abs(a @ spline.energy(grid, 3) @ a) < 1e-6
    b = np.linalg.lstsq(design, points[:, 1], rcond=None)[0]
    assert b @ spline.energy(grid, 1) @ b == pytest.approx(area, rel=1e-8)


def dense_posterior(f, weight, smooth, height):
    area = np.prod(f.grid.cells) * f.grid.spacing**2
    e = [spline.energy(f.grid, m).toarray() for m in range(4)]
    weak = e[0] / (area * gaussian.HEIGHT_SCALE) ** 2 + e[1] / (area * gaussian.SLOPE_SCALE**2)
    prior = weak + smooth.strength * (e[2] + smooth.reach**2 * e[3])
    b = f.design.toarray().reshape(len(weight), 2, -1)
    value = np.zeros((len(weight), f.grid.size))
    np.put_along_axis(value, f.index, f.value, 1)
    return prior, prior + np.einsum("npi,npq,nqj->ij", b, weight, b) + value.T @ (height[:, None] * value), b


def test_banded_algebra_equals_dense(setting):
    rng, grid, xy, _ = setting
    f = gaussian.make_field(grid, xy)
    half = rng.normal(size=(50, 2, 2))
    weight, height = half @ np.swapaxes(half, 1, 2), rng.uniform(0, 1, 50)
    smooth = gaussian.Smoothness(0.7, 25.0)
    prior, dense, b = dense_posterior(f, weight, smooth, height)
    factor = gaussian.posterior(f, weight, gaussian.prior(f, smooth), height)
    assert factor.logdet == pytest.approx(np.linalg.slogdet(dense)[1], rel=1e-10)
    assert gaussian.prior_logdet(f, smooth) == pytest.approx(np.linalg.slogdet(prior)[1], rel=1e-9)
    for columns in (1, 5):
        rhs = rng.normal(size=(grid.size, columns))
        expected = np.linalg.solve(dense, rhs)
        assert np.abs(blocks.solve(factor, rhs) - expected).max() < 1e-9 * np.abs(expected).max()
    inverse = np.linalg.inv(dense)
    expected = np.einsum("npi,ij,nqj->npq", b, inverse, b)
    assert np.allclose(gaussian.gradient_covariance(f, factor), expected, rtol=1e-7, atol=1e-12)


def test_evidence_is_the_marginal_likelihood(setting):
    rng, grid, xy, _ = setting
    f = gaussian.make_field(grid, xy)
    smooth, noise = gaussian.Smoothness(2.0, 15.0), 0.1
    y = rng.normal(size=(50, 2))
    weight = np.tile(np.eye(2) / noise**2, (50, 1, 1))
    prior, _, b = dense_posterior(f, weight, smooth, np.zeros(50))
    flat = b.reshape(100, -1)
    covariance = flat @ np.linalg.solve(prior, flat.T) + noise**2 * np.eye(100)
    chi2 = y.ravel() @ np.linalg.solve(covariance, y.ravel())
    direct = -0.5 * (chi2 + np.linalg.slogdet(covariance)[1] + 100 * np.log(2 * np.pi))
    value = gaussian.log_evidence(f, weight, y / noise**2, smooth)
    value += 100 * (-np.log(noise) - 0.5 * np.log(2 * np.pi)) - 0.5 * (y**2).sum() / noise**2
    assert value == pytest.approx(direct, rel=1e-8)


def test_leaving_out_is_leaving_out(setting):
    rng, grid, xy, _ = setting
    f = gaussian.make_field(grid, xy)
    prior = gaussian.prior(f, gaussian.Smoothness(1.0, 20.0))
    weight, y = np.tile(np.eye(2) * 30, (50, 1, 1)), rng.normal(size=(50, 2))
    pull = np.einsum("nij,nj->ni", weight, y)
    factor = gaussian.posterior(f, weight, prior)
    g = gaussian.gradients(f, blocks.solve(factor, gaussian.pulled(f, pull)))
    mean, spread = gaussian.without_own(g, gaussian.gradient_covariance(f, factor), weight, pull)
    keep = np.arange(50) != 7
    partial = gaussian.posterior(f, weight * keep[:, None, None], prior)
    a = blocks.solve(partial, gaussian.pulled(f, pull * keep[:, None]))
    assert np.allclose(mean[7], gaussian.gradients(f, a)[7], atol=1e-6)
    assert np.allclose(spread[7], gaussian.gradient_covariance(f, partial)[7], atol=1e-6)


def test_indefinite_matrix_is_refused():
    with pytest.raises(LinAlgError, match="not positive definite"):
        blocks.factor(-np.ones((4, 6)), 3)


def test_negative_height_pull_lowers_the_surface(setting):
    _, grid, xy, _ = setting
    f = gaussian.make_field(grid, xy)
    precision = np.full(50, 1e6)
    target = 0.2 * xy[:, 0] + 5
    factor = gaussian.posterior(f, np.zeros((50, 2, 2)), gaussian.prior(f, gaussian.Smoothness(1.0, 10.0)), precision)
    a = blocks.solve(factor, gaussian.lifted(f, precision * target))
    assert np.abs(gaussian.heights(f, a) - target).max() < 0.01
