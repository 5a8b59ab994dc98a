"""More instances by search: those that a detector missed come back where the print has them, and nowhere else."""

import numpy as np
import pytest
from synthetic import Scene, detect_of, glyph, image_of, render, sphere

from sftex_stages import enrich, frontal, surface
from sftex_stages.geometry.imaging import normal_angle

LEFT, RIGHT = (-0.5, 0.0), (0.5, 0.0)  # places of two elements on a motif of radius 1


def motif(s):
    """Albedo (..., 3) of two elements side by side: a glyph, and its mirror image turned."""
    return np.minimum(glyph((s - LEFT) / 0.45), glyph((s - RIGHT)[..., ::-1] / 0.45))


def normal_error(got, truth):
    return np.minimum(normal_angle(got, truth), normal_angle(got * [-1, -1, 1], truth))


def artefact(scene, at, seen, seed):
    """What frontal delivers of the elements at `at` on each motif, of which those `seen` were detected."""
    there = scene._replace(xy=scene.xy + scene.transform @ np.array(at), transform=0.45 * scene.transform)
    label = np.where(seen, 0, -1).astype(np.int32)
    detect = detect_of(there, np.random.default_rng(seed))
    cluster = {"label": label, "count": np.array(1)}
    inputs = {"image": image_of(scene), "detect": detect, "cluster": cluster, "part": 0}
    return frontal.run(inputs, frontal.Params(adopt=0.0))


def search(scene, parts, **params):
    return enrich.run({"image": image_of(scene), "frontal": parts}, enrich.Params(**params))


@pytest.fixture(scope="module")
def scene() -> Scene:
    """Motifs of random turn on a cap that is up to 62 degrees steep."""
    return render(normals=lambda xy: sphere(xy, 460), element=motif, radius=26, pitch=60, size=460)


@pytest.fixture(scope="module")
def missed(scene):
    """The steepest motifs, and some of the others."""
    steep = scene.normal[:, 2] < np.quantile(scene.normal[:, 2], 0.12)
    return steep | (np.random.default_rng(5).random(len(scene.xy)) < 0.12)


@pytest.fixture(scope="module")
def parts(scene, missed):
    """Both elements of each motif, the second's missed ones left out; an unusable texton lies between them."""
    return [artefact(scene, LEFT, missed == missed, 1), frontal.empty("none"), artefact(scene, RIGHT, ~missed, 2)]


@pytest.fixture(scope="module")
def found(scene, parts):
    return search(scene, parts, max_error=1.0)


def test_the_table_is_that_of_frontal_with_the_texton(found, parts):
    assert set(found) == {*frontal.no_rows(), "texton"}
    for name, array in frontal.no_rows().items():
        assert found[name].dtype == array.dtype == parts[0][name].dtype, name
        assert found[name].shape == (len(found["xy"]), *array.shape[1:]) and np.isfinite(found[name]).all(), name
    assert found["texton"].dtype == np.int32 and (found["index"] == -1).all() and (found["inlier"] > 0.8).all()


def test_missed_instances_come_back_at_their_place_and_slant(scene, missed, parts, found):
    known = parts[2]["inlier"] > 0.8
    place = np.linalg.solve(scene.transform[parts[2]["index"]], (parts[2]["xy"] - scene.xy[parts[2]["index"]])[..., None])
    at = np.median(place[known, :, 0], axis=0)  # of the element's detail, on the motif
    new = found["texton"] == 2
    motif_of = np.linalg.norm(found["xy"][new][:, None] - scene.xy, axis=2).argmin(1)
    off = np.linalg.solve(scene.transform[motif_of], (found["xy"][new] - scene.xy[motif_of])[..., None])[..., 0] - at
    assert (np.linalg.norm(off, axis=1) * 26 < 0.5).all()  # px of the frontal print
    assert len(set(motif_of)) == len(motif_of), "one physical instance was found twice"
    assert missed[motif_of].all(), "an instance that was known was found again"
    assert len(motif_of) > 0.8 * missed.sum()
    assert (np.degrees(np.arccos(scene.normal[motif_of, 2])) > 50).any()
    before = normal_error(parts[2]["normal"], scene.normal[parts[2]["index"]])[known]
    after = normal_error(found["normal"][new], scene.normal[motif_of])
    assert np.median(after) < 1.5 * np.median(before) and after.max() < 3
    light = np.concatenate([parts[2]["irradiance"][known], found["irradiance"][new]])
    true = np.concatenate([scene.light[parts[2]["index"]][known], scene.light[motif_of]])
    assert np.log(light / true).std() < 0.02


def test_same_input_same_bytes(scene, parts, found):
    again = search(scene, parts, max_error=1.0)
    assert all(again[name].tobytes() == found[name].tobytes() for name in found)


def test_nothing_is_found_where_nothing_is_missing(scene):
    every = np.ones(len(scene.xy), bool)
    whole = [artefact(scene, at, every, seed) for seed, at in enumerate((LEFT, RIGHT))]
    missing = sum((part["inlier"] <= 0.8).sum() for part in whole)
    assert len(search(scene, whole, max_error=1.0)["xy"]) <= missing


def test_elements_that_are_printed_at_random_predict_nothing():
    scene = render(radius=17, pitch=40, size=360)
    inputs = {"image": image_of(scene), "detect": detect_of(scene, np.random.default_rng(1)), "part": 0}
    label = np.where(np.arange(len(scene.xy)) % 3 == 0, -1, 0).astype(np.int32)
    part = frontal.run(inputs | {"cluster": {"label": label, "count": np.array(1)}}, frontal.Params(adopt=0.0))
    assert part["usable"] and len(search(scene, [part])["xy"]) == 0


def test_nothing_comes_where_the_motif_lacks_the_element(scene, missed, parts):
    """The second element is painted over on the motifs where it is asked for: what is there now is no view of it."""
    rgb = scene.rgb.copy()
    y, x = np.indices(rgb.shape[:2])
    for k in np.flatnonzero(missed):
        s = np.linalg.solve(scene.transform[k], np.stack([x.ravel(), y.ravel()]) - scene.xy[k][:, None])
        over = (np.linalg.norm(s.T - RIGHT, axis=1) < 0.5).reshape(rgb.shape[:2])
        rgb[over] = rgb[over].max(0)
    assert not (search(scene._replace(rgb=rgb), parts, max_error=1.0)["texton"] == 2).any()


def test_the_mask_is_not_searched(scene, parts):
    image = image_of(scene) | {"mask": np.zeros(scene.rgb.shape[:2], bool)}
    assert len(enrich.run({"image": image, "frontal": parts}, enrich.Params(max_error=1.0))["xy"]) == 0


@pytest.mark.parametrize("frontals", [[], [frontal.empty("none")]])
def test_without_a_usable_texton_the_table_is_empty(scene, frontals):
    got = search(scene, frontals)
    assert set(got) == {*frontal.no_rows(), "texton"} and len(got["xy"]) == 0


def test_it_can_be_left_out(scene, parts):
    assert len(search(scene, parts, enabled=False)["xy"]) == 0


def test_the_surface_takes_what_was_found(parts, found):
    rows = surface.collect(parts, 0.8, found)
    alone = surface.collect(parts, 0.8)
    n = len(alone["xy"])
    assert n == sum(len(part["xy"]) for part in parts) and len(rows["xy"]) == n + len(found["xy"])
    assert not alone["searched"].any() and rows["searched"].tolist() == [False] * n + [True] * len(found["xy"])
    for name in set(alone) - {"searched"}:
        assert np.array_equal(rows[name], np.concatenate([alone[name], found[name]])), name
