"""Lemmas 1 to 3 of the paper on random transforms, and the tensor that an instance gives of its normal."""

import numpy as np
import pytest

from sftex_stages.geometry.imaging import (
    compose,
    lemma1_residual,
    normal_angle,
    normal_of_tensor,
    rotation,
    tensor_of,
    tensor_of_normal,
)
from sftex_stages.geometry.metric import gram_lift

N = 500


@pytest.fixture
def rng():
    return np.random.default_rng(11)


def random_angles(rng, n=N, steepest=89.0):
    return rng.uniform(-np.pi, np.pi, n), np.radians(rng.uniform(0, steepest, n)), rng.uniform(-np.pi, np.pi, n)


def random_normals(rng, n=N):
    tilt, slant, _ = random_angles(rng, n)
    return np.stack([np.sin(slant) * np.cos(tilt), np.sin(slant) * np.sin(tilt), np.cos(slant)], -1)


def solutions_of_lemma1(rng, n=4000):
    """Matrices that meet det² − tr(T Tᵀ) + 1 = 0, from three random entries and the quadratic for the fourth."""
    a, b, c = rng.uniform(-1.3, 1.3, (3, n))
    quadratic, half, rest = a * a - 1, -a * b * c, (b * c) ** 2 - a * a - b * b - c * c + 1
    inside = half**2 - quadratic * rest
    a, b, c, quadratic, half, inside = (v[inside > 0] for v in (a, b, c, quadratic, half, inside))
    d = (-half + rng.choice([-1, 1], len(a)) * np.sqrt(inside)) / quadratic
    return np.stack([np.stack([a, b], -1), np.stack([c, d], -1)], -2)


def test_lemma1_holds_for_imaging_transforms(rng):
    t = compose(*random_angles(rng))
    det = np.linalg.det(t)
    assert np.abs(lemma1_residual(t)).max() < 1e-12
    assert det.min() >= 0 and det.max() <= 1


def test_lemma1_converse_every_solution_within_the_bounds_is_a_foreshortening(rng):
    t = solutions_of_lemma1(rng)
    assert np.abs(lemma1_residual(t)).max() < 1e-6
    det = np.linalg.det(t)
    t = t[(det >= 0.01) & (det <= 1)]
    assert len(t) > 100
    normal = normal_of_tensor(tensor_of(t))
    tilt, slant = np.arctan2(normal[:, 1], normal[:, 0]), np.arccos(normal[:, 2])
    assert np.cos(slant) == pytest.approx(np.linalg.det(t), abs=1e-5)
    spin = np.linalg.solve(compose(tilt, slant, np.zeros(len(t))), t)
    assert np.abs(spin @ np.swapaxes(spin, 1, 2) - np.eye(2)).max() < 1e-5
    assert np.linalg.det(spin) == pytest.approx(np.ones(len(t)), abs=1e-5)
    angle = np.arctan2(spin[:, 1, 0], spin[:, 0, 0])
    assert np.abs(compose(tilt, slant, angle) - t).max() < 1e-5


def test_lemma1_needs_its_bounds(rng):
    """The equation alone says that one singular value is 1: an enlarging map and a flip meet it as well."""
    t = solutions_of_lemma1(rng)
    det, sigma = np.linalg.det(t), np.linalg.svd(t, compute_uv=False)
    assert np.abs(sigma - 1).min(1).max() < 1e-5
    larger, flipped = det > 1 + 1e-6, det < 0
    assert larger.sum() > 100 and flipped.sum() > 100
    assert sigma[larger, 0].min() > 1
    any_matrix = rng.normal(size=(N, 2, 2))
    sigma2 = np.linalg.svd(any_matrix, compute_uv=False) ** 2
    assert lemma1_residual(any_matrix) == pytest.approx((sigma2[:, 0] - 1) * (sigma2[:, 1] - 1), abs=1e-9)


def test_lemma2_transpose_is_an_imaging_transform_and_one_vector_keeps_its_length(rng):
    tilt, slant, spin = random_angles(rng)
    t = compose(tilt, slant, spin)
    assert np.abs(np.swapaxes(t, 1, 2) - compose(-spin, slant, -tilt)).max() < 1e-12
    # across the tilt nothing is foreshortened: v is that direction in the element's frame
    across = np.stack([-np.sin(tilt), np.cos(tilt)], -1)
    v = np.einsum("nji,nj->ni", t, across)
    assert np.linalg.norm(v, axis=1) == pytest.approx(np.ones(N))
    assert np.einsum("nij,nj->ni", t, v) == pytest.approx(across, abs=1e-12)


