"""Prints, lights and views: what is laid on a known surface is where geometry says, and the rest of the picture stays."""

from __future__ import annotations

import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from sftex_stages import cli
from sftex_stages.errors import InputError
from sftex_stages.results import archive, cloth, dress, exports, light, retexture

H, W = 90, 130


def checks(cell: int = 16) -> np.ndarray:
    y, x = np.mgrid[: 2 * cell, : 2 * cell]
    return np.repeat(((x // cell + y // cell) % 2).astype("f4")[..., None], 3, 2)


def plane() -> tuple[np.ndarray, np.ndarray]:
    """The chart of a plane leaning by 60° to the right: u runs twice as fast as x."""
    y, x = np.mgrid[:H, :W].astype("f4")
    return np.dstack([2 * x, y]), np.ones((H, W), bool)


# ------------------------------------------------------------------------------------------------ retexture


def test_a_print_lies_where_the_chart_says() -> None:
    chart, valid = plane()
    wide = np.zeros((8, 64, 1), "f4")
    wide[:, :32] = 1  # stripes 32 px wide on the surface, 16 in the image
    found = retexture.print_on(chart, valid, wide)[..., 0]
    x = np.arange(W)
    inside = (x % 16 > 1) & (x % 16 < 14)
    np.testing.assert_allclose(found[:, inside], np.tile(x[inside] // 16 % 2 == 0, (H, 1)), atol=0.02)
    moved = retexture.print_on(chart, valid, wide, shift=(32.0, 0.0))[..., 0]
    np.testing.assert_allclose(moved, 1 - found, atol=0.02)
    twice = retexture.print_on(chart, valid, wide, tile_px=128)[..., 0]
    np.testing.assert_allclose(twice[:, 3:29], 1, atol=0.02)
    turned = retexture.print_on(chart, valid, wide, turn=90)[..., 0]  # now they lie flat
    assert np.ptp(turned, axis=1).max() < 0.02 and turned[4:28].min() > 0.9 and turned[36:60].max() < 0.1


def test_small_prints_turn_to_their_mean_not_to_moire() -> None:
    chart, valid = plane()
    for tile in (3.1, 1.7, 0.9):
        found = retexture.print_on(chart, valid, checks(), tile)[:, :, 0]
        coarse = found[:84, :120].reshape(7, 12, 10, 12).mean((1, 3))
        assert np.abs(coarse - 0.5).max() < 0.03, tile
        assert np.abs(found - 0.5).max() < (0.35 if tile > 3 else 0.12), tile  # 0.3 is a pixel's own mean
    large = retexture.print_on(chart, valid, checks(), 40.0)
    assert np.ptp(large) > 0.95 and abs(large.mean() - 0.5) < 0.05


def test_repetitions_meet_without_a_seam() -> None:
    wave = np.tile(0.5 + 0.5 * np.cos(2 * np.pi * np.arange(30) / 30), (30, 1))[..., None].astype("f4")
    chart = np.dstack(np.meshgrid(np.arange(W, dtype="f4"), np.arange(H, dtype="f4")))
    found = retexture.print_on(chart, np.ones((H, W), bool), wave)[..., 0]
    expected = 0.5 + 0.5 * np.cos(2 * np.pi * np.arange(W) / 30)
    np.testing.assert_allclose(found, np.tile(expected, (H, 1)), atol=0.02)


def test_nothing_is_printed_off_the_surface_or_where_the_chart_is_nonsense() -> None:
    chart, valid = plane()
    valid[:20] = False
    chart[30, 40], chart[50, 60] = np.nan, 1e30
    found = retexture.print_on(chart, valid, np.ones((4, 4, 3), "f4"))
    assert not found[:20].any() and not found[30, 40].any() and not found[50, 60].any()
    np.testing.assert_allclose(found[60:], 1, atol=1e-5)


# ------------------------------------------------------------------------------------------------ light


def test_photograph_is_albedo_times_irradiance(arrays: dict) -> None:
    image, field, valid = arrays["image"]["rgb"], arrays["irradiance"]["map"], arrays["surface"]["valid"]
    bare = light.albedo(image, field, valid)
    assert np.array_equal(np.isfinite(bare).all(2), valid)
    np.testing.assert_allclose((bare * field[..., None])[valid], image[valid], rtol=1e-5)


def test_another_light_follows_lambert(arrays: dict) -> None:
    normals, valid = arrays["surface"]["normals"], arrays["surface"]["valid"]
    found = light.shine(normals, np.array([0, -2.0, 2.0]), 0.25)[valid]
    cosine = (normals[valid] @ [0, -1, 1]) / np.sqrt(2)
    np.testing.assert_allclose(found, 0.25 + 0.75 * np.maximum(cosine, 0), rtol=1e-5)


def test_blending_leaves_the_background_alone(arrays: dict) -> None:
    image, valid = arrays["image"]["rgb"], arrays["surface"]["valid"]
    out = light.blend(image, np.full_like(image, 9), valid)
    np.testing.assert_array_equal(out[~valid], image[~valid])
    inside = cv2.erode(valid.astype(np.uint8), np.ones((9, 9), np.uint8), borderValue=1) > 0
    assert (out[inside] == 9).all() and inside.sum() > 0.5 * valid.sum()


# ------------------------------------------------------------------------------------------------ cloth and dress


def blue_cloth() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A blue cloth with white dots on a grey ground: picture, where the cloth is, what of it is supported."""
    rng = np.random.default_rng(0)
    y, x = np.mgrid[:200, :300]
    there = (np.abs(x - 150) < 100) & (np.abs(y - 100) < 70)
    dots = ((x % 24 - 12) ** 2 + (y % 24 - 12) ** 2) < 40
    picture = np.where(there[..., None], np.where(dots[..., None], [0.8, 0.8, 0.7], [0.05, 0.1, 0.4]), 0.2)
    picture = picture + rng.normal(0, 0.005, picture.shape)
    valid = (np.abs(x - 150) < 92) & (np.abs(y - 100) < 63) & ((x - 120) ** 2 + (y - 90) ** 2 > 200)
    return np.clip(picture, 0, 1).astype("f4"), there, valid


def test_the_outline_of_the_cloth_is_found() -> None:
    picture, there, valid = blue_cloth()
    found = cloth.outline(picture, valid)
    assert (found & valid).sum() == valid.sum()
    assert (found & ~there).sum() < 0.01 * there.sum() and (there & ~found).sum() < 0.02 * there.sum()
    masked = cloth.outline(picture, valid, there & (np.arange(300) < 245))
    assert not (masked & ~valid)[:, 245:].any()
    full = np.ones((200, 300), bool)
    full[50, 50] = False
    assert cloth.outline(picture, full).all()  # nothing but cloth: no background to tell it from


@pytest.fixture
def result_file(tmp_path: Path, arrays: dict, meta: dict) -> Path:
    rgb = arrays["image"]["rgb"]
    arrays["image"]["rgb"] = cv2.GaussianBlur(rgb, (0, 0), 2)
    (tmp_path / "result.h5").write_bytes(archive.encode(arrays, meta))
    return tmp_path / "result.h5"


def test_the_surface_goes_on_over_holes(result_file: Path) -> None:
    result = archive.open_result(result_file)
    on = dress.continued(result)
    assert on.there[30, 32] and not result.valid[30, 32]  # the hole in the left dome
    np.testing.assert_array_equal(on.height[result.valid], result.height[result.valid])
    y, x = np.mgrid[26:35, 28:37]
    true = 25 * (1 - ((x - 32) / 40) ** 2 / 2 - ((y - 45) / 45) ** 2 / 2)
    assert np.abs(on.height[26:35, 28:37] - true).max() < 0.5
    ends = on.chart[30, 20:45, 0]
    assert (np.diff(ends) > 0.8).all() and (np.diff(ends) < 1.4).all()  # the print runs through
    assert np.isfinite(on.irradiance[on.there]).all() and np.abs(np.linalg.norm(on.normals, axis=2)[on.there] - 1).max() < 1e-3


def test_nonsense_in_a_result_is_an_error_or_left_out(tmp_path: Path, arrays: dict, meta: dict) -> None:
    for name, value in (("uv", np.inf), ("uv", 1e20)):
        bad = {**arrays, "chart": {**arrays["chart"], name: np.full((H, W, 2), value, "f4")}}
        (tmp_path / "r.h5").write_bytes(archive.encode(bad, meta))
        with pytest.raises(InputError, match=r"r\.h5: no pixel of it has a surface"):
            dress.continued(archive.open_result(tmp_path / "r.h5"))
    rng = np.random.default_rng(0)
    spoiled = np.where(rng.random((H, W)) < 0.05, rng.choice([np.nan, np.inf, -1, 1e38, 0], (H, W)), 1)
    arrays["irradiance"]["map"] = (arrays["irradiance"]["map"] * spoiled).astype("f4")
    with np.errstate(invalid="ignore"):
        arrays["surface"]["normals"] = (arrays["surface"]["normals"] * spoiled[..., None]).astype("f4")
    (tmp_path / "r.h5").write_bytes(archive.encode(arrays, meta))
    on = dress.continued(archive.open_result(tmp_path / "r.h5"))
    assert np.isfinite(dress.composed(on, on.albedo, dress.lit(on, np.array([0, 0, 1.0]), 0.1))).all()


# ------------------------------------------------------------------------------------------------ the command


def run(*words: object) -> int:
    return cli.main(["render", *map(str, words)])


def read(path: Path) -> np.ndarray:
    return cv2.imread(str(path), cv2.IMREAD_UNCHANGED)[..., ::-1]


def test_the_command_makes_each_kind_of_picture(result_file: Path, tmp_path: Path, capfd: pytest.CaptureFixture) -> None:
    cv2.imwrite(str(tmp_path / "print.png"), np.full((5, 7, 3), (0, 0, 255), np.uint8))  # red
    result = archive.open_result(result_file)
    photo = exports.to_display(result.image)
    out = tmp_path / "new.png"
    assert run(tmp_path, "--texture", tmp_path / "print.png", "--tile-px", 30, "-o", out) == 0
    new = read(out)
    assert new.shape == (H, W, 3) and new[45, 30, 0] > 60 and new[45, 30, 1:].max() < 3
    brightness = exports.to_display(np.nan_to_num(result.irradiance[45]) * np.float32(light.white(light.albedo(
        result.image, result.irradiance, result.valid))), exports.usual_exposure(result.image))  # fmt: skip
    inside = np.r_[5:55, 75:125]
    assert np.abs(new[45, inside, 0].astype(int) - brightness[inside]).max() <= 2  # the light has stayed
    assert run(result_file, "--light", "-1,0,0.7", "--ambient", "0.1", "-o", out) == 0
    lit = read(out).astype(int)
    assert (lit - photo)[20:70, 5:25].mean() > (lit - photo)[20:70, 40:60].mean() + 10  # the left side of the left dome
    assert run(result_file, "--view", "-30,15", "--light", "0,0,1", "-o", tmp_path / "view.jpg") == 0
    assert cv2.imread(str(tmp_path / "view.jpg")).std() > 5
    assert run(result_file, "--light", "0,0,1", "-o", tmp_path / "new.exr") == 0
    assert (tmp_path / "new.exr").stat().st_size > 1000
    assert "new.png written" in capfd.readouterr().err


@pytest.mark.parametrize(
    "words, message",
    [
        (["-o", "x.png"], "nothing to do: give --texture, --light or --view"),
        (["--light", "1,2", "-o", "x.png"], "'1,2' is not 3 numbers"),
        (["--light", "0,0,0", "-o", "x.png"], "no direction"),
        (["--light", "nan,0,1", "-o", "x.png"], "is not 3 numbers"),
        (["--light", "0,0,-1", "-o", "x.png"], "falls on no part of the surface"),
        (["--light", "0,0,1", "--ambient", "2", "-o", "x.png"], r"2 is not a share \(0 to 1\)"),
        (["--ambient", "0.5", "--view", "1,2", "-o", "x.png"], "--ambient means nothing without --light"),
        (["--tile-px", "5", "--view", "1,2", "-o", "x.png"], "--tile-px means nothing without --texture"),
        (["--view", "85,0", "-o", "x.png"], "within ±80 degrees"),
        (["--view", "10,0", "-o", "x.exr"], "views are made for the screen"),
        (["--view", "10,0", "-o", "x.tiff"], "must end in one of"),
        (["--view", "10,0", "-o", "gone/x.png"], "gone: no such folder"),
        (["--texture", "none.png", "-o", "x.png"], "none.png: cannot be read"),
        (["--texture", "result.h5", "-o", "x.png"], "result.h5: not an image"),
    ],
)
def test_what_is_wrong_is_said(
    result_file: Path, words: list[str], message: str, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture
) -> None:
    monkeypatch.chdir(result_file.parent)
    try:
        code = run("result.h5", *words)
    except SystemExit as stop:  # argparse
        code = int(str(stop.code))
    error = capfd.readouterr().err
    assert code == cli.USAGE
    assert re.search(message, error), error
    assert not [p for p in result_file.parent.iterdir() if p.stem == "x"]


def test_other_files_are_refused(tmp_path: Path, capfd: pytest.CaptureFixture) -> None:
    (tmp_path / "result.h5").write_bytes(b"no archive")
    assert run(tmp_path, "--view", "1,2", "-o", tmp_path / "x.png") == cli.USAGE
    assert "result.h5: not a whole result file" in capfd.readouterr().err
