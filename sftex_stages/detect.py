"""Stage `detect`: interest points, regions and their descriptors (Lobay & Forsyth 2006, sections 1.3 and 3).

Interest points are Lowe's (SIFT), on the display-encoded image, where dark folds keep their contrast. Small images are
enlarged first: the elements of printed cloth are 10–40 px wide, and the finest of them live below SIFT's first octave.
"""

from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from .engine.stage import Arrays, Stage, StageParams
from .errors import StageError
from .geometry.regions import find_regions, orient_and_describe

Array = NDArray[np.floating]


class Params(StageParams):
    """Parameters of `detect`."""

    min_megapixels: float = Field(1.2, ge=0, le=16, description="smaller images are enlarged to this size, at most twofold")
    contrast_threshold: float = Field(0.01, gt=0, lt=1, description="SIFT contrast threshold; lower finds fainter points")
    edge_threshold: float = Field(10.0, gt=1, description="SIFT edge threshold; higher keeps points on edges")
    regions: bool = Field(True, description="find affine-covariant regions beside interest points")
    region_contrast: float = Field(0.5, gt=0, lt=5, description="contrast of a region, in deviations of its surroundings")
    max_keypoints: int = Field(60_000, ge=10, description="the strongest are kept")


LUMINANCE = np.array([0.2126, 0.7152, 0.0722], np.float32)
_FAINT = 0.15  # share of the best projection's contrast, as variance, below which luminance does not show a print
_DETAIL = (1.0, 6.0)  # px; detail between these is the print's


def encode(rgb: Array, mask: Array) -> Array:
    """Display-encoded grey (H, W) uint8 of linear `rgb` (H, W, 3), white at the image's 99.5th percentile.

    Luminance, or where that is blind to the detail within `mask` (H, W), as to red on a green as bright, the mixture of the
    encoded channels that shows most of it.
    """
    luminance = rgb @ LUMINANCE
    white = max(float(np.percentile(luminance, 99.5)), 1e-9)
    if white <= 1.0 and luminance.max() <= 1.0:
        white = 1.0 if white > 0.25 else white
    coded = display(rgb / max(white, float(np.percentile(rgb, 99.5))))
    mixture = most_contrast(coded, mask)
    if mixture is None:
        return np.round(255 * display(luminance / white)).astype(np.uint8)
    grey = coded @ mixture
    low, high = np.percentile(grey[mask], (0.5, 99.5))
    return np.round(255 * np.clip(0.5 + (grey - (low + high) / 2) / max(high - low, 1), 0, 1)).astype(np.uint8)


def display(linear: Array) -> Array:
    """sRGB's encoding, 0…1."""
    x = np.clip(linear, 0, 1)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.power(x, 1 / 2.4) - 0.055)


