"""The files for other programs, read back by other programs: OpenImageIO, trimesh, and the glTF bytes by hand."""

from __future__ import annotations

import io
import json
import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import OpenImageIO as oiio
import pytest

from sftex_stages.errors import StageError, StoreError
from sftex_stages.geometry.chart import Pinhole
from sftex_stages.results import exports
from sftex_stages.results.mesh import MAX_TEXTURE, Mesh, bake, mesh


@pytest.fixture
def surface(arrays: dict) -> Mesh:
    return mesh_of(arrays)


def mesh_of(arrays: dict, limit: int = 10**6) -> Mesh:
    s = arrays["surface"]
    return mesh(s["height"], s["normals"], s["piece"], arrays["chart"]["uv"], Pinhole(), limit)


def flat_mesh(height: np.ndarray, stretch: float = 1.0) -> Mesh:
    """Of a height field with frontal normals, its chart the image, stretched."""
    normals = np.tile(np.array([0, 0, 1], "f4"), (*height.shape, 1))
    chart = np.indices(height.shape)[::-1].transpose(1, 2, 0) * stretch
    return mesh(height, normals, np.ones(height.shape, "i4"), chart, Pinhole())


def read_glb(data: bytes) -> tuple[dict, bytes]:
    magic, version, length, text_length, kind = struct.unpack_from("<4sIII4s", data)
    assert (magic, version, length, kind) == (b"glTF", 2, len(data), b"JSON") and text_length % 4 == 0
    size, kind = struct.unpack_from("<I4s", data, 20 + text_length)
    assert kind == b"BIN\0" and 28 + text_length + size == len(data)
    return json.loads(data[20 : 20 + text_length]), data[28 + text_length :]


def accessor(document: dict, blob: bytes, index: int) -> np.ndarray:
    a = document["accessors"][index]
    view = document["bufferViews"][a["bufferView"]]
    width = {"SCALAR": 1, "VEC2": 2, "VEC3": 3}[a["type"]]
    kind: Any = {5126: "<f4", 5125: "<u4"}[a["componentType"]]
    assert view["byteLength"] == a["count"] * width * 4 and view["byteOffset"] % 4 == 0
    return np.frombuffer(blob, kind, a["count"] * width, view["byteOffset"]).reshape(-1, width)


# ------------------------------------------------------------------------------------------------ EXR


def test_exr_keeps_every_bit(tmp_path: Path, arrays: dict) -> None:
    for data, channels in (
        (arrays["surface"]["height"], ("Z",)),
        (arrays["surface"]["normals"], ("N.X", "N.Y", "N.Z")),
    ):
        content = exports.exr(data, channels, "a — description", tmp_path)
        assert content == exports.exr(data, channels, "a — description", tmp_path)
        (tmp_path / "a.exr").write_bytes(content)
        source = oiio.ImageInput.open(str(tmp_path / "a.exr"))
        spec = source.spec()
        assert tuple(spec.channelnames) == channels and str(spec.format) == "float"
        assert spec.get_string_attribute("ImageDescription") == "a — description"
        assert spec.get_string_attribute("DateTime").startswith("1970")  # not the clock
        np.testing.assert_array_equal(np.squeeze(source.read_image(oiio.FLOAT)), data)
        source.close()
    assert [p.name for p in tmp_path.iterdir()] == ["a.exr"]


