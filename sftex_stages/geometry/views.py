"""What registered frames say of the surface: views of a texton, each with transform, normal, light and uncertainties.

Registration gives affine frames. A texton's `Gauge` (its metric upgrade, and what is uncertain of it) makes them texture
imaging transforms, on the manifold s R F R. Whoever finds instances, by detection or by search, measures them so.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .imaging import normal_of_tensor, tensor_of
from .metric import (
    common_covariance,
    constraint_gap,
    leading_bias,
    metric_covariance,
    noise_split,
    project_tensors,
    trend_basis,
    turn_variance,
)
from .registration import Registered, Template, channel_gains, sample
from .texton import (
    element_radius,
    independent_samples,
    information_centre,
    strain_covariance,
    tensor_covariance,
    upgrade_texton,
    with_tensor,
)

Array = NDArray[np.floating]

_NO_VIEW = 12.0  # chi² of the distance from the manifold, beyond which a patch is doubted as a view of its texton


class Gauge(NamedTuple):
    """From a texton's registered frames to transforms, and what is uncertain about it."""

    gram: Array  # (2, 2) M of the metric upgrade
    trend: Array  # (K,) of log s over the image
    order: int  # of the trend
    relief: float  # amplitude of the trend's waves
    inflation: float  # factor from the registration's own covariance to the true one
    scale_variance: float  # of the departure of log s from its trend, times 4
    covariance: Array  # (3 + K, 3 + K) of (M11, M12, M22, trend) in the metric frame

    def apply(self, frames: Array, where: Array) -> tuple[Array, Array]:
        """Metric frames (M, 2, 2) and their scales by the trend (M,), of registered `frames` at `where` (M, 2) in [−1, 1]."""
        return frames @ np.linalg.cholesky(self.gram), np.exp(trend_basis(where, self.order, self.relief) @ self.trend)


def calibrate(
    template: Template, frames: Array, where: Array, residual: Array, inlier: Array, order: int
) -> tuple[Gauge, float, bool]:
    """The gauge of a texton by its instances, their metric residual, and whether the element was taken for a circle.

    Registered `frames` (M, 2, 2) at `where` (M, 2) in [−1, 1], with mean squared `residual` and posterior `inlier` (M,).
    """
    upgrade, circular = upgrade_texton(template, frames, where, inlier + 1e-6, order)
    metric, scale = frames @ np.linalg.cholesky(upgrade.gram), np.exp(upgrade.log_scale)
    tensor = tensor_of(metric, scale)
    own = tensor_covariance(metric, scale, strain_covariance(template, residual))
    gap, spread = constraint_gap(tensor, own)
    inflation, scale_variance = noise_split(gap, spread, inlier)
    turn = turn_variance(tensor, own * inflation)
    cov = metric_covariance(metric, where, inlier + 1e-6, order, upgrade.residual, turn, circular, upgrade.relief)
    gauge = Gauge(upgrade.gram, upgrade.trend, order, upgrade.relief, inflation, scale_variance, cov)
    return gauge, upgrade.residual, circular


class Views(NamedTuple):
    """Views of one texton, M of them; px are those of the image that they were registered in."""

    xy: Array  # (M, 2) px, where the element's detail lies
    transform: Array  # (M, 2, 2)
    scale: Array  # (M,)
    tensor: Array  # (M, 3) as registered, off the manifold
    tensor_cov: Array  # (M, 3, 3)
    log_scale_sigma: Array  # (M,)
    normal: Array  # (M, 3), sign free
    normal_sigma: Array  # (M,) degrees
    light: Array  # (M,) L
    light_rgb: Array  # (M, C)
    light_sigma: Array  # (M,) of log L
    credit: Array  # (M,) 1 on the manifold, less the farther off: factor on the posterior of being a view


def measure(image: Array, template: Template, gauge: Gauge, got: Registered, where: Array) -> Views:
    """The views that registered instances `got` at `where` (M, 2) in [−1, 1] are."""
    frames, scale = gauge.apply(got.frames, where)
    tensor = tensor_of(frames, scale)
    own = tensor_covariance(frames, scale, strain_covariance(template, got.residual))
    gap, spread = constraint_gap(tensor, own)
    common = common_covariance(frames, where, scale, gauge.order, gauge.covariance, gauge.relief)
    cov = own * gauge.inflation + common + gauge.scale_variance * tensor[:, :, None] * tensor[:, None, :]
    projected, left, chi2 = project_tensors(tensor, cov)
    # each instance's own scale: the trend with the whole departure from it, its upward bias where λ1 ≈ λ2 taken off
    scale = scale * np.sqrt(np.clip(1.0 + gap - leading_bias(tensor, gauge.inflation * spread), 0.1, 10.0))
    transform = with_tensor(frames, projected, scale)
    normal = normal_of_tensor(projected)
    energy = max(float((template.values**2).mean()), 1e-12)
    return Views(
        xy=got.xy + transform @ information_centre(template),
        transform=transform,
        scale=scale,
        tensor=tensor,
        tensor_cov=cov,
        log_scale_sigma=0.5 * np.sqrt(gauge.inflation * spread),
        normal=normal,
        normal_sigma=normal_sigma(normal, left),
        light=got.gain,
        light_rgb=channel_gains(template, sample(image, got.xy, got.frames, template.points), got.frames, got.variation),
        light_sigma=np.sqrt(got.residual / energy / independent_samples(template)),
        credit=np.where(chi2 < _NO_VIEW, 1.0, np.exp(-0.5 * (chi2 - _NO_VIEW))),
    )


def normal_sigma(normal: Array, cov: Array) -> Array:
    """Expected error in degrees (M,) of normals (M, 3) from the covariance of their tensors.

    Along the tilt the tensor moves with 2 sin σ cos σ, across it with sin² σ: near σ = 0 both vanish, and the error is
    the square root of the tensor's.
    """
    sine = np.hypot(normal[:, 0], normal[:, 1])
    u = normal[:, :2] / np.maximum(sine, 1e-9)[:, None]
    along = np.stack([u[:, 0] ** 2, 2 * u[:, 0] * u[:, 1], u[:, 1] ** 2], -1)
    across = np.stack([-u[:, 0] * u[:, 1], u[:, 0] ** 2 - u[:, 1] ** 2, u[:, 0] * u[:, 1]], -1)
    va = np.einsum("mi,mij,mj->m", along, cov, along)
    vc = np.einsum("mi,mij,mj->m", across, cov, across)
    cos = np.maximum(normal[:, 2], 0.1)
    slant = np.sqrt(va) / (2 * cos * np.sqrt(sine**2 + 0.5 * np.sqrt(va)))
    tilt = np.sqrt(vc) / np.sqrt(sine**2 + np.sqrt(vc))
    return np.degrees(np.hypot(slant, tilt))


def unique(xy: Array, residual: Array, transform: Array, template: Template) -> Array:
    """1 for instances to keep, 0 for those that have slid onto a better registered one (M,)."""
    order = np.argsort(residual)
    keep = np.zeros(len(xy))
    size = np.sqrt(np.abs(np.linalg.det(transform))) * element_radius(template.weights)
    taken, count = np.empty_like(xy), 0
    for i in order:
        apart2 = ((taken[:count] - xy[i]) ** 2).sum(1)
        if count and apart2.min() < (0.25 * size[i]) ** 2:
            continue
        taken[count], count = xy[i], count + 1
        keep[i] = 1.0
    return keep
