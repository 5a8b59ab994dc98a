import numpy as np
import pytest

from sftex_stages.geometry import gaussian, sign_regions, sign_search, signs, spline


def test_regions_are_merged_in_the_order_of_their_mean_agreement():
    # a chain 0-1-2-3-4 whose weakest links are 1-2 and, weaker still, 3-4; the pair 0-1 is listed twice
    pairs = np.array([0, 1, 1, 2, 3]), np.array([1, 0, 2, 3, 4])
    agreement = np.array([5.0, 5.0, 1.0, 4.0, -2.0])
    regions = [set(r.tolist()) for r in sign_regions.merge(agreement, pairs, 5)]
    assert regions == [{0, 1}, {2, 3}, {0, 1, 2, 3}, {0, 1, 2, 3, 4}]


def test_linkage_is_by_the_mean_over_the_rim():
    # 0-1 merge first; then 2 is tied to them by 3 and −1 (mean 1), 3 to 2 by 1.5
    pairs = np.array([0, 0, 1, 2]), np.array([1, 2, 2, 3])
    regions = sign_regions.merge(np.array([9.0, 3.0, -1.0, 1.5]), pairs, 4)
    assert [sorted(r.tolist()) for r in regions] == [[0, 1], [2, 3], [0, 1, 2, 3]]


def test_parts_that_nothing_connects_are_never_merged():
    pairs = np.array([0, 2]), np.array([1, 3])
    assert [sorted(r.tolist()) for r in sign_regions.merge(np.ones(2), pairs, 4)] == [[0, 1], [2, 3]]


@pytest.fixture(scope="module")
def problem():
    rng = np.random.default_rng(4)
    xy = np.stack(np.meshgrid(np.arange(14.0), np.arange(12.0)), -1).reshape(-1, 2) * 10 + rng.uniform(-3, 3, (168, 2))
    d = np.stack((0.9 * np.cos(xy[:, 0] / 28), 0.6 * np.sin(xy[:, 1] / 25)), 1) + 0.02 * rng.normal(size=(168, 2))
    f = gaussian.make_field(spline.cover(xy.min(0) - 20, xy.max(0) + 20, 10.0), xy)
    data = sign_search.Data(xy, d, np.tile(4e-4 * np.eye(2), (168, 1, 1)), np.ones(168), np.full(168, -5.0), None)
    return data, f


def energy(c, s, bias):
    return float(signs.energies(c, s[:, None], bias[:, None])[0])


def test_rises_are_differences_of_the_energy(problem):
    data, f = problem
    rng = np.random.default_rng(5)
    s, bias = rng.choice([-1.0, 1.0], 168), rng.normal(size=168)
    c = signs.coupling(f, data.d, np.linalg.inv(data.covariance), gaussian.Smoothness(1.0, 20.0))
    regions, rise = sign_regions.rivals(c, data.d, s, bias, sign_search.neighbours(data.xy))
    assert max(map(len, regions)) <= 84
    for k in rng.choice(len(regions), 12, replace=False):
        other = s.copy()
        other[regions[k]] *= -1
        assert rise[k] == pytest.approx(energy(c, other, bias) - energy(c, s, bias), rel=1e-6, abs=1e-6)
    margin = sign_regions.margins(regions, rise, 168)
    assert margin[7] == min(v for r, v in zip(regions, rise, strict=True) if 7 in r)


def test_a_wrong_region_that_single_flips_cannot_mend_is_turned(problem):
    data, f = problem
    smooth = gaussian.Smoothness(1.0, 20.0)
    wrong = np.where((data.xy[:, 0] < 60) & (data.xy[:, 1] < 60), -1.0, 1.0)
    c = signs.coupling(f, data.d, np.linalg.inv(data.covariance), smooth)
    stuck = signs.descend(c, wrong[:, None], np.zeros((168, 1)))[:, 0]
    assert abs(stuck.sum()) < 168
    found = sign_search.judge(data, f, stuck, smooth, 1.0, 0, "stuck")
    settled = sign_search.settle(found)
    flat = np.linalg.norm(data.d, axis=1) < 0.06  # whose sign is noise
    assert len(np.unique(settled[~flat])) == 1
    right = sign_search.judge(data, f, settled, smooth, 1.0, 0, "right")
    assert right.evidence > found.evidence + 20
    assert len(np.unique(sign_search.settle(right)[~flat])) == 1
    regions, rise = sign_search.rivals(data, sign_search.own_coupling(right), right.s)
    assert sign_regions.margins(regions, rise, 168)[~flat].min() > 1
