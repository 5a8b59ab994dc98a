"""Loading and finding images. Every file is written here, bytes by hand where no writer makes them."""

from __future__ import annotations

import base64
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import OpenImageIO as oiio
import pytest

from sftex_stages import images
from sftex_stages.errors import InputError
from sftex_stages.images import ImageItem, Params, discover, load_image, load_mask, run, summary

PIXELS = np.random.default_rng(0).integers(0, 256, (12, 17, 4), dtype=np.uint8)


def write(path: Path, pixels: np.ndarray, channels: str = "", **attributes: object) -> Path:
    """Write with OpenImageIO; `channels` names one channel a letter, attributes' __ stands for a colon."""
    kind = {"uint8": oiio.UINT8, "uint16": oiio.UINT16, "float32": oiio.FLOAT, "float16": oiio.HALF}[str(pixels.dtype)]
    h, w, n = pixels.shape
    spec = oiio.ImageSpec(w, h, n, kind)
    if channels:
        spec.channelnames = tuple(channels)
    for name, value in attributes.items():
        spec.attribute(name.replace("__", ":"), value)
    out = oiio.ImageOutput.create(str(path))
    assert out.open(str(path), spec), out.geterror()
    assert out.write_image(np.ascontiguousarray(pixels)), out.geterror()
    out.close()
    return path


def srgb(v: np.ndarray) -> np.ndarray:
    """The standard's curve, written a second time."""
    v = np.asarray(v, float)
    out = v / 12.92
    out[v > 0.04045] = ((v[v > 0.04045] + 0.055) / 1.055) ** 2.4
    return out


def png_chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


# ------------------------------------------------------------------------------------------------ values


@pytest.mark.parametrize("ending", ["png", "tif", "bmp", "tga"])
def test_eight_bit_srgb_is_linearised_exactly(tmp_path: Path, ending: str) -> None:
    rgb, mask = load_image(write(tmp_path / f"a.{ending}", PIXELS[..., :3]))
    np.testing.assert_allclose(rgb, srgb(PIXELS[..., :3] / 255), atol=1e-7)
    assert rgb.dtype == np.float32 and rgb.flags.c_contiguous and mask.all() and mask.shape == (12, 17)


@pytest.mark.parametrize("ending", ["png", "tif"])
def test_sixteen_bits_are_all_used(tmp_path: Path, ending: str) -> None:
    ramp = np.linspace(0, 65535, 12 * 17 * 3).astype(np.uint16).reshape(12, 17, 3)
    rgb, _ = load_image(write(tmp_path / f"a.{ending}", ramp))
    np.testing.assert_allclose(rgb, srgb(ramp / 65535), rtol=1e-5, atol=1e-8)


def test_half_grey_becomes_the_known_number(tmp_path: Path) -> None:
    rgb, _ = load_image(write(tmp_path / "a.tif", np.full((2, 3, 1), 32768, np.uint16)))
    np.testing.assert_allclose(rgb, 0.21404, atol=2e-5)
    assert rgb.shape == (2, 3, 3)


@pytest.mark.parametrize("ending", ["exr", "hdr", "tif"])
def test_linear_formats_are_left_alone(tmp_path: Path, ending: str) -> None:
    light = np.random.default_rng(1).uniform(0.1, 4, (6, 20, 3)).astype(np.float32)
    rgb, _ = load_image(write(tmp_path / f"a.{ending}", light))
    np.testing.assert_allclose(rgb, light, rtol=0, atol=0.02 if ending == "hdr" else 0)


def test_declared_curves_are_honoured_and_unknown_ones_refused(tmp_path: Path) -> None:
    plain = write(tmp_path / "a.png", PIXELS[..., :3]).read_bytes()
    plain = plain.replace(plain[plain.find(b"sRGB") - 4 : plain.find(b"sRGB") + 9], b"") if b"sRGB" in plain else plain

    def declared(name: str, kind: bytes, body: bytes) -> Path:
        (tmp_path / name).write_bytes(plain[:33] + png_chunk(kind, body) + plain[33:])
        return tmp_path / name

    v = PIXELS[..., :3] / 255
    linear, _ = load_image(declared("lin.png", b"gAMA", struct.pack(">I", 100000)))
    np.testing.assert_allclose(linear, v, atol=1e-7)
    gamma, _ = load_image(declared("g18.png", b"gAMA", struct.pack(">I", 55556)))
    np.testing.assert_allclose(gamma, v**1.8, atol=1e-5)
    with pytest.raises(InputError, match=r"colour space .*pq.* image\.color_space"):
        load_image(declared("pq.png", b"cICP", bytes([9, 16, 0, 1])))
    forced, _ = load_image(tmp_path / "pq.png", color_space="srgb")
    np.testing.assert_allclose(forced, srgb(v), atol=1e-7)


