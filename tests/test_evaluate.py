"""`evaluate` on files written here to the documented schemas: spheres and planes whose every figure is known."""

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from sftex_stages.errors import InputError
from sftex_stages.evaluate import evaluate, format_text
from sftex_stages.measures import FLIP, angle, unit

H, W = 60, 80
Y, X = np.mgrid[:H, :W].astype(float)


def sphere() -> dict[str, Any]:
    """A ball of radius 40 px about the picture's middle, valid to a slant of 48°, lit from the right."""
    radius, dx, dy = 40.0, X - 39.5, Y - 29.5
    valid = dx**2 + dy**2 < 30**2
    z = np.sqrt(np.where(valid, radius**2 - dx**2 - dy**2, 1.0))
    normals = unit(np.stack([dx, dy, z], axis=-1))
    light = np.where(valid, 0.4 + 0.5 * normals[..., 0] ** 2 + 0.3 * normals[..., 2], 0.0)
    return {"valid": valid, "height": np.where(valid, z, np.nan), "normals": normals, "light": light}


def elements() -> dict[str, np.ndarray]:
    """Twelve elements on a grid, the last one spurious."""
    xy = np.array([[x, y] for y in (20.0, 30.0, 40.0) for x in (25.0, 35.0, 45.0, 55.0)])
    texton = np.array([0, 1] * 6, np.int32)
    texton[-1] = -1
    return {"xy": xy, "texton": texton, "radius_px": np.full(12, 3.0)}


def at(field: np.ndarray, xy: np.ndarray) -> np.ndarray:
    return field[xy[:, 1].round().astype(int), xy[:, 0].round().astype(int)]


def write_truth(path: Path, scene: dict[str, Any], attrs: dict[str, Any] | None = None) -> Path:
    with h5py.File(path, "w") as f:
        f.attrs.update(attrs or {"camera": "orthographic"})
        for name in ("valid", "height", "normals"):
            f[f"surface/{name}"] = scene[name] if name == "valid" else scene[name].astype(np.float32)
        f["irradiance/map"] = scene["light"].astype(np.float32)
        for name, values in elements().items():
            f[f"instances/{name}"] = values
        f["instances/normal"] = at(scene["normals"], elements()["xy"]).astype(np.float32)
    return path


def write_result(path: Path, scene: dict[str, Any], **change: np.ndarray) -> Path:
    """A result that equals the scene; `change` replaces datasets by name ('/' written as '__')."""
    xy = elements()["xy"]
    data = {
        "surface/height": scene["height"] + 17.0,
        "surface/normals": np.where(scene["valid"][..., None], scene["normals"], np.nan),
        "surface/valid": scene["valid"],
        "surface/normal_sigma": np.full((H, W), 1.0),
        "irradiance/map": np.where(scene["valid"], 3.0 * scene["light"], np.nan),
        "instances/xy": xy,
        "instances/normal": at(scene["normals"], xy),
        "instances/inlier": np.ones(len(xy)),
        "instances/irradiance": np.where(elements()["texton"] == 0, 2.0, 5.0) * at(scene["light"], xy),
        "instances/texton": elements()["texton"] + 1,
        "instances/normal_sigma": np.full(len(xy), 2.0),
    }
    data |= {name.replace("__", "/"): values for name, values in change.items()}
    with h5py.File(path, "w") as f:
        f.attrs["camera"] = "orthographic"
        for name, values in data.items():
            f[name] = values.astype(np.float32) if values.dtype == float else values
    return path


@pytest.fixture
def truth(tmp_path: Path) -> Path:
    return write_truth(tmp_path / "ball.truth.h5", sphere())


def test_a_perfect_result_has_no_error(tmp_path: Path, truth: Path) -> None:
    got = evaluate(write_result(tmp_path / "r.h5", sphere()), truth)
    assert got["coverage"] == 1.0
    assert got["normals"]["given"]["p90"] == pytest.approx(0.0, abs=1e-4)
    assert got["normals"]["signs_right"] == 1.0 and got["normals"]["best"] == "given"
    assert got["normals"]["flipped"]["median"] > 40
    assert got["height"]["rms_over_range"] == pytest.approx(0.0, abs=1e-6) and got["height"]["sign"] == 1
    assert got["irradiance"]["error"] == pytest.approx(0.0, abs=1e-6)
    assert got["irradiance"]["correlation"] == pytest.approx(1.0)
    assert got["irradiance"]["constant"]["error"] > 0.03 and got["irradiance"]["blurred"] is None
    instances = got["instances"]
    assert instances["accepted"] == 12 and instances["error"]["p90"] == pytest.approx(0.0, abs=1e-4)
    assert instances["recall"] == {"recall": 1.0, "true": 11, "found": 11}  # the spurious one is not asked for
    assert instances["irradiance"]["worst"] == pytest.approx(0.0, abs=1e-6)  # each texton has its own scale
    assert got["frame"]["compared"] == "camera"


