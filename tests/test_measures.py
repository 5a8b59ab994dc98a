"""Figures against values worked out by hand, on normals, heights and light whose errors are known."""

import numpy as np
import pytest

from sftex_stages import measures
from sftex_stages.measures import angle, relative_to_ray, unit


def tilted(slant: float, tilt: float = 0.0) -> np.ndarray:
    """Unit normal of this slant and tilt, degrees."""
    s, t = np.radians([slant, tilt])
    return np.array([np.sin(s) * np.cos(t), np.sin(s) * np.sin(t), np.cos(s)])


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(5)


def test_angle_is_exact_from_a_millionth_to_180_degrees() -> None:
    z = tilted(0.0)
    for degrees in (0.0, 1e-6, 1.0, 60.0, 90.0, 180.0):
        assert angle(z, tilted(degrees)) == pytest.approx(degrees, rel=1e-9)


def test_relative_to_ray_is_a_rotation_that_takes_the_ray_to_the_axis(rng: np.random.Generator) -> None:
    focal, centre = 300.0, np.array([50.0, 40.0])
    xy = rng.uniform(0, 400, (20, 2))
    ray = unit(np.column_stack([-(xy - centre) / focal, np.ones(20)]))
    assert relative_to_ray(ray, xy, focal, centre) == pytest.approx(np.tile([0.0, 0.0, 1.0], (20, 1)))
    a, b = unit(rng.normal(size=(2, 20, 3)))
    turned_a, turned_b = relative_to_ray(a, xy, focal, centre), relative_to_ray(b, xy, focal, centre)
    assert angle(turned_a, turned_b) == pytest.approx(angle(a, b))
    # The smallest rotation: what is perpendicular to the ray and to the axis does not move.
    still = unit(np.cross(ray, [0.0, 0.0, 1.0]))
    assert relative_to_ray(still, xy, focal, centre) == pytest.approx(still)


def test_relative_to_ray_is_the_gradient_of_log_range_on_the_axis() -> None:
    """A plane through the optical axis: its normal relative to the ray there is the camera's own."""
    n = tilted(35.0, 110.0)
    assert relative_to_ray(n[None], np.array([[7.0, 9.0]]), 500.0, np.array([7.0, 9.0])) == pytest.approx(n[None])


def test_spread_counts_shares_strictly_under_each_threshold() -> None:
    got = measures.spread(np.array([0.0, 4.0, 5.0, 11.0, 25.0, 80.0]))
    assert got["median"] == 8.0 and got["mean"] == pytest.approx(125 / 6) and got["p90"] == pytest.approx(52.5)
    shares = [got[k] for k in ("under_5", "under_11.25", "under_22.5", "under_30")]
    assert shares == pytest.approx([2 / 6, 4 / 6, 4 / 6, 5 / 6])
    assert set(measures.spread(np.zeros(0)).values()) == {None}


def test_sign_share_agrees_with_the_two_errors(rng: np.random.Generator) -> None:
    estimate, truth = unit(rng.normal(size=(2, 500, 3)))
    estimate[:, 2], truth[:, 2] = np.abs(estimate[:, 2]), np.abs(truth[:, 2])
    smaller = np.mean(angle(estimate, truth) <= angle(estimate * measures.FLIP, truth))
    assert measures.sign_share(estimate, truth) == pytest.approx(smaller)
    assert measures.sign_share(np.array([tilted(0.0)]), np.array([tilted(30.0)])) == 1.0


def test_compare_normals_separates_signs_and_misses() -> None:
    truth = np.array([tilted(20, t) for t in (0, 90, 180, 270)])
    got = measures.compare_normals(truth * measures.FLIP, truth, misses=4)
    assert got["given"]["median"] == pytest.approx(40.0) and got["flipped"]["median"] == pytest.approx(0.0, abs=1e-6)
    assert got["best"] == "flipped" and got["signs_right"] == 0.0 and got["signs_right_flipped"] == 1.0
    assert got["flipped_all"]["under_5"] == 0.5 and got["flipped_all"]["mean"] == pytest.approx(45.0)
    assert got["flipped"]["under_5"] == 1.0


def test_heights_lose_their_offset_by_piece_and_find_the_sign(rng: np.random.Generator) -> None:
    truth = rng.uniform(0, 10, 60)
    piece = np.repeat([3, 8], 30)
    shifted = -truth + np.where(piece == 3, 100.0, -7.0)
    got = measures.compare_heights(shifted, truth, 10.0, piece, both_signs=True)
    assert got["sign"] == -1 and got["rms_over_range"] == pytest.approx(0.0, abs=1e-12)
    assert measures.compare_heights(shifted, truth, 10.0, piece, both_signs=False)["rms_over_range"] > 0.3
    one_piece = measures.compare_heights(shifted, truth, 10.0, np.zeros(60), both_signs=True)
    assert one_piece["rms_over_range"] == pytest.approx(53.5 / 10, rel=0.05)
    ramp = np.array([-1.0, 1.0])
    wrong = measures.compare_heights(2 * ramp, ramp, 2.0, np.zeros(2), both_signs=True)
    assert wrong["rms_over_range"] == pytest.approx(0.5) and wrong["rms_over_range_scaled"] == pytest.approx(0.0)


