"""The surface and the maps for other programs: EXR (OpenImageIO), PLY and GLB. Every function returns a file's bytes.

Meshes are in the frame of 3-D viewers: x right, y up, z toward the viewer, that is (x, -y, z) of the image's frame, so
that the surface stands upright and faces the viewer. Their unit is the pixel.
"""

from __future__ import annotations

import json
import struct
import tempfile
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import OpenImageIO as oiio

from ..errors import StageError, StoreError

MAX_TRIANGLES = 190_000
MAX_TEXTURE = 2048  # px, longer side; keeps a GLB under 10 MB
#: A cell of the mesh rising more than this many times its width is a tear between two pieces, not a surface: that slant
#: of 85° is far beyond what can be measured (the detector itself loses elements near 60°).
STEEPEST = 12.0


class Mesh(NamedTuple):
    """Triangles in the viewers' frame: vertices (V, 3) px, normals (V, 3), uv (V, 2) in 0…1 from the image's top left
    corner, faces (F, 3) counter-clockwise seen from the viewer."""

    vertices: np.ndarray
    normals: np.ndarray
    uv: np.ndarray
    faces: np.ndarray


def to_display(light: np.ndarray, exposure: float | None = None) -> np.ndarray:
    """Linear light, float32 of any shape, times `exposure`, to sRGB uint8, for pictures.

    Without `exposure` it is 1, unless the scene is far from the range 0…1, as EXR may be: then the 99th percentile is
    taken to 0.9.
    """
    if exposure is None:
        bright = float(np.percentile(light[:: max(1, len(light) // 256)], 99)) if light.size else 1.0
        exposure = 1.0 if 0.05 < bright <= 1 else 0.9 / max(bright, 1e-12)
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
    spec.attribute("oiio:ColorSpace", "lin_rec709_scene" if channels == ("Y",) else "data")
    with tempfile.TemporaryDirectory(dir=scratch) as folder:
        path = Path(folder) / "x.exr"
        out = oiio.ImageOutput.create(str(path))
        if out is None or not (out.open(str(path), spec) and out.write_image(data) and out.close()):
            reason = out.geterror() if out else oiio.geterror()
            raise StoreError(
                f"{scratch}: an EXR file cannot be written ({reason}); free space or choose another folder"
            )
        return path.read_bytes()


def mesh(height: np.ndarray, normals: np.ndarray, valid: np.ndarray, max_triangles: int = MAX_TRIANGLES) -> Mesh:
    """Triangulate a height field (H, W) on a regular grid coarse enough for `max_triangles`.

    A cell is filled only if every pixel that it covers is valid: holes stay open and separate pieces are not joined.
    Raises StageError if no cell is.
    """
    h, w = height.shape
    valid = valid & np.isfinite(height) & np.isfinite(normals).all(axis=2)
    step = max(1, int(np.ceil(np.sqrt(2 * valid.sum() / max_triangles))))
    ys = np.arange((h - 1) % step // 2, h, step)
    xs = np.arange((w - 1) % step // 2, w, step)
    grid = np.ix_(ys, xs)
    # Minimum over the (step + 1)² pixels right of and below each corner.
    filled = cv2.erode(valid.astype(np.uint8), np.ones((step + 1, step + 1), np.uint8), anchor=(0, 0)) > 0
    z = np.where(valid, height, 0)[grid]
    corners = np.stack([z[:-1, :-1], z[:-1, 1:], z[1:, :-1], z[1:, 1:]])
    cells = filled[grid][:-1, :-1] & (np.ptp(corners, axis=0) <= STEEPEST * step)
    r, c = np.nonzero(cells)
    a = r * len(xs) + c  # top left; seen from the viewer, y up, counter-clockwise is down first
    b, below, d = a + 1, a + len(xs), a + len(xs) + 1
    faces = np.concatenate([np.stack([a, below, b], 1), np.stack([b, below, d], 1)])
    if not len(faces):
        raise StageError(f"the supported surface ({int(valid.sum())} pixels) is too small or too thin for a mesh")
    here = np.zeros(len(ys) * len(xs), bool)
    here[faces] = True
    used, faces = np.flatnonzero(here), (np.cumsum(here) - 1)[faces]
    y, x = ys[used // len(xs)], xs[used % len(xs)]
    n = normals[y, x]
    return Mesh(
        np.stack([x, -y, height[y, x]], 1).astype(np.float32),
        (n * np.array([1, -1, 1])).astype(np.float32),
        np.stack([(x + 0.5) / w, (y + 0.5) / h], 1).astype(np.float32),
        faces.astype(np.uint32),
    )


def texture(photo: np.ndarray) -> bytes:
    """The photograph (H, W, 3) uint8 sRGB as a JPEG of at most `MAX_TEXTURE` pixels a side."""
    scale = MAX_TEXTURE / max(photo.shape[:2])
    if scale < 1:
        photo = cv2.resize(photo, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return cv2.imencode(".jpg", photo[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 92])[1].tobytes()


def ply(surface: Mesh, photo: np.ndarray, texture_name: str) -> bytes:
    """Binary PLY: position, normal, colour of the photograph (H, W, 3) uint8, coordinates into `texture_name`."""
    h, w = photo.shape[:2]
    x, y = surface.vertices[:, 0].astype(int), -surface.vertices[:, 1].astype(int)
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


def glb(surface: Mesh, jpeg: bytes, size: tuple[int, int], about: str) -> bytes:
    """Binary glTF 2.0, one mesh with the JPEG as its base colour.

    Vertices are in px; the node centres the photograph of `size` (height, width) and makes its longer side 1 unit long,
    as viewers expect objects of about a metre.
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
        "asset": {"version": "2.0", "generator": "sftex", "extras": {"about": about}},
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
        "images": [{"mimeType": "image/jpeg", "bufferView": view(jpeg)}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(blob) + -len(blob) % 4}],
    }
    text = json.dumps(document, separators=(",", ":")).encode()
    chunks = [(b"JSON", text + b" " * (-len(text) % 4)), (b"BIN\0", bytes(blob) + bytes(-len(blob) % 4))]
    body = b"".join(struct.pack("<I", len(data)) + kind + data for kind, data in chunks)
    return b"glTF" + struct.pack("<II", 2, 12 + len(body)) + body