def most_contrast(coded: Array, mask: Array) -> Array | None:
    """Weights (3,) of the channels of `coded` (H, W, 3) whose mixture shows most detail; None while luminance shows enough."""
    step = max(1, round(np.sqrt(coded.shape[0] * coded.shape[1] / 4e6)))
    small = coded[: coded.shape[0] // step * step, : coded.shape[1] // step * step].astype(np.float32)
    small = cv2.resize(small, None, fx=1 / step, fy=1 / step, interpolation=cv2.INTER_AREA) if step > 1 else small
    detail = cv2.GaussianBlur(small, (0, 0), _DETAIL[0]) - cv2.GaussianBlur(small, (0, 0), _DETAIL[1])
    inside = cv2.resize(mask.astype(np.uint8), detail.shape[1::-1], interpolation=cv2.INTER_NEAREST) > 0
    if inside.sum() < 10:
        return None
    covariance = np.cov(detail[inside].T.astype(np.float64))
    values, vectors = np.linalg.eigh(covariance)
    shown = LUMINANCE @ covariance @ LUMINANCE / (LUMINANCE @ LUMINANCE)
    return None if shown >= _FAINT * values[-1] else vectors[:, -1]


def enlarge(grey: Array, min_megapixels: float) -> tuple[Array, Array]:
    """The image at `min_megapixels` or its own size, and the factors (2,) in x and y."""
    factor = float(np.clip(np.sqrt(min_megapixels * 1e6 / grey.size), 1.0, 2.0))
    if factor <= 1.05:
        return grey, np.ones(2)
    size = (round(grey.shape[1] * factor), round(grey.shape[0] * factor))
    scale = np.array([size[0] / grey.shape[1], size[1] / grey.shape[0]])
    return cv2.resize(grey, size, interpolation=cv2.INTER_CUBIC), scale


def interest_points(enlarged: Array, scale: Array, mask: Array, params: Params) -> tuple[Array, Array, Array]:
    """SIFT keypoints of an 8-bit image: xy (N, 2), frames (N, 2, 2) = σ R(orientation), RootSIFT (N, 128)."""
    sift = cv2.SIFT_create(
        nfeatures=params.max_keypoints, contrastThreshold=params.contrast_threshold, edgeThreshold=params.edge_threshold
    )
    points, descriptors = sift.detectAndCompute(enlarged, None)
    if not points:
        return np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros((0, 128), np.float32)
    # SIFT doubles the image and forgets that this moves it by half a pixel: its points lie ¼ px too far right and down
    xy = (np.array([p.pt for p in points]) + 0.25) / scale - 0.5
    sigma = np.array([p.size for p in points]) / 2 / scale.mean()
    angle = np.radians([p.angle for p in points])
    inside = np.round(xy).astype(int).clip(0, np.array(mask.shape[::-1]) - 1)
    keep = mask[inside[:, 1], inside[:, 0]]
    c, s = np.cos(angle), np.sin(angle)
    frames = sigma[:, None, None] * np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], -2)
    root = np.sqrt(descriptors / np.maximum(descriptors.sum(1, keepdims=True), 1e-9))
    # detectors report in an order of their own making; a fixed one keeps every later stage reproducible
    order = np.lexsort((angle, sigma, xy[:, 0], xy[:, 1]))
    order = order[keep[order]]
    return xy[order], frames[order], root[order].astype(np.float32)


def regions(enlarged: Array, scale: Array, mask: Array, params: Params) -> tuple[Array, Array, Array]:
    """Affine-covariant regions: xy (N, 2), frames (N, 2, 2) from the unit disc, RootSIFT of the normalised patch (N, 128)."""
    if not params.regions:
        return np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros((0, 128), np.float32)
    longest = max(enlarged.shape)
    windows = tuple(round(longest / d) | 1 for d in (8, 16, 32))
    size = (enlarged.shape[1], enlarged.shape[0])
    allowed = cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
    xy, frames = find_regions(enlarged, allowed, windows, params.region_contrast, smallest=3.0)
    frames, descriptors = orient_and_describe(enlarged, xy, frames)
    return (xy + 0.5) / scale - 0.5, frames / scale.mean(), descriptors


def run(inputs: Mapping[str, Any], params: Params) -> Arrays:
    """Detect interest points and regions. Input `image` {rgb (H, W, 3), mask (H, W)}.

    Returns `xy` (N, 2) px, `frame` (N, 2, 2) unit disc of the element → px, `descriptor` (N, 128), `kind` (N,) 0 for
    interest points, 1 for regions. Raises StageError when there are fewer than three: nothing can repeat.
    """
    image = inputs["image"]
    mask = image["mask"]
    enlarged, scale = enlarge(encode(image["rgb"], mask), params.min_megapixels)
    points = interest_points(enlarged, scale, mask, params)
    blobs = regions(enlarged, scale, mask, params)
    xy, frames, descriptors = (np.concatenate(both) for both in zip(points, blobs, strict=True))
    if len(xy) < 3:
        raise StageError(
            f"only {len(xy)} interest points and regions found: the image (or its mask) shows no texture; "
            "use a sharper or larger image, widen the mask, or lower detect.contrast_threshold"
        )
    return {
        "xy": xy.astype(np.float32),
        "frame": frames.astype(np.float32),
        "descriptor": descriptors,
        "kind": np.repeat(np.array([0, 1], np.uint8), [len(points[0]), len(blobs[0])]),
    }


STAGE = Stage(name="detect", version=2, params=Params, run=run, inputs=("image",))