def test_irradiance_error_ignores_one_scale_and_nothing_else() -> None:
    truth = np.exp(np.linspace(0.0, 1.0, 101))
    got = measures.compare_irradiance(7.0 * truth, truth)
    assert got["error"] == pytest.approx(0.0, abs=1e-12) and got["correlation"] == pytest.approx(1.0)
    flat = measures.compare_irradiance(np.ones(101), truth)
    assert flat["error"] == pytest.approx(0.25) and flat["correlation"] is None  # |log| of a ramp about its middle
    opposite = measures.compare_irradiance(1 / truth, truth)
    assert opposite["error"] == pytest.approx(0.5) and opposite["correlation"] == pytest.approx(-1.0)
    assert measures.compare_irradiance(truth, np.ones(101))["correlation"] is None


def test_blur_of_a_constant_surface_does_not_darken_at_its_border() -> None:
    inside = np.zeros((60, 80), bool)
    inside[10:50, 20:60] = True
    rgb = np.where(inside[..., None], 0.25, 9.0) * np.ones(3)
    assert measures.blurred_brightness(rgb, inside)[inside] == pytest.approx(0.25)


def test_instances_lose_the_ambiguity_one_by_one() -> None:
    truth = np.array([tilted(30.0, t) for t in (0.0, 90.0, 200.0)])
    estimate = np.array([tilted(33.0, 0.0), tilted(30.0, 270.0), tilted(28.0, 200.0)])
    got = measures.compare_instances(estimate, np.array([3.0, 1.0, 1.0]), truth)
    assert got["error"]["median"] == pytest.approx(2.0) and got["error_given"]["median"] == pytest.approx(3.0)
    assert got["signs_right"] == got["signs_right_best"] == pytest.approx(2 / 3)
    assert got["calibration"]["median_ratio"] == pytest.approx(1.0) and got["calibration"]["beyond_3"] == 0.0
    mirrored = measures.compare_instances(estimate * measures.FLIP, np.ones(3), truth)
    assert mirrored["signs_right"] == pytest.approx(1 / 3) and mirrored["signs_right_best"] == pytest.approx(2 / 3)
    assert mirrored["error"] == got["error"]


def test_recall_counts_true_instances_within_their_own_radius() -> None:
    true_xy = np.array([[0.0, 0.0], [10.0, 0.0], [20.0, 0.0], [30.0, 0.0]])
    radius = np.array([2.0, 2.0, 5.0, 1.0])
    found = np.array([[1.0, 1.0], [1.5, 0.0], [16.0, 1.0], [30.0, 1.5]])  # two on the first, none on the second
    assert measures.recall(found, true_xy, radius) == {"recall": 0.5, "true": 4, "found": 2}
    assert measures.recall(np.zeros((0, 2)), true_xy, radius)["recall"] == 0.0
    assert measures.recall(found, np.zeros((0, 2)), np.zeros(0))["recall"] is None


def test_irradiance_at_instances_is_per_texton() -> None:
    offsets = np.array([-0.02, -0.01, 0.0, 0.01, 0.02])
    own = np.exp(np.concatenate([offsets, 5 + 3 * offsets, [1.0, 2.0]]))
    texton = np.array([4] * 5 + [9] * 5 + [11] * 2)
    got = measures.irradiance_at_instances(own, texton, np.ones(12))
    std = offsets.std(ddof=1)
    assert got["per_texton"] == pytest.approx({"4": std, "9": 3 * std})  # texton 11 is too small to tell
    assert got["textons"] == 2 and got["worst"] == pytest.approx(3 * std)


def test_calibration_of_gaussian_errors_by_decile(rng: np.random.Generator) -> None:
    sigma = rng.uniform(0.5, 5.0, 20000)
    errors = sigma * np.abs(rng.normal(size=20000))
    got = measures.calibration(errors, sigma, deciles=True)
    assert got["median_ratio"] == pytest.approx(0.6745, abs=0.02)
    assert got["beyond_3"] == pytest.approx(0.0027, abs=0.002)
    assert len(got["decile_ratio"]) == 10 and got["worst_factor"] == pytest.approx(1 / 0.6745, rel=0.1)
    assert got["decile_sigma"] == sorted(got["decile_sigma"])
    twice = measures.calibration(errors, sigma / 2)
    assert twice["median_ratio"] == pytest.approx(2 * got["median_ratio"])
    assert measures.calibration(errors, np.full(20000, np.nan))["count"] == 0


