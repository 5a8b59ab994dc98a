"""Irradiance stage: one relative irradiance field from the instances of all textons (section 4.1 of the paper)."""

from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.ndimage import distance_transform_edt, find_objects

from sftex_stages.engine.stage import Arrays, Stage, StageParams
from sftex_stages.errors import StageError
from sftex_stages.geometry import blocks, field, spline

Float = NDArray[np.floating]

LEAST = 30  # instances on which a piece of the surface has a field of its own


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

    Pieces of the surface that do not touch share the textons' scales and nothing else, where they hold `LEAST` instances.

    Returns
    -------
    map (H, W) relative irradiance, geometric mean 1 over valid pixels, and sigma (H, W), expected error of its logarithm; NaN
    elsewhere; class_scale (K,) r_k, NaN for textons without an accepted instance; instance/irradiance (N,) r_k L_i on the
    map's scale; instance/weight (N,) robust weights; noise_factor, by which instances scatter more than they say, squared.

    Raises
    ------
    StageError
        with fewer than three instances to believe in.
    """
    surface = inputs["surface"]
    piece = np.asarray(surface["piece"])
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
    log = np.log(light[used])
    result = field.fit(xy, log, sigma, index, trust, _spacing(xy, params), params.detail)
    log_map, log_sigma = np.full(piece.shape, np.nan), np.full(piece.shape, np.nan)
    log -= result.offset[index]
    member = _label_at(piece, xy)
    for k, box in enumerate(find_objects(piece), 1):
        if box is None:
            continue
        here, own = piece[box] == k, member == k
        if own.all() or own.sum() < LEAST:
            found, level = result, 0.0
        else:
            one = np.zeros(int(own.sum()), np.int64)
            found = field.fit(xy[own], log[own], sigma[own], one, trust[own], _spacing(xy[own], params), params.detail)
            level = float(found.offset[0])
        value, error = _maps(found, box)
        log_map[box][here] = value[here] + level
        log_sigma[box][here] = error[here]
    mean = float(np.nanmean(log_map)) if (piece > 0).any() else 0.0
    scale = np.full(int(texton.max()) + 1, np.nan)
    scale[present] = np.exp(-result.offset - mean)
    weight = np.zeros(len(light))
    weight[used] = result.weight
    return {
        "map": np.exp(log_map - mean).astype(np.float32),
        "sigma": log_sigma.astype(np.float32),
        "class_scale": scale.astype(np.float32),
        "instance/irradiance": (light * scale[texton]).astype(np.float32),
        "instance/weight": weight.astype(np.float32),
        "noise_factor": np.array(result.noise),
    }


def _spacing(xy: Float, params: Params) -> float:
    """Typical distance of neighbours, but no less than gives `nodes` cells."""
    area = float(np.prod(np.maximum(np.ptp(xy, axis=0), 1.0)))
    return float(np.sqrt(area / min(len(xy), params.nodes)))


def _label_at(piece: NDArray[np.integer], xy: Float) -> NDArray[np.integer]:
    """Label (N,) of the piece nearest to each of `xy` (N, 2), 0 without any."""
    if not piece.any():
        return np.zeros(len(xy), np.int64)
    row, column = distance_transform_edt(piece == 0, return_distances=False, return_indices=True)
    x, y = (np.clip(np.rint(xy[:, k]).astype(int), 0, piece.shape[1 - k] - 1) for k in (0, 1))
    return np.asarray(piece[row[y, x], column[y, x]])


def _maps(found: field.Irradiance, box: tuple[slice, slice]) -> tuple[Float, Float]:
    """The logarithm of the field on the pixels of `box`, and its posterior deviation (it varies slowly: on a raster)."""
    rows, columns = (np.arange(s.start, s.stop, dtype=float) for s in box)
    value = spline.evaluate(found.grid, found.a, columns, rows)
    pace = found.grid.spacing / 2
    y, x = (np.linspace(k[0], k[-1], max(int(np.ceil((k[-1] - k[0]) / pace)) + 1, 2)) for k in (rows, columns))
    index, stencil = spline.stencil(found.grid, np.stack(np.meshgrid(x, y), -1).reshape(-1, 2))
    inverse = blocks.selected_inverse(found.factor)
    variance = blocks.covariance(inverse, index, stencil[:, None], stencil[:, None])[:, 0, 0]
    coarse = np.sqrt(np.maximum(variance, 0)).reshape(len(y), len(x))
    at = [np.linspace(0, len(k) - 1, len(n), dtype=np.float32) for k, n in ((x, columns), (y, rows))]
    return value, cv2.remap(coarse.astype(np.float32), *np.meshgrid(*at), cv2.INTER_LINEAR)


STAGE = Stage(name="irradiance", version=2, params=Params, run=run, inputs=("surface",))
