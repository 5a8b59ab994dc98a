"""One texton from the small synthetic surface: transforms, normals, light and appearance against the truth."""

import numpy as np
import pytest
from scipy.ndimage import map_coordinates
from synthetic import PAPER, Scene, detect_of, glyph, image_of, plane, render

from sftex_stages import frontal
from sftex_stages.geometry.imaging import lemma1_residual, normal_angle, rotation, tensor_of_normal

SINGLES = {
    "usable": "bool",
    "reason": "str",
    "spacing": "float32",
    "metric_residual": "float32",
    "information": "float32",
    "strain_error": "float32",
    "circular": "bool",
    "blur": "float32",
}
MEMBERS = {
    "index": ("int32", ()),
    "xy": ("float32", (2,)),
    "transform": ("float32", (2, 2)),
    "scale": ("float32", ()),
    "tensor": ("float32", (3,)),
    "tensor_cov": ("float32", (3, 3)),
    "log_scale_sigma": ("float32", ()),
    "normal": ("float32", (3,)),
    "normal_sigma": ("float32", ()),
    "inlier": ("float32", ()),
    "irradiance": ("float32", ()),
    "irradiance_rgb": ("float32", (3,)),
    "irradiance_sigma": ("float32", ()),
}


def run(scene, detect=None, label=None, part=0, seed=1, **params):
    detect = detect_of(scene, np.random.default_rng(seed)) if detect is None else detect
    n = len(detect["xy"])
    label = np.zeros(n, np.int32) if label is None else label
    inputs = {
        "image": image_of(scene),
        "detect": detect,
        "cluster": {"label": label, "count": np.array(1)},
        "part": part,
    }
    return frontal.run(inputs, frontal.Params(**params))


def normal_error(got, truth):
    return np.minimum(normal_angle(got, truth), normal_angle(got * [-1, -1, 1], truth))


@pytest.fixture(scope="module")
def scene() -> Scene:
    return render(radius=17, pitch=40, size=360)


@pytest.fixture(scope="module")
def texton(scene):
    return run(scene)


def check_contract(got):
    m, n = len(got["index"]), len(got["domain"])
    for name, kind in SINGLES.items():
        assert got[name].shape == () and (got[name].dtype.kind == "U" if kind == "str" else got[name].dtype == kind), (
            name
        )
    for name, (dtype, shape) in MEMBERS.items():
        assert got[name].dtype == dtype and got[name].shape == (m, *shape), name
    steps = len(got["progress_iterations"])
    for name, shape in (("appearance", (n, n, 3)), ("domain", (n, n)), ("progress", (steps, n, n, 3))):
        assert got[name].dtype == np.float32 and got[name].shape == shape, name
    assert got["progress_iterations"].dtype == np.int32
    known = {*SINGLES, *MEMBERS, "appearance", "domain", "progress", "progress_iterations"}
    assert known <= set(got)
    assert bool(got["usable"]) == (str(got["reason"]) == "")


def test_arrays_are_those_of_the_contract(texton, scene):
    check_contract(texton)
    assert texton["usable"] and not texton["circular"]
    assert texton["progress_iterations"].tolist() == [1, 5, 10, 20]
    assert texton["index"].tolist() == list(range(len(scene.xy)))
    assert all(np.isfinite(texton[name]).all() for name in MEMBERS)
    assert texton["domain"].min() >= 0 and 0.2 < texton["domain"].max() <= 1


def test_nearly_all_instances_are_accepted(texton):
    assert (texton["inlier"] > 0.8).mean() > 0.9
    assert texton["inlier"].min() >= 0 and texton["inlier"].max() <= 1


def test_normals_are_right_to_a_degree(texton, scene):
    good = texton["inlier"] > 0.8
    error = normal_error(texton["normal"], scene.normal)[good]
    assert np.median(error) < 1.0
    assert np.percentile(error, 90) < 2.0
    # against what a constant normal says
    assert np.median(error) < 0.05 * np.median(normal_error(np.tile([0.0, 0, 1], (good.sum(), 1)), scene.normal[good]))


