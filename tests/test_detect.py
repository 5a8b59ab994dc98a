"""Detection on drawn dots and glyphs whose places are known."""

import cv2
import numpy as np
import pytest
from synthetic import glyph, image_of, render

from sftex_stages import detect
from sftex_stages.errors import StageError


@pytest.fixture(scope="module")
def scene():
    return render(size=256)


@pytest.fixture(scope="module")
def found(scene):
    return detect.run({"image": image_of(scene)}, detect.Params())


def blobs(shape, centres, sigmas):
    """Linear rgb of dark Gaussian blobs at `centres` on white, integrated over every pixel."""
    fine = (np.arange(max(shape) * 4) + 0.5) / 4 - 0.5
    image = np.ones((*shape, 3), np.float32)
    for (x, y), sigma in zip(centres, sigmas, strict=True):
        across, down = (np.exp(-((fine - c) ** 2) / (2 * sigma**2)).reshape(-1, 4).mean(1) for c in (x, y))
        image -= 0.7 * np.outer(down[: shape[0]], across[: shape[1]])[..., None].astype(np.float32)
    return image


def image(rgb):
    return {"rgb": rgb, "mask": np.ones(rgb.shape[:2], bool)}


def encoded(rgb):
    return detect.encode(rgb, np.ones(rgb.shape[:2], bool))


def test_arrays_are_those_of_the_contract(found):
    n = len(found["xy"])
    kinds = {name: (array.dtype.name, array.shape) for name, array in found.items()}
    assert kinds == {
        "xy": ("float32", (n, 2)),
        "frame": ("float32", (n, 2, 2)),
        "descriptor": ("float32", (n, 128)),
        "kind": ("uint8", (n,)),
    }
    assert set(found["kind"]) == {0, 1}
    assert all(np.isfinite(a).all() for a in found.values())
    assert np.linalg.norm(found["descriptor"], axis=1) == pytest.approx(np.ones(n), abs=1e-3)


def test_same_bytes_with_any_number_of_threads(scene, found):
    threads = cv2.getNumThreads()
    for count in (1, 3):
        cv2.setNumThreads(count)
        try:
            again = detect.run({"image": image_of(scene)}, detect.Params())
        finally:
            cv2.setNumThreads(threads)
        assert all(again[name].tobytes() == found[name].tobytes() for name in found)


def test_points_come_in_reading_order_before_regions(found):
    kind = found["kind"]
    assert (np.diff(kind.astype(int)) >= 0).all()
    y, x = found["xy"][kind == 0].astype(np.float64).T[::-1]
    assert (np.diff(y) >= 0).all()
    assert (np.diff(x)[np.diff(y) == 0] >= 0).all()


def test_frames_of_points_are_similarities_and_of_regions_are_not(found):
    frame, kind = found["frame"].astype(float), found["kind"]
    sigma = np.linalg.svd(frame, compute_uv=False)
    assert (np.linalg.det(frame) > 0).all()
    assert np.abs(sigma[kind == 0, 0] / sigma[kind == 0, 1] - 1).max() < 1e-4
    assert (sigma[kind == 1, 0] / sigma[kind == 1, 1] > 1.1).mean() > 0.3


def test_orientation_follows_the_image():
    """Points of the image turned a quarter have frames turned a quarter (x right, y down)."""
    rgb = render(size=160, pitch=36).rgb
    params = detect.Params(min_megapixels=0, regions=False)
    first = detect.run({"image": image(rgb)}, params)
    clockwise = np.ascontiguousarray(np.rot90(rgb, -1))
    second = detect.run({"image": image(clockwise)}, params)
    quarter = np.array([[0.0, -1], [1, 0]])  # (x, y) → (−y, x)
    moved = first["xy"] @ quarter.T + [rgb.shape[0] - 1, 0]
    distance = np.linalg.norm(moved[:, None] - second["xy"], axis=2)
    turned = quarter @ first["frame"]
    close = np.abs(turned[:, None] - second["frame"]).max((2, 3)) / np.sqrt(np.linalg.det(turned))[:, None]
    assert ((distance < 0.3) & (close < 0.15)).any(1).mean() > 0.8


@pytest.mark.parametrize("shape", [(150, 200), (151, 203)])
@pytest.mark.parametrize("megapixels", [0.0, 0.06, 1.2])
def test_places_and_sizes_are_in_pixels_of_the_image_however_it_is_enlarged(shape, megapixels):
    centres = np.array(
        [[40.13, 40.37], [100.3, 41.7], [160.61, 45.18], [41.72, 100.59], [99.44, 104.08], [158.1, 102.6]]
    )
    sigmas = np.array([2.4, 2.7, 3.0, 3.3, 3.6, 4.0])
    params = detect.Params(min_megapixels=megapixels, regions=False)
    got = detect.run({"image": image(blobs(shape, centres, sigmas))}, params)
    distance = np.linalg.norm(got["xy"][:, None] - centres, axis=2)
    at = distance.argmin(0)
    seen = distance.min(0) < 2  # SIFT loses blobs whose size falls between two of its scales
    assert seen.sum() >= 4
    assert distance.min(0)[seen].max() < 0.1
    # its size of a Gaussian blob goes with the blob's, in steps
    ratio = np.sqrt(np.linalg.det(got["frame"][at])) / sigmas
    assert ratio[seen] == pytest.approx(np.full(seen.sum(), 0.85), rel=0.25)


