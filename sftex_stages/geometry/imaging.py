"""Texture imaging transforms: what foreshortening does to a flat texture element.

A texton is seen through T = R(a) diag(1, cos σ) R(b), times a scale s under (locally) scaled orthography
(Lobay & Forsyth 2006, section 2.1). Frames: x right, y down, z toward the camera; n is the unit normal,
σ its slant, T maps frontal texton coordinates to image pixels.
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating]


def rotation(angle: Array | float) -> Array:
    """Rotation matrices (..., 2, 2) by `angle` (...,) radians."""
    c, s = np.cos(angle), np.sin(angle)
    return np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], -2)


def compose(tilt: Array | float, slant: Array | float, spin: Array | float, scale: Array | float = 1.0) -> Array:
    """Texture imaging transforms s R(tilt) diag(cos slant, 1) R(spin), shape (..., 2, 2).

    `tilt` is the image direction of the gradient's foreshortening: n_xy = sin(slant) (cos tilt, sin tilt).
    This is the paper's R_G F R_S with the axes of F exchanged, so that the tilt direction is the compressed one.
    """
    cos = np.cos(np.asarray(slant, float))
    squeeze = np.zeros((*cos.shape, 2, 2))
    squeeze[..., 0, 0], squeeze[..., 1, 1] = cos, 1.0
    return np.asarray(scale)[..., None, None] * (rotation(tilt) @ squeeze @ rotation(spin))


def lemma1_residual(transform: Array) -> Array:
    """det(T)² − tr(T Tᵀ) + 1, zero exactly for texture imaging transforms (Lemma 1). (..., 2, 2) → (...,)."""
    det = np.linalg.det(transform)
    return det**2 - (transform**2).sum((-2, -1)) + 1.0


def tensor_of(transform: Array, scale: Array | float = 1.0) -> Array:
    """(xx, xy, yy) of T Tᵀ / s² = I − n_xy n_xyᵀ, shape (..., 3)."""
    scaled = transform / np.asarray(scale)[..., None, None]
    gram = scaled @ np.swapaxes(scaled, -1, -2)
    return np.stack([gram[..., 0, 0], gram[..., 0, 1], gram[..., 1, 1]], -1)


def normal_of_tensor(tensor: Array) -> Array:
    """One of the two unit normals (..., 3) whose I − n_xy n_xyᵀ is nearest to `tensor` (..., 3).

    The nearest rank-one matrix to I − tensor is its leading eigenpair; its eigenvalue is sin² of the slant, held
    to [0, 1). The sign is free (section 2.1): the one with n_x > 0 is returned.
    """
    xx, xy, yy = 1.0 - tensor[..., 0], -tensor[..., 1], 1.0 - tensor[..., 2]
    mean, half = (xx + yy) / 2, np.hypot((xx - yy) / 2, xy)
    sine = np.sqrt(np.clip(mean + half, 0.0, 1.0 - 1e-6))
    tilt = 0.5 * np.arctan2(2 * xy, xx - yy)
    return np.stack([sine * np.cos(tilt), sine * np.sin(tilt), np.sqrt(1.0 - sine**2)], -1)


def tensor_of_normal(normal: Array) -> Array:
    """(xx, xy, yy) of I − n_xy n_xyᵀ for unit normals (..., 3)."""
    nx, ny = normal[..., 0], normal[..., 1]
    return np.stack([1.0 - nx * nx, -nx * ny, 1.0 - ny * ny], -1)


def normal_angle(a: Array, b: Array) -> Array:
    """Angle in degrees between unit vectors (..., 3)."""
    return np.degrees(2 * np.arctan2(np.linalg.norm(a - b, axis=-1), np.linalg.norm(a + b, axis=-1)))