def test_tensors_scales_and_transforms_say_the_same(texton, scene):
    good = texton["inlier"] > 0.8
    t, scale = texton["transform"].astype(float), texton["scale"].astype(float)
    assert np.linalg.svd(t, compute_uv=False)[:, 0] == pytest.approx(scale, rel=1e-4)
    assert np.abs(lemma1_residual(t / scale[:, None, None])).max() < 1e-3
    gram = t @ np.swapaxes(t, 1, 2) / scale[:, None, None] ** 2
    held = np.stack([gram[:, 0, 0], gram[:, 0, 1], gram[:, 1, 1]], -1)
    shallow = texton["normal"][:, 2] > 0.2
    assert np.abs(held - tensor_of_normal(texton["normal"]))[shallow].max() < 5e-3
    assert np.abs(texton["tensor"] - tensor_of_normal(scene.normal))[good].max() < 0.12
    # orthographic: every scale is the same
    assert np.log(scale[good]).std() < 0.02


def test_covariances_are_covariances_of_the_right_size(texton, scene):
    good = texton["inlier"] > 0.8
    cov = texton["tensor_cov"].astype(float)
    assert np.abs(cov - np.swapaxes(cov, 1, 2)).max() < 1e-7
    assert np.linalg.eigvalsh(cov)[good].min() > 0
    # white noise is not all of the error (every pixel is a box, whatever the slant): within a factor of four
    error = normal_error(texton["normal"], scene.normal)[good]
    ratio = np.median(error / texton["normal_sigma"][good])
    assert 0.1 < ratio < 4


def test_light_is_right_to_a_percent_up_to_one_factor(texton, scene):
    good = texton["inlier"] > 0.8
    log_ratio = np.log(texton["irradiance"] / scene.light)[good]
    assert log_ratio.std() < 0.01
    assert np.ptp(np.log(scene.light[good])) > 0.8
    assert (texton["irradiance_sigma"] > 0).all()


def test_centres_keep_one_place_in_the_element(texton, scene):
    """The centre is the detail's, the same in the element's frame for all: T⁻¹ (x − x_true) is constant."""
    good = texton["inlier"] > 0.8
    place = np.linalg.solve(scene.transform, (texton["xy"] - scene.xy)[..., None])[..., 0][good]
    assert np.abs(np.median(place, axis=0)).max() < 0.5
    spread = np.linalg.norm(place - np.median(place, axis=0), axis=1) * 17
    assert np.median(spread) < 0.2  # px of the frontal element


def test_transforms_differ_from_the_truth_by_one_rotation(texton, scene):
    good = texton["inlier"] > 0.8
    relative = np.linalg.solve(scene.transform, texton["transform"].astype(float))[good]
    common = np.median(relative, axis=0)
    u, sigma, vt = np.linalg.svd(common)
    assert sigma[0] / sigma[1] < 1.03
    assert np.median(np.linalg.norm(relative - common, axis=(1, 2)) / sigma[0]) < 0.04
    assert np.linalg.det(u @ vt) > 0


