"""Results out: the archive, the files for other programs and the pictures of one photograph, all in one folder."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from ..engine.stage import Arrays
from ..engine.store import write_atomically
from ..errors import StoreError
from ..geometry.chart import Pinhole
from . import archive, exports, pictures, render
from . import light as light_
from .exports import to_display
from .mesh import bake
from .mesh import mesh as make_mesh

#: Raise it whenever a file's content or the list of files changes: with it the files are written anew.
VERSION = 9

#: The files of one photograph's folder, in the order in which they are written.
FILES = {
    "result.h5": "the archive: everything, with units and axes (read it with sftex_stages.open_result or h5py)",
    "surface_textured.png": "the surface seen obliquely, dressed in the photograph",
    "surface_grey.png": "the same view in grey",
    "normals.png": "normal map: red right, green up, blue toward the viewer",
    "irradiance.png": "relative irradiance, with its scale",
    "albedo.png": "the print in even light, transparent where unsupported",
    "instances.png": "the texture's elements as circles at their slant and tilt",
    "textons.png": "the frontal textons after 1, 5, 10 and 20 iterations",
    "height.exr": "float32, channel Z, px toward the camera, NaN where unsupported",
    "normals.exr": "float32, channels N.X N.Y N.Z (x right, y down, z toward the camera), NaN where unsupported",
    "irradiance.exr": "float32, channels Y, relative, geometric mean 1, sigma, of its logarithm (R G B if asked for); else NaN",
    "albedo.exr": "float32, linear, channels R G B A: the photograph over the irradiance; A is 0 where unsupported",
    "surface.jpg": "the albedo, flattened by the chart: texture of surface.ply and surface.obj",
    "surface.ply": "mesh in px: x right, y up, z toward the viewer; normals, albedo, coordinates in surface.jpg",
    "surface.obj": "the same mesh for programs that read no PLY",
    "surface.mtl": "its material, with surface.jpg",
    "surface.glb": "the same mesh with its texture, for 3-D viewers; under 10 MB",
}


def write_outputs(folder: Path, arrays: Mapping[str, Arrays | list[Arrays]], meta: Mapping[str, Any]) -> list[Path]:
    """Write all of `FILES` for one photograph, each whole or not at all; equal input gives equal bytes.

    arrays: {"image": …, "frontal": [...], "surface": …, "irradiance": …, "chart": …}, the stages' outputs.
    meta: image_name, image_sha256, config_yaml (texts); keys, versions (dictionaries).
    Raises StoreError if the folder cannot be written, StageError if the surface is too small for a mesh.
    """
    scratch = folder / ".tmp"
    written = []
    try:
        with _writing(folder):
            shutil.rmtree(scratch, ignore_errors=True)  # left by a run that was killed
            scratch.mkdir(parents=True)
        for name, content in _contents(arrays, meta, scratch):
            with _writing(folder / name):
                write_atomically(folder / name, content, scratch)
            written.append(folder / name)
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
    return written


@contextmanager
def _writing(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as e:
        raise StoreError(f"{path}: cannot be written ({e.strerror or e}); free space or choose another folder") from e


def _contents(arrays: Mapping[str, Any], meta: Mapping[str, Any], scratch: Path) -> Iterator[tuple[str, bytes]]:
    """Name and bytes of each file, made one after another so that one file at a time is in memory."""
    surface, frontal, light = arrays["surface"], arrays["frontal"], arrays["irradiance"]
    height, normals, valid = surface["height"], surface["normals"], surface["valid"]
    photo, camera = to_display(arrays["image"]["rgb"]), Pinhole.of(surface)
    counts = np.bincount(surface["instance/texton"], minlength=len(frontal))
    about = f"sftex result of {meta['image_name']} (SHA-256 {meta['image_sha256']}); {archive.AXES}"

    yield "result.h5", archive.encode(arrays, meta)
    textured, grey = render.render(height, normals, valid, (photo, None), camera=camera)
    yield "surface_textured.png", _png(textured)
    yield "surface_grey.png", _png(grey)
    yield "normals.png", _png(pictures.normal_map(normals, valid))
    yield "irradiance.png", _png(pictures.irradiance(light["map"], valid))
    bare = light_.albedo(arrays["image"]["rgb"], light["map"], valid)
    exposure = 0.8 / max(light_.white(bare), 1e-12)
    shown = to_display(np.nan_to_num(bare), exposure)
    seen = np.isfinite(bare).all(axis=2)
    yield "albedo.png", _png(np.dstack([shown, np.where(seen, 255, 0).astype(np.uint8)]))
    yield "instances.png", _png(pictures.instances(photo, surface))
    yield "textons.png", _png(pictures.textons(archive.judged(frontal, surface), counts))
    yield "height.exr", exports.exr(height, ("Z",), f"height, px toward the camera; {about}", scratch)
    yield "normals.exr", exports.exr(normals, ("N.X", "N.Y", "N.Z"), f"unit normals; {about}", scratch)
    channels = {"Y": light["map"], "sigma": light["sigma"]}
    if "rgb" in light:
        channels |= {name: light["rgb"][..., c] for c, name in enumerate("RGB")}
    planes = np.dstack(list(channels.values()))
    yield "irradiance.exr", exports.exr(planes, tuple(channels), f"relative linear irradiance; {about}", scratch)
    layers = np.dstack([np.where(seen[..., None], bare, 0), seen])
    yield "albedo.exr", exports.exr(layers, ("R", "G", "B", "A"), f"linear albedo on the image's scale; {about}", scratch)
    mesh = make_mesh(height, normals, surface["piece"], arrays["chart"]["uv"], camera)
    texture = exports.encode(to_display(bake(mesh, bare), exposure), ".jpg")
    yield "surface.jpg", texture
    yield "surface.ply", exports.ply(mesh, shown, "surface.jpg")
    yield "surface.obj", exports.obj(mesh, "surface.mtl")
    yield "surface.mtl", exports.mtl("surface.jpg")
    yield "surface.glb", exports.glb(mesh, texture, height.shape, about)


def _png(picture: np.ndarray) -> bytes:
    return exports.encode(picture, ".png")
