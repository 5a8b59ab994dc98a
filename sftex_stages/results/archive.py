"""The archive result.h5: everything that was recovered from one photograph, readable years later with h5py alone.

`SCHEMA` is its definition: the writer, the reader's checks and the attributes in the file all come from that table.
Frame: x right, y down, z toward the camera, pixel centres at integers; light is linear.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np

from ..engine.stage import Arrays
from ..errors import InputError
from ..guarded import Declared, read_hdf5

SCHEMA_NAME = "sftex-result"
SCHEMA_VERSION = 2
AXES = "x right, y down, z toward the camera; pixel centres at integers"


class Entry(NamedTuple):
    """A dataset: dtype ("U" = UTF-8), axes by letter (H, W image; P pieces; N instances; K textons; n grid), unit, meaning."""

    dtype: str
    axes: str
    unit: str
    about: str
    optional: bool = False


SCHEMA = {
    "image/rgb": Entry("f4", "H W 3", "relative", "the photograph, linear, sRGB's primaries, to 12 bits; 1 = its white"),
    "image/mask": Entry("?", "H W", "1", "False where it is transparent or masked"),
    "surface/height": Entry(
        "f4", "H W", "px", "height toward the camera (perspective: px at the distance f), NaN where unsupported"
    ),
    "surface/normals": Entry(
        "f4", "H W 3", "1", "unit normal in the camera's frame (orthographic: ∝ (-dz/dx, -dz/dy, 1)), NaN where unsupported"
    ),
    "surface/valid": Entry("?", "H W", "1", "True where measurements support the surface"),
    "surface/piece": Entry("i4", "H W", "1", "connected piece of valid, from 1; offsets between pieces are guessed; else 0"),
    "surface/normal_sigma": Entry("f4", "H W", "degree", "expected error of the normal"),
    "irradiance/map": Entry("f4", "H W", "relative", "linear irradiance, geometric mean 1 over valid, else NaN"),
    "irradiance/sigma": Entry("f4", "H W", "1", "expected error of the logarithm of irradiance/map, else NaN"),
    "irradiance/rgb": Entry(
        "f4", "H W 3", "relative", "only with irradiance.channels = rgb: of each channel, each with geometric mean 1", True
    ),
    "chart/uv": Entry("f4", "H W 2", "px", "flat coordinates, each piece's own: px of the surface seen straight on, else NaN"),
    "chart/angular": Entry("f4", "P 2", "degree", "a piece's distortion of angles: median, 95th percentile over its area"),
    "chart/area": Entry("f4", "P 2", "1", "a piece's relative distortion of areas: median, 95th percentile over its area"),
    "instances/xy": Entry("f4", "N 2", "px", "centre in the image"),
    "instances/transform": Entry("f4", "N 2 2", "1", "maps frontal px to image px"),
    "instances/normal": Entry("f4", "N 3", "1", "unit normal with its sign resolved"),
    "instances/inlier": Entry("f4", "N", "1", "posterior of being a view of its texton, and on the surface"),
    "instances/state": Entry("f4", "N 3", "1", "posteriors of: sign +, sign -, not from the surface"),
    "instances/irradiance": Entry("f4", "N", "relative", "irradiance, on one scale for all textons"),
    "instances/irradiance_sigma": Entry("f4", "N", "1", "standard deviation of its logarithm"),
    "instances/texton": Entry("i4", "N", "1", "row in textons/*"),
    "instances/normal_sigma": Entry("f4", "N", "degree", "expected error of the normal"),
    "textons/appearance": Entry(
        "f4", "K n n 3", "relative", "frontal albedo, linear; centred, NaN beyond its own grid"
    ),
    "textons/domain": Entry("f4", "K n n", "1", "weight of the texton's pixels, 0 to 1; 0 beyond its own grid"),
    "textons/spacing": Entry("f4", "K", "px", "frontal px per grid px"),
    "textons/usable": Entry("?", "K", "1", "whether its instances entered the surface"),
    "textons/reason": Entry("U", "K", "1", "why not usable, in words; empty if usable"),
    "textons/instances": Entry("i4", "K", "1", "number of its rows in instances/*"),
    "textons/class_scale": Entry("f4", "K", "1", "r of its irradiance, NaN if unusable"),
}


@dataclass(frozen=True)
class Result:
    """What a result.h5 holds, as arrays in memory; `SCHEMA` gives axes, units and meaning of each.

    H × W pixels, P pieces, N instances, K textons. `instances` and `textons` are keyed by the names after the slash.
    `focal_px` and `principal_point` (x, y) are None under an orthographic camera. `attributes` has everything else:
    image_name, image_sha256, config_yaml, keys and versions (these two as dictionaries), schema, schema_version, axes, and
    under a perspective camera focal_sigma, the standard deviation of focal_px (0 if it was given).
    """

    path: Path
    image: np.ndarray  # (H, W, 3) linear
    mask: np.ndarray  # (H, W) bool
    height: np.ndarray  # (H, W) px
    normals: np.ndarray  # (H, W, 3)
    valid: np.ndarray  # (H, W) bool
    piece: np.ndarray  # (H, W) int32
    normal_sigma: np.ndarray  # (H, W) degrees
    irradiance: np.ndarray  # (H, W) relative
    irradiance_sigma: np.ndarray  # (H, W) of its logarithm
    irradiance_rgb: np.ndarray | None  # (H, W, 3) relative, of each channel
    chart: np.ndarray  # (H, W, 2) px
    chart_angular: np.ndarray  # (P, 2) degrees
    chart_area: np.ndarray  # (P, 2)
    instances: Mapping[str, np.ndarray]
    textons: Mapping[str, np.ndarray]
    camera: str = "orthographic"
    focal_px: float | None = None
    principal_point: tuple[float, float] | None = None
    attributes: Mapping[str, Any] = field(default_factory=dict)


# ---------------------------------------------------------------------------------------------------- writing


def encode(arrays: Mapping[str, Arrays | list[Arrays]], meta: Mapping[str, Any]) -> bytes:
    """The archive's bytes, from the stages' arrays {"image": …, "frontal": [...], …} and `meta`.

    meta: image_name, image_sha256, config_yaml (texts), keys, versions (dictionaries). Equal input gives equal bytes.
    Built in memory, so that a full disk is an ordinary OSError at the write instead of a crash inside of HDF5.
    """
    with h5py.File.in_memory(libver=("v110", "v110")) as file:
        file.attrs["schema"] = SCHEMA_NAME
        file.attrs["schema_version"] = SCHEMA_VERSION
        file.attrs["about"] = (
            "surface, normals and relative irradiance recovered from texture in one photograph (sftex)"
        )
        file.attrs["axes"] = AXES
        file.attrs.update(_camera(arrays["surface"]))
        for name in ("image_name", "image_sha256", "config_yaml"):
            file.attrs[name] = str(meta[name])
        for name in ("keys", "versions"):
            file.attrs[name] = json.dumps(meta[name], sort_keys=True)
        sizes: dict[str, int] = {}
        for name, array in _collect(arrays).items():
            entry = SCHEMA[name]
            if not _fits(entry, np.shape(array), sizes):
                raise ValueError(f"{name} has shape {np.shape(array)}, expected {entry.axes} with {sizes}")
            dataset = _create(file, name, array, entry.dtype)
            dataset.attrs["axes"] = entry.axes
            dataset.attrs["unit"] = entry.unit
            dataset.attrs["about"] = entry.about
        file.flush()
        image: bytes = file.id.get_file_image()
    return image


def _camera(surface: Any) -> dict[str, Any]:
    """The attributes `camera`, "orthographic" or "perspective"; the latter with `focal_px`, its expected error `focal_sigma`
    and `principal_point` (x, y)."""
    camera = str(surface["camera"])
    if camera != "perspective":
        return {"camera": camera}
    centre = np.asarray(surface["principal_point"], float)
    focal = {name: float(surface[name]) for name in ("focal_px", "focal_sigma")}
    return {"camera": camera, **focal, "principal_point": centre}


def _collect(arrays: Mapping[str, Any]) -> Arrays:
    """The schema's datasets from the stages' arrays."""
    surface, irradiance, frontal = arrays["surface"], arrays["irradiance"], arrays["frontal"]
    data: Arrays = {"image/rgb": _rounded(arrays["image"]["rgb"]), "image/mask": arrays["image"]["mask"]}
    data |= {f"surface/{n}": surface[n] for n in ("height", "normals", "valid", "piece", "normal_sigma")}
    data |= {f"irradiance/{n}": irradiance[n] for n in ("map", "sigma", "rgb") if n in irradiance}
    data |= {f"chart/{n}": arrays["chart"][n] for n in ("uv", "angular", "area")}
    for name in SCHEMA:
        group, _, short = name.partition("/")
        if group == "instances":
            data[name] = surface[f"instance/{short}"]
    data["instances/irradiance"] = irradiance["instance/irradiance"]
    data |= {f"textons/{n}": a for n, a in _stack(judged(frontal, surface)).items()}
    data["textons/instances"] = np.bincount(surface["instance/texton"], minlength=len(frontal))
    # The irradiance stage sees the textons that entered the surface alone; those after the last of them are missing.
    scale = irradiance["class_scale"]
    data["textons/class_scale"] = np.pad(scale, (0, max(0, len(frontal) - len(scale))), constant_values=np.nan)
    return data


def _rounded(values: np.ndarray) -> np.ndarray:
    """float32 values to 12 significant bits, finer than any picture needs: what is left compresses well."""
    bits = np.ascontiguousarray(values, np.float32).view(np.uint32)
    return ((bits + np.uint32(1 << 11)) & np.uint32(0xFFFFF000)).view(np.float32)


def _fits(entry: Entry, shape: tuple[int, ...], sizes: dict[str, int]) -> bool:
    """Whether a shape has the entry's axes, each as long as in `sizes`, to which axes met for the first time are added."""
    axes = entry.axes.split()
    if len(shape) != len(axes):
        return False
    known = [sizes.setdefault(a, int(a) if a.isdigit() else n) for a, n in zip(axes, shape, strict=True)]
    return known == list(shape)


