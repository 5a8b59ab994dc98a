"""Irradiance stage: one relative irradiance field from the instances of all textons (section 4.1 of the paper)."""

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.ndimage import distance_transform_edt, find_objects
from scipy.optimize import nnls

from sftex_stages.engine.stage import Arrays, Stage, StageParams
from sftex_stages.errors import StageError
from sftex_stages.geometry import blocks, field, ground, pooling, spline

Float = NDArray[np.floating]
Int = NDArray[np.integer]

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
    channels: Literal["one", "rgb"] = Field(
        "one", description="One map for all channels; or rgb: beside it a map of each channel, for coloured light"
    )
    plain: bool = Field(True, description="Take the light between elements from plain print of one colour, as far as it agrees")
    detail: float = Field(0.8, gt=0.2, le=4, description="Spacing of the field's grid, in spacings of those cells")


@dataclass(frozen=True)
class Instances:
    """Those that are believed: xy (N, 2) px, log L (N,) with `sigma`, `texton` from 0 without gaps, `trust` 0…1, `piece`."""

    xy: Float
    log: Float
    sigma: Float
    texton: Int
    trust: Float
    piece: Int

    def some(self, which: NDArray) -> "Instances":
        """A part of them."""
        return Instances(*(getattr(self, f.name)[which] for f in fields(self)))

    def on_one_scale(self, offset: Float) -> "Instances":
        """As instances of one texton, their own `offset` (K,) removed."""
        return replace(self, log=self.log - offset[self.texton], texton=np.zeros_like(self.texton))


def run(inputs: Mapping[str, Any], params: Params) -> Arrays:
    """The field over the surface's valid pixels, and the textons' scales.

    Pieces of the surface that do not touch share the textons' scales and nothing else, where they hold `LEAST` instances.

    Returns
    -------
    map (H, W) relative irradiance, geometric mean 1 over valid pixels, and sigma (H, W), expected error of its logarithm; NaN
    elsewhere; class_scale (K,) r_k, NaN for textons without an accepted instance; instance/irradiance (N,) r_k L_i on the
    map's scale; instance/weight (N,) robust weights; noise_factor, by which instances scatter more than they say, squared;
    with channels = rgb also rgb (H, W, 3), each channel's irradiance, up to a constant of its own.
    plain_share (4,), how much of what plain print says was believed at each scale, from coarse to fine (`ground.py`).

    Raises
    ------
    StageError
        with fewer than three instances to believe in.
    """
    surface = inputs["surface"]
    piece = np.asarray(surface["piece"])
    light = surface["instance/irradiance"].astype(float)
    texton = np.asarray(surface["instance/texton"])
    used = (surface["instance/inlier"] > params.min_inlier) & (light > 0) & np.isfinite(light)
    if used.sum() < 3:
        raise StageError(
            f"only {int(used.sum())} instances are believed to show the surface; at least 3 are needed for an irradiance map. "
            "Lower irradiance.min_inlier, or use a photograph with more repetitions."
        )
    present, index = np.unique(texton[used], return_inverse=True)
    xy = surface["instance/xy"][used].astype(float)
    sigma = np.hypot(surface["instance/irradiance_sigma"][used].astype(float), params.noise_floor)
    trust = 1 - surface["instance/state"][used, 2].astype(float)
    every = Instances(xy, np.log(light[used]), sigma, index, trust, _label_at(piece, xy))
    result = _fit(every, params)
    every = every.on_one_scale(result.offset)
    log_map, log_sigma = _by_pieces(every, piece, result, params)
    actual = 0.0, 1.0
    share: Float = np.zeros(len(ground.SCALES))
    if piece.any() and len(xy) >= LEAST:
        image = np.asarray(inputs["image"]["rgb"]) if params.plain else None
        log_map, share, actual = _checked(image, every, piece, result, log_map, params)
    mean = float(np.nanmean(log_map)) if piece.any() else 0.0
    scale = np.full(int(texton.max()) + 1, np.nan)
    scale[present] = np.exp(-result.offset - mean)
    weight = np.zeros(len(light))
    weight[used] = result.weight
    light_map = np.exp(log_map - mean).astype(np.float32)
    extra = {}
    if params.channels == "rgb":
        channel = np.log(np.maximum(surface["instance/irradiance_rgb"][used].astype(float), 1e-9))
        extra["rgb"] = light_map[..., None] * _tint(every, channel - np.log(light[used])[:, None], index, piece, params)
    return extra | {
        "map": light_map,
        "sigma": np.hypot(actual[1] * log_sigma, max(actual[0], field.POOLED_FLOOR)).astype(np.float32),
        "class_scale": scale.astype(np.float32),
        "instance/irradiance": (light * scale[texton]).astype(np.float32),
        "instance/weight": weight.astype(np.float32),
        "noise_factor": np.array(result.noise),
        "plain_share": share.astype(np.float32),
    }


