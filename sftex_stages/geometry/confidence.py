"""How far the surface may be off, beyond what the linear model says of itself.

The posterior takes errors as independent and of one size everywhere. They are neither: textons share errors, and where
elements are small against a fold they are not flat, on a rim not modelled at all. The instances themselves show it: by
their residuals against the surface nearby, in their scatter (the noise there) and in their mean (what the surface does not
follow).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sftex_stages.geometry import tensors

Float = NDArray[np.floating]

NEAR = 24  # instances that speak for a place
UPPER_QUARTILE = float(np.log(4.0))  # of half a chi-square of two degrees of freedom
NOISE_FACTORS = (0.1, 20.0)
# Instances in one crowd are half as many independent ones; what shows of a misfit is half of it, since the surface has
# followed the rest. Chosen among four settings on three rendered scenes (a sphere, waves, a pushed cloth).
EXCESS, HIDDEN = 2.0, 2.0


@dataclass(frozen=True)
class Errors:
    """Instances believed: places `xy` (N, 2), residuals of w (N, 2), half their squares over the stated variance (N,); and
    the standard deviation of w that all textons share (`calibration.py`)."""

    xy: Float
    residual: Float
    chi2: Float
    common: float


def errors(xy: Float, w: Float, covariance: Float, g: Float, common: float) -> Errors:
    """From instances at `xy` (N, 2), their w (N, 2) with covariance (N, 2, 2), the surface's slopes `g` (N, 2) there."""
    residual = w - tensors.predict(g)[0]
    chi2 = np.einsum("ni,nij,nj->n", residual, np.linalg.inv(covariance), residual) / 2
    return Errors(xy, residual, chi2, common)


def spread(e: Errors, at: Float, g: Float, posterior: Float) -> Float:
    """Covariance (P, 2, 2) to expect of slopes `g` (P, 2) at `at` (P, 2) px, where the posterior has (P, 2, 2)."""
    if not len(e.xy):
        return EXCESS * posterior + tensors.common_error(g, e.common)
    near = cKDTree(e.xy).query(at, min(NEAR, len(e.xy)))[1].reshape(len(at), -1)
    noise = np.clip(np.quantile(e.chi2[near], 0.75, axis=1) / UPPER_QUARTILE, *NOISE_FACTORS)
    misfit = np.sqrt((np.median(e.residual[near], axis=1) ** 2).mean(1))
    return EXCESS * noise[:, None, None] * posterior + tensors.common_error(g, np.hypot(HIDDEN * misfit, e.common))
