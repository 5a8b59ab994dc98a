"""The surface and the maps for other programs: EXR (OpenImageIO), PLY, OBJ and GLB. Every function returns a file's bytes."""

from __future__ import annotations

import json
import struct
import tempfile
from pathlib import Path

import cv2
import numpy as np
import OpenImageIO as oiio

from ..errors import StoreError
from .mesh import Mesh


def usual_exposure(light: np.ndarray) -> float:
    """What linear light (H, …) is multiplied by to be shown: 1, unless the scene is far from the range 0…1, as EXR may be.

    Then the 99th percentile is taken to 0.9.
    """
    bright = float(np.percentile(light[:: max(1, len(light) // 256)], 99)) if light.size else 1.0
    return 1.0 if 0.05 < bright <= 1 else 0.9 / max(bright, 1e-12)


def to_display(light: np.ndarray, exposure: float | None = None) -> np.ndarray:
    """Linear light, float32 of any shape, times `exposure` (default: its `usual_exposure`), to sRGB uint8, for pictures."""
    if exposure is None:
        exposure = usual_exposure(light)
    v = np.clip(light * np.float32(exposure), 0, 1)
    # A table over 16 bits of linear light is finer than 8 bits of sRGB need anywhere but in the darkest two steps.
    return _ENCODE[(v * 65535 + 0.5).astype(np.uint16)]


def _encode_table() -> np.ndarray:
    v = np.arange(65536) / 65535
    return (np.where(v <= 0.0031308, v * 12.92, 1.055 * v ** (1 / 2.4) - 0.055) * 255 + 0.5).astype(np.uint8)


_ENCODE = _encode_table()


def exr(data: np.ndarray, channels: tuple[str, ...], about: str, scratch: Path) -> bytes:
    """data (H, W) or (H, W, C) as a float32 OpenEXR file, lossless. NaN stays NaN. Raises StoreError."""
    data = np.ascontiguousarray(np.atleast_3d(data), np.float32)
    spec = oiio.ImageSpec(data.shape[1], data.shape[0], data.shape[2], oiio.FLOAT)
    spec.channelnames = channels
    spec.attribute("compression", "zip:1")
    spec.attribute("ImageDescription", about)
    spec.attribute("Software", "sftex")
    spec.attribute("DateTime", "1970:01:01 00:00:00")  # else the clock's time: equal data must give equal files
    spec.attribute("oiio:ColorSpace", "lin_rec709_scene" if channels[0] in ("Y", "R") else "data")
    with tempfile.TemporaryDirectory(dir=scratch) as folder:
        path = Path(folder) / "x.exr"
        out = oiio.ImageOutput.create(str(path))
        if out is None or not (out.open(str(path), spec) and out.write_image(data) and out.close()):
            reason = out.geterror() if out else oiio.geterror()
            raise StoreError(
                f"{scratch}: an EXR file cannot be written ({reason}); free space or choose another folder"
            )
        return path.read_bytes()


def encode(picture: np.ndarray, ending: str) -> bytes:
    """A picture (h, w, 3 or 4) uint8 sRGB, RGB or RGBA, as a file of the kind ".png" or ".jpg"."""
    order = [2, 1, 0, 3][: picture.shape[2]]
    quality = [] if ending == ".png" else [cv2.IMWRITE_JPEG_QUALITY, 92]
    return cv2.imencode(ending, picture[..., order], quality)[1].tobytes()


def ply(surface: Mesh, photo: np.ndarray, texture_name: str) -> bytes:
    """Binary PLY: position, normal, colour from a picture (H, W, 3) uint8 of the image, coordinates into `texture_name`."""
    h, w = photo.shape[:2]
    x, y = surface.pixel.T
    vertex = np.zeros(len(surface.vertices), [("p", "<f4", 3), ("n", "<f4", 3), ("rgb", "u1", 3), ("st", "<f4", 2)])
    vertex["p"], vertex["n"], vertex["rgb"] = surface.vertices, surface.normals, photo[y, x]
    vertex["st"] = surface.uv * [1, -1] + [0, 1]  # PLY's readers count t from the bottom
    face = np.zeros(len(surface.faces), [("n", "u1"), ("i", "<i4", 3)])
    face["n"], face["i"] = 3, surface.faces
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"comment sftex: x right, y up, z toward the viewer; unit: pixel of the {w} x {h} photograph",
        f"comment TextureFile {texture_name}",
        f"element vertex {len(vertex)}",
        *(f"property float {name}" for name in "x y z nx ny nz".split()),
        *(f"property uchar {name}" for name in ("red", "green", "blue")),
        *(f"property float {name}" for name in "st"),
        f"element face {len(face)}",
        "property list uchar int vertex_indices",
        "end_header",
    ]
    return "\n".join([*header, ""]).encode("ascii") + vertex.tobytes() + face.tobytes()


def obj(surface: Mesh, material_name: str) -> bytes:
    """Wavefront OBJ: positions, normals and coordinates into the texture of the material "surface" in `material_name`."""
    st = surface.uv * [1, -1] + [0, 1]  # counted from the bottom
    number = np.repeat(surface.faces.astype(np.int64) + 1, 3, axis=1)
    u, v = surface.unit
    parts = [
        "# sftex: x right, y up, z toward the viewer; unit: pixel of the photograph\n"
        f"# texture: the flattened surface, {u:.1f} x {v:.1f} px of it\n"
        f"mtllib {material_name}\no surface\nusemtl surface\n",
        _lines("v %.3f %.3f %.3f", surface.vertices),
        _lines("vt %.6f %.6f", st),
        _lines("vn %.4f %.4f %.4f", surface.normals),
        _lines("f %d/%d/%d %d/%d/%d %d/%d/%d", number),
    ]
    return "".join(parts).encode("ascii")


def _lines(form: str, rows: np.ndarray) -> str:
    return "\n".join([form] * len(rows)) % tuple(rows.ravel().tolist()) + "\n"


def mtl(texture_name: str) -> bytes:
    """The material of `obj`: matt, its colour from a texture."""
    return f"newmtl surface\nKa 0 0 0\nKd 1 1 1\nKs 0 0 0\nillum 1\nmap_Kd {texture_name}\n".encode("ascii")


def glb(surface: Mesh, texture: bytes, size: tuple[int, int], about: str) -> bytes:
    """Binary glTF 2.0, one mesh with a JPEG, `texture`, as its base colour.

    Vertices are in px; the node centres the photograph of `size` (height, width) and makes its longer side 1 unit long,
    as viewers expect objects of about a metre. The asset's extras say how many px of the surface a unit of u and v is.
    """
    views: list[dict] = []
    blob = bytearray()

    def view(data: bytes, **more: int) -> int:
        blob.extend(bytes(-len(blob) % 4))
        views.append({"buffer": 0, "byteOffset": len(blob), "byteLength": len(data), **more})
        blob.extend(data)
        return len(views) - 1

    def accessor(array: np.ndarray, kind: str, target: int, component: int = 5126, **more: list[float]) -> dict:
        shared = {"componentType": component, "count": len(array), "type": kind, **more}
        return {"bufferView": view(array.tobytes(), target=target), **shared}

    box = {"min": surface.vertices.min(0).tolist(), "max": surface.vertices.max(0).tolist()}
    accessors = [
        accessor(surface.vertices, "VEC3", 34962, **box),
        accessor(surface.normals, "VEC3", 34962),
        accessor(surface.uv, "VEC2", 34962),
        accessor(surface.faces.reshape(-1), "SCALAR", 34963, 5125),
    ]
    scale = 1 / max(size)
    centre = np.array([(size[1] - 1) / 2, -(size[0] - 1) / 2, float(np.median(surface.vertices[:, 2]))])
    document = {
        "asset": {"version": "2.0", "generator": "sftex", "extras": {"about": about, "px_per_uv": surface.unit.tolist()}},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": "surface", "scale": [scale] * 3, "translation": (-centre * scale).tolist()}],
        "meshes": [
            {"primitives": [{"attributes": {"POSITION": 0, "NORMAL": 1, "TEXCOORD_0": 2}, "indices": 3, "material": 0}]}
        ],
        "materials": [
            {
                "doubleSided": True,
                "pbrMetallicRoughness": {"baseColorTexture": {"index": 0}, "metallicFactor": 0, "roughnessFactor": 1},
            }
        ],
        "textures": [{"source": 0, "sampler": 0}],
        "samplers": [{"magFilter": 9729, "minFilter": 9987, "wrapS": 33071, "wrapT": 33071}],
        "images": [{"mimeType": "image/jpeg", "bufferView": view(texture)}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(blob) + -len(blob) % 4}],
    }
    text = json.dumps(document, separators=(",", ":")).encode()
    chunks = [(b"JSON", text + b" " * (-len(text) % 4)), (b"BIN\0", bytes(blob) + bytes(-len(blob) % 4))]
    body = b"".join(struct.pack("<I", len(data)) + kind + data for kind, data in chunks)
    return b"glTF" + struct.pack("<II", 2, 12 + len(body)) + body
