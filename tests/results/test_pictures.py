"""The pictures: not whether they are beautiful, but whether they show what is so."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from sftex_stages.results import pictures
from sftex_stages.results.render import BACKGROUND


def one_instance(trust: float, transform: np.ndarray, normal: list[float]) -> dict[str, np.ndarray]:
    return {
        "instance/xy": np.array([[100, 60]], "f4"),
        "instance/transform": transform[None].astype("f4"),
        "instance/normal": np.array([normal], "f4"),
        "instance/inlier": np.array([trust], "f4"),
        "instance/state": np.array([[1, 0, 0]], "f4"),
        "instance/texton": np.array([0], "i4"),
    }


def drawn(trust: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A circle at slant 60° leaning right, on black: the picture, x and y of its coloured pixels in photograph px."""
    tilted = one_instance(trust, np.diag([0.5, 1.0]), [np.sqrt(0.75), 0, 0.5])
    picture = pictures.instances(np.zeros((120, 200, 3), np.uint8), tilted, size=800)[: 120 * 4]
    y, x = np.nonzero(np.ptp(picture.astype(int), axis=2) > 60)
    return picture, x / 4 - 0.375, y / 4 - 0.375


def test_instances_are_ellipses_at_their_slant_with_a_normal() -> None:
    _, x, y = drawn(1.0)
    ring = np.abs(y - 60) > 1.0  # without the stroke
    radius = 0.03 * 200
    assert np.ptp(y) / 2 == pytest.approx(radius, abs=0.5) and y.mean() == pytest.approx(60, abs=0.3)
    assert x[ring].min() == pytest.approx(100 - radius / 2, abs=0.5)
    assert x[ring].max() == pytest.approx(100 + radius / 2, abs=0.5)
    assert x.max() == pytest.approx(100 + 1.25 * radius * np.sqrt(0.75), abs=0.5)  # the normal leans to the right


def test_colour_tells_the_posterior() -> None:
    def hue(trust: float) -> np.ndarray:
        picture, x, y = drawn(trust)
        return picture[np.round((y + 0.375) * 4).astype(int), np.round((x + 0.375) * 4).astype(int)].mean(0)

    sure, doubtful, rejected = hue(1.0), hue(0.5), hue(0.0)
    assert sure[1] > 2 * sure[0] and rejected[0] > 2 * rejected[1]
    assert doubtful[0] > 2 * doubtful[2] and doubtful[1] > 2 * doubtful[2]


def test_circles_grow_with_the_distance_of_neighbours(arrays: dict) -> None:
    xy = np.stack(np.meshgrid(np.arange(5, 500, 20), np.arange(5, 400, 20)), -1).reshape(-1, 2)
    assert pictures._radius(xy, (400, 500)) == pytest.approx(9)
    photo = np.zeros((90, 130, 3), np.uint8)
    picture = pictures.instances(photo, arrays["surface"])
    empty = pictures.instances(photo, {k: v[:0] for k, v in arrays["surface"].items() if k.startswith("instance/")})
    assert picture.shape == empty.shape and picture.shape[1] == 130 * 4
    changed = (picture.astype(int) - empty).any(2)
    some = pictures._apart(
        arrays["surface"]["instance/xy"], 2 * pictures._radius(arrays["surface"]["instance/xy"], (90, 130))
    )
    assert 20 < len(some) < 40
    for x, y in arrays["surface"]["instance/xy"][some]:
        assert changed[int(y * 4) - 2 : int(y * 4) + 6, int(x * 4) - 2 : int(x * 4) + 6].any()


def texts(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, tuple[int, int]]]:
    seen: list[tuple[str, tuple[int, int]]] = []
    real = pictures._write

    def spy(picture: np.ndarray, text: str, at: tuple[int, int], *rest: int) -> int:
        seen.append((text, at))
        end = real(picture, text, at, *rest)
        assert end <= picture.shape[1] and at[1] < picture.shape[0], f"{text!r} leaves the picture"
        return end

    monkeypatch.setattr(pictures, "_write", spy)
    return seen


