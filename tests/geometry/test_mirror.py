from itertools import product

import numpy as np
import pytest

from sftex_stages.geometry import mirror

NOTHING, NO_DISC = np.zeros((0, 2)), np.zeros((0, 3))


def hints(near=NOTHING, far=NOTHING, convex=NO_DISC, light=None):
    return mirror.Hints(np.array(near, float), np.array(far, float), np.array(convex, float), light)


@pytest.fixture
def two_bowls():
    """A dome at x < 100 and a hollow at x > 200: nodes, slopes, heights, pieces (the dome first)."""
    x, y = np.meshgrid(np.arange(0.0, 91, 10), np.arange(0.0, 91, 10))
    one = np.stack((x.ravel(), y.ravel()), 1)
    xy = np.concatenate((one, one[:-1] + np.array([200.0, 0.0])))
    centre = np.where(xy[:, :1] < 150, 45.0, 245.0) * [1, 0] + [0, 45.0]
    bend = np.where(xy[:, 0] < 150, -0.01, 0.01)
    g = bend[:, None] * (xy - centre)
    return xy, g, 0.5 * bend * ((xy - centre) ** 2).sum(1), mirror.pieces(xy, 25.0)


def test_pieces_are_what_steps_link_largest_first(two_bowls):
    xy, _, _, piece = two_bowls
    assert np.array_equal(piece, (xy[:, 0] > 150).astype(int))
    assert mirror.pieces(xy, 150.0).max() == 0


def test_bulge_prefers_the_dome(two_bowls):
    xy, g, _, piece = two_bowls
    assert np.array_equal(mirror.bulge(xy, g, piece, 2), [mirror.BULGE, -mirror.BULGE])


@pytest.mark.parametrize(
    ("told", "votes"),
    [
        (hints(near=[[45, 45]]), [1, 0]),
        (hints(far=[[45, 45]]), [-1, 0]),
        (hints(near=[[245, 45]]), [0, -1]),
        (hints(near=[[0, 0]], far=[[45, 45]]), [-2, 0]),
        (hints(near=[[45, 45]], far=[[245, 45]]), [1, 1]),
        (hints(convex=[[45, 45, 30]]), [1, 0]),
        (hints(convex=[[245, 45, 30], [45, 45, 1]]), [1, -1]),
    ],
)
def test_hints_vote_for_the_piece_they_lie_in(two_bowls, told, votes):
    xy, g, h, piece = two_bowls
    assert np.array_equal(mirror.hint(told, xy, g, h, piece, 2), mirror.HINT * np.array(votes))


def test_a_convex_mask_speaks_for_every_piece(two_bowls):
    xy, g, h, piece = two_bowls
    told = mirror.Hints(NOTHING, NOTHING, NO_DISC, None, everything=True)
    lean = np.array([0.9, -0.4])
    assert np.array_equal(mirror.hint(told, xy, g + lean, h + xy @ lean, piece, 2), mirror.HINT * np.array([1, -1]))
    lone = np.append(piece[:-1], 2)  # a piece of one node bulges nowhere
    assert mirror.hint(told, xy, g, h, lone, 3)[2] == 0


def test_a_convex_disc_on_a_slope_is_about_its_curvature(two_bowls):
    xy, g, h, piece = two_bowls
    lean = np.array([0.9, -0.4])
    vote = mirror.hint(hints(convex=[[20, 20, 25]]), xy, g + lean, h + xy @ lean, piece, 2)
    assert vote[0] == mirror.HINT


def test_light_comes_from_above_or_from_where_it_is_told():
    up, tie = np.array([0.0, -0.4]), np.array([9.0, -9.0, 0.0])
    assert np.allclose(mirror.light(up, 50.0, tie, None), [mirror.LIGHT_ABOVE, -mirror.LIGHT_ABOVE, 0], atol=1e-6)
    right = np.array([1.0, 0.0])
    assert np.allclose(mirror.light(np.array([-0.3, 0.0]), 50.0, tie, right)[:2], [-mirror.HINT, mirror.HINT])
    assert not mirror.light(up, 5.0, tie, right).any()


def test_size_votes_as_it_goes_with_height_piece_by_piece(two_bowls):
    _, _, h, piece = two_bowls
    weight = np.ones(len(h))
    assert np.array_equal(mirror.scale(-70.0, h, weight, h, 0 * piece, 1), [-70.0])
    votes = mirror.scale(70.0, np.where(piece == 0, h, 5 - h), weight, h, piece, 2)
    assert votes[0] > 10 and votes[1] < -10 and np.abs(votes).sum() == pytest.approx(70)


@pytest.mark.parametrize("count", [1, 5, 14])
def test_decision_is_the_best_of_all(count):
    rng = np.random.default_rng(count)
    votes, ties = rng.normal(size=count), rng.normal(size=(count, count)) * (0.4 if count < 13 else 0.05)
    ties = ties + ties.T
    t = np.array(list(product((1.0, -1.0), repeat=count))).T
    value = votes @ t + 0.5 * (t * ((ties - np.diag(np.diag(ties))) @ t)).sum(0)
    assert np.array_equal(mirror.decide(votes, ties), t[:, value.argmax()])
