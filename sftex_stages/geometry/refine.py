"""Gauss-Newton on the measured tensors themselves: no gradient, no sign, no small-angle approximation.

Minimises  ½ sum_i rho(r_iᵀ Omega_i r_i) + ½ aᵀ P a,   r_i = w_i − w(grad h(x_i)),
with `w` of `tensors.py`, Omega_i the measured precision over a common noise factor, and rho that of a Student distribution, so
that what is not from the surface loses its say. Smoothness and noise factor maximise the marginal likelihood (Laplace).
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sftex_stages.geometry import blocks, gaussian, tensors

Float = NDArray[np.float64]

FREEDOM = 4.0  # of the Student distribution; two dimensions
NOISE_FACTORS = (0.05, 50.0)


@dataclass(frozen=True)
class Solution:
    """Coefficients `a` (M,), the posterior's factor, and at the points: gradient, its covariance, robust weights (N,) ≤ 1.5."""

    a: Float
    factor: blocks.Factor
    gradient: Float
    covariance: Float
    weight: Float
    smooth: gaussian.Smoothness
    noise: float
    evidence: float


def linearise(w: Float, omega: Float, g: Float) -> tuple[Float, Float, float]:
    """Information (N, 2, 2), pull (N, 2) and constant (nats) of the tensors about the gradient, near `g` (N, 2)."""
    predicted, jacobian = tensors.predict(g)
    z = w - predicted + np.einsum("nij,nj->ni", jacobian, g)
    jo = np.swapaxes(jacobian, 1, 2) @ omega
    used = omega[:, 0, 0] > 0
    constant = 0.5 * (np.linalg.slogdet(omega[used])[1].sum() - np.einsum("ni,nij,nj->", z, omega, z))
    return jo @ jacobian, np.einsum("nij,nj->ni", jo, z), float(constant - used.sum() * np.log(2 * np.pi))


def step(
    f: gaussian.Field, w: Float, omega: Float, g: Float, smooth: gaussian.Smoothness
) -> tuple[Float, blocks.Factor, Float, Float]:
    """One Gauss-Newton step: coefficients, factor, and the information and pull it was made with."""
    information, pull, _ = linearise(w, omega, g)
    factor = gaussian.posterior(f, information, gaussian.prior(f, smooth))
    return blocks.solve(factor, f.design.T @ pull.ravel()), factor, information, pull


def student(w: Float, omega: Float, g: Float, spread: Float) -> tuple[Float, Float]:
    """Robust weights (N,) and squared residuals (N,) at `g` (N, 2), whose covariance `spread` (N, 2, 2) is allowed for."""
    predicted, jacobian = tensors.predict(g)
    r = w - predicted
    total = np.linalg.inv(omega) + jacobian @ spread @ np.swapaxes(jacobian, 1, 2)
    chi2 = np.einsum("ni,nij,nj->n", r, np.linalg.inv(total), r)
    return (FREEDOM + 2) / (FREEDOM + chi2), chi2


def tune(
    f: gaussian.Field, w: Float, omega: Float, g: Float, smooth: gaussian.Smoothness, noise: float, rounds: int
) -> tuple[gaussian.Smoothness, float, float]:
    """Smoothness and noise factor of greatest evidence near the given ones (pattern search in log scale), and the evidence."""

    def score(x: tuple[float, ...]) -> float:
        strength, reach, factor = np.exp(x)
        if not NOISE_FACTORS[0] <= factor <= NOISE_FACTORS[1]:
            return -np.inf
        information, pull, constant = linearise(w, omega / factor, g)
        return constant + gaussian.log_evidence(f, information, pull, gaussian.Smoothness(strength, reach))

    best = (np.log(smooth.strength), np.log(smooth.reach), np.log(noise))
    value = score(best)
    pace = np.array([1.2, 0.7, 0.5])
    for _ in range(rounds):
        moved = False
        for k in range(3):
            for sign in (1, -1):
                trial = tuple(b + sign * pace[k] * (j == k) for j, b in enumerate(best))
                new = score(trial)
                if new > value:
                    best, value, moved = trial, new, True
                    break
        if not moved:
            pace = pace / 2
    return gaussian.Smoothness(float(np.exp(best[0])), float(np.exp(best[1]))), float(np.exp(best[2])), value


def refine(
    f: gaussian.Field, w: Float, covariance: Float, weight: Float, start: Float, smooth: gaussian.Smoothness, steps: int = 4
) -> Solution:
    """The surface from tensors `w` (N, 2) with `covariance` (N, 2, 2), trusted by `weight` (N,) in 0…1.

    Parameters
    ----------
    start : (N, 2)
        gradients with their signs decided; only where it starts, the tensors decide the rest.
    steps : int
        rounds of: robust weights, tuning, Gauss-Newton.
    """
    precision = np.linalg.inv(covariance)
    g, noise, robust = start, 1.0, weight.copy()
    value = -np.inf
    for n in range(steps):
        smooth, noise, value = tune(f, w, precision * robust[:, None, None], g, smooth, noise, 3 if n else 4)
        for _ in range(2):
            omega = precision * (robust / noise)[:, None, None]
            a, factor, information, pull = step(f, w, omega, g, smooth)
            g = limit(gaussian.gradients(f, a))
        spread = gaussian.gradient_covariance(f, factor)
        mean, alone = gaussian.without_own(g, spread, information, pull)
        robust = weight * student(w, precision / noise, limit(mean), alone)[0]
    return Solution(a, factor, g, spread, robust, smooth, noise, value)


def limit(g: Float, steepest: float = 12.0) -> Float:
    """Gradients (N, 2) no steeper than `steepest`, where the tensor no longer changes."""
    size = np.linalg.norm(g, axis=1, keepdims=True)
    return g * np.minimum(1, steepest / np.maximum(size, 1e-12))


def flipped(s: Solution) -> Solution:
    """The mirror image of a solution: all signs turned, everything else as it is."""
    return replace(s, a=-s.a, gradient=-s.gradient)
