"""Where the cloth is: beyond the pixels that measurements support, as far as it looks like them."""

from __future__ import annotations

import cv2
import numpy as np
from scipy.ndimage import binary_fill_holes, gaussian_filter

REACH = 0.06  # of the longer side: how far past what is supported
_SIDE = 400  # px, longer side of the picture that is cut out
_TURNS = 2


def outline(image: np.ndarray, valid: np.ndarray, mask: np.ndarray | None = None) -> np.ndarray:
    """Pixels (H, W) taken for the same surface as `valid`, which is among them.

    image (H, W, 3) linear. What lies within `REACH` of valid pixels, or in holes among them, is cut out by colour and edges
    (GrabCut; Rother, Kolmogorov, Blake, SIGGRAPH 2004), against what lies farther off. `mask` (H, W) limits it.
    """
    reach = REACH * max(valid.shape)
    near = cv2.distanceTransform((~valid).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE) <= reach
    near |= binary_fill_holes(valid)
    if mask is not None:
        near &= mask
    scale = min(1.0, _SIDE / max(valid.shape))
    size = [max(1, round(n * scale)) for n in valid.shape[::-1]]
    small = cv2.resize(np.sqrt(np.clip(image, 0, 1)), size, interpolation=cv2.INTER_AREA)
    share = [cv2.resize(m.astype(np.float32), size, interpolation=cv2.INTER_AREA) for m in (valid, near)]
    sure, possible = share[0] > 0.99, share[1] > 0.5
    if (~possible).sum() < 50 or not sure.any():
        return near | valid
    eight = (small * 255 + 0.5).astype(np.uint8)
    # GrabCut learns both colours from its own first guess, which must not count the doubtful rim as one of them.
    alike = _frequency(eight, sure) > _frequency(eight, ~possible)
    guess = np.where(alike, cv2.GC_PR_FGD, cv2.GC_PR_BGD)
    trimap = np.where(sure, cv2.GC_FGD, np.where(possible, guess, cv2.GC_BGD)).astype(np.uint8)
    cv2.setRNGSeed(0)
    cv2.grabCut(eight, trimap, None, np.zeros((1, 65)), np.zeros((1, 65)), _TURNS, cv2.GC_INIT_WITH_MASK)
    cut = ((trimap == cv2.GC_FGD) | (trimap == cv2.GC_PR_FGD)).astype(np.float32)
    large = cv2.resize(cut, valid.shape[::-1], interpolation=cv2.INTER_LINEAR) > 0.5
    return (large & near) | valid


def _frequency(picture: np.ndarray, of: np.ndarray) -> np.ndarray:
    """How often the colour of every pixel of `picture` (H, W, 3) uint8, or one near it, occurs in `of` (H, W): (H, W)."""
    bins = tuple((picture >> 3).reshape(-1, 3).T)
    count = np.zeros((32, 32, 32))
    np.add.at(count, tuple(b[of.ravel()] for b in bins), 1 / max(of.sum(), 1))
    return gaussian_filter(count, 1.0, mode="constant")[bins].reshape(of.shape)
