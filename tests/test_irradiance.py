import numpy as np
import pytest

from sftex_stages import irradiance
from sftex_stages.errors import StageError

SHAPE = (240, 320)


def surface_of(n=600, noise=0.0, seed=0):
    """What the surface stage hands on, under a known light; texton 2 of four has no instance."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform(0, [SHAPE[1] - 1, SHAPE[0] - 1], (n, 2))
    texton = rng.choice([0, 1, 3], n).astype(np.int32)
    scale = np.array([1.0, 2.5, np.nan, 0.4])
    light = field(xy[:, 0], xy[:, 1]) / scale[texton] * np.exp(noise * rng.normal(size=n))
    valid = np.zeros(SHAPE, bool)
    valid[10:-10, 10:-10] = True
    arrays = {
        "piece": valid.astype(np.int32),
        "instance/xy": xy.astype(np.float32),
        "instance/irradiance": light.astype(np.float32),
        "instance/irradiance_sigma": np.full(n, 0.003, np.float32),
        "instance/texton": texton,
        "instance/inlier": np.full(n, 0.95, np.float32),
        "instance/state": np.tile(np.array([1, 0, 0], np.float32), (n, 1)),
    }
    return arrays, scale


def run(surface, image=None, **params):
    """The stage, on a picture without any plain print unless one is given."""
    if image is None:
        image = np.random.default_rng(9).uniform(0.05, 1, (*SHAPE, 3)).astype(np.float32)
    return irradiance.run({"surface": surface, "image": {"rgb": image}}, irradiance.Params(**params))


def field(x, y):
    return np.exp(0.4 * np.sin(x / 60) - 0.5 * np.cos(y / 80))


def log_error(out):
    y, x = np.nonzero(np.isfinite(out["map"]))
    ratio = np.log(out["map"][y, x] / field(x, y))
    return np.abs(ratio - np.median(ratio))


def test_exact_data_give_map_and_scales():
    surface, scale = surface_of()
    out = run(surface)
    assert np.quantile(log_error(out), 0.99) < 0.01
    found = out["class_scale"] / out["class_scale"][0]
    assert np.isnan(found[2]) and np.allclose(found[[0, 1, 3]], scale[[0, 1, 3]], rtol=0.005)
    assert np.array_equal(np.isfinite(out["map"]), (surface["piece"] > 0))
    assert abs(np.log(out["map"][(surface["piece"] > 0)]).mean()) < 1e-5


def test_instances_are_put_on_the_maps_scale():
    surface, _ = surface_of()
    out = run(surface)
    at = np.rint(surface["instance/xy"]).astype(int)
    inside = (surface["piece"] > 0)[at[:, 1], at[:, 0]]
    ratio = out["instance/irradiance"][inside] / out["map"][at[inside, 1], at[inside, 0]]
    assert np.abs(np.log(ratio)).max() < 0.05


def test_noise_is_smoothed_and_outliers_of_either_kind_ignored():
    surface, _ = surface_of(noise=0.02, seed=1)
    surface["instance/irradiance"][::20] *= 3
    surface["instance/irradiance"][5::40] = 0  # no positive estimate: left out
    surface["instance/inlier"][::20] = 0
    out = run(surface)
    assert np.median(log_error(out)) < 0.01


def test_too_few_instances():
    surface, _ = surface_of(10)
    surface["instance/inlier"][2:] = 0.1
    with pytest.raises(StageError, match="only 2 instances"):
        run(surface)


def test_pieces_share_scales_and_no_light():
    surface, scale = surface_of(900, noise=0.01, seed=2)
    right = surface["instance/xy"][:, 0] >= 160
    surface["instance/irradiance"][right] *= 3  # another light begins behind the gap
    surface["piece"][:, 155:166] = 0
    surface["piece"][:, 166:] *= 2
    out = run(surface)
    step = np.where(np.arange(SHAPE[1]) < 160, 1.0, 3.0)
    rows, columns = np.nonzero(surface["piece"])
    log = np.log(out["map"][rows, columns] / (field(columns, rows) * step[columns]))
    near = np.abs(columns - 160) < 12  # where one field for both would be smeared
    assert np.abs(log - np.median(log))[near].max() < 0.05
    found = out["class_scale"] / out["class_scale"][0]
    assert np.allclose(found[[1, 3]], scale[[1, 3]], rtol=0.02)


def test_sigma_tells_where_the_light_is_known():
    surface, _ = surface_of(900, noise=0.03, seed=3)
    alone = surface["instance/xy"][:, 0] > 220
    surface["instance/inlier"][alone & (np.arange(900) % 8 > 0)] = 0  # an eighth of them is believed there
    out = run(surface)
    assert np.array_equal(np.isfinite(out["sigma"]), surface["piece"] > 0)
    left, right = out["sigma"][20:-20, 20:180], out["sigma"][20:-20, 240:-20]
    assert np.median(right) > 1.3 * np.median(left)
    y, x = np.nonzero(surface["piece"])
    ratio = np.log(out["map"][y, x] / field(x, y))
    ratio = np.abs(ratio - np.median(ratio)) / out["sigma"][y, x]
    assert 0.3 < np.median(ratio) < 1.5 and (ratio > 4).mean() < 0.05


def test_plain_print_adds_what_lies_between_instances_unless_they_disagree():
    surface, _ = surface_of(250, noise=0.005, seed=4)
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    fold = np.exp(-0.5 * np.exp(-(((x - 160) / 9) ** 2)))  # narrower than the instances are apart
    at = np.rint(surface["instance/xy"]).astype(int)
    surface["instance/irradiance"] *= fold[at[:, 1], at[:, 0]].astype(np.float32)
    cloth = (field(x, y) * fold)[..., None] * np.array([0.1, 0.15, 0.3])
    dots = (x % 40 - 20) ** 2 + (y % 40 - 20) ** 2 < 60
    cloth[dots] *= [3, 1, 0.5]

    def error(out):
        log = np.log(out["map"] / (field(x, y) * fold))[surface["piece"] > 0]
        return np.abs(log - np.median(log))

    alone, both = run(surface, plain=False), run(surface, cloth.astype(np.float32))
    assert error(both).mean() < 0.3 * error(alone).mean() and both["plain_share"][1] > 0.8
    # A ground whose albedo varies by itself: instances, which see the light alone, do not confirm it.
    stained = cloth * np.exp(0.3 * np.sin(x / 11) * np.cos(y / 13))[..., None]
    wrong = run(surface, stained.astype(np.float32))
    assert error(wrong).mean() < 1.5 * error(alone).mean() and wrong["plain_share"].max() < 0.6


def test_coloured_light_has_a_map_of_each_channel():
    """Warm on the left, cold on the right; every texton has a colour of its own, which is not light."""
    surface, _ = surface_of(900, noise=0.005, seed=6)

    def tint(x):
        return np.stack([1.3 - 0.6 * x / SHAPE[1], np.ones_like(x), 0.7 + 0.6 * x / SHAPE[1]], -1)

    print_ = np.array([[1.0, 0.5, 0.2], [0.3, 0.9, 0.6], [1, 1, 1], [0.2, 0.4, 1.0]])
    colour = tint(surface["instance/xy"][:, 0]) * print_[surface["instance/texton"]]
    surface["instance/irradiance_rgb"] = (surface["instance/irradiance"][:, None] * colour).astype(np.float32)
    assert "rgb" not in run(surface)
    out = run(surface, channels="rgb")
    y, x = np.nonzero(np.isfinite(out["map"]))
    ratio = np.log(out["rgb"][y, x] / (field(x, y)[:, None] * tint(x.astype(float))))
    assert (np.quantile(np.abs(ratio - np.median(ratio, axis=0)), 0.95, axis=0) < 0.02).all()