def test_baselines_are_those_of_the_truth(tmp_path: Path, truth: Path) -> None:
    scene = sphere()
    slant = angle(scene["normals"][scene["valid"]], np.array([0.0, 0.0, 1.0]))
    base = evaluate(write_result(tmp_path / "r.h5", scene), truth)["baselines"]
    assert base["frontal"]["median"] == pytest.approx(np.median(slant), abs=1e-4)
    assert base["constant"]["median"] == pytest.approx(np.median(slant), abs=0.2)  # a ball has no better normal


def test_a_known_rotation_is_the_error(tmp_path: Path, truth: Path) -> None:
    """Normals turned by 7° about the line of sight: the angle at slant s is 2 asin(sin s sin 3.5°)."""
    scene, turn = sphere(), np.radians(7.0)
    rotation = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
    turned = scene["normals"] @ rotation.T
    xy = elements()["xy"]
    result = write_result(
        tmp_path / "r.h5", scene, surface__normals=turned, instances__normal=at(turned, xy)
    )
    got = evaluate(result, truth)
    sine = np.sqrt(1 - scene["normals"][..., 2] ** 2)
    expected = np.degrees(2 * np.arcsin(sine * np.sin(turn / 2)))
    assert got["normals"]["given"]["median"] == pytest.approx(np.median(expected[scene["valid"]]), abs=1e-3)
    assert got["instances"]["error"]["median"] == pytest.approx(np.median(at(expected, xy)), abs=1e-3)
    assert got["normals"]["calibration"]["median_ratio"] == pytest.approx(got["normals"]["given"]["median"])
    assert got["instances"]["calibration"]["median_ratio"] == pytest.approx(got["instances"]["error"]["median"] / 2)


def test_a_flipped_result_shows_in_the_flipped_columns(tmp_path: Path, truth: Path) -> None:
    scene = sphere()
    result = write_result(
        tmp_path / "r.h5", scene, surface__normals=scene["normals"] * FLIP, surface__height=-scene["height"],
        instances__normal=at(scene["normals"], elements()["xy"]) * FLIP,
    )  # fmt: skip
    got = evaluate(result, truth)
    assert got["normals"]["flipped"]["p90"] == pytest.approx(0.0, abs=1e-4) and got["normals"]["given"]["median"] > 40
    assert got["normals"]["best"] == "flipped" and got["normals"]["signs_right"] == 0.0
    assert got["height"]["sign"] == -1 and got["height"]["rms_over_range"] == pytest.approx(0.0, abs=1e-6)
    assert got["instances"]["error"]["p90"] == pytest.approx(0.0, abs=1e-4)
    assert got["instances"]["error_given"]["median"] > 20
    assert got["instances"]["signs_right"] == 0.0 and got["instances"]["signs_right_best"] == 1.0


def test_gaps_are_misses(tmp_path: Path, truth: Path) -> None:
    scene = sphere()
    left = scene["valid"] & (X < 39.5)
    got = evaluate(write_result(tmp_path / "r.h5", scene, surface__valid=left), truth)
    assert got["coverage"] == pytest.approx(0.5)
    assert got["normals"]["given"]["under_5"] == 1.0 and got["normals"]["given_all"]["under_5"] == pytest.approx(0.5)


def test_recall_asks_for_accepted_instances_within_the_radius(tmp_path: Path, truth: Path) -> None:
    xy = elements()["xy"].copy()
    inlier = np.ones(12)
    inlier[0] = 0.8  # not above the threshold
    xy[1] += [2.9, 0.0]  # still within 3 px
    xy[2] += [3.1, 0.0]  # just outside
    result = write_result(tmp_path / "r.h5", sphere(), instances__xy=xy, instances__inlier=inlier)
    instances = evaluate(result, truth)["instances"]
    assert instances["accepted"] == 11 and instances["recall"] == {"recall": 9 / 11, "true": 11, "found": 9}


def test_instances_off_the_surface_are_counted_and_have_no_error(tmp_path: Path, truth: Path) -> None:
    xy = elements()["xy"].copy()
    xy[11] = [2.0, 2.0]
    instances = evaluate(write_result(tmp_path / "r.h5", sphere(), instances__xy=xy), truth)["instances"]
    assert instances["off_surface"] == 1 and instances["compared"] == 11 and instances["accepted"] == 12


