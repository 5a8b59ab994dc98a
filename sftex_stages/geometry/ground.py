"""Light between the elements: plain print of one colour, wherever it shows, has one albedo.

Instances sample the light where elements are. The cloth's ground, and other flat patches of a few common colours, sample it at
nearly every pixel: log I = u + log albedo there. Given u to some per cent, the commonest colours of log I − u are its modes;
pixels of a flat neighbourhood near one of them measure u up to the mode's own constant.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, maximum_filter
from scipy.optimize import lsq_linear

Float = NDArray[np.floating]
Bool = NDArray[np.bool_]

FLAT = 0.15  # most change of a logarithm within 5 × 5 px of flat print
TOLERANCE = np.array([0.35, 0.12, 0.12])  # distance from a mode's brightness (u may err so much) and colours
SCALES = (1.0, 0.5, 0.25, 0.125)  # of the corrections, in typical distances of instances
DARKEST = 5e-4  # least linear value whose logarithm means something
MODES, SHARE, LEAST = 6, 0.05, 500  # most modes; least height of one to the highest; least pixels of one
HOLD = 0.1  # share of plain print around a pixel at which half of what it says is believed
_BIN = 0.1
_TURNS = 2


@dataclass(frozen=True)
class Plain:
    """Pixels of plain print: `level` (H, W), log irradiance up to one constant; `weight` (H, W), 1 where there is one."""

    level: Float
    weight: Float


def find(image: Float, log_map: Float, inside: Bool, spacing: float) -> Plain | None:
    """The plain print where `log_map` (H, W), to some per cent the log irradiance, is known (`inside`); None without any.

    image (H, W, 3) linear; `spacing` px of instances.
    """
    logs = np.log(np.maximum(image, DARKEST)).astype(np.float32)
    level = logs.mean(2)
    red, blue = logs[..., 0] - logs[..., 1], logs[..., 2] - logs[..., 1]
    kernel = np.ones((5, 5), np.uint8)
    change = np.max([cv2.dilate(x, kernel) - cv2.erode(x, kernel) for x in (level, red, blue)], 0)
    flat = inside & (change < FLAT) & (image.min(2) > DARKEST)
    u = np.where(inside, log_map, 0).astype(np.float32)
    colors = np.stack((red[flat], blue[flat]), 1)
    found = None
    for turn in range(_TURNS):
        found = _modes(level, u, colors, flat)
        if found is None or turn == _TURNS - 1:
            break
        u = u + layers(found, u, spacing).sum(0)
    return found


def layers(plain: Plain, log_map: Float, spacing: float) -> Float:
    """What plain print says beyond `log_map` (H, W): (S, H, W), a layer for each of `SCALES`, the coarsest first.

    Their sum is to be added; it is 0 where no plain print is near.
    """
    out = np.zeros((len(SCALES), *log_map.shape), np.float32)
    rest = np.where(plain.weight > 0, plain.level - log_map, 0).astype(np.float32)
    rest -= np.float32(np.median(rest[plain.weight > 0]))
    for layer, scale in zip(out, SCALES, strict=True):
        width = max(scale * spacing, 2.0)
        layer[:] = _blur(rest * plain.weight, width) / (_blur(plain.weight, width) + np.float32(HOLD))
        rest = rest - layer
    return out


def _blur(values: Float, width: float) -> Float:
    """Gaussian mean of standard deviation `width` px, wide ones on a smaller picture."""
    factor = int(width / 3)
    if factor < 2 or min(values.shape) < 4 * factor:
        return cv2.GaussianBlur(values, (0, 0), width)
    h, w = values.shape
    small = cv2.resize(values, (-(-w // factor), -(-h // factor)), interpolation=cv2.INTER_AREA)
    return cv2.resize(cv2.GaussianBlur(small, (0, 0), width / factor), (w, h), interpolation=cv2.INTER_LINEAR)


def _modes(level: Float, u: Float, colors: Float, flat: Bool) -> Plain | None:
    """The pixels of `flat` (H, W) near a mode of albedo, log brightness level − u and `colors` (M, 2), less the mode's own."""
    features = np.column_stack(((level - u)[flat], colors))
    if len(features) < LEAST:
        return None
    low, high = np.quantile(features, [0.001, 0.999], axis=0)  # no mode is as rare as what lies beyond
    bins = np.floor((features - low) / _BIN).astype(int)
    bins = bins[((bins >= 0) & (features <= high)).all(1)]
    shape = bins.max(0) + 1
    count = np.bincount(np.ravel_multi_index(tuple(bins.T), shape), minlength=int(np.prod(shape))).reshape(shape)
    count = count.astype(np.float32)
    count = gaussian_filter(count, (1.5, 0.7, 0.7), mode="constant")
    peaks = np.argwhere((count == maximum_filter(count, (9, 5, 5))) & (count > SHARE * count.max()))
    peaks = peaks[np.argsort(-count[tuple(peaks.T)], kind="stable")[:MODES]]
    modes = low + (peaks + 0.5) * _BIN
    far = np.stack([(((features - m) / TOLERANCE) ** 2).sum(1) for m in modes])
    nearest = far.argmin(0)
    far.sort(0)
    near = (far[0] < 1.5) & ((far[1] > far[0] + 2) if len(modes) > 1 else True)
    constant, known = np.zeros(len(features), np.float32), np.zeros(len(features), np.float32)
    for k in range(len(modes)):
        of = near & (nearest == k)
        if of.sum() >= LEAST:
            constant[of] = np.median(features[of, 0])
            known[of] = 1
    if not known.any():
        return None
    value, weight = np.zeros(flat.shape, np.float32), np.zeros(flat.shape, np.float32)
    value[flat], weight[flat] = level[flat] - constant, known
    return Plain(value, weight)


def shares(layers: Float, error: Float, trust: Float) -> Float:
    """How much of each layer to believe, (S,) in 0…1: robust regression of errors (N,) on layers at the same places (S, N).

    `error` is that of instances which had no part in the map that was corrected; `trust` (N,) their weights.
    """
    share = np.zeros(len(layers))
    robust = np.ones(len(error))
    for _ in range(6):
        root = np.sqrt(trust * robust)
        design = np.concatenate([layers, np.ones((1, layers.shape[1]))]).T * root[:, None]
        found = lsq_linear(design, error * root, ([0] * len(layers) + [-np.inf], [1] * len(layers) + [np.inf]))
        share = found.x[:-1]
        r = error - layers.T @ share - found.x[-1]
        scale = max(float(np.median(np.abs(r))) / 0.6745, 1e-6)
        robust = 1 / (1 + (r / (2 * scale)) ** 2)
    return share