def png(depth: int, color_type: int, rows: list[bytes], width: int, *chunks: bytes) -> bytes:
    header = struct.pack(">IIBBBBB", width, len(rows), depth, color_type, 0, 0, 0)
    body = zlib.compress(b"".join(b"\0" + row for row in rows))
    parts = [png_chunk(b"IHDR", header), *chunks, png_chunk(b"IDAT", body), png_chunk(b"IEND", b"")]
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


def tiff(width: int, height: int, bits: int, samples: int, photometric: int, data: bytes) -> bytes:
    """Uncompressed little-endian TIFF; photometric 1 = black is zero, 5 = CMYK."""
    tags = [(256, width), (257, height), (258, bits), (259, 1), (262, photometric), (273, 8), (277, samples)]
    tags += [(278, height), (279, len(data)), (284, 1)]
    count = 4 if samples == 4 else 1  # BitsPerSample of all samples lies behind the pixels
    entries = b"".join(
        struct.pack("<HHIHH", tag, 3, 1, value, 0)
        if (tag, count) != (258, 4)
        else struct.pack("<HHII", tag, 3, 4, 8 + len(data))
        for tag, value in tags
    )
    tail = struct.pack("<4H", *[bits] * 4)
    start = struct.pack("<2sHI", b"II", 42, 8 + len(data) + len(tail))
    return start + data + tail + struct.pack("<H", len(tags)) + entries + bytes(4)


def test_grey_palette_and_one_bit(tmp_path: Path) -> None:
    grey = PIXELS[..., 0]
    expected = np.repeat(srgb(grey / 255)[..., None], 3, 2)
    np.testing.assert_allclose(load_image(write(tmp_path / "g.png", grey[..., None]))[0], expected, atol=1e-7)
    palette = np.random.default_rng(5).integers(0, 256, (256, 3), dtype=np.uint8)
    chunk = png_chunk(b"PLTE", palette.tobytes())
    (tmp_path / "p.png").write_bytes(png(8, 3, [r.tobytes() for r in grey], 17, chunk))
    np.testing.assert_allclose(load_image(tmp_path / "p.png")[0], srgb(palette[grey] / 255), atol=1e-7)
    bits = np.packbits(grey > 127, axis=1)
    (tmp_path / "b.png").write_bytes(png(1, 0, [r.tobytes() for r in bits], 17))
    (tmp_path / "b.tif").write_bytes(tiff(17, 12, 1, 1, 1, bits.tobytes()))
    for name in ("b.png", "b.tif"):
        np.testing.assert_array_equal(load_image(tmp_path / name)[0][..., 1], grey > 127)


#: An 8 × 8 CMYK JPEG as Photoshop and Pillow write them (inverted), of sRGB (200, 60, 30).
CMYK_JPEG = (
    "|JeWT01iQ9Z(?NtWB>pF0095n07C!`2?`4e2n`Dg3l0tq4-+626A}^=CmbFZATB8}FfJ)AEHgSvJ~K8(H!LkcS3yQhPEu1+GCo>iT2Nq0QBqI;zyK5o"
    "00;mG1Va%3O%VWD5dcdO0RO}Q6#xMN000000000000000000ID|HJ?k5CH%H0000000000000000095m01gC008Ic{080P>KLA)N2B$y&*#"
)


def test_cmyk(tmp_path: Path) -> None:
    (tmp_path / "c.jpg").write_bytes(base64.b85decode(CMYK_JPEG))
    ink = bytes(255 - v for v in (200, 60, 30)) + b"\0"
    (tmp_path / "c.tif").write_bytes(tiff(8, 8, 8, 4, 5, ink * 64))
    for name in ("c.jpg", "c.tif"):
        rgb, mask = load_image(tmp_path / name)
        np.testing.assert_allclose(rgb[4, 4], srgb(np.array([200, 60, 30]) / 255), atol=0.03)
        assert rgb.shape == (8, 8, 3) and mask.all()