def test_exr_says_where_it_cannot_write(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(exports.oiio.ImageOutput, "create", lambda name: None)
    with pytest.raises(StoreError, match="EXR file cannot be written"):
        exports.exr(np.ones((3, 4), "f4"), ("Y",), "", tmp_path)


# ------------------------------------------------------------------------------------------------ mesh


def test_mesh_is_the_surface_upright_and_facing(surface: Mesh, arrays: dict) -> None:
    s = arrays["surface"]
    x, y = surface.vertices[:, 0].astype(int), -surface.vertices[:, 1].astype(int)
    np.testing.assert_array_equal(surface.vertices[:, 2], s["height"][y, x])
    np.testing.assert_array_equal(surface.normals, s["normals"][y, x] * [1, -1, 1])
    np.testing.assert_array_equal(surface.pixel, np.stack([x, y], 1))
    a, b, c = surface.vertices[surface.faces].transpose(1, 0, 2)
    flat = np.cross(b - a, c - a)
    assert (flat[:, 2] > 0).all()  # counter-clockwise toward the viewer
    cosine = (flat * surface.normals[surface.faces[:, 0]]).sum(1) / np.linalg.norm(flat, axis=1)
    assert cosine.min() > np.cos(np.radians(3))


def test_mesh_leaves_holes_open_and_pieces_apart(arrays: dict) -> None:
    s = arrays["surface"]
    for limit in (10**6, 2000):  # at full resolution, and on a grid of several pixels
        m = mesh_of(arrays, limit)
        assert 0.5 * limit < len(m.faces) <= limit or limit == 10**6
        inside = np.zeros((90, 130), np.uint8)
        for triangle in m.vertices[m.faces][..., :2] * [1, -1]:
            cv2.fillConvexPoly(inside, triangle.astype(np.int32), 1)
        assert not (inside.astype(bool) & ~s["valid"]).any()
        assert (inside.astype(bool) & s["valid"]).sum() > 0.85 * s["valid"].sum()
        sides = np.sign(m.vertices[m.faces][..., 0] - 65)
        assert (np.ptp(sides, axis=1) == 0).all()


def test_mesh_tears_where_the_surface_jumps() -> None:
    height = np.zeros((20, 30), np.float32)
    height[:, 15:] = 100
    m = flat_mesh(height)
    assert (np.ptp(m.vertices[m.faces][..., 2], axis=1) == 0).all() and len(m.faces) == 2 * 19 * 28


def test_meshes_of_large_photographs_stay_small() -> None:
    y, x = np.mgrid[:1500, :2000].astype("f4")
    m = flat_mesh(np.sin(x / 99) + y, 2.0)
    assert 60_000 < len(m.faces) < 100_000 and 0.95 * MAX_TEXTURE < max(m.size) <= MAX_TEXTURE
    noise = cv2.GaussianBlur(np.random.default_rng(0).random((1500, 2000, 3), "f4"), (0, 0), 1)
    texture = exports.encode(exports.to_display(bake(m, noise)), ".jpg")
    assert len(exports.glb(m, texture, (1500, 2000), "")) < 10e6


def test_meshes_of_a_perspective_camera_spread_with_depth() -> None:
    height = np.full((21, 31), -100.0, "f4")  # 100 px farther than where a px is a px: larger by a fifth
    normals = np.tile(np.array([0, 0, 1], "f4"), (21, 31, 1))
    chart = np.indices(height.shape)[::-1].transpose(1, 2, 0)
    m = mesh(height, normals, np.ones(height.shape, "i4"), chart, Pinhole(500.0, (15.0, 10.0)))
    np.testing.assert_allclose(m.vertices[:, 0], 15 + 1.2 * (m.pixel[:, 0] - 15), rtol=1e-6)
    np.testing.assert_allclose(m.vertices[:, 1], -(10 + 1.2 * (m.pixel[:, 1] - 10)), rtol=1e-5)


def test_the_texture_is_the_picture_laid_flat(surface: Mesh, arrays: dict) -> None:
    y, x = np.mgrid[:90, :130]
    picture = np.dstack([x, y, np.where(x < 65, 0, 100)]).astype("f4")
    picture[~arrays["surface"]["valid"]] = np.nan
    flat = bake(surface, picture)
    assert flat.shape[:2] == surface.size and np.isfinite(flat).all()
    at = (surface.uv * surface.size[::-1] - 0.5).round().astype(int)
    found = flat[at[:, 1], at[:, 0]]
    error = np.linalg.norm(found[:, :2] - surface.pixel, axis=1)
    assert np.quantile(error, 0.99) < 1.5 and (found[:, 2] == np.where(surface.pixel[:, 0] < 65, 0, 100)).all()
    # Lengths in the texture are lengths on the surface, also from piece to piece.
    edge = surface.faces[:, :2]
    on_surface = np.linalg.norm(np.diff(surface.vertices[edge], axis=1)[:, 0], axis=1)
    on_chart = np.linalg.norm(np.diff(surface.uv[edge], axis=1)[:, 0] * surface.unit, axis=1)
    assert 0.97 < np.median(on_chart / on_surface) < 1.03


def test_too_little_surface_is_an_error(arrays: dict) -> None:
    s = arrays["surface"]
    with pytest.raises(StageError, match="too small or too thin"):
        mesh(s["height"], s["normals"], np.zeros((90, 130), "i4"), arrays["chart"]["uv"], Pinhole())


# ------------------------------------------------------------------------------------------------ GLB and PLY


def texture_of(surface: Mesh, arrays: dict) -> bytes:
    smooth = cv2.GaussianBlur(arrays["image"]["rgb"], (0, 0), 4)
    return exports.encode(exports.to_display(bake(surface, smooth), 1.0), ".jpg")


def test_glb_bytes(surface: Mesh, arrays: dict) -> None:
    photo = exports.to_display(cv2.GaussianBlur(arrays["image"]["rgb"], (0, 0), 4), 1.0)
    data = exports.glb(surface, texture_of(surface, arrays), (90, 130), "words")
    document, blob = read_glb(data)
    primitive = document["meshes"][0]["primitives"][0]
    position, normal, uv = (
        accessor(document, blob, primitive["attributes"][n]) for n in ("POSITION", "NORMAL", "TEXCOORD_0")
    )
    faces = accessor(document, blob, primitive["indices"]).reshape(-1, 3)
    np.testing.assert_array_equal(position, surface.vertices)
    np.testing.assert_array_equal(normal, surface.normals)
    np.testing.assert_array_equal(faces, surface.faces)
    box = document["accessors"][primitive["attributes"]["POSITION"]]
    np.testing.assert_allclose([box["min"], box["max"]], [position.min(0), position.max(0)])
    node = document["nodes"][0]
    placed = position * node["scale"] + node["translation"]
    assert np.abs(placed).max() <= 0.5 and np.ptp(placed[:, 0]) > 0.95
    # glTF counts v from the picture's top: the vertex must find its own pixel there.
    view = document["bufferViews"][document["images"][0]["bufferView"]]
    jpeg = blob[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
    picture = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)[..., ::-1].astype(int)
    found = picture[(uv[:, 1] * picture.shape[0]).astype(int), (uv[:, 0] * picture.shape[1]).astype(int)]
    expected = photo[-position[:, 1].astype(int), position[:, 0].astype(int)].astype(int)
    assert np.median(np.abs(found - expected)) <= 3
    assert document["asset"]["extras"]["px_per_uv"] == surface.unit.tolist()
    top_left = (placed[:, 0] < -0.05) & (placed[:, 1] > 0.05)  # the photograph's upper left is red
    assert found[top_left, 0].mean() > 1.5 * found[top_left, 1].mean()
    assert document["materials"][0]["doubleSided"] and document["asset"]["version"] == "2.0"


def test_trimesh_reads_all(tmp_path: Path, surface: Mesh, arrays: dict) -> None:
    trimesh = pytest.importorskip("trimesh", reason="trimesh, a development dependency, reads the meshes back")
    photo = exports.to_display(arrays["image"]["rgb"])
    scene = trimesh.load_scene(io.BytesIO(exports.glb(surface, texture_of(surface, arrays), (90, 130), "")), file_type="glb")
    (model,) = scene.geometry.values()
    assert len(model.faces) == len(surface.faces)
    assert scene.bounds[1][0] - scene.bounds[0][0] == pytest.approx(np.ptp(surface.vertices[:, 0]) / 130, rel=1e-3)
    ply = trimesh.load(io.BytesIO(exports.ply(surface, photo, "surface.jpg")), file_type="ply", process=False)
    np.testing.assert_array_equal(ply.vertices, surface.vertices)
    np.testing.assert_array_equal(ply.faces, surface.faces)
    np.testing.assert_allclose(ply.vertex_normals, surface.normals, atol=1e-5)
    x, y = surface.vertices[:, 0].astype(int), -surface.vertices[:, 1].astype(int)
    data = exports.ply(surface, photo, "surface.jpg")
    header, _, body = data.partition(b"end_header\n")
    assert b"comment TextureFile surface.jpg" in header
    vertex = np.frombuffer(body, [("pn", "<f4", 6), ("rgb", "u1", 3), ("st", "<f4", 2)], len(surface.vertices))
    np.testing.assert_array_equal(vertex["rgb"], photo[y, x])
    np.testing.assert_allclose(vertex["st"], surface.uv * [1, -1] + [0, 1], atol=1e-6)
    (tmp_path / "surface.obj").write_bytes(exports.obj(surface, "surface.mtl"))
    (tmp_path / "surface.mtl").write_bytes(exports.mtl("surface.jpg"))
    (tmp_path / "surface.jpg").write_bytes(texture_of(surface, arrays))
    obj = trimesh.load(tmp_path / "surface.obj", process=False, maintain_order=True)
    np.testing.assert_allclose(obj.vertices, surface.vertices, atol=1e-3)
    np.testing.assert_array_equal(obj.faces, surface.faces)
    np.testing.assert_allclose(obj.visual.uv, surface.uv * [1, -1] + [0, 1], atol=1e-5)
    # trimesh opens textures with Pillow, which is not needed otherwise: the material names the file, OpenCV reads it
    named = (tmp_path / "surface.mtl").read_text().split("map_Kd ")[1].strip()
    assert cv2.imread(str(tmp_path / named)).shape[:2] == tuple(surface.size)


# ------------------------------------------------------------------------------------------------ display


def test_display_is_srgb_and_exposes_only_strange_scenes() -> None:
    v = np.linspace(0, 1, 4001, dtype="f4")
    exact = 255 * np.where(v <= 0.0031308, v * 12.92, 1.055 * v ** (1 / 2.4) - 0.055)
    assert np.abs(exports.to_display(v, 1.0) - exact).max() < 0.55
    ordinary = exports.to_display(np.full((4, 4, 3), 0.2159, "f4"))
    assert (ordinary == 128).all()  # photographs stay as they are
    for scale in (1e-3, 50):
        shown = exports.to_display(np.linspace(0, scale, 3000, dtype="f4").reshape(1000, 3))
        assert 240 < shown.max() and 178 <= np.median(shown) <= 182
    assert exports.to_display(np.array([-1, 2], "f4"), 1.0).tolist() == [0, 255]