def _stack(frontal: list[Arrays]) -> Arrays:
    """Textons of different grids in common arrays, their centres aligned."""
    n = max((len(t["domain"]) for t in frontal), default=0)
    appearance = np.full((len(frontal), n, n, 3), np.nan, np.float32)
    domain = np.zeros((len(frontal), n, n), np.float32)
    for k, texton in enumerate(frontal):
        m = len(texton["domain"])
        a = (n - m) // 2
        domain[k, a : a + m, a : a + m] = texton["domain"]
        appearance[k, a : a + m, a : a + m] = texton["appearance"]
    return {
        "appearance": appearance,
        "domain": domain,
        "spacing": np.array([t["spacing"] for t in frontal], np.float32),
        "usable": np.array([t["usable"] for t in frontal], bool),
        "reason": np.array([str(t["reason"]) for t in frontal], np.str_),
    }


def judged(frontal: list[Arrays], surface: Arrays) -> list[Arrays]:
    """The textons' tables with the surface's verdict on those that the frontal stage let pass: `usable`, `reason`."""
    out = list(frontal)
    for part, words in zip(surface["texton/part"], surface["texton/reason"], strict=True):
        if str(words):
            out[part] = out[part] | {"usable": np.array(False), "reason": words}
    return out


def _create(file: h5py.File, name: str, array: np.ndarray, dtype: str) -> h5py.Dataset:
    if dtype == "U":  # fixed length: variable-length strings lie outside of the checksums
        text = np.char.encode(np.asarray(array, np.str_), "utf-8")
        length = max(1, text.dtype.itemsize)
        return file.create_dataset(name, data=text.astype(h5py.string_dtype("utf-8", length)))
    array = np.ascontiguousarray(array, dtype)
    if array.nbytes < 4096:
        return file.create_dataset(name, data=array)
    rows = max(1, min(len(array), 2**20 * len(array) // array.nbytes))
    return file.create_dataset(
        name, data=array, chunks=(rows, *array.shape[1:]), compression=1, shuffle=True, fletcher32=True
    )


# ---------------------------------------------------------------------------------------------------- reading


def open_result(path: str | Path, max_bytes: int = 8 << 30) -> Result:
    """Read a result.h5 completely.

    It is read in a child process (see `guarded`), so that a hostile file can neither crash nor hang this one. Nothing
    but plain datasets inside of this one file is read: links, external storage and virtual datasets are refused, and so
    is, before any is read, data of more than `max_bytes`. Raises InputError.
    """
    path = Path(path)
    try:
        attributes, data = read_hdf5(path, list(SCHEMA), max_bytes, partial(_check, path), "result")
        for name in ("keys", "versions"):
            attributes[name] = json.loads(attributes[name])
        camera = str(attributes.pop("camera"))
        focal = float(attributes.pop("focal_px")) if camera == "perspective" else None
        centre = tuple(map(float, attributes.pop("principal_point"))) if camera == "perspective" else None
    except (KeyError, ValueError, TypeError, RecursionError) as e:
        raise InputError(f"{path}: not a whole result file ({e}); run sftex again to make it anew") from e
    return Result(
        path=path,
        **{n: data[f"surface/{n}"] for n in ("height", "normals", "valid", "piece", "normal_sigma")},
        image=data["image/rgb"],
        mask=data["image/mask"],
        irradiance=data["irradiance/map"],
        irradiance_sigma=data["irradiance/sigma"],
        irradiance_rgb=data.get("irradiance/rgb"),
        chart=data["chart/uv"],
        chart_angular=data["chart/angular"],
        chart_area=data["chart/area"],
        instances={n.partition("/")[2]: a for n, a in data.items() if n.startswith("instances/")},
        textons={n.partition("/")[2]: a for n, a in data.items() if n.startswith("textons/")},
        camera=camera,
        focal_px=focal,
        principal_point=(centre[0], centre[1]) if centre else None,
        attributes=attributes,
    )


def _check(path: Path, attributes: Mapping[str, Any], declared: Mapping[str, Declared]) -> None:
    """InputError unless a file says of itself what `SCHEMA` says."""
    if attributes.get("schema") != SCHEMA_NAME:
        raise InputError(
            f"{path}: an HDF5 file, but not a result of sftex (its attribute schema is not “{SCHEMA_NAME}”)"
        )
    if (version := int(attributes["schema_version"])) > SCHEMA_VERSION:
        raise InputError(
            f"{path}: written by a newer sftex (schema {version}, this one reads {SCHEMA_VERSION}); update it"
        )
    sizes: dict[str, int] = {}
    for name, entry in SCHEMA.items():
        if name not in declared and entry.optional:
            continue
        if name not in declared:
            raise InputError(f"{path}: {name} is missing; run sftex again to make the file anew")
        dtype, shape = declared[name]
        kind = np.dtype(dtype).kind if dtype != "U" else "U"
        if kind not in {"U": "U", "f4": "f", "i4": "iu", "?": "b"}[entry.dtype] or not _fits(entry, shape, sizes):
            known = ", ".join(f"{axis} = {sizes[axis]}" for axis in entry.axes.split() if axis in sizes)
            found = "text" if dtype == "U" else np.dtype(dtype).name
            raise InputError(
                f"{path}: {name} is {found} {shape}, expected {entry.dtype} with axes {entry.axes} ({known})"
            )
