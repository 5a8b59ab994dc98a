import numpy as np

from sftex_stages.geometry import calibration, pooling, tensors


def test_w_is_what_the_tensor_says_and_has_that_jacobian():
    g = np.random.default_rng(0).normal(size=(20, 2))
    n = tensors.normals(g)
    tensor = np.stack((1 - n[:, 0] ** 2, -n[:, 0] * n[:, 1], 1 - n[:, 1] ** 2), 1)
    w, covariance = tensors.deviator(tensor, np.tile(np.eye(3), (20, 1, 1)))
    predicted, jacobian = tensors.predict(g)
    assert np.allclose(w, predicted, atol=1e-12)
    assert np.allclose(covariance[0], np.diag([2, 4]))
    assert np.allclose(predicted, tensors.predict(-g)[0])
    for k in range(2):
        e = 1e-6 * np.eye(2)[k]
        numeric = (tensors.predict(g + e)[0] - tensors.predict(g - e)[0]) / 2e-6
        assert np.abs(numeric - jacobian[:, :, k]).max() < 1e-8


def test_gradient_inverts_w_up_to_sign():
    g = np.random.default_rng(1).normal(size=(30, 2))
    found, covariance = tensors.gradient(tensors.predict(g)[0], np.tile(1e-8 * np.eye(2), (30, 1, 1)))
    sign = np.sign((found * g).sum(1))[:, None]
    assert np.abs(sign * found - g).max() < 1e-9
    inverse = np.linalg.inv(tensors.predict(found)[1])
    assert np.allclose(covariance, 1e-8 * inverse @ np.swapaxes(inverse, 1, 2))


def test_frontal_instances_are_uncertain_not_infinitely_so():
    g, covariance = tensors.gradient(np.array([[0.0, 0.0], [1e-4, 0.0]]), np.tile(0.02**2 * np.eye(2), (2, 1, 1)))
    assert np.linalg.norm(g, axis=1).max() < 0.02
    spread = np.sqrt(np.linalg.eigvalsh(covariance))
    assert spread.min() > 0.03 and spread.max() < 0.3


def test_angular_error_against_sampling():
    rng = np.random.default_rng(2)
    g, covariance = np.array([0.8, -0.5]), np.array([[4e-4, 1e-4], [1e-4, 9e-4]])
    sample = tensors.normals(rng.multivariate_normal(g, covariance, 40000))
    angle = np.arccos(np.clip(sample @ tensors.normals(g), -1, 1))
    assert np.isclose(tensors.angular_error(g, covariance), np.sqrt((angle**2).mean()), rtol=0.02)


def test_effect_of_a_shear_against_finite_differences():
    t = np.random.default_rng(3).normal(size=(9, 2, 2))
    _, effect = calibration.shear_effect(t)
    for k, e in enumerate((np.array([[1.0, 0], [0, -1]]), np.array([[0, 1.0], [1, 0]]))):
        # T (I + e) Tᵀ is what a frame sheared by I + e / 2 shows, to first order.
        ends = [calibration.shear_effect(t @ (np.eye(2) + h * e / 2))[0] for h in (1e-6, -1e-6)]
        assert np.abs((ends[0] - ends[1]) / 2e-6 - effect[:, :, k]).max() < 1e-7


def field_of_transforms(n=600, textons=6, seed=4):
    rng = np.random.default_rng(seed)
    xy = rng.uniform(0, 600, (n, 2))
    g = np.stack((0.8 * np.sin(xy[:, 0] / 150), 0.7 * np.cos(xy[:, 1] / 130)), 1)
    normal = tensors.normals(g)
    values, axes = np.linalg.eigh(np.eye(2) - normal[:, :2, None] * normal[:, None, :2])
    root = axes @ (np.sqrt(values)[:, :, None] * np.swapaxes(axes, 1, 2))
    turn = rng.uniform(0, 2 * np.pi, n)
    spin = np.stack((np.stack((np.cos(turn), -np.sin(turn)), 1), np.stack((np.sin(turn), np.cos(turn)), 1)), 1)
    return xy, root @ spin, rng.integers(0, textons, n), tensors.predict(g)[0]