def test_alpha_is_a_mask_and_does_not_darken(tmp_path: Path) -> None:
    v = srgb(PIXELS[..., :3] / 255)
    rgb, mask = load_image(write(tmp_path / "rgba.png", PIXELS, "RGBA", oiio__UnassociatedAlpha=1))
    np.testing.assert_array_equal(mask, PIXELS[..., 3] >= 128)
    np.testing.assert_allclose(rgb, v, atol=1e-7)
    rgb, mask = load_image(write(tmp_path / "ga.png", PIXELS[..., [0, 3]], "YA", oiio__UnassociatedAlpha=1))
    np.testing.assert_array_equal(mask, PIXELS[..., 3] >= 128)
    np.testing.assert_allclose(rgb[..., 2], v[..., 0], atol=1e-7)
    alpha = PIXELS[..., 3:] / np.float32(255)
    light = np.concatenate([v * alpha, alpha], axis=2).astype(np.float32)
    rgb, mask = load_image(write(tmp_path / "rgba.exr", light, "RGBA"))  # EXR stores colour multiplied by alpha
    np.testing.assert_allclose(rgb[mask], v[mask], rtol=1e-5)


def test_pixels_that_are_not_finite_are_masked(tmp_path: Path) -> None:
    light = np.ones((5, 6, 3), np.float32)
    light[1, 2, 0], light[3, 4, 1], light[0, 0, 2] = np.nan, np.inf, -np.inf
    rgb, mask = load_image(write(tmp_path / "a.exr", light))
    assert sorted(zip(*np.nonzero(~mask), strict=True)) == [(0, 0), (1, 2), (3, 4)]
    assert np.isfinite(rgb).all() and (rgb[mask] == 1).all()


@pytest.mark.parametrize("orientation", range(1, 9))
def test_exif_orientation(tmp_path: Path, orientation: int) -> None:
    upright = PIXELS[..., :3]
    stored = {  # how a camera stores the upright picture for each EXIF value (row 0, column 0 are at …)
        1: upright,  # top left
        2: upright[:, ::-1],  # top right
        3: upright[::-1, ::-1],  # bottom right
        4: upright[::-1],  # bottom left
        5: upright.transpose(1, 0, 2),  # left top
        6: upright.transpose(1, 0, 2)[::-1],  # right top
        7: upright.transpose(1, 0, 2)[::-1, ::-1],  # right bottom
        8: upright.transpose(1, 0, 2)[:, ::-1],  # left bottom
    }[orientation]
    rgb, mask = load_image(write(tmp_path / "a.tif", stored, Orientation=orientation))
    np.testing.assert_allclose(rgb, srgb(upright / 255), atol=1e-7)
    assert mask.shape == upright.shape[:2]


def test_content_decides_not_the_ending(tmp_path: Path) -> None:
    data = write(tmp_path / "a.png", PIXELS[..., :3]).read_bytes()
    for name in ("wrong.jpg", "none"):
        (tmp_path / name).write_bytes(data)
        np.testing.assert_allclose(load_image(tmp_path / name)[0], srgb(PIXELS[..., :3] / 255), atol=1e-7)


# ------------------------------------------------------------------------------------------------ bad input


def test_bad_files_are_named_with_what_to_do(tmp_path: Path) -> None:
    (tmp_path / "empty.png").touch()
    (tmp_path / "text.png").write_text("not a picture\n" * 20)
    (tmp_path / "noise.jpg").write_bytes(bytes(range(256)) * 4)
    (tmp_path / "photo.heic").write_bytes(b"\0\0\0\x18ftypheic" + bytes(100))
    for name, words in {
        "empty.png": "empty",
        "text.png": "holds text.*convert it to PNG",
        "noise.jpg": "not an image.*convert",
        "photo.heic": "HEIC.*convert",
        "missing.png": "cannot be read",
        ".": "cannot be read",
    }.items():
        with pytest.raises(InputError, match=words) as e:
            load_image(tmp_path / name)
        assert str(tmp_path / name) in str(e.value)


@pytest.mark.parametrize("ending", ["png", "jpg", "tif", "exr", "bmp", "webp"])
def test_truncated_files_are_refused(tmp_path: Path, ending: str) -> None:
    noise = np.random.default_rng(2).integers(0, 256, (60, 80, 3), dtype=np.uint8)
    pixels = noise.astype(np.float32) if ending == "exr" else noise
    data = write(tmp_path / f"whole.{ending}", pixels).read_bytes()
    load_image(tmp_path / f"whole.{ending}")
    for part in (0.3, 0.9):
        (tmp_path / f"cut.{ending}").write_bytes(data[: int(len(data) * part)])
        with pytest.raises(InputError, match=r"cut\.\w+: (the file is damaged or cut short|not an image)"):
            load_image(tmp_path / f"cut.{ending}")