def test_perspective_truth_is_compared_relative_to_the_ray(tmp_path: Path) -> None:
    """A ball seen from near: the relative normals are the image gradient of -f log range, by finite differences."""
    focal, centre = 300.0, np.array([39.5, 29.5])
    direction = np.stack([(X - centre[0]) / focal, (Y - centre[1]) / focal, -np.ones_like(X)], axis=-1)
    ball, radius = np.array([0.0, 0.0, -20.0 - focal]), 60.0  # the camera is the origin, z toward the camera
    a, b = np.sum(direction**2, axis=-1), direction @ ball
    reach = (b - np.sqrt(b**2 - a * (ball @ ball - radius**2))) / a  # nearer intersection
    point = reach[..., None] * direction
    valid = np.ones((H, W), bool)
    scene = {"valid": valid, "height": point[..., 2] + focal, "normals": unit(point - ball), "light": np.ones((H, W))}
    camera = {"camera": "perspective", "focal_px": focal, "principal_point": centre}
    truth = write_truth(tmp_path / "t.h5", scene, camera)

    height = -focal * np.log(np.linalg.norm(point, axis=-1))
    q, p = np.gradient(height)
    relative = unit(np.stack([-p, -q, np.ones_like(p)], axis=-1))
    result = write_result(
        tmp_path / "r.h5", scene, surface__height=height, surface__normals=relative,
        instances__normal=at(relative, elements()["xy"]),
    )  # fmt: skip
    got = evaluate(result, truth)
    assert got["frame"] == {"truth": "perspective", "result": "orthographic", "compared": "viewing ray"}
    assert got["normals"]["given"]["median"] < 0.3 and got["instances"]["error_given"]["median"] < 0.3
    assert got["height"]["rms_over_range"] == pytest.approx(0.0, abs=1e-5) and got["height"]["sign"] == 1
    assert angle(scene["normals"], relative)[valid].mean() > 3  # as they stand, the normals differ

    same = write_result(tmp_path / "same.h5", scene)
    with h5py.File(same, "a") as f:
        f.attrs.update(camera)
    got = evaluate(same, truth)
    assert got["frame"]["compared"] == "camera" and got["normals"]["given"]["p90"] == pytest.approx(0.0, abs=1e-4)


def test_blurred_baseline_comes_from_the_photograph(tmp_path: Path, truth: Path) -> None:
    photograph = np.dstack([sphere()["light"]] * 3)
    light = evaluate(write_result(tmp_path / "r.h5", sphere(), image__rgb=photograph), truth)["irradiance"]
    assert light["blurred"]["error"] < 0.5 * light["constant"]["error"]  # a white ball's picture is its light


def test_text_is_aligned_and_shows_the_figures(tmp_path: Path, truth: Path) -> None:
    x, y = np.meshgrid(np.arange(W), np.arange(H))
    more = {"chart__uv": np.dstack([x, y]).astype(float), "irradiance__sigma": np.full((H, W), 0.02)}
    text = format_text(evaluate(write_result(tmp_path / "r.h5", sphere(), **more), truth))
    assert "chart                angles change by" in text
    table = [line for line in text.splitlines() if "°" in line and ("surface," in line or "instances," in line)]
    assert len(table) == 6 and len({len(line) for line in table}) == 1
    assert "recall             100.0 % (11 of 11" in text and "None" not in text and "nan" not in text


def test_an_empty_result_has_figures_too(tmp_path: Path, truth: Path) -> None:
    """No instance and no supported pixel: coverage 0, no error figure, and text that can be printed."""
    none = np.zeros((0,))
    empty = {f"instances__{n}": none for n in ("inlier", "irradiance", "texton", "normal_sigma")}
    result = write_result(
        tmp_path / "r.h5", sphere(), surface__valid=np.zeros((H, W), bool), instances__xy=np.zeros((0, 2)),
        instances__normal=np.zeros((0, 3)), **empty,
    )  # fmt: skip
    got = evaluate(result, truth)
    assert got["coverage"] == 0.0 and got["normals"]["given"]["median"] is None
    assert got["normals"]["given_all"]["under_30"] == 0.0 and got["instances"]["recall"]["recall"] == 0.0
    assert "–" in format_text(got)


@pytest.mark.parametrize("damage", ["missing", "text", "size", "dataset", "camera"])
def test_files_that_cannot_be_used_are_named(tmp_path: Path, truth: Path, damage: str) -> None:
    result = write_result(tmp_path / "r.h5", sphere())
    if damage == "missing":
        truth.unlink()
    elif damage == "text":
        truth.write_text("not HDF5")
    elif damage == "size":
        with h5py.File(result, "a") as f:
            del f["surface/valid"]
            f["surface/valid"] = np.ones((H, W + 1), bool)
    else:
        with h5py.File(truth, "a") as f:
            if damage == "dataset":
                del f["surface/normals"]
            else:
                f.attrs["camera"] = "fisheye"
    words = {"missing": "no such truth", "text": "HDF5", "size": "80 × 60", "dataset": "surface/normals"}
    with pytest.raises(InputError, match=words.get(damage, "fisheye")) as caught:
        evaluate(result, truth)
    assert "ball.truth.h5" in str(caught.value)
