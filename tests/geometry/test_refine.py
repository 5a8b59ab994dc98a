import numpy as np
import pytest

from sftex_stages.geometry import blocks, confidence, gaussian, refine, spline, support, tensors


def exact(seed=0):
    rng = np.random.default_rng(seed)
    grid = spline.cover(np.zeros(2), np.array([200.0, 160.0]), 40.0)
    xy = rng.uniform(0, [200, 160], (150, 2))
    f = gaussian.make_field(grid, xy)
    a = 25 * rng.normal(size=grid.size)
    return rng, f, a, gaussian.gradients(f, a)


def test_surface_in_the_span_is_recovered_from_noise_free_tensors():
    rng, f, _, g = exact()
    w = tensors.predict(g)[0]
    omega = np.tile(1e10 * np.eye(2), (len(w), 1, 1))
    now = g + 0.1 * rng.normal(size=g.shape)
    for _ in range(12):
        a, *_ = refine.step(f, w, omega, now, gaussian.Smoothness(1e-3, 1.0))
        now = gaussian.gradients(f, a)
    assert np.abs(now - g).max() < 1e-8


def test_refinement_survives_outliers_and_estimates_the_noise():
    rng, f, _, g = exact(1)
    noise = 0.01
    w = tensors.predict(g)[0] + noise * rng.normal(size=g.shape)
    bad = np.arange(len(w)) % 12 == 0
    w[bad] = rng.uniform(-0.7, 0.7, (bad.sum(), 2))
    stated = np.tile((noise / 2) ** 2 * np.eye(2), (len(w), 1, 1))  # half the true noise
    start = g + 0.05 * rng.normal(size=g.shape)
    s = refine.refine(f, w, stated, np.ones(len(w)), start, gaussian.Smoothness(1.0, 20.0), 8)
    angle = np.degrees(np.arccos(np.clip((tensors.normals(s.gradient) * tensors.normals(g)).sum(1), -1, 1)))
    assert np.median(angle[~bad]) < 1.0
    assert np.median(s.weight[bad]) < 0.1 < 0.7 < np.median(s.weight[~bad])
    assert 1.5 < s.noise < 8
    mirror = refine.flipped(s)
    assert np.allclose(mirror.gradient, -s.gradient) and np.allclose(mirror.a, -s.a)


def test_linearised_tensors_have_the_residual_and_slope_of_the_exact_ones():
    rng, _, _, g = exact(2)
    w = tensors.predict(g)[0] + 0.05 * rng.normal(size=g.shape)
    omega = np.tile(np.array([[9.0, 2.0], [2.0, 5.0]]), (len(w), 1, 1))
    information, pull, _ = refine.linearise(w, omega, g)

    def cost(x):
        r = w - tensors.predict(x)[0]
        return 0.5 * np.einsum("ni,nij,nj->n", r, omega, r)

    slope = np.einsum("nij,nj->ni", information, g) - pull
    for k in range(2):
        e = 1e-6 * np.eye(2)[k]
        assert np.abs((cost(g + e) - cost(g - e)) / 2e-6 - slope[:, k]).max() < 1e-6


def sure_errors(xy):
    """A field over 300 x 300 px measured well at `xy` (N, 2), and what is known of its errors."""
    f = gaussian.make_field(spline.cover(np.full(2, -40.0), np.full(2, 340.0), 20.0), xy)
    weight = np.tile(1e4 * np.eye(2), (len(xy), 1, 1))
    factor = gaussian.posterior(f, weight, gaussian.prior(f, gaussian.Smoothness(1.0, 30.0)))
    inverse = blocks.selected_inverse(factor)
    return f, confidence.Errors(xy, np.full(len(xy), 0.7), np.zeros((f.grid.size, 1)), f.grid, inverse)