def test_textons_correct_one_another():
    xy, transform, texton, truth = field_of_transforms()
    wrong = texton == 2
    transform[wrong] = transform[wrong] @ np.array([[1.04, 0.02], [0.02, 0.96]])
    covariance = np.tile(1e-5 * np.eye(2), (len(xy), 1, 1))
    result = calibration.calibrate(xy, transform, covariance, texton, np.ones(len(xy)), 0.02)
    before = np.linalg.norm(calibration.shear_effect(transform)[0] - truth, axis=1)
    after = np.linalg.norm(result.w - truth, axis=1)
    assert np.median(before[wrong]) > 0.05
    assert np.median(after[wrong]) < 0.2 * np.median(before[wrong])
    assert np.median(after[~wrong]) < 0.01


def test_the_finished_surface_finds_what_is_left_of_a_shear():
    xy, transform, texton, truth = field_of_transforms()
    wrong, shear = texton == 2, np.array([[1.04, 0.02], [0.02, 0.96]])
    transform[wrong] = transform[wrong] @ shear
    covariance, count = np.tile(1e-5 * np.eye(2), (len(xy), 1, 1)), int(texton.max()) + 1
    nothing = np.zeros((count, 2))
    raw = calibration.shear_effect(transform)[0]
    start = calibration.Calibration(nothing, np.ones(count), raw, np.ones(len(xy)), 0.0)
    args = transform, covariance, texton, np.ones(len(xy))
    found = calibration.against_surface(start, *args, truth)
    assert np.median(np.linalg.norm(found.w - truth, axis=1)[wrong]) < 0.005
    assert np.allclose(found.e[2], [-0.084, -0.043], atol=0.004) and np.abs(np.delete(found.e, 2, 0)).max() < 0.003
    lonely = calibration.against_surface(start, transform, covariance, np.minimum(texton, 1) * 0 + wrong, args[3], truth)
    assert not lonely.e[0].any()  # it is most of what the surface was made from


def test_a_texton_that_agrees_with_no_one_loses_its_say():
    xy, transform, texton, _ = field_of_transforms()
    rng = np.random.default_rng(5)
    bad = texton == 3
    transform[bad] = rng.normal(size=(bad.sum(), 2, 2))
    covariance = np.tile(1e-4 * np.eye(2), (len(xy), 1, 1))
    noise = calibration.calibrate(xy, transform, covariance, texton, np.ones(len(xy)), 0.02).noise
    assert noise[3] > 20 * np.delete(noise, 3).max()


def test_pooling_averages_a_crowd_and_resists_its_outlier():
    rng = np.random.default_rng(6)
    xy = rng.uniform(0, 10, (30, 2))
    w = np.array([0.3, -0.2]) + 0.01 * rng.normal(size=(30, 2))
    w[4] = [-0.9, 0.3]
    nodes = pooling.pool(xy, w, np.tile(1e-4 * np.eye(2), (30, 1, 1)), np.ones(30), 100.0, 0.001)
    assert len(nodes.xy) == 1 and (nodes.member == 0).all()
    assert np.abs(nodes.w[0] - [0.3, -0.2]).max() < 0.01
    mean, variance = pooling.average(w[:, 0], np.full(30, 1e-4), nodes, np.ones(30), 0.0)
    assert abs(mean[0] - 0.3) < 0.01 and 1e-6 < variance[0] < 1e-3


def test_cells_of_two_sizes_nest():
    xy = np.stack(np.meshgrid(np.arange(8.0), np.arange(8.0)), -1).reshape(-1, 2)
    even = pooling.cells(xy, 4.0)
    assert (np.bincount(even) == 16).all() and len(np.bincount(even)) == 4
    size = np.where(even == 0, 2.0, 4.0)
    mixed = pooling.cells(xy, size)
    assert sorted(np.bincount(mixed)) == [4, 4, 4, 4, 16, 16, 16]
    assert all(len(set(even[mixed == k])) == 1 for k in range(7))
