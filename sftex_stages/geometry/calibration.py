"""Textons judge one another before any surface is known.

The tensors of all instances sample one smooth field w(x), whatever their signs (`tensors.py`). What a texton's metric upgrade
got wrong is common to its instances: its frontal frame is sheared by some I + e_k / 2, so that w(T_i (I + e_k) T_iᵀ), and not
w(T_i T_iᵀ), agrees with the neighbours of other textons: linear in the two numbers of the traceless symmetric e_k. A texton
that agrees with no one gets a large noise factor, and thereby no say.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

Float = NDArray[np.floating]
Int = NDArray[np.integer]

NEIGHBOURS = 24
SHEAR = 0.06  # standard deviation of e_k a priori: metric upgrades are off by a few per cent
FREEDOM = 3.0
# What all textons have wrong together: so many standard errors of the mean shear, were the shears independent.
COMMON = 1.5
OWN_SAY = 0.25
DISAGREES = 9.0  # noise factor from which a texton is said to disagree: errors of three times what it states
MEMBERS = 4.0  # instances' worth of prior that a texton's noise is as stated


@dataclass(frozen=True)
class Calibration:
    """Shears `e` (K, 2), noise factor of each texton (K,), corrected w (N, 2), robust weights (N,), and the standard
    deviation in w of what all textons may still have in common, which no agreement among them shows."""

    e: Float
    noise: Float
    w: Float
    weight: Float
    common: float


def shear_effect(transform: Float) -> tuple[Float, Float]:
    """w (N, 2) of transforms (N, 2, 2) of any scale, and its derivative (N, 2, 2) by the shear e = ((e1, e2), (e2, −e1))."""
    s = transform @ np.swapaxes(transform, 1, 2)
    mean, half, off = (s[:, 0, 0] + s[:, 1, 1]) / 2, (s[:, 0, 0] - s[:, 1, 1]) / 2, s[:, 0, 1]
    radius = np.hypot(half, off)
    top = mean + radius  # the larger eigenvalue, the scale squared
    w = np.stack((-2 * half / top, -2 * off / top), 1)
    # Unit vector along which S is largest: n_xy is across it.
    safe = np.maximum(radius, 1e-12)
    jacobian = np.empty((len(s), 2, 2))
    for k, e in enumerate((np.array([[1.0, 0.0], [0.0, -1.0]]), np.array([[0.0, 1.0], [1.0, 0.0]]))):
        d = transform @ e @ np.swapaxes(transform, 1, 2)
        d_mean, d_half, d_off = (d[:, 0, 0] + d[:, 1, 1]) / 2, (d[:, 0, 0] - d[:, 1, 1]) / 2, d[:, 0, 1]
        d_top = d_mean + (half * d_half + off * d_off) / safe
        jacobian[:, 0, k] = (-2 * d_half - w[:, 0] * d_top) / top
        jacobian[:, 1, k] = (-2 * d_off - w[:, 1] * d_top) / top
    return w, jacobian


def scales(transform: Float, e: Float) -> Float:
    """Largest singular values (N,) of transforms (N, 2, 2) corrected by shears `e` (N, 2), half of them in the frame."""
    shear = np.eye(2) + np.stack((e, np.stack((e[:, 1], -e[:, 0]), 1)), 1) / 2
    return np.asarray(np.linalg.svd(transform @ shear, compute_uv=False)[:, 0])


def predict_from_neighbours(xy: Float, w: Float, weight: Float, near: Int) -> tuple[Float, Float]:
    """Local linear prediction of w (N, 2) from neighbours `near` (N, k) with weights (N, k), and its variance (N,) if
    weights are inverse variances."""
    offset = xy[near] - xy[:, None]
    reach = np.sqrt((offset**2).sum(2).max(1))[:, None]
    weight = weight * (1 - (np.linalg.norm(offset, axis=2) / (reach * 1.05)) ** 2)
    basis = np.concatenate((np.ones_like(offset[..., :1]), offset / reach[..., None]), 2)
    normal = np.einsum("nk,nki,nkj->nij", weight, basis, basis)
    total = weight.sum(1)
    # A weak pull of the slope to zero, in units of the weight: neighbours on one side only must not extrapolate wildly.
    normal += total[:, None, None] * np.diag([1e-9, 0.03, 0.03]) + 1e-12 * np.eye(3)
    right = np.einsum("nk,nki,nkc->nic", weight, basis, w[near])
    inverse = np.linalg.inv(normal)
    return (inverse @ right)[:, 0], inverse[:, 0, 0]


def calibrate(
    xy: Float, transform: Float, covariance: Float, texton: Int, trust: Float, floor: float, rounds: int = 8
) -> Calibration:
    """Shears and noise of the textons by mutual agreement.

    Parameters
    ----------
    xy, transform, covariance : (N, 2), (N, 2, 2), (N, 2, 2)
        positions, transforms, covariance of w.
    texton, trust : (N,)
        number 0 … K − 1 and belief 0…1.
    floor
        standard deviation of w below which neighbours cannot agree (curvature).
    """
    n, count = len(xy), int(texton.max()) + 1
    w, effect = shear_effect(transform)
    variance = np.trace(covariance, axis1=1, axis2=2) / 2 + floor**2
    near = cKDTree(xy).query(xy, min(NEIGHBOURS + 1, n))[1][:, 1:]
    # The instance's own texton shares its error: it may not testify while others can.
    foreign = texton[near] != texton[:, None]
    lonely = (foreign * (trust[near] > 0.1)).sum(1) < 4
    witness = np.where(foreign | lonely[:, None], 1.0, 0.0)
    e: Float = np.zeros((count, 2))
    noise: Float = np.ones(count)
    robust: Float = np.ones(n)
    current: Float = w.copy()
    for _ in range(rounds):
        strength = trust * robust / (noise[texton] * variance)
        mean, spread = predict_from_neighbours(xy, current, witness * strength[near], near)
        own = noise[texton] * variance + spread
        residual = mean - current
        chi2 = (residual**2).sum(1) / own
        robust = (FREEDOM + 2) / (FREEDOM + chi2)
        # Shear: ridge regression of what the neighbours want on the effect; lonely textons learn nothing from themselves.
        target = residual + np.einsum("nij,nj->ni", effect, e[texton])
        say = trust * robust / own * ~lonely
        normal, right = np.zeros((count, 2, 2)), np.zeros((count, 2))
        np.add.at(normal, texton, say[:, None, None] * np.swapaxes(effect, 1, 2) @ effect)
        np.add.at(right, texton, say[:, None] * np.einsum("nji,nj->ni", effect, target))
        e = np.linalg.solve(normal + np.eye(2) / SHEAR**2, right[..., None])[..., 0]
        current = w + np.einsum("nij,nj->ni", effect, e[texton])
        # Noise factor of each texton from its residuals, two numbers an instance; robust by the Student weights.
        relative = trust * robust * ((mean - current) ** 2).sum(1) / (variance + spread) / 2
        mass = np.bincount(texton, trust, count)
        noise = (np.bincount(texton, relative, count) + MEMBERS) / (mass + MEMBERS)
    # A texton that no other one saw may have any shear; the others' shears show how large they are.
    unseen = np.bincount(texton, trust * ~lonely, count) == 0
    variance_of_shear = np.where(unseen, (SHEAR / COMMON) ** 2, (e**2).sum(1) / 2)
    total = np.bincount(texton, trust, count) / noise
    common = COMMON * np.sqrt(total**2 @ variance_of_shear) / total.sum()
    return Calibration(e, noise, current, robust, float(common))


def against_surface(
    found: Calibration, transform: Float, covariance: Float, texton: Int, trust: Float, w: Float, rounds: int = 4
) -> Calibration:
    """The same with shears that fit a finished surface, which shows w (N, 2) at the instances.

    Neighbours see a texton's shear through a handful of witnesses each; the surface has all of them in it, and the signs.
    `covariance` (N, 2, 2) of w holds the textons' noise already. A texton that makes up more of the surface than
    `OWN_SAY` would be its own witness, and keeps its shear.
    """
    raw, effect = shear_effect(transform)
    variance = np.trace(covariance, axis1=1, axis2=2) / 2
    count, current = len(found.e), found.w
    say = trust / variance
    own = np.bincount(texton, say, count) > OWN_SAY * say.sum()
    for _ in range(rounds):
        chi2 = ((w - current) ** 2).sum(1) / variance
        say = trust / variance * (FREEDOM + 2) / (FREEDOM + chi2)
        normal, right = np.zeros((count, 2, 2)), np.zeros((count, 2))
        np.add.at(normal, texton, say[:, None, None] * np.swapaxes(effect, 1, 2) @ effect)
        np.add.at(right, texton, say[:, None] * np.einsum("nji,nj->ni", effect, w - raw))
        fitted = np.linalg.solve(normal + np.eye(2) / SHEAR**2, right[..., None])[..., 0]
        e = np.where(own[:, None], found.e, fitted)
        current = raw + np.einsum("nij,nj->ni", effect, e[texton])
    return replace(found, e=e, w=current)