def test_support_follows_the_surface_and_leaves_holes():
    rng = np.random.default_rng(3)
    x, y = np.meshgrid(np.arange(10.0, 300, 20), np.arange(10.0, 300, 20))
    xy = np.stack((x.ravel(), y.ravel()), 1)
    hole = np.hypot(xy[:, 0] - 150, xy[:, 1] - 150) < 80
    xy = xy[~hole] + rng.normal(size=(int((~hole).sum()), 2))
    f, errors = sure_errors(xy)
    maps = support.dense(f.grid, np.zeros(f.grid.size), (300, 300), xy, 20.0, errors, support.reach(xy, 20.0))
    assert not maps["supported"][150, 150] and maps["supported"][20, 20] and maps["supported"][299, 150]
    assert 0.6 < maps["supported"].mean() < 0.95
    assert maps["sigma"][150, 150] > 2 * maps["sigma"][30, 30]
    assert np.allclose(maps["normals"], [0, 0, 1])
    # The same instances on a steep slope are further apart on the surface, and reach less far in the image.
    steep = np.linalg.lstsq(spline.design(f.grid, xy).toarray(), 3 * xy[:, 0], rcond=None)[0]
    there = support.dense(f.grid, steep, (300, 300), xy, 20.0, errors, support.reach(xy, 20.0))
    assert there["supported"].mean() < maps["supported"].mean()


def test_pieces_are_connected_and_no_specks():
    valid = np.zeros((40, 60), bool)
    valid[5:15, 5:15] = valid[5:35, 20:50] = True
    valid[38, 58] = valid[15, 15] = True
    label = support.pieces(valid, 4.0)
    assert (label[5:35, 20:50] == 1).all() and (label[5:15, 5:15] == 2).all()
    assert label[38, 58] == 0 and label[15, 15] == 0 and label.dtype == np.int32
    assert ((label > 0).sum() == 1000) and (support.pieces(valid & False, 1.0) == 0).all()


def test_holes_are_closed_where_support_all_around_would_do():
    supported = np.ones((40, 60), bool)
    closable = np.zeros_like(supported)
    supported[5:8, 5:9] = False  # a speck
    closable[5:8, 5:9] = True
    supported[20:30, 10:20] = False  # a gap: its middle is out of all reach
    closable[20:30, 10:20] = True
    closable[24:26, 14:16] = False
    supported[15:18, :6] = False  # open toward the border
    closable[15:18, :6] = True
    supported[4:7, 40:43] = supported[7:9, 43:46] = False  # two that touch at a corner are one, and it is not closable
    closable[4:7, 40:43] = True
    closed = support.close_holes(supported, closable)
    assert closed[5:8, 5:9].all()
    assert np.array_equal(closed[10:], supported[10:]) and np.array_equal(closed[:, 30:], supported[:, 30:])
    everything = np.ones((4, 4), bool)
    assert support.close_holes(everything, everything).all() and not support.close_holes(~everything, everything).any()


@pytest.mark.parametrize(("radius", "closed"), [(80, False), (50, True)])
def test_a_place_a_little_out_of_reach_is_closed(radius, closed):
    x, y = np.meshgrid(np.arange(10.0, 300, 20), np.arange(10.0, 300, 20))
    xy = np.stack((x.ravel(), y.ravel()), 1)
    f, errors = sure_errors(xy[np.hypot(xy[:, 0] - 150, xy[:, 1] - 150) > radius])
    maps = support.dense(f.grid, np.zeros(f.grid.size), (300, 300), errors.xy, 20.0, errors, support.reach(xy, 20.0))
    assert not maps["supported"][150, 150]
    assert support.close_holes(maps["supported"], maps["closable"])[150, 150] == closed


def test_surrounded_is_inside_of_the_hull_of_the_neighbours():
    x, y = np.meshgrid(np.arange(0.0, 100, 10), np.arange(0.0, 100, 10))
    xy = np.stack((x.ravel(), y.ravel()), 1)
    at = np.array([[45.0, 52.0], [3.0, 80.0], [-4.0, 50.0], [95.0, 95.0]])
    assert list(support.surrounded(xy, at)) == [True, True, False, False]
