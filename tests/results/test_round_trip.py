"""The round trip of a print on a surface of which everything is known."""

from pathlib import Path

import h5py
import numpy as np
import pytest

from sftex_stages.bench import dressing
from sftex_stages.errors import SftexError
from sftex_stages.results import archive


def write_truth(path: Path, arrays: dict, **change: np.ndarray) -> Path:
    surface = arrays["surface"]
    data = {
        "surface/height": surface["height"], "surface/normals": surface["normals"],
        "surface/valid": surface["valid"], "irradiance/map": 3 * arrays["irradiance"]["map"],
    } | change  # fmt: skip
    with h5py.File(path, "w") as file:
        file.attrs["camera"] = "orthographic"
        for name, values in data.items():
            file[name] = values
    return path


@pytest.fixture
def printed(arrays: dict) -> dict:
    """The domes of `conftest.py`, with a smooth print on them."""
    u, v = np.moveaxis(np.nan_to_num(arrays["chart"]["uv"]), 2, 0)
    color = np.dstack([0.3 + 0.2 * np.sin(u / 4), 0.3 + 0.2 * np.cos(v / 5), 0.3 + 0.2 * np.sin((u + v) / 6)])
    arrays["image"]["rgb"] = (color * np.nan_to_num(arrays["irradiance"]["map"])[..., None]).astype("f4")
    return arrays


def result_of(folder: Path, arrays: dict, meta: dict) -> archive.Result:
    (folder / "result.h5").write_bytes(archive.encode(arrays, meta))
    return archive.open_result(folder / "result.h5")


def test_a_perfect_result_gives_the_photograph_back(tmp_path: Path, printed: dict, meta: dict) -> None:
    truth = write_truth(tmp_path / "t.h5", printed)
    c, s = np.cos(0.7), np.sin(0.7)
    printed["chart"]["uv"] = (printed["chart"]["uv"] @ np.array([[c, s], [-s, c]]) + [30, -500]).astype("f4")
    assert dressing.round_trip(result_of(tmp_path, printed, meta), truth) < 0.01  # charts are free up to a rigid motion


def test_wrong_light_or_chart_shows(tmp_path: Path, printed: dict, meta: dict) -> None:
    truth = write_truth(tmp_path / "t.h5", printed)
    x = np.arange(130) / 130
    right = printed["irradiance"]["map"]
    printed["irradiance"]["map"] = (right * np.exp(0.4 * x)).astype("f4")
    assert 0.03 < dressing.round_trip(result_of(tmp_path, printed, meta), truth) < 0.2
    printed["irradiance"]["map"] = right
    printed["chart"]["uv"] = printed["chart"]["uv"] * np.float32(1.3)
    assert dressing.round_trip(result_of(tmp_path, printed, meta), truth) > 0.05


def test_a_truth_without_light_has_no_round_trip(tmp_path: Path, printed: dict, meta: dict) -> None:
    truth = write_truth(tmp_path / "t.h5", printed)
    with h5py.File(truth, "a") as file:
        del file["irradiance"]
    assert dressing.round_trip(result_of(tmp_path, printed, meta), truth) is None


def test_a_failing_render_is_told(tmp_path: Path) -> None:
    with pytest.raises(SftexError, match="last words"):
        dressing.render_seconds(["bash", "-c", "echo last words >&2; exit 2"], tmp_path, tmp_path)