def test_stray_bytes_between_jpeg_segments_do_no_harm(tmp_path: Path) -> None:
    data = write(tmp_path / "a.jpg", PIXELS[..., :3]).read_bytes()
    at = data.find(b"\xff\xdb")
    (tmp_path / "b.jpg").write_bytes(data[:at] + b"\0\1\2" + data[at:])
    np.testing.assert_array_equal(load_image(tmp_path / "b.jpg")[0], load_image(tmp_path / "a.jpg")[0])


def test_size_limit_holds_before_pixels_are_read(tmp_path: Path) -> None:
    header = png_chunk(b"IHDR", struct.pack(">IIBBBBB", 9000, 9000, 1, 0, 0, 0, 0))  # one bit a pixel: 10 kB
    body = png_chunk(b"IDAT", zlib.compress(bytes(9000 * 1126))) + png_chunk(b"IEND", b"")
    (tmp_path / "bomb.png").write_bytes(b"\x89PNG\r\n\x1a\n" + header + body)
    with pytest.raises(InputError, match=r"9000 × 9000 = 81\.0 megapixels.*image\.max_megapixels"):
        load_image(tmp_path / "bomb.png")
    write(tmp_path / "a.png", PIXELS[..., :3])
    with pytest.raises(InputError, match="over the limit"):
        load_image(tmp_path / "a.png", max_megapixels=1e-4)


def test_depth_maps_are_no_photographs(tmp_path: Path) -> None:
    write(tmp_path / "uv.exr", np.ones((4, 5, 2), np.float32), "UV")
    with pytest.raises(InputError, match="no R, G, B or grey channel"):
        load_image(tmp_path / "uv.exr")


# ------------------------------------------------------------------------------------------------ the stage, masks


def test_stage_combines_the_masks(tmp_path: Path) -> None:
    image = write(tmp_path / "a.png", PIXELS, "RGBA", oiio__UnassociatedAlpha=1)
    painted = np.zeros((12, 17, 1), np.uint8)
    painted[3:9, 4:] = 1  # 0/1 as label programs write it
    out = images.STAGE.run({"image": image, "mask": write(tmp_path / "m.png", painted)}, Params())
    np.testing.assert_array_equal(out["mask"], (painted[..., 0] > 0) & (PIXELS[..., 3] >= 128))
    assert out["rgb"].shape == (12, 17, 3) and images.STAGE.files == ("image", "mask")
    assert run({"image": image, "mask": None}, Params())["mask"].sum() == (PIXELS[..., 3] >= 128).sum()


def test_mask_of_another_size_names_both(tmp_path: Path) -> None:
    image = write(tmp_path / "a.png", PIXELS[..., :3])
    mask = write(tmp_path / "a.mask.png", np.full((12, 16, 1), 255, np.uint8))
    with pytest.raises(InputError, match=r"a\.mask\.png: the mask is 16 × 12 pixels but .*a\.png is 17 × 12"):
        run({"image": image, "mask": mask}, Params())


def test_black_masks_and_transparent_images_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="black all over"):
        load_mask(write(tmp_path / "black.png", np.zeros((4, 4, 1), np.uint8)))
    clear = write(tmp_path / "clear.png", PIXELS * np.array([1, 1, 1, 0], np.uint8), "RGBA", oiio__UnassociatedAlpha=1)
    with pytest.raises(InputError, match="no pixel is left"):
        run({"image": clear, "mask": None}, Params())


# ------------------------------------------------------------------------------------------------ discovery


def touch(folder: Path, *names: str) -> None:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(b"x")


def test_folder_takes_images_only(tmp_path: Path) -> None:
    touch(tmp_path, "b.png", "A.JPG", "a.mask.png", "c.truth.h5", ".hid.png", "notes.txt", "sub/d.png", "e.exr")
    touch(tmp_path, "f.heic", "twin.cr2", "twin.jpg")
    items = discover(tmp_path)
    assert [i.path.name for i in items] == ["A.JPG", "b.png", "e.exr", "f.heic", "twin.jpg"]
    assert items[0] == ImageItem("A", tmp_path / "A.JPG", tmp_path / "a.mask.png")
    assert summary(items) == "5 images, 1 with a mask"


