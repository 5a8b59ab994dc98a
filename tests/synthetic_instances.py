"""Synthetic frontal results of known surfaces, shared by the tests of the geometry and of the stages."""

import numpy as np


def instances_of(gradient, seed=0, noise=0.0, textons=3, light=None):
    """One dictionary per texton, as the frontal stage delivers, for gradients (N, 2) at positions (N, 2) of `gradient`.

    `gradient` is a pair (xy, g). Signs are arbitrary; `light` (N,) is the irradiance, every texton has its own scale.
    """
    xy, g = gradient
    rng = np.random.default_rng(seed)
    n = len(xy)
    normal = np.concatenate((-g, np.ones((n, 1))), 1) / np.sqrt(1 + (g**2).sum(1))[:, None]
    # T = root of (I - n_xy n_xyT) times a rotation on the surface
    values, axes = np.linalg.eigh(np.eye(2) - normal[:, :2, None] * normal[:, None, :2])
    root = axes @ (np.sqrt(np.maximum(values, 0))[:, :, None] * np.swapaxes(axes, 1, 2))
    turn = rng.uniform(0, 2 * np.pi, n)
    spin = np.stack((np.stack((np.cos(turn), -np.sin(turn)), 1), np.stack((np.sin(turn), np.cos(turn)), 1)), 1)
    transform = root @ spin + noise * rng.normal(size=(n, 2, 2))
    tensor = transform @ np.swapaxes(transform, 1, 2)
    top = np.linalg.eigvalsh(tensor)[:, 1]
    tensor = tensor / top[:, None, None]
    variance = max(noise, 1e-3) ** 2
    flips = rng.choice([-1.0, 1.0], n)
    light = np.ones(n) if light is None else light
    parts = []
    for k in range(textons):
        m = np.arange(n) % textons == k
        size = int(m.sum())
        parts.append(
            {
                "usable": np.array(True),
                "reason": np.array(""),
                "xy": xy[m].astype(np.float32),
                "transform": transform[m].astype(np.float32),
                "scale": np.sqrt(top[m]).astype(np.float32),
                "tensor": np.stack((tensor[m, 0, 0], tensor[m, 0, 1], tensor[m, 1, 1]), 1).astype(np.float32),
                "tensor_cov": np.tile((variance * np.diag([4, 1, 4])).astype(np.float32), (size, 1, 1)),
                "log_scale_sigma": np.full(size, 0.01, np.float32),
                "normal": (normal[m] * np.stack((flips[m], flips[m], np.ones(size)), 1)).astype(np.float32),
                "normal_sigma": np.full(size, 1, np.float32),
                "inlier": np.full(size, 0.98, np.float32),
                "irradiance": (light[m] * (1 + 0.5 * k)).astype(np.float32),
                "irradiance_rgb": np.repeat((light[m] * (1 + 0.5 * k))[:, None], 3, 1).astype(np.float32),
                "irradiance_sigma": np.full(size, 0.005, np.float32),
            }
        )
    return parts


def jittered(shape, spacing, seed=0):
    """Positions (N, 2) px on a jittered raster over an image of `shape` (H, W), `spacing` px apart."""
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(np.arange(spacing / 2, shape[1], spacing), np.arange(spacing / 2, shape[0], spacing))
    xy = np.stack((x.ravel(), y.ravel()), 1)
    return np.clip(xy + rng.uniform(-0.3, 0.3, xy.shape) * spacing, 0, np.array(shape[::-1]) - 1.0)