def test_appearance_is_the_element(texton, scene):
    """Every frontal point looks up its place in the true element through one instance's two transforms."""
    good = np.flatnonzero(texton["inlier"] > 0.8)
    relative = np.linalg.solve(scene.transform, texton["transform"].astype(float))[good]
    common = np.median(relative, axis=0)
    n = len(texton["domain"])
    axis = (np.arange(n) - n // 2) * float(texton["spacing"])
    points = np.stack(np.meshgrid(axis, axis), -1).reshape(-1, 2)
    got, weight = texton["appearance"].reshape(-1, 3), texton["domain"].ravel()

    def correlation(turn, shift):
        # the grid is relative to the registered place, which lies `shift` from the element's own centre
        truth = glyph(points / float(np.median(texton["scale"])) @ (scale * turn).T + shift)
        a, b = (v - np.average(v, axis=0, weights=weight) for v in (got, truth))
        return (weight[:, None] * a * b).sum() / np.sqrt(
            (weight[:, None] * a**2).sum() * (weight[:, None] * b**2).sum()
        )

    scale = np.sqrt(np.linalg.det(common)) * float(np.median(texton["scale"]))
    turn = common / np.sqrt(np.linalg.det(common))
    shifts = [np.array([x, y]) for x in np.linspace(-0.5, 0.5, 21) for y in np.linspace(-0.5, 0.5, 21)]
    best = max(correlation(turn, shift) for shift in shifts)
    assert best > 0.93
    assert max(correlation(turn @ rotation(1.2), shift) for shift in shifts) < 0.8
    # linear relative albedo: ink against paper, up to the common factor
    assert got[weight > 0.3].min() / np.percentile(got[weight > 0.3], 95) == pytest.approx(0.15 / PAPER, abs=0.2)


def test_progress_comes_to_the_appearance(texton):
    w, final = texton["domain"][..., None], texton["progress"][-1]
    distance = [(w * (p - final) ** 2).sum() for p in texton["progress"]]
    assert min(distance[:2]) > 5 * distance[2] > distance[3] == 0
    a, b = (v - (w * v).sum((0, 1)) / w.sum() for v in (final, texton["appearance"]))
    assert (w * a * b).sum() / np.sqrt((w * a * a).sum() * (w * b * b).sum()) > 0.999


def test_same_input_same_bytes(scene, texton):
    again = run(scene)
    assert set(again) == set(texton)
    assert all(again[name].tobytes() == texton[name].tobytes() for name in texton)


def test_subset_founds_the_texton_and_all_are_registered_to_it(scene):
    few = run(scene, subset=25)
    good = few["inlier"] > 0.8
    assert good.mean() > 0.85 and len(good) == len(scene.xy)
    assert np.median(normal_error(few["normal"], scene.normal)[good]) < 1.5


def test_members_that_are_something_else_are_no_inliers(scene):
    rng = np.random.default_rng(1)
    detect = detect_of(scene, rng)
    n = len(scene.xy)
    wrong = np.arange(n) % 4 == 0
    detect["xy"][wrong] += 20  # between the elements
    got = run(scene, detect)
    assert (got["inlier"][~wrong] > 0.8).mean() > 0.85
    on_place = np.linalg.norm(got["xy"][:, None] - scene.xy, axis=2).min(1) < 9
    assert (got["inlier"][wrong & ~on_place] < 0.2).all()
    good = (got["inlier"] > 0.8) & ~wrong
    assert np.median(normal_error(got["normal"], scene.normal)[good]) < 1.5


def test_one_instance_detected_twice_counts_once(scene, texton):
    detect = detect_of(scene, np.random.default_rng(1))
    again = detect_of(scene, np.random.default_rng(2))
    double = {name: np.concatenate([detect[name], again[name][:20]]) for name in detect}
    got = run(scene, double)
    n = len(scene.xy)
    pairs = np.stack([got["inlier"][:20], got["inlier"][n:]], 1) > 0.8
    assert (pairs.sum(1) <= 1).all()
    assert (pairs.sum(1) == 1).mean() > 0.9


def test_only_the_members_of_its_cluster_are_used(scene):
    label = np.where(np.arange(len(scene.xy)) % 2 == 0, 3, -1).astype(np.int32)
    got = run(scene, label=label, part=3)
    assert got["index"].tolist() == np.flatnonzero(label == 3).tolist()
    assert got["usable"]


def test_instances_that_clustering_cut_off_are_adopted(scene):
    """Every other instance lies in another cluster, with a descriptor like the own; a few points of that cluster do not."""
    rng = np.random.default_rng(1)
    detect = detect_of(scene, rng)
    n = len(scene.xy)
    own = np.arange(n) % 2 == 0
    foreign = np.arange(n) % 10 == 1
    detect["descriptor"] = (0.05 * rng.normal(size=(n, 128)) + foreign[:, None]).astype(np.float32)
    label = np.where(own, 0, 1).astype(np.int32)
    alone = run(scene, detect, label, adopt=0.0)
    assert alone["index"].tolist() == np.flatnonzero(own).tolist()
    got = run(scene, detect, label)
    assert got["index"][: own.sum()].tolist() == alone["index"].tolist()
    assert len(np.unique(got["index"])) == len(got["index"])
    more = got["index"][own.sum() :]
    assert len(more) > 0.6 * (~own & ~foreign).sum() and not foreign[more].any()
    good = got["inlier"] > 0.8
    assert good[own.sum() :].mean() > 0.7
    assert np.median(normal_error(got["normal"], scene.normal[got["index"]])[good]) < 1.2


def test_light_of_each_channel_is_right_up_to_one_factor(scene):
    """Light that turns from red to blue across the image."""
    size = scene.rgb.shape[1]
    tint = np.stack([np.linspace(1.3, 0.7, size), np.ones(size), np.linspace(0.6, 1.2, size)], -1)
    got = run(scene._replace(rgb=(scene.rgb * tint).astype(np.float32)))
    good = got["inlier"] > 0.8
    colour = np.stack([np.interp(scene.xy[:, 0], np.arange(size), tint[:, c]) for c in range(3)], -1)
    log_ratio = np.log(got["irradiance_rgb"] / (scene.light[:, None] * colour))[good]
    assert (log_ratio.std(0) < 0.02).all()


@pytest.mark.parametrize("members", [0, 1, 2, 3])
def test_fewer_than_four_members_are_unusable(scene, members):
    label = np.full(len(scene.xy), -1, np.int32)
    label[:members] = 0
    got = run(scene, label=label)
    check_contract(got)
    assert not got["usable"] and f"only {members} instances" in str(got["reason"])
    assert len(got["xy"]) == 0


def reason_of(got):
    check_contract(got)
    assert not got["usable"], "usable"
    return str(got["reason"])


def test_a_plain_cluster_is_unusable_with_a_reason():
    scene = render(element=lambda s: np.full((*s.shape[:-1], 3), PAPER), size=220, light=lambda xy: np.ones(len(xy)))
    assert reason_of(run(scene)) != ""


def test_an_edge_is_unusable_with_a_reason():
    """Along an edge nothing holds the transform: its slant there is no measurement."""

    def edge(s):
        dark = 1 / (1 + np.exp(np.clip(s[..., :1] / 0.06, -40, 40)))
        return PAPER * (1 - 0.7 * dark) * np.ones(3)

    scene = render(element=edge, radius=17, pitch=60, size=360)
    assert "as an edge is" in reason_of(run(scene, max_growth=1.0))


def test_noise_is_unusable_with_a_reason():
    rng = np.random.default_rng(4)
    scene = render(size=220)._replace(rgb=rng.uniform(0, 1, (220, 220, 3)).astype(np.float32))
    assert reason_of(run(scene)) != ""


@pytest.mark.parametrize("radius", [13, 17])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_an_aligned_print_on_a_tilted_plane_is_unusable(seed, radius):
    """All instances are alike: any stretch along the tilt explains them (section 2.2.2)."""
    scene = render(normals=plane, aligned=True, seed=seed, radius=radius, pitch=2.4 * radius, size=300)
    assert reason_of(run(scene)) != ""


def test_an_aligned_print_on_a_sphere_is_unusable_for_keeping_one_direction():
    scene = render(aligned=True, radius=17, pitch=40, size=300)
    assert "one direction" in reason_of(run(scene))


def test_a_tilted_plane_with_elements_at_random_is_usable():
    scene = render(normals=plane, radius=17, pitch=40, size=300)
    got = run(scene)
    good = got["inlier"] > 0.8
    assert got["usable"] and good.mean() > 0.85
    assert np.median(normal_error(got["normal"], scene.normal)[good]) < 1.5


def test_perspective_shows_as_a_trend_of_scale(scene):
    """The same picture stretched by distance: elements to the right are larger by a fifth."""
    size = 360
    y, x = np.mgrid[:size, :size].astype(float)

    def back(u):  # picture → scene, along x: local magnification exp(0.2 u / size)
        return (1 - np.exp(-0.2 * u / size)) / (1 - np.exp(-0.2)) * size

    def there(v):
        return -np.log(1 - v / size * (1 - np.exp(-0.2))) * size / 0.2

    rgb = np.stack([map_coordinates(scene.rgb[..., c], [y, back(x)], order=3, mode="nearest") for c in range(3)], -1)
    stretch = 1 / np.gradient(back(np.arange(size * 1.0)))
    xy = np.stack([there(scene.xy[:, 0]), scene.xy[:, 1]], -1)
    along = np.interp(xy[:, 0], np.arange(size), stretch)
    moved = np.stack([np.stack([along, 0 * along], -1), np.stack([0 * along, 0 * along + 1], -1)], -2)
    got = run(scene._replace(rgb=rgb.astype(np.float32), xy=xy, transform=moved @ scene.transform))
    good = got["inlier"] > 0.8
    assert got["usable"]
    # larger singular value of the true transforms in units of the element: what the scale and the tensor have to give
    truth = moved @ scene.transform
    gram, found = (t @ np.swapaxes(t, 1, 2) for t in (truth, got["transform"].astype(float)))
    ratio = np.sqrt(np.linalg.det(found) / np.linalg.det(gram))[good]
    assert np.std(np.log(ratio)) < 0.06