def test_files_globs_and_lists(tmp_path: Path) -> None:
    touch(tmp_path, "a.png", "b.png", "x/c.png", "odd[1].png", "noending", "b.mask.png", "b.truth.h5")
    assert [i.name for i in discover(f"{tmp_path}/*")] == ["a", "b", "odd[1]"]
    assert [i.name for i in discover(f"{tmp_path}/**/*.png")] == ["a", "b", "odd[1]", "c"]
    assert [i.name for i in discover(str(tmp_path / "odd[1].png"))] == ["odd[1]"]
    several = [tmp_path / "noending", f"{tmp_path}/a*", tmp_path / "a.png"]
    assert [i.name for i in discover(several)] == ["a", "noending"]


def test_equal_stems_get_names_of_their_own(tmp_path: Path) -> None:
    touch(tmp_path, "a.png", "a.jpg", "A.tif", "x/b.png", "y/b.png", "b.exr", "x/b_exr.png")
    names = [i.name for i in discover([tmp_path, tmp_path / "x", tmp_path / "y"])]
    assert len({n.lower() for n in names}) == 7
    assert names == ["A_tif", "a_jpg", "a_png", f"{tmp_path.name}_b_exr", "x_b_png", "x_b_exr", "y_b_png"]
    assert names == [i.name for i in discover([tmp_path / "y", tmp_path / "x", tmp_path])]


def test_masks_folder(tmp_path: Path) -> None:
    touch(tmp_path, "i/a.jpg", "i/b.png", "i/c.png", "i/c.mask.png", "m/a.png", "m/B.MASK.PNG", "n/z.png")
    items = discover(tmp_path / "i", tmp_path / "m")
    assert [i.mask and i.mask.name for i in items] == ["a.png", "B.MASK.PNG", None]
    assert [i.mask for i in discover(tmp_path / "i", tmp_path / "i")] == [None, None, tmp_path / "i/c.mask.png"]
    with pytest.raises(InputError, match="no mask matches any of the 3"):
        discover(tmp_path / "i", tmp_path / "n")
    with pytest.raises(InputError, match="no such folder of masks"):
        discover(tmp_path / "i", tmp_path / "nowhere")


def test_nothing_found_says_so(tmp_path: Path) -> None:
    touch(tmp_path, "only.mask.png", "t.h5")
    for item, words in {
        str(tmp_path): "no image in this folder",
        f"{tmp_path}/*.jpg": "no image matches",
        str(tmp_path / "gone.png"): "no such file",
        str(tmp_path / "only.mask.png"): "this is a mask",
    }.items():
        with pytest.raises(InputError, match=words):
            discover(item)
    with pytest.raises(InputError, match="no images given"):
        discover([])


def test_decoding_agrees_with_a_second_decoder(tmp_path: Path) -> None:
    smooth = cv2.resize(PIXELS[..., :3], (170, 120), interpolation=cv2.INTER_CUBIC)
    write(tmp_path / "a.jpg", smooth, CompressionQuality=90)
    other = cv2.imread(str(tmp_path / "a.jpg"))[..., ::-1]
    np.testing.assert_allclose(load_image(tmp_path / "a.jpg")[0], srgb(other / 255), atol=0.03)


@pytest.mark.parametrize(
    ("data", "focal"),
    [
        ({"Exif:FocalLengthIn35mmFilm": 50}, 50 * np.hypot(300, 200) / np.hypot(36, 24)),
        ({"Exif:FocalLength": 24.0, "Exif:FocalPlaneXResolution": 2540.0, "Exif:FocalPlaneResolutionUnit": 2}, 2400.0),
        ({"Exif:FocalLength": 24.0, "Exif:FocalPlaneXResolution": 1000.0, "Exif:FocalPlaneResolutionUnit": 3,
          "Exif:PixelXDimension": 600}, 1200.0),
        ({"Exif:FocalLength": 24.0}, None),
        ({}, None),
    ],
)  # fmt: skip
def test_focal_length_comes_from_the_exif_data(tmp_path, data, focal):
    path = tmp_path / "photo.jpg"
    spec = oiio.ImageSpec(300, 200, 3, oiio.UINT8)
    for name, value in data.items():
        spec.attribute(name, "int" if isinstance(value, int) else "float", value)
    out = oiio.ImageOutput.create(str(path))
    assert out.open(str(path), spec) and out.write_image(np.full((200, 300, 3), 128, np.uint8)) and out.close()
    arrays = images.run({"image": path, "mask": None}, images.Params())
    if focal is None:
        assert "focal_px" not in arrays
    else:
        assert float(arrays["focal_px"]) == pytest.approx(focal, rel=1e-3)
