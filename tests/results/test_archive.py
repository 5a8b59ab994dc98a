"""result.h5: what goes in comes out, by the reader and by h5py alone; hostile and broken files are refused."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

import sftex_stages
from sftex_stages.errors import InputError
from sftex_stages.results import archive


@pytest.fixture
def path(tmp_path: Path, arrays: dict, meta: dict) -> Path:
    (tmp_path / "result.h5").write_bytes(archive.encode(arrays, meta))
    return tmp_path / "result.h5"


def test_round_trip(path: Path, arrays: dict, meta: dict) -> None:
    result = sftex_stages.open_result(path)
    surface = arrays["surface"]
    for name in ("height", "normals", "valid", "piece", "normal_sigma"):
        np.testing.assert_array_equal(getattr(result, name), surface[name])
        assert getattr(result, name).dtype == surface[name].dtype
    np.testing.assert_array_equal(result.irradiance, arrays["irradiance"]["map"])
    np.testing.assert_array_equal(result.irradiance_sigma, arrays["irradiance"]["sigma"])
    for name, part in (("chart", "uv"), ("chart_angular", "angular"), ("chart_area", "area")):
        np.testing.assert_array_equal(getattr(result, name), arrays["chart"][part])
    np.testing.assert_allclose(result.image, arrays["image"]["rgb"], rtol=2**-12)  # half a unit of the twelfth bit
    np.testing.assert_array_equal(result.mask, arrays["image"]["mask"])
    for name in ("xy", "transform", "normal", "inlier", "texton", "normal_sigma", "state", "irradiance_sigma"):
        np.testing.assert_array_equal(result.instances[name], surface[f"instance/{name}"])
    assert (result.instances["irradiance"] == 1.25).all()  # on the common scale, not each texton's own
    assert list(result.textons["instances"]) == [25, 15, 0]
    assert list(result.textons["usable"]) == [True, False, False]
    assert list(result.textons["reason"]) == ["", "residual 0.08 ≥ 0.03", "2 members"]
    assert result.textons["appearance"].shape == (3, 12, 12, 3)
    np.testing.assert_array_equal(result.textons["appearance"][1], arrays["frontal"][1]["appearance"])
    np.testing.assert_array_equal(result.textons["appearance"][0, 1:10, 1:10], arrays["frontal"][0]["appearance"])
    assert np.isnan(result.textons["appearance"][0, 0]).all() and not result.textons["domain"][2].any()
    assert (result.camera, result.focal_px, result.principal_point) == ("orthographic", None, None)
    for name in ("image_name", "image_sha256", "config_yaml", "keys", "versions"):
        assert result.attributes[name] == meta[name]


def test_h5py_alone_understands_it(path: Path) -> None:
    with h5py.File(path) as file:
        assert file.attrs["schema"] == "sftex-result" and file.attrs["schema_version"] == 2
        assert file.attrs["axes"] == "x right, y down, z toward the camera; pixel centres at integers"
        assert file.attrs["camera"] == "orthographic"
        found = []
        file.visititems(lambda name, node: found.append(name) if isinstance(node, h5py.Dataset) else None)
        assert sorted(found) == sorted(n for n, entry in archive.SCHEMA.items() if not entry.optional)
        for name in found:
            dataset = file[name]
            assert (
                len(dataset.attrs["axes"].split()) == dataset.ndim and dataset.attrs["unit"] and dataset.attrs["about"]
            )
        height = file["surface/height"]
        assert height.dtype == np.float32 and height.fletcher32 and height.compression == "gzip"
        assert file["surface/valid"].dtype == bool and file["textons/reason"].asstr()[2] == "2 members"


def test_equal_input_gives_equal_bytes(path: Path, arrays: dict, meta: dict) -> None:
    assert archive.encode(arrays, meta) == path.read_bytes()


def test_results_without_instances_or_textons_are_whole(tmp_path: Path, arrays: dict, meta: dict) -> None:
    arrays["frontal"] = []
    for group in ("surface", "irradiance"):
        arrays[group] |= {k: v[:0] for k, v in arrays[group].items() if k.startswith("instance/") or k == "class_scale"}
    (tmp_path / "r.h5").write_bytes(archive.encode(arrays, meta))
    result = archive.open_result(tmp_path / "r.h5")
    assert result.instances["transform"].shape == (0, 2, 2) and result.textons["reason"].shape == (0,)


def test_what_could_not_be_read_back_is_not_written(arrays: dict, meta: dict) -> None:
    arrays["surface"]["instance/inlier"] = arrays["surface"]["instance/inlier"][:-1]
    with pytest.raises(ValueError, match=r"instances/inlier has shape \(39,\), expected N"):
        archive.encode(arrays, meta)


def test_textons_beyond_the_last_used_one_have_no_class_scale(tmp_path: Path, arrays: dict, meta: dict) -> None:
    arrays["irradiance"]["class_scale"] = np.array([1, 1.5], "f4")
    (tmp_path / "r.h5").write_bytes(archive.encode(arrays, meta))
    np.testing.assert_array_equal(archive.open_result(tmp_path / "r.h5").textons["class_scale"], [1, 1.5, np.nan])


def test_perspective_results_give_their_camera(tmp_path: Path, arrays: dict, meta: dict) -> None:
    arrays["surface"] |= {
        "camera": np.array("perspective"), "focal_px": np.array(900.0), "principal_point": np.array([64.5, 44.5]),
        "focal_sigma": np.array(30.0),
    }  # fmt: skip
    (tmp_path / "r.h5").write_bytes(archive.encode(arrays, meta))
    result = archive.open_result(tmp_path / "r.h5")
    assert (result.camera, result.focal_px, result.principal_point) == ("perspective", 900.0, (64.5, 44.5))
    assert result.attributes["focal_sigma"] == 30.0


def _replace(name: str, make: Callable[[h5py.File, Path], Any]) -> Callable[[Path], None]:
    def change(path: Path) -> None:
        with h5py.File(path, "r+") as file:
            del file[name]
            made = make(file, path.parent)
            if made is not None:
                file[name] = made

    return change


def _external(file: h5py.File, folder: Path) -> None:
    (folder / "secret").write_bytes(b"s" * 90 * 130 * 4)
    file.create_dataset("surface/height", (90, 130), "f4", external=[(str(folder / "secret"), 0, h5py.h5f.UNLIMITED)])


def _virtual(file: h5py.File, folder: Path) -> None:
    layout = h5py.VirtualLayout((90, 130), "f4")
    layout[:] = h5py.VirtualSource(str(folder / "other.h5"), "x", (90, 130))
    file.create_virtual_dataset("surface/height", layout)


def _huge(file: h5py.File, folder: Path) -> None:
    pixels = [n for n, entry in archive.SCHEMA.items() if entry.axes.startswith("H W")]
    for name in [n for n in pixels if n in file]:
        del file[name]
    for name in pixels:
        entry = archive.SCHEMA[name]
        axes = entry.axes.split()
        shape = (10**6, 10**6, *map(int, axes[2:]))
        file.create_dataset(name, shape, entry.dtype, chunks=(1000, 1000, *map(int, axes[2:])))


@pytest.mark.parametrize(
    "change, words",
    [
        (_replace("surface/height", lambda f, d: h5py.SoftLink("/surface/normals")), "surface/height is a link"),
        (_replace("surface/height", lambda f, d: h5py.ExternalLink("/etc/x.h5", "/x")), "surface/height is a link"),
        (_replace("surface", lambda f, d: h5py.ExternalLink("/etc/x.h5", "/x")), "is a link to elsewhere"),
        (_replace("surface/height", _external), "not an ordinary dataset"),
        (_replace("surface/height", _virtual), "not an ordinary dataset"),
        (_replace("surface/height", _huge), r"declares \d+\.\d GiB"),
        (_replace("surface/height", lambda f, d: None), "surface/height is missing"),
        (_replace("surface/height", lambda f, d: np.zeros((90, 131), "f4")), r"surface/height is .* W = 130"),
        (_replace("instances/xy", lambda f, d: np.zeros((40, 3), "f4")), r"instances/xy .* axes N 2"),
        (_replace("surface/valid", lambda f, d: np.zeros((90, 130), "c8")), "surface/valid is complex64"),
    ],
)
def test_hostile_and_odd_files_are_refused(path: Path, change: Callable[[Path], None], words: str) -> None:
    change(path)
    with pytest.raises(InputError, match=words) as e:
        archive.open_result(path)
    assert str(path) in str(e.value)


def test_files_of_another_kind_are_refused(path: Path, tmp_path: Path) -> None:
    whole = path.read_bytes()
    for name, content in {"cut.h5": whole[: len(whole) // 2], "text.h5": b"no archive\n" * 50, "empty.h5": b""}.items():
        (tmp_path / name).write_bytes(content)
        with pytest.raises(InputError, match=rf"{name}: not a whole result file .* make or copy it anew"):
            archive.open_result(tmp_path / name)
    with h5py.File(tmp_path / "truth.h5", "w") as file:
        file.attrs["schema"] = "sftex-truth-1"
    with pytest.raises(InputError, match="not a result of sftex"):
        archive.open_result(tmp_path / "truth.h5")
    with h5py.File(path, "r+") as file:
        file.attrs["schema_version"] = 99
    with pytest.raises(InputError, match="newer sftex"):
        archive.open_result(path)
    with pytest.raises(InputError, match="no such result file"):
        archive.open_result(tmp_path / "gone.h5")


def test_flipped_bits_in_the_data_are_found(path: Path) -> None:
    with h5py.File(path) as file:
        info = file["surface/normals"].id.get_chunk_info(0)
    data = bytearray(path.read_bytes())
    data[info.byte_offset + info.size // 2] ^= 0x10
    path.write_bytes(data)
    with pytest.raises(InputError, match="not a whole result file"):
        archive.open_result(path)