@pytest.mark.parametrize("megapixels", [0.0, 1.2])
def test_regions_are_in_pixels_of_the_image_too(megapixels):
    centres = np.array([[40.2, 40], [100.3, 41.7], [160.5, 45.25], [41.75, 110.5], [99.5, 107], [158.1, 112.6]])
    y, x = np.mgrid[: 160 * 4, : 200 * 4] / 4 - 0.375
    ink = sum((((x - cx) / 11) ** 2 + ((y - cy) / 7) ** 2 < 1) for cx, cy in centres)
    rgb = np.repeat((0.8 - 0.7 * ink).reshape(160, 4, 200, 4).mean((1, 3))[..., None], 3, 2).astype(np.float32)
    got = detect.run({"image": image(rgb)}, detect.Params(min_megapixels=megapixels))
    region = got["kind"] == 1
    for centre in centres:
        distance = np.linalg.norm(got["xy"][region] - centre, axis=1)
        frames = got["frame"][region][distance < 0.2].astype(float)
        assert len(frames) >= 1
        size = np.stack([np.sqrt((f @ f.T).diagonal()) for f in frames])
        assert np.abs(size / [11, 7] - 1).max(1).min() < 0.08


def test_nothing_is_found_outside_the_mask(scene):
    mask = np.zeros(scene.rgb.shape[:2], bool)
    mask[40:200, 30:140] = True
    got = detect.run({"image": {"rgb": scene.rgb, "mask": mask}}, detect.Params())
    x, y = np.round(got["xy"]).astype(int).T
    assert len(x) > 20 and set(got["kind"]) == {0, 1}
    assert mask[y, x].all()


def test_most_elements_are_found(scene, found):
    for kind in (0, 1):
        xy = found["xy"][found["kind"] == kind]
        near = np.linalg.norm(xy[:, None] - scene.xy, axis=2).min(0) < 13
        assert near.mean() > 0.9


@pytest.mark.parametrize("value", [0.0, 0.5])
def test_an_image_without_texture_is_refused_with_what_to_do(value):
    with pytest.raises(StageError, match=r"no texture.*(larger|sharper).*detect\.contrast_threshold"):
        detect.run({"image": image(np.full((80, 90, 3), value, np.float32))}, detect.Params())


def test_an_empty_mask_is_refused(scene):
    empty = {"rgb": scene.rgb, "mask": np.zeros(scene.rgb.shape[:2], bool)}
    with pytest.raises(StageError, match="mask"):
        detect.run({"image": empty}, detect.Params())


def test_brightness_as_stored_does_not_matter(scene):
    """Scene-referred images may be of any brightness: white is the image's own."""
    small = scene.rgb[:128, :128]
    first, second = (detect.run({"image": image(small * k)}, detect.Params()) for k in (32, 64))
    assert len(first["xy"]) > 100
    assert all((first[name] == second[name]).all() for name in first)


def test_encoding_is_srgb_and_monotonic():
    grey = np.linspace(0, 1, 256)
    rgb = np.repeat(grey[None, :, None], 3, 2).astype(np.float32)
    coded = encoded(rgb)[0]
    assert coded[0] == 0 and coded[-1] == 255 and (np.diff(coded.astype(int)) >= 0).all()
    assert coded[55] == pytest.approx(255 * (1.055 * grey[55] ** (1 / 2.4) - 0.055), abs=0.6)


def test_glyph_of_the_synthetic_scene_is_paper_beyond_its_radius():
    ring = np.stack([np.cos(t := np.linspace(0, 6.3, 50)), np.sin(t)], -1)
    assert np.abs(glyph(1.1 * ring) - 0.8).max() < 0.01


def two_colours(colour, ground=(0.5, 0.2, 0.1), size=160):
    """Linear rgb of round spots of `colour` on `ground`, under light that falls off to the right."""
    y, x = np.mgrid[0:size, 0:size]
    spot = (np.hypot(x % 32 - 15.5, y % 32 - 15.5) < 8.0)[..., None]
    light = np.linspace(1, 0.5, size)[:, None]
    return (np.where(spot, colour, ground) * light).astype(np.float32)


def test_print_of_the_grounds_own_luminance_is_seen_by_its_colour():
    ground = np.array([0.5, 0.2, 0.1])
    blue = np.array([0.1, 0.3, 0.5])
    blue *= ground @ detect.LUMINANCE / (blue @ detect.LUMINANCE)
    rgb = two_colours(blue)
    assert np.ptp(rgb @ detect.LUMINANCE, axis=0).max() < 1e-6  # no luminance photograph would show it
    mixture = detect.most_contrast(detect.display(rgb), np.ones((160, 160), bool))
    assert mixture[0] * mixture[2] < 0 and np.linalg.norm(mixture) == pytest.approx(1)
    found = detect.run({"image": image(rgb)}, detect.Params())
    inner = found["xy"][found["kind"] == 1]
    centres = np.stack(np.meshgrid(np.arange(15.5, 160, 32), np.arange(15.5, 160, 32)), -1).reshape(-1, 2)
    assert (np.linalg.norm(centres[:, None] - inner, axis=-1).min(1) < 1).mean() > 0.9


def test_luminance_is_kept_where_it_shows_the_print():
    for rgb in (two_colours([0.1, 0.05, 0.05]), two_colours([0.1, 0.1, 0.1]), two_colours([0.2] * 3, [0.6] * 3)):
        assert detect.most_contrast(detect.display(rgb), np.ones((160, 160), bool)) is None
    assert detect.most_contrast(np.zeros((20, 20, 3)), np.ones((20, 20), bool)) is None
    assert detect.most_contrast(two_colours([0.1] * 3), np.zeros((160, 160), bool)) is None
