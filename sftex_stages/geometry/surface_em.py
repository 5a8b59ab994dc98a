"""The paper's own method (section 4): radial functions, a ridge, and EM over the three states of every instance.

    sum_i δ1 ½ |grad h − d_i|²_W + δ2 ½ |grad h + d_i|²_W + δ3 K_r  +  µ aᵀ a,    h = sum_j a_j / (|x − x_j|² + ε²)

started from a cylinder. It takes the nearest valley of its energy: patches of wrong sign stay (the paper's Fig. 7). Kept as a
method to choose and to compare with; `sign_search.py` integrates the surface out instead.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

Float = NDArray[np.floating]


@dataclass(frozen=True)
class Result:
    """Coefficients `a` (M,), gradients (N, 2) at the points, posteriors (N, 3) of {+, −, not from the surface}, and the
    log posterior after every iteration, nats, which never falls."""

    a: Float
    gradient: Float
    state: Float
    history: Float


def radial(xy: Float, centres: Float, eps: float) -> Float:
    """Values (N, M) of ε² / (|x − x_j|² + ε²) at `xy` (N, 2) px for `centres` (M, 2): the paper's function, made unit high."""
    d2 = ((xy[:, None] - centres) ** 2).sum(2)
    return eps**2 / (d2 + eps**2)


def radial_gradient(xy: Float, centres: Float, eps: float) -> Float:
    """Gradients (N, 2, M) of `radial` with respect to `xy`, 1/px."""
    offset = xy[:, None] - centres
    d2 = (offset**2).sum(2)
    return np.swapaxes(-2 * eps**2 * offset / (d2 + eps**2)[..., None] ** 2, 1, 2)


def cylinder(xy: Float, azimuth: float) -> Float:
    """Gradient (N, 2) of a cylinder over `xy` (N, 2) whose axis is at right angles to `azimuth`, through their centroid."""
    axis = np.array([np.cos(azimuth), np.sin(azimuth)])
    t = (xy - xy.mean(0)) @ axis
    t = t / (1.05 * np.abs(t).max() + 1e-12)
    return -(t / np.sqrt(1 - t**2))[:, None] * axis


def sphere(xy: Float, _azimuth: float = 0.0) -> Float:
    """Gradient (N, 2) of a sphere over `xy` (N, 2), through their centroid."""
    t = xy - xy.mean(0)
    t = t / (1.05 * np.linalg.norm(t, axis=1).max() + 1e-12)
    return np.asarray(-t / np.sqrt(1 - (t**2).sum(1, keepdims=True)))


def plane(xy: Float, azimuth: float) -> Float:
    """Gradient (N, 2) of a plane that falls toward `azimuth` by 45 degrees."""
    return np.tile([-np.cos(azimuth), -np.sin(azimuth)], (len(xy), 1))


def posterior(d: Float, precision: Float, g: Float, log_outlier: Float, share: float) -> tuple[Float, Float]:
    """E step: posteriors (N, 3) of the states at gradients `g` (N, 2), and log likelihoods (N,)."""
    logdet = np.linalg.slogdet(precision)[1]
    log = np.empty((len(d), 3))
    for k, sign in enumerate((1.0, -1.0)):
        r = sign * d - g
        log[:, k] = 0.5 * (logdet - np.einsum("ni,nij,nj->n", r, precision, r)) - np.log(4 * np.pi) + np.log1p(-share)
    log[:, 2] = log_outlier + np.log(share)
    top = log.max(1, keepdims=True)
    total = np.exp(log - top).sum(1, keepdims=True)
    return np.exp(log - top) / total, (top + np.log(total))[:, 0]


def run(
    xy: Float,
    d: Float,
    covariance: Float,
    log_outlier: Float,
    start: Float,
    spacing: float,
    ridge: float = 1e-3,
    share: float = 0.05,
    iterations: int = 60,
) -> Result:
    """EM from the gradients `start` (N, 2).

    Parameters
    ----------
    xy, d, covariance : (N, 2), (N, 2), (N, 2, 2)
        positions in px, gradients of unknown sign, their covariance.
    log_outlier : (N,)
        K_r: log density of a measurement that is not from the surface.
    spacing : float
        of the centres, px; ε is the same.
    ridge, share : float
        µ per squared px of coefficient over spacing, and the prior share of measurements not from the surface.
    """
    low, high = xy.min(0) - spacing, xy.max(0) + spacing
    count = np.maximum(np.ceil((high - low) / spacing).astype(int) + 1, 2)
    centres = np.stack(np.meshgrid(*(np.linspace(low[k], high[k], count[k]) for k in range(2))), -1).reshape(-1, 2)
    basis = radial_gradient(xy, centres, spacing)  # (N, 2, M)
    mu = ridge / spacing**2 * len(xy)
    precision = np.linalg.inv(covariance)
    flat = basis.reshape(-1, basis.shape[2])
    g, a, history = start, np.zeros(basis.shape[2]), []
    for _ in range(iterations):
        state, likelihood = posterior(d, precision, g, log_outlier, share)
        history.append(float(likelihood.sum() - mu * a @ a))
        heavy = (state[:, 0] + state[:, 1])[:, None, None] * precision
        pull = (state[:, 0] - state[:, 1])[:, None] * np.einsum("nij,nj->ni", precision, d)
        weighted = (heavy @ basis).reshape(flat.shape)
        normal = flat.T @ weighted + 2 * mu * np.eye(flat.shape[1])
        a = cho_solve(cho_factor(normal), flat.T @ pull.ravel())
        g = np.einsum("npm,m->np", basis, a)
        if len(history) > 3 and history[-1] - history[-2] < 1e-4 * abs(history[-1]):
            break
    state, likelihood = posterior(d, precision, g, log_outlier, share)
    history.append(float(likelihood.sum() - mu * a @ a))
    return Result(a, g, state, np.array(history[1:]))
