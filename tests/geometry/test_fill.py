import numpy as np
import pytest

from sftex_stages.geometry.fill import fill


def maps():
    y, x = np.mgrid[:80, :100].astype("f4")
    return np.dstack([0.3 * x - 0.2 * y + 5, 0.01 * (x - 50) ** 2])


def test_a_plane_goes_on_as_a_plane_and_a_bowl_bends_on():
    values = maps()
    known = np.ones((80, 100), bool)
    known[30:50, 40:60] = False
    known[:, 90:] = False
    found = fill(values, known, np.ones_like(known), 4000)
    assert np.array_equal(found[known], values[known])
    assert np.abs(found[..., 0] - values[..., 0]).max() < 0.2
    assert np.abs(found[..., 1] - values[..., 1])[30:50, 40:60].max() < 0.15
    assert np.abs(found[..., 1] - values[..., 1])[:, 90:].max() < 2.5  # it goes on straight


def test_only_what_is_wanted_is_filled():
    known = np.zeros((80, 100), bool)
    known[10:20, 10:20] = True
    wanted = np.zeros_like(known)
    wanted[20:30, 15] = True
    found = fill(maps(), known, wanted)
    assert np.array_equal(np.isfinite(found[..., 0]), known | wanted)
    with pytest.raises(ValueError, match="nothing is known"):
        fill(maps(), np.zeros_like(known), wanted)


def test_a_single_known_pixel_is_enough():
    known = np.zeros((80, 100), bool)
    known[40, 50] = True
    found = fill(maps(), known, np.ones_like(known))
    np.testing.assert_allclose(found[..., 0], maps()[40, 50, 0], atol=0.01)
