"""Clusters of descriptors whose groups are planted."""

import numpy as np
import pytest

from sftex_stages import cluster
from sftex_stages.cluster import Params, number_of_clusters, outlying


@pytest.fixture
def rng():
    return np.random.default_rng(13)


def planted(rng, groups=(40, 40, 40), regions=(30, 30), noise=0.02):
    """Descriptors around random unit vectors, equal sizes: an artefact of `detect`, and the group of every row."""
    kind = np.repeat(np.array([0, 1], np.uint8), [sum(groups), sum(regions)])
    group = np.repeat(np.arange(len(groups) + len(regions)), [*groups, *regions])
    centres = np.abs(rng.normal(size=(group.max() + 1, 128)))
    centres /= np.linalg.norm(centres, axis=1, keepdims=True)
    n = len(kind)
    angle = rng.uniform(-3, 3, n)
    c, s = np.cos(angle), np.sin(angle)
    size = 4.0 * np.exp(0.1 * rng.normal(size=n))
    frame = size[:, None, None] * np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], -2)
    detect = {
        "xy": rng.uniform(0, 300, (n, 2)).astype(np.float32),
        "frame": frame.astype(np.float32),
        "descriptor": (centres[group] + noise * rng.normal(size=(n, 128))).astype(np.float32),
        "kind": kind,
    }
    return detect, group


def run(detect, **params):
    return cluster.run({"detect": detect}, Params(**params))


def test_groups_far_apart_become_clusters(rng):
    detect, group = planted(rng)
    got = run(detect, points_per_cluster=40, regions_per_cluster=30, min_clusters=1)
    label = got["label"]
    assert label.dtype == np.int32 and label.shape == group.shape
    assert got["count"].dtype == np.int64 and got["count"].shape == () and got["count"] == 5
    for k in range(5):
        assert len(set(label[group == k])) == 1
    assert sorted(set(label)) == list(range(5))


@pytest.mark.parametrize("points, per, expected", [(800, 80, 10), (1000, 80, 12), (30, 80, 1), (10, 3, 3), (0, 80, 1)])
def test_number_of_clusters_follows_the_number_of_points(points, per, expected):
    assert number_of_clusters(points, per, Params()) == expected


@pytest.mark.parametrize("points, expected", [(20000, 250), (5000, 100), (1500, 60), (20, 1)])
def test_few_points_make_smaller_clusters(points, expected):
    assert number_of_clusters(points, 80, Params(), 100) == expected
    assert number_of_clusters(points, 80, Params(clusters=5), 100) == 5


def test_number_of_clusters_given_holds_for_each_kind_but_leaves_three_members_each(rng):
    assert number_of_clusters(800, 80, Params(clusters=7)) == 7
    assert number_of_clusters(12, 80, Params(clusters=7)) == 4
    detect, _ = planted(rng)
    assert run(detect, clusters=6)["count"] == 12


def test_kinds_are_never_mixed(rng):
    detect, _ = planted(rng)
    detect["descriptor"][:] = detect["descriptor"][0]
    detect["descriptor"] += 0.01 * rng.normal(size=detect["descriptor"].shape).astype(np.float32)
    label = run(detect, points_per_cluster=30, regions_per_cluster=30)["label"]
    points, regions = set(label[detect["kind"] == 0]), set(label[detect["kind"] == 1])
    assert (points & regions) <= {-1}
    assert len(points | regions) > 4


def test_members_far_from_their_centre_belong_to_none(rng):
    detect, group = planted(rng, groups=(60,), regions=(30,))
    far = np.array([3, 17, 70])
    detect["descriptor"][far] += 0.1 * rng.normal(size=(3, 128)).astype(np.float32)
    label = run(detect, clusters=1)["label"]
    assert (label[far] == -1).all()
    others = np.setdiff1d(np.arange(len(group)), far)
    assert (label[others] >= 0).all()


def test_members_of_another_size_belong_to_none(rng):
    detect, _ = planted(rng, groups=(60,), regions=(30,))
    detect["frame"][5] *= 2.9
    detect["frame"][6] /= 2.9
    detect["frame"][70] *= 2.9
    label = run(detect, clusters=1)["label"]
    assert np.flatnonzero(label == -1).tolist() == [5, 6, 70]
    assert (run(detect, clusters=1, max_scale_ratio=10.0)["label"] >= 0).all()


def test_size_is_that_of_the_ellipse_whatever_its_shape(rng):
    """A slanted instance of one size: the frame's area counts."""
    detect, _ = planted(rng, groups=(60,), regions=(30,))
    detect["frame"][60:] = detect["frame"][60:] @ np.diag([1.7, 1 / 1.7]).astype(np.float32)
    detect["frame"][61] = detect["frame"][61] @ np.diag([1.0, -1.0]).astype(np.float32)
    assert (run(detect, clusters=1)["label"] >= 0).all()


def test_outlying_judges_every_cluster_by_its_own_medians():
    label = np.array([0, 1, 0, 1, 0, 1, 0, 1])
    distance = np.array([1.0, 10, 1, 10, 1.7, 17, 1, 10])
    size = np.zeros(8)
    assert np.flatnonzero(outlying(label, distance, size, Params(max_distance=1.6))).tolist() == [4, 5]
    size = np.array([0.0, 3, 0, 3, 0, 3, 1, 2])
    assert np.flatnonzero(outlying(label, np.ones(8), size, Params(max_scale_ratio=2.0))).tolist() == [6, 7]


def test_same_input_same_bytes(rng):
    detect, _ = planted(rng, noise=0.2)
    first, second = run(detect, clusters=9), run({k: v.copy() for k, v in detect.items()}, clusters=9)
    assert all(first[name].tobytes() == second[name].tobytes() for name in first)


@pytest.mark.parametrize("points, regions, count", [(2, 20, 1), (20, 0, 1), (20, 2, 1), (2, 1, 0)])
def test_fewer_than_three_of_a_kind_make_no_cluster(rng, points, regions, count):
    detect, _ = planted(rng, groups=(points,), regions=(regions,))
    got = run(detect)
    assert got["count"] == count
    small = detect["kind"] == (0 if points < 3 else 1)
    assert (got["label"][small] == -1).all()
