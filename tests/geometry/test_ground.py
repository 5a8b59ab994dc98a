import numpy as np
import pytest

from sftex_stages.geometry import ground

H, W = 160, 220


def scene(noise=0.01):
    """A ground of one colour with dots of two others, lit with a fold of 12 px: image, log light, the same but the fold."""
    y, x = np.mgrid[:H, :W].astype("f4")
    smooth = 0.004 * x - 0.3 * np.cos(y / 60)
    light = smooth + 0.5 * np.exp(-(((x - 110) / 12) ** 2))
    near = ((x % 40 - 20) ** 2 + (y % 40 - 20) ** 2) < 90
    dots = np.where((x // 40 % 2 == 0)[..., None], [0.7, 0.6, 0.2], [0.3, 0.05, 0.05])
    color = np.where(near[..., None], dots, [0.1, 0.15, 0.3])
    rng = np.random.default_rng(0)
    image = color * np.exp(light)[..., None] * (1 + noise * rng.normal(size=(H, W, 3)))
    return image.astype("f4"), light, smooth


def test_plain_print_shows_the_light_between_elements():
    image, light, smooth = scene()
    inside = np.ones((H, W), bool)
    plain = ground.find(image, smooth, inside, 40.0)
    shown = plain.weight > 0
    assert 0.4 < shown.mean() < 0.95
    error = (plain.level - light)[shown]
    assert np.quantile(np.abs(error - np.median(error)), 0.98) < 0.05
    found = smooth + ground.layers(plain, smooth, 40.0).sum(0)
    error = found - light
    assert np.abs(error - np.median(error)).mean() < 0.15 * np.abs(smooth - light - np.median(smooth - light)).mean()


def test_without_plain_print_there_is_nothing_to_say():
    rough = np.random.default_rng(0).uniform(0.05, 1, (H, W, 3)).astype("f4")
    assert ground.find(rough, np.zeros((H, W)), np.ones((H, W), bool), 40.0) is None
    image, _, smooth = scene()
    assert ground.find(image, smooth, np.zeros((H, W), bool), 40.0) is None
    assert ground.find(np.zeros_like(image), smooth, np.ones((H, W), bool), 40.0) is None


def test_layers_are_believed_as_far_as_errors_follow_them():
    rng = np.random.default_rng(1)
    layers = rng.normal(0, 0.05, (3, 400))
    error = 1.0 * layers[0] + 0.4 * layers[1] - 0.5 * layers[2] + 0.01 * rng.normal(size=400) + 0.2
    error[::15] += 1
    share = ground.shares(layers, error, np.ones(400))
    assert share == pytest.approx([1, 0.4, 0], abs=0.05)
