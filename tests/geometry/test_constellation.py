"""Rules between textons on prints of which every place is known."""

import numpy as np
import pytest

from sftex_stages.geometry import constellation
from sftex_stages.geometry.constellation import Candidates, Known
from sftex_stages.geometry.imaging import compose, rotation

SHAPE = (400, 400)
RADIUS = np.array([8.0, 6.0])
VIEW = compose(0.4, 0.8, 0.3, 1.2)  # of a tilted plane
STEPS = np.array([[40.0, 5.0], [-8.0, 36.0]])  # of the print's raster, px of the frontal frame
SECOND, TURN = np.array([11.0, -7.0]), 0.9  # place and turn of the second texton against the first


def lattice():
    """Places (n, 2) on the print that lie in the image."""
    i = np.stack(np.meshgrid(np.arange(-12, 13), np.arange(-12, 13)), -1).reshape(-1, 2)
    s = i @ STEPS
    xy = s @ VIEW.T + 200
    return s[((xy > 12) & (xy < 388)).all(1)]


def printed(noise=0.0, seed=0):
    """Two textons on a regular print, seen on a plane: (N,) rows, the first texton's first."""
    rng = np.random.default_rng(seed)
    s = lattice()
    at = np.concatenate([s, s + SECOND])
    n = len(s)
    transform = np.concatenate([np.tile(VIEW, (n, 1, 1)), np.tile(VIEW @ rotation(TURN), (n, 1, 1))])
    xy = at @ VIEW.T + 200 + noise * rng.normal(size=(2 * n, 2))
    return Known(xy, transform, np.repeat([0, 1], n), np.repeat([0.0, 0.5], n))


def some(known, rows):
    return Known(*(column[rows] for column in known))


def predict(known, rules, crowd=100, mask=None, tried=None, doubt=1.0):
    mask = np.ones(SHAPE, bool) if mask is None else mask
    return constellation.predict(known, rules, RADIUS, doubt, crowd, mask, tried or Candidates.none())


def learn(known, turns=(False, False), reach=8.0, share=0.3):
    return constellation.learn(known, RADIUS, np.array(turns), reach, share)


def test_rules_are_the_vectors_of_the_print():
    rules = learn(printed(noise=0.2))
    pair = rules.take((rules.source == 0) & (rules.target == 1))
    nearest = pair.take(np.argsort(np.linalg.norm(pair.offset, axis=1)))
    assert nearest.offset[0] == pytest.approx(SECOND, abs=0.2)
    assert nearest.relative[0] == pytest.approx(rotation(TURN), abs=1e-9)
    assert nearest.light[0] == pytest.approx(0.5)
    assert 0.1 < nearest.spread[0] < 0.6
    own = rules.take((rules.source == 0) & (rules.target == 0))
    for step in STEPS:
        assert np.linalg.norm(own.offset - step, axis=1).min() < 0.3


def test_what_is_missing_is_predicted_and_nothing_else():
    known = printed()
    gone = np.random.default_rng(3).random(len(known.xy)) < 0.25
    got = predict(some(known, ~gone), learn(some(known, ~gone)))
    inner = (np.abs(got.xy - 200) < 170).all(1)  # beyond lies print that `printed` left out
    expected = np.flatnonzero(gone & (np.abs(known.xy - 200) < 170).all(1))
    assert inner.sum() == len(expected)
    for k in expected:
        j = np.linalg.norm(got.xy - known.xy[k], axis=1).argmin()
        assert got.xy[j] == pytest.approx(known.xy[k], abs=0.05) and got.texton[j] == known.texton[k]
        assert got.transform[j] == pytest.approx(known.transform[k], abs=1e-6)
        assert got.log_light[j] == pytest.approx(known.log_light[k])


def test_nothing_is_asked_in_a_crowd_nor_twice_nor_beyond_the_mask():
    known = printed()
    gone = np.random.default_rng(3).random(len(known.xy)) < 0.25
    left, rules = some(known, ~gone), learn(some(known, ~gone))
    every = predict(left, rules)
    assert len(every.xy) and len(predict(left, rules, tried=every).xy) == 0
    mask = np.ones(SHAPE, bool)
    mask[:, :200] = False
    assert set(map(tuple, predict(left, rules, mask=mask).xy)) == {tuple(xy) for xy in every.xy if xy[0] > 199.5}
    few = predict(left, rules, crowd=1)
    size = RADIUS[few.texton] * np.sqrt(np.abs(np.linalg.det(few.transform)))
    others = np.linalg.norm(few.xy[:, None] - left.xy, axis=2).min(1)
    assert 0 < len(few.xy) <= len(every.xy) and (others >= size).all()
    assert len(predict(left, rules, doubt=1e-6).xy) == 0


def test_elements_scattered_at_random_have_no_rules():
    rng = np.random.default_rng(0)
    n = 300
    spin = rotation(rng.uniform(-np.pi, np.pi, n))
    raster = np.stack(np.meshgrid(np.arange(20, 400, 22.0), np.arange(20, 400, 22.0)), -1).reshape(-1, 2)[:n]
    known = Known(raster, VIEW @ spin, np.arange(n) % 2, np.zeros(n))
    assert len(learn(known).source) == 0
    level = known._replace(xy=rng.uniform(0, 400, (n, 2)), transform=np.tile(VIEW, (n, 1, 1)))
    assert len(learn(level).source) == 0


def test_circles_are_predicted_and_predict_nothing():
    known = printed()
    turned = known.transform.copy()
    of = known.texton == 1
    turned[of] = turned[of] @ rotation(np.random.default_rng(0).uniform(-np.pi, np.pi, of.sum()))
    rules = learn(known._replace(transform=turned), turns=(False, True))
    assert not (rules.source == 1).any()
    pair = rules.take((rules.source == 0) & (rules.target == 1))
    assert np.linalg.norm(pair.offset - SECOND, axis=1).min() < 0.1


@pytest.mark.parametrize("n", [0, 1, 2])
def test_next_to_nothing_has_no_rules(n):
    known = some(printed(), np.arange(n))
    assert len(learn(known).source) == 0 and len(predict(known, learn(known)).xy) == 0


def test_a_texton_with_a_wrong_metric_disagrees():
    rng = np.random.default_rng(0)
    n = 400
    xy, texton = rng.uniform(0, 400, (n, 2)), np.arange(n) % 4
    tensor = np.array([0.7, 0.1, 0.9]) + 0.01 * rng.normal(size=(n, 3))
    tensor[texton == 3] += [0.2, 0, -0.1]
    found = constellation.disagreement(xy, tensor, texton, 5)
    assert (found[:3] < 1.5).all() and found[3] > 8 and np.isnan(found[4])


def test_first_of_each_place():
    xy = np.array([[0.0, 0], [3, 0], [0, 3], [10, 0], [10, 1]])
    squeeze = np.tile(np.diag([1.0, 0.25]), (5, 1, 1))  # three px down are twelve on the print
    free = np.array([True, True, True, False, True])
    assert constellation.first_of_each(xy, squeeze, 5.0, free).tolist() == [0, 2, 4]