def test_lemma3_three_directions_of_fixed_length_leave_only_isometries(rng):
    v = rng.normal(size=(N, 3, 2))
    rows = np.zeros((N * 3, 2, 2))
    rows[:, 0] = v.reshape(-1, 2)
    system = gram_lift(rows)[:, 0].reshape(N, 3, 3)  # vᵀ E v, linear in E = BᵀB
    cross = [v[:, i, 0] * v[:, j, 1] - v[:, i, 1] * v[:, j, 0] for i, j in ((0, 1), (1, 2), (0, 2))]
    assert np.abs(np.linalg.det(system)) == pytest.approx(2 * np.abs(np.prod(cross, axis=0)), abs=1e-9)
    generic = np.abs(np.prod(cross, axis=0)) > 1e-3
    solution = np.linalg.solve(system[generic], (v[generic] ** 2).sum(-1)[..., None])[..., 0]
    assert np.abs(solution - [1, 0, 1]).max() < 1e-8


def test_lemma3_two_directions_are_too_few():
    e, f = np.array([1.0, 0.0]), np.array([0.6, 0.8])
    cross = f[0] * f[1]
    gram = np.array([[1.0, 0.2], [0.2, 1 - 2 * 0.2 * cross / f[1] ** 2]])
    b = np.linalg.cholesky(gram).T
    assert np.linalg.norm(b @ e) == pytest.approx(1) and np.linalg.norm(b @ f) == pytest.approx(1)
    assert np.abs(b.T @ b - np.eye(2)).max() > 0.1


def test_rotation_and_compose_agree_with_matrix_products():
    r = rotation(np.pi / 2)
    assert r == pytest.approx(np.array([[0.0, -1.0], [1.0, 0.0]]))
    squeeze = np.diag([0.5, 1.0])
    got = compose(0.3, np.radians(60), -1.1, scale=3.0)
    assert got == pytest.approx(3 * rotation(0.3) @ squeeze @ rotation(-1.1))


def test_tensor_of_a_transform_is_that_of_its_normal(rng):
    tilt, slant, spin = random_angles(rng)
    scale = rng.uniform(0.2, 5, N)
    normal = np.stack([np.sin(slant) * np.cos(tilt), np.sin(slant) * np.sin(tilt), np.cos(slant)], -1)
    tensor = tensor_of(compose(tilt, slant, spin, scale), scale)
    assert np.abs(tensor - tensor_of_normal(normal)).max() < 1e-12


def test_normal_comes_back_from_its_tensor_up_to_the_twofold_sign(rng):
    normal = random_normals(rng)
    back = normal_of_tensor(tensor_of_normal(normal))
    assert (back[:, 0] >= 0).all()
    error = np.minimum(normal_angle(back, normal), normal_angle(back * [-1, -1, 1], normal))
    assert error.max() < 1e-4
    assert np.linalg.norm(back, axis=1) == pytest.approx(np.ones(N))


def test_normal_of_a_noisy_tensor_is_of_its_leading_direction_and_always_unit(rng):
    half = rng.normal(size=(N, 2, 2)) * 0.8
    outer = half + np.swapaxes(half, 1, 2)  # I − tensor, indefinite and beyond 1 at times
    tensor = np.stack([1 - outer[:, 0, 0], -outer[:, 0, 1], 1 - outer[:, 1, 1]], -1)
    normal = normal_of_tensor(tensor)
    values, vectors = np.linalg.eigh(outer)
    assert np.linalg.norm(normal, axis=1) == pytest.approx(np.ones(N))
    assert (normal[:, 2] > 0).all()
    assert (normal[:, :2] ** 2).sum(1) == pytest.approx(np.clip(values[:, 1], 0, 1), abs=1e-5)
    seen = values[:, 1] > 0.01
    along = np.einsum("ni,ni->n", normal[seen, :2], vectors[seen, :, 1]) / np.linalg.norm(normal[seen, :2], axis=1)
    assert np.abs(along) == pytest.approx(np.ones(seen.sum()))


def test_angle_is_exact_for_small_and_large_angles():
    z = np.array([0.0, 0.0, 1.0])
    for degrees in (1e-6, 1.0, 90.0, 180.0):
        a = np.radians(degrees)
        assert normal_angle(z, np.array([np.sin(a), 0, np.cos(a)])) == pytest.approx(degrees, rel=1e-6)