def _fit(of: Instances, params: Params, tuned: Float | None = None) -> field.Irradiance:
    return field.fit(of.xy, of.log, of.sigma, of.texton, of.trust, _spacing(of.xy, params), params.detail, tuned)


def _by_pieces(of: Instances, piece: Int, result: field.Irradiance, params: Params) -> tuple[Float, Float]:
    """Log irradiance and its deviation (H, W), NaN off the surface, of instances on one scale; `result`: their common field."""
    log_map, log_sigma = np.full(piece.shape, np.nan), np.full(piece.shape, np.nan)
    for k, box in enumerate(find_objects(piece), 1):
        if box is None:
            continue
        here, own = piece[box] == k, of.piece == k
        found, level = result, 0.0
        if not own.all() and own.sum() >= LEAST:
            found = _fit(of.some(own), params)
            level = float(found.offset[0])
        value, error = _maps(found, box)
        log_map[box][here] = value[here] + level
        log_sigma[box][here] = error[here]
    return log_map, log_sigma


def _tint(of: Instances, log_ratio: Float, texton: Int, piece: Int, params: Params) -> Float:
    """Irradiance of each channel over that of all (H, W, 3) float32, geometric mean 1, NaN off the surface.

    log_ratio (N, 3) at the instances, up to a constant for each texton (N,) and channel: the print's own colour.
    """
    tint = np.full((*piece.shape, 3), np.nan, np.float32)
    for c in range(3):
        of_channel = replace(of, log=log_ratio[:, c], texton=texton)
        result = _fit(of_channel, params)
        of_channel = of_channel.on_one_scale(result.offset)
        value, _ = _by_pieces(of_channel, piece, result, params)
        tint[..., c] = np.exp(value - np.nanmean(value)) if piece.any() else np.nan
    return tint


def _checked(
    image: Float | None, of: Instances, piece: Int, result: field.Irradiance, log_map: Float, params: Params
) -> tuple[Float, Float, tuple[float, float]]:
    """The map (H, W) corrected by plain print, the shares (S,) of it believed, and (a, b) of `_calibrated`.

    Instances (on one scale) of a quarter of the cells are held out, and predicted from the others with the same smoothness:
    they tell how far plain print may be trusted, and how far off the map is.
    """
    spacing = _spacing(of.xy, params)
    cell = pooling.cells(of.xy, spacing)
    out = np.random.default_rng(0).permutation(int(cell.max()) + 1)[cell] % 4 == 0
    x, y = (np.clip(np.rint(of.xy[:, k]).astype(int), 0, piece.shape[1 - k] - 1) for k in (0, 1))
    out_here = out & (piece[y, x] > 0)
    share: Float = np.zeros(len(ground.SCALES))
    if out_here.sum() < LEAST // 3 or (~out).sum() < 3:
        return log_map, share, (0.0, 1.0)
    rest = _fit(of.some(~out), params, result.tuned)
    predicted, deviation = _maps(rest, (slice(0, piece.shape[0]), slice(0, piece.shape[1])))
    held = y[out_here], x[out_here]
    error = of.log[out_here] - predicted[held] - rest.offset[0]
    trust = result.weight[out_here]
    plain = ground.find(image, log_map, piece > 0, spacing) if image is not None else None
    if plain:
        said = ground.layers(plain, predicted, spacing)[:, held[0], held[1]]
        share = ground.shares(said, error, trust)
        error = error - share @ said
        log_map = log_map + np.tensordot(share, ground.layers(plain, np.nan_to_num(log_map), spacing), 1)
    return log_map, share, _calibrated(error - np.median(error), deviation[held], of.sigma[out_here] * np.sqrt(result.noise))


