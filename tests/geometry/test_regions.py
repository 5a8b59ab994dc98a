"""Affine-covariant regions on ellipses and shapes drawn from formulas."""

import numpy as np
import pytest

from sftex_stages.geometry.imaging import rotation
from sftex_stages.geometry.regions import drop_repeats, find_regions, orient_and_describe

WINDOWS = (121, 61)


@pytest.fixture
def rng():
    return np.random.default_rng(5)


def coverage(shape, inside, samples=5):
    """Share (H, W) of every pixel, centred at integers, in which `inside` (…, 2) → bool holds."""
    axis = (np.arange(samples) + 0.5) / samples - 0.5
    total = np.zeros(shape)
    y, x = np.mgrid[: shape[0], : shape[1]].astype(float)
    for dy in axis:
        for dx in axis:
            total += inside(np.stack([x + dx, y + dy], -1))
    return total / samples**2


def ellipse(centre, frame):
    inverse = np.linalg.inv(frame)
    return lambda s: (((s - centre) @ inverse.T) ** 2).sum(-1) <= 1


def draw(shape, ellipses, ground=200.0, ink=60.0):
    image = np.full(shape, ground)
    for centre, frame in ellipses:
        reach = int(np.ceil(np.abs(frame).sum(1).max())) + 2
        x, y = np.round(centre).astype(int) - reach
        tile = coverage((2 * reach + 1, 2 * reach + 1), ellipse(centre - [x, y], frame))
        image[y : y + 2 * reach + 1, x : x + 2 * reach + 1] += (ink - ground) * tile
    return np.round(image).astype(np.uint8)


def dots(rng):
    """Ellipses of semi-axes 13 to 24 px on a jittered raster of 400 × 480 px: centres (N, 2), symmetric frames (N, 2, 2)."""
    x, y = np.meshgrid(np.arange(60, 440, 90), np.arange(60, 360, 90))
    centres = np.stack([x.ravel(), y.ravel()], -1) + rng.uniform(-5, 5, (x.size, 2))
    axes = np.stack([rng.uniform(13, 18, x.size), rng.uniform(16, 24, x.size)], -1)
    turn = rotation(rng.uniform(-3, 3, x.size))
    return centres, turn @ (axes[:, :, None] * np.swapaxes(turn, 1, 2))


def nearest(xy, centre):
    return int(np.linalg.norm(xy - centre, axis=1).argmin())


def find(grey, mask=None, contrast=0.5):
    mask = np.ones(grey.shape, bool) if mask is None else mask
    return find_regions(grey, mask, WINDOWS, contrast, smallest=3.0)


@pytest.mark.parametrize("ground, ink", [(200.0, 60.0), (60.0, 200.0), (130.0, 100.0)])
def test_ellipses_of_both_polarities_are_found_where_and_as_large_as_they_are(rng, ground, ink):
    centres, frames = dots(rng)
    xy, found = find(draw((400, 480), list(zip(centres, frames, strict=True)), ground, ink))
    for centre, frame in zip(centres, frames, strict=True):
        near = np.linalg.norm(xy - centre, axis=1) < 0.2
        assert near.any()
        expected, got = np.linalg.eigh(frame), np.linalg.eigh(found[near])
        # half a pixel more: the threshold lies nearer to the ground than to the ink
        error = np.abs(got[0] - expected[0]).max(1)
        best = int(error.argmin())
        assert (np.abs(got[0][best] - expected[0]) < 0.03 * expected[0] + 0.5).all()
        if expected[0][1] > 1.2 * expected[0][0]:
            assert abs(got[1][best, :, 1] @ expected[1][:, 1]) > np.cos(np.radians(3))
    assert np.abs(found - np.swapaxes(found, 1, 2)).max() < 1e-9
    assert np.linalg.eigvalsh(found)[:, 0].min() >= 3


def test_every_dot_is_found_once_though_two_windows_see_it(rng):
    centres, frames = dots(rng)
    grey = draw((400, 480), list(zip(centres, frames, strict=True)))
    size = np.sqrt(np.linalg.det(frames))

    def hits(windows):
        xy, found = find_regions(grey, np.ones(grey.shape, bool), windows, 0.5, smallest=3.0)
        near = np.linalg.norm(xy[:, None] - centres, axis=2) < 2
        alike = np.abs(np.log(np.sqrt(np.linalg.det(found))[:, None] / size)) < 0.1
        return (near & alike).sum(0).tolist()

    assert hits((121,)) == [1] * len(centres) and hits((101,)) == [1] * len(centres)
    assert hits((121, 101)) == [1] * len(centres)


def test_a_highlight_does_not_break_a_hole(rng):
    centre, frame = np.array([60.3, 55.8]), rotation(0.4) @ np.diag([9.0, 7.0]) @ rotation(-0.4)
    image = draw((120, 120), [(centre, frame)]).astype(float)
    image += 190 * coverage(image.shape, ellipse(centre - np.array([5.5, 3.0]), 2.2 * np.eye(2)))  # up to the rim
    xy, found = find(np.clip(image, 0, 255).astype(np.uint8))
    at = nearest(xy, centre)
    assert np.linalg.norm(xy[at] - centre) < 0.6
    assert np.linalg.eigvalsh(found[at]) == pytest.approx([7, 9], rel=0.1)


def test_the_mask_is_respected(rng):
    centres, frames = dots(rng)
    image = draw((400, 480), list(zip(centres, frames, strict=True)))
    mask = np.zeros(image.shape, bool)
    mask[:, :240] = True
    xy, _ = find(image, mask)
    assert len(xy) >= 4 and xy[:, 0].max() < 240
    left, right = centres[:, 0] < 205, centres[:, 0] > 275
    distance = np.linalg.norm(xy[:, None] - centres, axis=2).min(0)
    assert (distance[left] < 0.2).all() and (distance[right] > 5).all()


