"""The image at the scale of an element: halved or doubled, and what that does to its point spread."""

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating]

_MEMO: dict[Any, Any] = {}  # the pyramid of the image in hand, shared by the jobs that one worker runs


def level_image(rgb: Array, level: int) -> Array:
    """`rgb` (H, W, C) at pyramid level: −1 doubled, 0 as it is, 1 halved, … (x_level = (x + ½) 2^−level − ½)."""
    if _MEMO.get("rgb") is not rgb:
        _MEMO.clear()
        _MEMO["rgb"] = rgb
    if level not in _MEMO:
        if level == 0:
            _MEMO[level] = np.ascontiguousarray(rgb, np.float32)
        elif level < 0:
            _MEMO[level] = cv2.resize(rgb, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC)
        else:
            above = level_image(rgb, level - 1)
            size = (max(1, (above.shape[1] + 1) // 2), max(1, (above.shape[0] + 1) // 2))
            _MEMO[level] = cv2.resize(above, size, interpolation=cv2.INTER_AREA)
    return _MEMO[level]


def sampling_spread(factor: float) -> float:
    """Variance of the point spread that a pyramid level and its sampling add, in px² of the level; `factor` its scale.

    Halving averages over boxes as wide as the new pixels; bilinear sampling, on average over subpixel positions, adds 1/6.
    """
    return max(1 - factor**2, 0) / 12 + 1 / 6
