"""Pyramid levels: where their pixels lie."""

import numpy as np
import pytest

from sftex_stages.geometry.pyramid import level_image, sampling_spread


@pytest.mark.parametrize("level", [-1, 0, 1, 2])
def test_pixels_of_a_level_lie_where_they_should(level):
    ramp = np.tile(np.arange(64, dtype=np.float32)[:, None, None], (1, 48, 3))
    image = level_image(ramp, level)
    row = len(image) // 2
    assert image[row, 3, 0] == pytest.approx((row + 0.5) * 2.0**level - 0.5, abs=0.06)  # as good as bicubic is


def test_halving_averages_over_boxes_and_doubling_does_not():
    assert sampling_spread(1.0) == sampling_spread(2.0) == pytest.approx(1 / 6)
    assert sampling_spread(0.5) == pytest.approx(1 / 6 + (1 - 0.25) / 12)