def _calibrated(error: Float, deviation: Float, noise: Float) -> tuple[float, float]:
    """(a, b) such that errors (N,) have the variance a² + b² deviation² + noise², from groups of like deviation."""
    groups = np.array_split(np.argsort(deviation, kind="stable"), 8)
    spread = np.array([np.median(np.abs(error[g])) / 0.6745 for g in groups])
    extra = np.maximum(spread**2 - np.array([np.median(noise[g]) for g in groups]) ** 2, 0)
    stated = np.array([np.median(deviation[g]) for g in groups]) ** 2
    root = 1 / np.maximum(spread, 1e-4) ** 2  # a variance is known to a share of itself
    design = np.stack([np.ones(8), stated], 1) * root[:, None]
    # Where the groups hardly differ, they cannot tell a from b: as much as one of them speaks for a factor alone.
    one = np.array([0, design[:, 1].mean()])
    factor = float(np.median(extra / stated))
    a, b = nnls(np.vstack([design, one]), np.append(extra * root, factor * one[1]))[0]
    return float(np.sqrt(a)), float(np.sqrt(b))


def _spacing(xy: Float, params: Params) -> float:
    """Typical distance of neighbours, but no less than gives `nodes` cells."""
    area = float(np.prod(np.maximum(np.ptp(xy, axis=0), 1.0)))
    return float(np.sqrt(area / min(len(xy), params.nodes)))


def _label_at(piece: Int, xy: Float) -> Int:
    """Label (N,) of the piece nearest to each of `xy` (N, 2), 0 without any."""
    if piece.max() <= 1:
        return np.full(len(xy), piece.max(), np.int64)
    row, column = distance_transform_edt(piece == 0, return_distances=False, return_indices=True)
    x, y = (np.clip(np.rint(xy[:, k]).astype(int), 0, piece.shape[1 - k] - 1) for k in (0, 1))
    return np.asarray(piece[row[y, x], column[y, x]])


def _maps(found: field.Irradiance, box: tuple[slice, slice]) -> tuple[Float, Float]:
    """The logarithm of the field on the pixels of `box`, and its posterior deviation (it varies slowly: on a raster)."""
    rows, columns = (np.arange(s.start, s.stop, dtype=float) for s in box)
    value = spline.evaluate(found.grid, found.a, columns, rows)
    pace = found.grid.spacing
    y, x = (np.linspace(k[0], k[-1], max(int(np.ceil((k[-1] - k[0]) / pace)) + 1, 2)) for k in (rows, columns))
    index, stencil = spline.stencil(found.grid, np.stack(np.meshgrid(x, y), -1).reshape(-1, 2))
    inverse = blocks.selected_inverse(found.factor)
    variance = blocks.covariance(inverse, index, stencil[:, None], stencil[:, None])[:, 0, 0]
    coarse = np.sqrt(np.maximum(variance, 0)).reshape(len(y), len(x))
    at = [np.linspace(0, len(k) - 1, len(n), dtype=np.float32) for k, n in ((x, columns), (y, rows))]
    return value, cv2.remap(coarse.astype(np.float32), *np.meshgrid(*at), cv2.INTER_LINEAR)


STAGE = Stage(name="irradiance", version=5, params=Params, run=run, inputs=("image", "surface"))