def test_a_plain_image_has_no_regions():
    xy, frames = find(np.full((80, 90), 128, np.uint8))
    assert xy.shape == (0, 2) and frames.shape == (0, 2, 2)
    frames, descriptors = orient_and_describe(np.full((80, 90), 128, np.uint8), xy, frames)
    assert frames.shape == (0, 2, 2) and descriptors.shape == (0, 128) and descriptors.dtype == np.float32


def test_repeats_are_dropped_and_different_sizes_are_kept():
    frames = np.array([10.0, 10.5, 16, 10, 10])[:, None, None] * np.eye(2)
    xy = np.array([[50.0, 50], [51, 50], [50, 50], [54, 50], [80, 50]])
    kept, size = drop_repeats(xy, frames)
    rows = {(float(x), float(s[0, 0])) for (x, _), s in zip(kept, size, strict=True)}
    assert rows == {(51.0, 10.5), (50.0, 16.0), (54.0, 10.0), (80.0, 10.0)}


def test_repeats_do_not_depend_on_the_order(rng):
    xy = np.repeat(rng.uniform(0, 200, (40, 2)), 3, 0) + rng.uniform(-1, 1, (120, 2))
    frames = np.repeat(rng.uniform(8, 12, 40), 3)[:, None, None] * rng.uniform(0.97, 1.03, (120, 1, 1)) * np.eye(2)
    first = drop_repeats(xy, frames)
    order = rng.permutation(120)
    second = drop_repeats(xy[order], frames[order])
    assert (first[0] == second[0]).all() and (first[1] == second[1]).all()
    assert len(first[0]) < 60


# descriptors


def bowl(s):
    """Half a disc with a notch in its round side: one straight edge says where its top is. (…, 2) → bool."""
    x, y = s[..., 0], s[..., 1]
    return (x**2 + (y + 0.4) ** 2 < 0.81) & (y > -0.4) & ~((np.abs(x - 0.4) < 0.13) & (y > 0))


def ring(s):
    """Another: half a disc with a window in it."""
    x, y = s[..., 0], s[..., 1]
    return (x**2 + (y + 0.4) ** 2 < 0.81) & (y > -0.4) & ~((np.abs(x + 0.1) < 0.4) & (np.abs(y + 0.02) < 0.17))


def shapes(inside, maps, cell=90):
    """One view of the shape per map on a grey ground, side by side; the image and the centres."""
    image = np.full((cell, cell * len(maps)), 190.0)
    centres = np.array([[cell * (k + 0.5) + 0.3 * k, cell / 2 - 0.4 * k] for k in range(len(maps))])
    for k, (m, centre) in enumerate(zip(maps, centres, strict=True)):
        inverse = np.linalg.inv(m)
        tile = coverage((cell, cell), lambda s, i=inverse, c=centre, k=k: inside((s - c + [cell * k, 0]) @ i.T))
        image[:, k * cell : (k + 1) * cell] -= 130 * tile
    return np.round(image).astype(np.uint8), centres


def test_descriptors_follow_a_shape_through_rotation_and_affine_maps_and_not_to_another():
    stretch = rotation(0.3) @ np.diag([0.65, 1.0]) @ rotation(0.8)
    maps = [16 * m for m in (np.eye(2), rotation(0.7), rotation(2.5), rotation(-1.4) @ np.diag([0.8, 1.0]), stretch)]
    described = []
    for inside in (bowl, ring):
        image, centres = shapes(inside, maps)
        xy, frames = find_regions(image, np.ones(image.shape, bool), (89,), 0.5, smallest=3.0)
        at = [nearest(xy, c) for c in centres]
        assert (np.linalg.norm(xy[at] - centres, axis=1) < 8).all()
        turned, descriptors = orient_and_describe(image, xy, frames)
        # turning keeps the ellipse
        assert turned @ np.swapaxes(turned, 1, 2) == pytest.approx(frames @ frames, abs=1e-6)
        assert (np.linalg.det(turned) > 0).all()
        described.append(descriptors[at])
    everything = np.concatenate(described)
    assert np.linalg.norm(everything, axis=1) == pytest.approx(np.ones(len(everything)), abs=1e-3)
    distance = np.linalg.norm(everything[:, None] - everything, axis=2)
    one, other = distance[:5, :5], distance[:5, 5:]
    assert one.max() < 0.85 * other.min() and distance[5:, 5:].max() < 0.85 * other.min()
    rotated = [0, 1, 2]
    assert one[np.ix_(rotated, rotated)].max() < 0.3 * other.min()


def test_frames_of_one_shape_differ_by_its_map():
    maps = [16 * m for m in (np.eye(2), rotation(0.8), rotation(2.0) @ np.diag([0.75, 1.0]))]
    image, centres = shapes(bowl, maps)
    xy, frames = find_regions(image, np.ones(image.shape, bool), (89,), 0.5, smallest=3.0)
    at = [nearest(xy, c) for c in centres]
    turned, _ = orient_and_describe(image, xy, frames)
    own = np.linalg.solve(np.stack(maps), turned[at])  # frames in the shape's own coordinates: all the same
    assert np.abs(own[1:] - own[0]).max() < 0.12


def test_descriptors_do_not_depend_on_brightness_and_contrast():
    image, centres = shapes(bowl, [16 * np.eye(2), 16 * rotation(1.2)])
    darker = np.round(image * 0.4 + 20).astype(np.uint8)
    frames = np.tile(14 * np.eye(2), (2, 1, 1))
    first, second = (orient_and_describe(grey, centres, frames) for grey in (image, darker))
    assert np.abs(first[0] - second[0]).max() < 1e-6
    assert np.linalg.norm(first[1] - second[1], axis=1).max() < 0.1
