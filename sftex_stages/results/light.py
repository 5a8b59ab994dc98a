"""Light and print taken apart and put together again: the albedo, another light, and the blend with the photograph.

All values are linear. The photograph is albedo × irradiance; irradiance is relative, its geometric mean 1, so the albedo is on
the photograph's own scale.
"""

from __future__ import annotations

import cv2
import numpy as np

WHITE = 99.0  # percentile of the albedo's brightness that counts as the white of a print
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722], np.float32)  # of linear sRGB


def albedo(image: np.ndarray, irradiance: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """image (H, W, 3) / irradiance (H, W), (H, W, 3) float32, NaN where not valid or without irradiance."""
    with np.errstate(invalid="ignore"):
        lit = valid & (irradiance > 0) & np.isfinite(irradiance)
    out = np.full(image.shape, np.nan, np.float32)
    out[lit] = image[lit] / irradiance[lit][:, None]
    return out


def white(print_: np.ndarray) -> float:
    """The brightness (luminance) that white has in an albedo (H, W, 3): its 99th percentile."""
    brightness = (print_ @ _LUMINANCE)[np.isfinite(print_).all(2)]
    return float(np.percentile(brightness, WHITE)) if brightness.size else 1.0


def shine(normals: np.ndarray, toward: np.ndarray, ambient: float) -> np.ndarray:
    """Irradiance (H, W) of a matt surface: `ambient` from everywhere, the rest, 1 − ambient, from a far light `toward` (3,).

    The light falls on a surface that faces it with strength 1; no surface shades another.
    """
    direction = np.asarray(toward, float) / np.linalg.norm(toward)
    with np.errstate(invalid="ignore"):
        return np.asarray(ambient + (1 - ambient) * np.maximum(normals @ direction, 0), np.float32)


def blend(image: np.ndarray, new: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """`new` (H, W, 3) over the photograph: alone inside, fading out over the last pixels before the border of `valid`."""
    width = float(np.clip(0.003 * max(valid.shape), 1.5, 8))
    distance = cv2.distanceTransform(valid.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    share = np.clip(distance / width, 0, 1)
    share = (share * share * (3 - 2 * share))[..., None]
    return np.where(share > 0, image + share * (np.where(valid[..., None], new, 0) - image), image).astype(np.float32)
