"""From texture imaging transforms to gradients, without a sign.

An instance gives `T Tᵀ / s² = I − n_xy n_xyᵀ` (section 2.1), whose trace is lost in the unknown scale s. What is left is the
traceless part, two numbers a point,

    w = (n_x² − n_y², 2 n_x n_y) = (p² − q², 2 p q) / (1 + p² + q²),

blind to the sign of (p, q). Noise is additive in w, not in (p, q): near the frontal view the gradient is ill determined.
"""

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.floating]

STEEPEST = 0.97  # sin² of the steepest slant that a single instance is believed to show (80 degrees)


def deviator(tensor: Float, covariance: Float) -> tuple[Float, Float]:
    """Measured w (N, 2) and its covariance (N, 2, 2) from tensors (N, 3) = (xx, xy, yy) with covariance (N, 3, 3)."""
    take = np.array([[-1.0, 0.0, 1.0], [0.0, -2.0, 0.0]])
    return tensor @ take.T, take @ covariance @ take.T


def predict(g: Float) -> tuple[Float, Float]:
    """w (N, 2) of gradients `g` (N, 2), and its Jacobian (N, 2, 2), rows w, columns (p, q)."""
    p, q = g[:, 0], g[:, 1]
    k = 1 / (1 + p * p + q * q)
    w = np.stack(((p * p - q * q) * k, 2 * p * q * k), 1)
    jacobian = np.empty((len(g), 2, 2))
    jacobian[:, 0, 0] = 2 * p * k * (1 - w[:, 0])
    jacobian[:, 0, 1] = -2 * q * k * (1 + w[:, 0])
    jacobian[:, 1, 0] = 2 * k * (q - p * w[:, 1])
    jacobian[:, 1, 1] = 2 * k * (p - q * w[:, 1])
    return w, jacobian


def gradient(w: Float, covariance: Float) -> tuple[Float, Float]:
    """One of the two gradients (N, 2) that show w, and its covariance (N, 2, 2) to first order.

    Where the tensor is within its noise of the frontal one, first order fails; there the derivative is taken at the
    slant of that noise instead, which leaves a gradient of nearly nothing with an honest uncertainty.
    """
    size = np.hypot(w[:, 0], w[:, 1])
    angle = np.arctan2(w[:, 1], w[:, 0]) / 2
    direction = np.stack((np.cos(angle), np.sin(angle)), 1)

    def slope(m2: Float) -> Float:
        m2 = np.clip(m2, 0, STEEPEST)
        return np.sqrt(m2 / (1 - m2))

    noise = np.sqrt(np.trace(covariance, axis1=1, axis2=2) / 2)
    jacobian = predict(direction * slope(np.maximum(size, np.maximum(noise, 1e-6)))[:, None])[1]
    inverse = np.linalg.inv(jacobian)
    return direction * slope(size)[:, None], inverse @ covariance @ np.swapaxes(inverse, 1, 2)


def normals(g: Float) -> Float:
    """Unit normals (…, 3) ∝ (−p, −q, 1) of gradients (…, 2)."""
    n = np.concatenate((-g, np.ones_like(g[..., :1])), -1)
    return n / np.linalg.norm(n, axis=-1, keepdims=True)


def angular_error(g: Float, covariance: Float) -> Float:
    """Root mean square angle (…,) in radians between the normal of `g` (…, 2) and those of gradients of that covariance.

    Averaged over four points one standard deviation out along the axes of the covariance (times sqrt 2, so that they have
    it): near the rim, where slopes run away, the linear formula would promise far too much.
    """
    values, axes = np.linalg.eigh(covariance)
    out = np.sqrt(2 * np.maximum(values, 0))[..., None, :] * axes  # columns
    n = normals(g)
    total = np.zeros(g.shape[:-1])
    for k in range(2):
        for sign in (1, -1):
            other = normals(g + sign * out[..., k])
            total += np.arctan2(np.linalg.norm(np.cross(n, other), axis=-1), (n * other).sum(-1)) ** 2
    return np.sqrt(total / 4)


def limit(g: Float, steepest: float = 12.0) -> Float:
    """Gradients (N, 2) no steeper than `steepest`, where the tensor no longer changes."""
    size = np.linalg.norm(g, axis=1, keepdims=True)
    return g * np.minimum(1, steepest / np.maximum(size, 1e-12))
