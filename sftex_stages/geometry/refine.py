"""Gauss-Newton on the measured tensors themselves: no gradient, no sign, no small-angle approximation.

Minimises  ½ sum_i rho(r_iᵀ Omega_i r_i) + ½ aᵀ P a,   r_i = w_i − w(grad h(x_i)),
with `w` of `tensors.py`, Omega_i the measured precision over a common noise factor, and rho that of a Student distribution, so
that what is not from the surface loses its say. Smoothness and noise factor maximise the marginal likelihood (Laplace).
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sftex_stages.geometry import blocks, curvature, gaussian, roughness, tensors
from sftex_stages.geometry.camera import Camera
from sftex_stages.geometry.climb import climb

Float = NDArray[np.floating]

FREEDOM = 4.0  # of the Student distribution; two dimensions
NOISE_FACTORS = (0.2, 50.0)
HEIGHT_FACTORS = (0.002, 100.0)
LOCAL_ROUNDS = (1, 1, 2)  # of each pass that learns where the surface is rough; only those beyond the first weigh by residuals


@dataclass(frozen=True)
class Solution:
    """The field with the prior it was found under, coefficients `a` (M,), the posterior's factor, and at the points: gradient,
    its covariance, robust weights (N,) ≤ 1.5."""

    field: gaussian.Field
    a: Float
    factor: blocks.Factor
    gradient: Float
    covariance: Float
    weight: Float
    smooth: gaussian.Smoothness
    noise: float
    evidence: float
    height_noise: float = 1.0
    height: gaussian.Heights | None = None  # with robust weights


def linearise(w: Float, omega: Float, g: Float) -> tuple[Float, Float, float]:
    """Information (N, 2, 2), pull (N, 2) and constant (nats) of the tensors about the gradient, near `g` (N, 2)."""
    predicted, jacobian = tensors.predict(g)
    z = w - predicted + np.einsum("nij,nj->ni", jacobian, g)
    jo = np.swapaxes(jacobian, 1, 2) @ omega
    used = omega[:, 0, 0] > 0
    constant = 0.5 * (np.linalg.slogdet(omega[used])[1].sum() - np.einsum("ni,nij,nj->", z, omega, z))
    return jo @ jacobian, np.einsum("nij,nj->ni", jo, z), float(constant - used.sum() * np.log(2 * np.pi))


def step(
    f: gaussian.Field,
    w: Float,
    omega: Float,
    g: Float,
    smooth: gaussian.Smoothness,
    height: gaussian.Heights | None = None,
) -> tuple[Float, blocks.Factor, Float, Float]:
    """One Gauss-Newton step: coefficients, factor, and the information and pull it was made with."""
    information, pull, _ = linearise(w, omega, g)
    factor = gaussian.posterior(f, information, gaussian.prior(f, smooth), None if height is None else height.precision)
    return gaussian.solve(f, factor, pull, height)[0], factor, information, pull


def student(w: Float, omega: Float, g: Float, spread: Float) -> tuple[Float, Float]:
    """Robust weights (N,) and squared residuals (N,) at `g` (N, 2), whose covariance `spread` (N, 2, 2) is allowed for."""
    predicted, jacobian = tensors.predict(g)
    r = w - predicted
    total = np.linalg.inv(omega) + jacobian @ spread @ np.swapaxes(jacobian, 1, 2)
    chi2 = np.einsum("ni,nij,nj->n", r, np.linalg.inv(total), r)
    return (FREEDOM + 2) / (FREEDOM + chi2), chi2


def refine(
    f: gaussian.Field,
    w: Float,
    covariance: Float,
    trust: Float,
    start: Float,
    smooth: gaussian.Smoothness,
    rounds: int = 4,
    height: gaussian.Heights | None = None,
    noise: float = 1.0,
    height_noise: float = 2.0,
    tune: bool = True,
    camera: Camera | None = None,
) -> Solution:
    """The surface from tensors `w` (N, 2) with `covariance` (N, 2, 2), trusted by `trust` (N,) in 0…1.

    Parameters
    ----------
    start : (N, 2)
        gradients with their signs decided; only where it starts, the tensors decide the rest.
    rounds : int
        of: smoothness and noise by one pattern search step, two Gauss-Newton steps, new robust weights. The first has no
        weights to go by.
    height
        heights, their precisions up to one noise factor, if they are measured (element size under perspective); robust.
    noise, height_noise
        factors on `covariance`, and on the heights' variance, to start from; `tune=False` keeps them and the smoothness.
    camera
        if given, every round but the first has the prior of curvature about the surface of the last (`curvature.py`).
    """
    precision = np.linalg.inv(covariance)
    g, robust = tensors.limit(start), trust.copy()
    smooth, noise = gaussian.softened(f, smooth), float(np.clip(noise, *NOISE_FACTORS))
    noises, rises = np.log(NOISE_FACTORS), np.log(HEIGHT_FACTORS)
    x, pace = np.log([smooth.strength, smooth.reach, noise]), np.array([0.7, 0.7, 0.7])
    if height is not None:
        x, pace = np.append(x, np.log(height_noise)), np.append(pace, 0.7)

    def rise(x: Float) -> gaussian.Heights | None:
        return None if height is None else height.over(float(np.exp(x[3])))

    def score(x: Float) -> float:
        strength, reach, noise = map(float, np.exp(x[:3]))
        if not gaussian.reasonable(f, strength, reach) or not noises[0] <= x[2] <= noises[1]:
            return -np.inf
        if height is not None and not rises[0] <= x[3] <= rises[1]:
            return -np.inf
        information, pull, constant = linearise(w, precision * (robust / noise)[:, None, None], g)
        return constant + gaussian.log_evidence(f, information, pull, gaussian.Smoothness(strength, reach), rise(x))

    for k in range(rounds):
        if tune:
            x, moved = climb(score, x, pace)
            pace = pace if moved else pace / 2
        strength, reach, noise = map(float, np.exp(x[:3]))
        smooth = gaussian.Smoothness(strength, reach)
        for _ in range(2):
            omega = precision * (robust / noise)[:, None, None]
            a, factor, information, pull = step(f, w, omega, g, smooth, rise(x))
            g = tensors.limit(gaussian.gradients(f, a))
        spread = gaussian.gradient_covariance(f, factor)
        mean, alone = gaussian.without_own(g, spread, information, pull)
        robust = trust * student(w, precision / noise, tensors.limit(mean), alone)[0]
        if height is not None:
            height = height.reweighted(gaussian.heights(f, a), float(np.exp(x[3])))
        if camera is not None and k < rounds - 1:
            f = curvature.follow(f, a, camera)
            x[0] = np.log(gaussian.softened(f, smooth).strength)
    height_noise = 1.0 if height is None else float(np.exp(x[3]))
    return Solution(f, a, factor, g, spread, robust, smooth, noise, score(x), height_noise, height)


def refine_locally(
    w: Float,
    covariance: Float,
    trust: Float,
    found: Solution,
    camera: Camera | None = None,
) -> Solution:
    """The surface `found` refined under a prior that is rougher where it is rough (`roughness.py`), and with a `camera` about
    its own curvature. Overall smoothness and noise stay as found.

    At first nothing is let go: what looks like outliers to a smooth prior may be a fold to a rough one.
    """
    f = found.field
    for rounds in LOCAL_ROUNDS:
        if camera is not None:
            f = curvature.follow(f, found.a, camera)
        shaped = roughness.learn(f, found.a, found.factor, found.smooth).field
        start, smooth, noise = found.gradient, found.smooth, found.noise
        found = refine(shaped, w, covariance, trust, start, smooth, rounds, found.height, noise, found.height_noise, tune=False)
    return found


def flipped(s: Solution) -> Solution:
    """The mirror image of a solution: all signs turned, everything else as it is."""
    return replace(s, a=-s.a, gradient=-s.gradient)