def test_textons_are_ordered_and_named(arrays: dict, monkeypatch: pytest.MonkeyPatch) -> None:
    seen = texts(monkeypatch)
    arrays["frontal"].insert(0, arrays["frontal"][1])
    picture = pictures.textons(arrays["frontal"], np.array([0, 25, 15, 0]))
    words = [t for t, _ in seen]
    assert words[0] == "4 textons, 1 usable, 40 instances"
    assert [w for w in words if w.startswith("texton ")] == ["texton 1", "texton 2", "texton 0"]
    assert "25 instances" in words and words.count("residual 0.08 ≥ 0.03") == 2
    assert words[-1] == "not shown: 1 cluster without an appearance (2 members)"
    assert [w for w in words if "after" in w or "iterations" in w] == ["after 1", "20 iterations"]
    x, y = next(at for t, at in seen if t == "texton 1")
    tile = picture[y - 15 : y + 61, x - 4 * 82 - 4 : x - 4 * 82 + 72]
    expected = cv2.resize(arrays["frontal"][1]["progress"][0], (76, 76), interpolation=cv2.INTER_CUBIC)
    assert np.corrcoef(tile.ravel(), np.clip(expected, 0, 1).ravel())[0, 1] > 0.9


def test_many_textons_and_none(arrays: dict) -> None:
    many = pictures.textons([arrays["frontal"][0]] * 240, np.full(240, 9))
    assert 0.4 < many.shape[1] / many.shape[0] < 2.5
    assert pictures.textons([], np.zeros(0)).shape[2] == 3
    assert pictures.textons([arrays["frontal"][2]] * 30, np.zeros(30)).shape[0] < 200


def test_normal_map_colours() -> None:
    normals = np.array(
        [[[0, 0, 1], [1, 0, 0], [0, -1, 0], [np.nan] * 3]], "f4"
    )  # viewer, right, up (y is down), nothing
    valid = np.array([[True, True, True, False]])
    assert pictures.normal_map(normals, valid)[0].tolist() == [
        [128, 128, 255],
        [255, 128, 128],
        [128, 255, 128],
        [*BACKGROUND],
    ]


def test_irradiance_is_monotone_and_calm_when_constant(monkeypatch: pytest.MonkeyPatch) -> None:
    seen = texts(monkeypatch)
    ramp = np.exp(np.linspace(-1.2, 1.2, 300))[None].repeat(200, 0).astype("f4")
    valid = np.ones(ramp.shape, bool)
    valid[:, :10] = False
    ramp[:, :10] = np.nan
    row = pictures.irradiance(ramp, valid)[100, :300].astype(float)
    assert (row[5] == BACKGROUND).all()
    brightness = row[12:] @ [0.2126, 0.7152, 0.0722]
    assert (np.diff(brightness) > -1.5).all() and brightness[-1] > brightness[0] + 150
    ticks = [float(t) for t, _ in seen if t.replace(".", "").isdigit()]
    assert 1.0 in ticks and 4 <= len(ticks) <= 10 and ticks == sorted(ticks)
    noise = np.exp(np.random.default_rng(0).normal(0, 0.005, (200, 300)))
    flat = pictures.irradiance(noise, np.ones((200, 300), bool))[:, :300]
    assert flat.std(axis=(0, 1)).max() < 12


@pytest.mark.parametrize(
    "low, high", [(0.97, 1.06), (0.2, 5), (1e-3, 40), (0.9, 1.1), (0.5, 1.49), (0.5, 1.51), (0.91, 1.09)]
)
def test_ticks_are_few_round_and_inside(low: float, high: float) -> None:
    ticks = pictures._ticks(low, high)
    assert 3 <= len(ticks) <= 10 and all(low <= t <= high for t in ticks)
    assert max(np.diff(np.log([low, *ticks, high]))) < 0.62 * np.log(high / low)
    assert all(len(f"{t:g}".replace(".", "").strip("0")) <= 3 for t in ticks)


def test_crowds_are_thinned_evenly() -> None:
    xy = np.random.default_rng(1).uniform(0, 300, (5000, 2))
    some = pictures._apart(xy, 20)
    gaps = np.linalg.norm(xy[some][:, None] - xy[some][None], axis=2) + 1e9 * np.eye(len(some))
    assert gaps.min() > 17
    assert np.linalg.norm(xy[:, None] - xy[some][None], axis=2).min(1).max() < 25  # nowhere is a gap left
