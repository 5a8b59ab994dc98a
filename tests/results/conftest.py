"""A small analytic photograph, two domes (one with a hole) cut apart by a stripe, and what the stages say of it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from sftex_stages.engine.stage import Arrays
from sftex_stages.geometry.chart import Pinhole, make_chart

H, W = 90, 130


def domes() -> Arrays:
    """height, normals, valid of z = 25 (1 − (x/40)²/2 − (y/45)²/2) about each dome's centre."""
    y, x = np.mgrid[:H, :W].astype(np.float64)
    u = np.where(x < 65, x - 32, x - 97)
    p, q = -25 * u / 40**2, -25 * (y - 45) / 45**2
    height = 25 * (1 - (u / 40) ** 2 / 2 - ((y - 45) / 45) ** 2 / 2)
    normals = np.stack([-p, -q, np.ones_like(p)], 2) / np.sqrt(1 + p**2 + q**2)[..., None]
    valid = (np.abs(x - 65) > 3) & ((x - 32) ** 2 + (y - 30) ** 2 > 64)
    height[~valid], normals[~valid] = np.nan, np.nan
    return {"height": height.astype("f4"), "normals": normals.astype("f4"), "valid": valid}


def stage_arrays() -> dict[str, Any]:
    rng = np.random.default_rng(3)
    surface = domes()
    valid = surface["valid"]
    piece = np.where(valid, np.where(np.arange(W) < 65, 1, 2), 0).astype("i4")
    flat = make_chart(surface["height"], surface["normals"], piece, Pinhole(), 2000, 40)
    n, sizes = 40, (9, 12, 0)
    iy, ix = (a[rng.permutation(valid.sum())[:n]] for a in np.nonzero(valid))
    normal = surface["normals"][iy, ix]
    slant = np.linalg.norm(normal[:, :2], axis=1)
    tilt = normal[:, :2] / np.maximum(slant, 1e-9)[:, None]
    squeeze = np.eye(2) - (1 - normal[:, 2])[:, None, None] * tilt[:, :, None] * tilt[:, None, :]
    light = np.where(valid, np.exp(np.linspace(-0.5, 0.5, W))[None, :] * np.ones((H, 1)), np.nan)
    rgb = rng.uniform(0.05, 0.9, (H, W, 3)).astype("f4")
    rgb[:45, :65] *= [1, 0.2, 0.2]  # the upper left is red
    instance = {
        "xy": np.stack([ix, iy], 1).astype("f4"), "transform": squeeze.astype("f4"), "normal": normal,
        "inlier": rng.uniform(0, 1, n).astype("f4"), "irradiance": np.ones(n, "f4"),
        "irradiance_sigma": np.full(n, 0.02, "f4"), "texton": np.repeat([0, 1], [25, 15]).astype("i4"),
        "normal_sigma": np.full(n, 2, "f4"), "state": np.tile(np.array([0.9, 0.1, 0], "f4"), (n, 1)),
    }  # fmt: skip
    frontal = [
        {
            "usable": np.array(m == 9), "reason": np.array({9: "", 12: "residual 0.08 ≥ 0.03", 0: "2 members"}[m]),
            "appearance": rng.uniform(0, 1, (m, m, 3)).astype("f4"), "domain": np.ones((m, m), "f4"),
            "spacing": np.array(1.5, "f4"), "progress": rng.uniform(0, 1, (4, m, m, 3)).astype("f4"),
            "progress_iterations": np.array([1, 5, 10, 20], "i4"), "metric_residual": np.array(0.01, "f4"),
            "xy": np.zeros((3, 2), "f4"),
        }
        for m in sizes
    ]  # fmt: skip
    return {
        "image": {"rgb": rgb, "mask": np.ones((H, W), bool)},
        "frontal": frontal,
        "surface": surface
        | {"normal_sigma": np.full((H, W), 3, "f4"), "energy": np.array(1.0), "camera": np.array("orthographic")}
        | {"focal_px": np.array(np.inf), "principal_point": np.array([64.5, 44.5]), "piece": piece}
        | {f"instance/{k}": v for k, v in instance.items()}
        | {"texton/part": np.array([0], np.int32), "texton/reason": np.array([""])},
        "irradiance": {
            "map": light.astype("f4"),
            "sigma": np.where(valid, 0.02, np.nan).astype("f4"),
            "class_scale": np.array([1, np.nan, np.nan], "f4"),
            "instance/irradiance": np.full(n, 1.25, "f4"),
        },
        "chart": {"uv": flat.uv.astype("f4"), "angular": flat.angular.astype("f4"), "area": flat.area.astype("f4")},
    }


@pytest.fixture
def arrays() -> dict[str, Any]:
    return stage_arrays()


@pytest.fixture
def meta() -> dict[str, Any]:
    return {
        "image_name": "Stoff — 1.png", "image_sha256": "ab" * 32, "config_yaml": "frontal:\n  tolerance: 1e-6 # ±\n",
        "keys": {"detect": "k1", "frontal": ["k2", "k3"]}, "versions": {"sftex": "1", "numpy": "2"},
    }  # fmt: skip