def test_best_constant_normal_of_a_leaning_cone_is_its_axis() -> None:
    axis = tilted(40.0, 70.0)
    around = np.linspace(0, 2 * np.pi, 360, endpoint=False)
    u = unit(np.cross(axis, [0.0, 0.0, 1.0]))
    v = np.cross(axis, u)
    ring = np.cos(0.2) * axis + np.sin(0.2) * (np.cos(around)[:, None] * u + np.sin(around)[:, None] * v)
    cloud = np.vstack([ring, np.tile(axis, (300, 1))])
    best = measures.best_constant_normal(cloud)
    median = np.median(angle(cloud, best))
    assert median <= np.degrees(0.2) + 1e-3 and median <= np.median(angle(cloud, axis)) + 1e-3
    assert angle(best, axis) < 12.0


def test_value_at_walks_and_forgives() -> None:
    figures = {"a": {"b": {"c": 2.0}, "none": None}}
    assert measures.value_at(figures, "a.b.c") == 2.0
    assert measures.value_at(figures, "a.none.c") is None and measures.value_at(figures, "a.x") is None


def test_a_chart_is_measured_on_the_true_surface() -> None:
    y, x = np.mgrid[:60, :80].astype(float)
    z = np.sqrt(100**2 - (x - 40) ** 2)
    normals = np.dstack([(x - 40) / 100, np.zeros_like(x), z / 100])
    inside = np.ones((60, 80), bool)
    unrolled = np.dstack([100 * np.arcsin((x - 40) / 100), y])
    for chart, degrees, area in (
        (unrolled, 0.0, 0.0),
        (unrolled * [2, 1], np.degrees(2 * np.arcsin(1 / 3)), 1.0),
        (unrolled @ np.array([[0.6, 0.8], [-0.8, 0.6]]) * 1.1, 0.0, 0.21),
    ):
        got = measures.chart_distortion(chart, normals, z, inside, np.inf, np.zeros(2))
        assert got["angle"]["median"] == pytest.approx(degrees, abs=0.1)
        assert got["area"]["p95"] == pytest.approx(area, abs=0.01)
    flat = measures.chart_distortion(np.dstack([x, y]), normals, z, inside, np.inf, np.zeros(2))
    assert flat["area"]["p95"] == pytest.approx(1 - np.sqrt(1 - 0.38**2), abs=0.01)  # cos of the slant at |x − 40| = 38
    nothing = measures.chart_distortion(unrolled, normals, z, ~inside, np.inf, np.zeros(2))
    assert nothing["angle"]["median"] is None


def test_a_chart_under_perspective_is_free_in_size_only() -> None:
    focal, centre = 200.0, np.array([40.0, 30.0])
    y, x = np.mgrid[:60, :80].astype(float)
    normal = np.array([0.5, 0.2, 1.0]) / np.sqrt(1.29)
    offset = np.dstack([x, y]) - centre
    z = -(offset @ normal[:2]) / (normal[2] - offset @ normal[:2] / focal)  # the plane through (centre, 0)
    points = np.dstack([offset * (1 - z / focal)[..., None], z])
    u = np.cross([0, 1, 0], normal) / np.linalg.norm(np.cross([0, 1, 0], normal))
    chart = np.dstack([points @ u, points @ np.cross(normal, u)]) * 3
    got = measures.chart_distortion(chart, np.tile(normal, (60, 80, 1)), z, np.ones((60, 80), bool), focal, centre)
    assert got["angle"]["p95"] < 0.2 and got["area"]["p95"] < 0.01


def test_errors_are_split_by_slant_and_into_what_a_texton_has_in_common():
    """Texton 0 sees 3° too much slant, texton 1 is right up to ±1°; all without the two-fold ambiguity."""
    slant = np.radians([10.0, 20, 33, 40] * 2)
    extra = np.radians([3.0, 3, 3, 3, 1, -1, 1, -1])
    texton = np.repeat([0, 1], 4)

    def normals(s):
        return np.stack([np.sin(s), np.zeros(8), np.cos(s)], 1)

    got = measures.split_errors(normals(slant + extra) * measures.FLIP, normals(slant), texton)
    assert [b["count"] for b in got["by_slant"]] == [2, 2, 4, 0, 0]
    assert got["by_slant"][0]["median"] == pytest.approx(2.0) and got["by_slant"][3]["median"] is None
    assert got["slant_bias"]["textons"] == pytest.approx(1.5)
    assert got["slant_bias"]["within"] == pytest.approx(0.5 / 0.6745, rel=1e-3)
