"""Irradiance stage: one relative irradiance field from the instances of all textons (section 4.1 of the paper)."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from pydantic import Field

from sftex_stages.engine.stage import Arrays, Stage, StageParams
from sftex_stages.errors import StageError
from sftex_stages.geometry import field, spline


class Params(StageParams):
    """Parameters of the irradiance stage."""

    min_inlier: float = Field(
        0.8, ge=0, le=1, description="Posterior above which an instance is used (the paper's 0.8)"
    )
    noise_floor: float = Field(0.01, gt=0, le=1, description="Least relative error of an irradiance that is believed")
    nodes: int = Field(
        2000, ge=50, le=20000, description="Most cells that instances are pooled in to find the smoothness"
    )
    detail: float = Field(0.8, gt=0.2, le=4, description="Spacing of the field's grid, in spacings of those cells")


def run(inputs: Mapping[str, Any], params: Params) -> Arrays:
    """The field over the surface's valid pixels, and the textons' scales.

    Returns
    -------
    map (H, W) relative irradiance, geometric mean 1 over valid pixels, NaN elsewhere; class_scale (K,) r_k, NaN for textons
    without an accepted instance; instance/irradiance (N,) r_k L_i on the map's scale; instance/weight (N,) robust weights.

    Raises
    ------
    StageError
        with fewer than three instances to believe in.
    """
    surface = inputs["surface"]
    valid = np.asarray(surface["valid"], bool)
    light = surface["instance/irradiance"].astype(float)
    texton = np.asarray(surface["instance/texton"])
    outside = surface["instance/state"][:, 2].astype(float)
    used = (surface["instance/inlier"] > params.min_inlier) & (light > 0) & np.isfinite(light) & (outside < 0.99)
    if used.sum() < 3:
        raise StageError(
            f"only {int(used.sum())} instances are believed to show the surface; at least 3 are needed for an irradiance map. "
            "Lower irradiance.min_inlier, or use a photograph with more repetitions."
        )
    present, index = np.unique(texton[used], return_inverse=True)
    xy = surface["instance/xy"][used].astype(float)
    sigma = np.hypot(surface["instance/irradiance_sigma"][used].astype(float), params.noise_floor)
    trust = np.maximum(1 - outside[used], 0.01)
    area = float(np.prod(np.maximum(np.ptp(xy, axis=0), 1.0)))
    spacing = float(np.sqrt(area / min(len(xy), params.nodes)))
    result = field.fit(xy, np.log(light[used]), sigma, index, trust, spacing, params.detail)
    rows, columns = np.arange(valid.shape[0], dtype=float), np.arange(valid.shape[1], dtype=float)
    log_map = spline.evaluate(result.grid, result.a, columns, rows)
    mean = float(log_map[valid].mean()) if valid.any() else 0.0
    count = int(inputs["surface"]["instance/texton"].max()) + 1
    scale = np.full(count, np.nan)
    scale[present] = np.exp(-result.offset - mean)
    weight = np.zeros(len(light))
    weight[used] = result.weight
    return {
        "map": np.where(valid, np.exp(log_map - mean), np.nan).astype(np.float32),
        "class_scale": scale.astype(np.float32),
        "instance/irradiance": (light * scale[texton]).astype(np.float32),
        "instance/weight": weight.astype(np.float32),
        "noise_factor": np.array(result.noise),
    }


STAGE = Stage(name="irradiance", version=1, params=Params, run=run, inputs=("surface",))
