"""Pattern search for the few settings that an evidence chooses (Hooke & Jeeves, Journal of the ACM 8, 1961)."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.floating]


def climb(score: Callable[[Float], float], x: Float, pace: Float) -> tuple[Float, bool]:
    """One round of pattern search: the first better neighbour of `x` (K,) at ±`pace` (K,) along every axis in turn."""
    value, moved = score(x), False
    for k in range(len(x)):
        for sign in (1, -1):
            trial = x + sign * pace * (np.arange(len(x)) == k)
            new = score(trial)
            if new > value:
                x, value, moved = trial, new, True
                break
    return x, moved
