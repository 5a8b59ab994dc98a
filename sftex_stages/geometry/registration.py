"""Affine registration of many image patches to one template at once.

Inverse-compositional steps (Baker & Matthews, IJCV 2004): the template's gradient and Hessian are computed once,
so that a step for all instances is one bilinear sampling and one matrix product. The relative irradiance (gain) is
solved for together with the six affine parameters: a patch d is explained as L (µ + ∇µ · Δ), which is linear in
(L, L Δ).
"""

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating]

_ROWS = 30_000  # cv2.remap takes maps of fewer than 32768 rows


def patch_grid(half: int, spacing: float) -> Array:
    """Sample points ((2 half + 1)², 2) of a square patch, row by row, in texton units; the centre is the origin."""
    axis = np.arange(-half, half + 1, dtype=np.float32) * np.float32(spacing)
    return np.stack(np.meshgrid(axis, axis), -1).reshape(-1, 2)


def sample(image: Array, xy: Array, frames: Array, points: Array) -> Array:
    """Bilinear samples of `image` (H, W, C) at xy_i + frames_i · points: (M, P, C) float32.

    `xy` (M, 2) and `frames` (M, 2, 2) are in pixels of `image`, pixel centres at integers; beyond the border the
    border's value is repeated.
    """
    f, centre, points = frames.astype(np.float32), xy.astype(np.float32), points.astype(np.float32)
    across, down = points[:, 0], points[:, 1]
    out = np.empty((len(xy), len(points), image.shape[2]), np.float32)
    for start in range(0, len(xy), _ROWS):
        g, c = f[start : start + _ROWS, :, :, None], centre[start : start + _ROWS, :, None]
        x = g[:, 0, 0] * across + g[:, 0, 1] * down + c[:, 0]
        y = g[:, 1, 0] * across + g[:, 1, 1] * down + c[:, 1]
        got = cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        out[start : start + _ROWS] = got.reshape(len(x), len(points), -1)
    return out


class Template(NamedTuple):
    """A texton prepared for registration; P sample points, C channels."""

    points: Array  # (P, 2) texton units
    values: Array  # (P, C) µ
    weights: Array  # (P,) inverse-variance weights, 0 outside the domain
    basis: Array  # (P·C, 7) √w [µ, ∂µ/∂A (a11, a12, a21, a22), ∂µ/∂t]
    gram: Array  # (7, 7) basisᵀ basis


def make_template(values: Array, weights: Array, spacing: float) -> Template:
    """Template from the texton's appearance `values` (n, n, C), pixel weights (n, n) and grid spacing."""
    n, channels = values.shape[0], values.shape[2]
    gy, gx = np.gradient(values, spacing, axis=(0, 1))
    points = patch_grid(n // 2, spacing)
    sx, sy = points[:, :1], points[:, 1:]
    gx, gy = gx.reshape(-1, channels), gy.reshape(-1, channels)
    flat = values.reshape(-1, channels)
    columns = [flat, gx * sx, gx * sy, gy * sx, gy * sy, gx, gy]
    root = np.sqrt(weights.reshape(-1, 1))
    basis = np.stack([(c * root).ravel() for c in columns], -1).astype(np.float64)
    return Template(points, flat, weights.ravel(), basis, basis.T @ basis)


class Solver(NamedTuple):
    """The part of a registration step that depends on the template alone."""

    used: NDArray[np.bool_]  # (P,), points with weight
    root: Array  # (P',) √w there
    basis: Array  # (P'·C, 7) float32
    unit: Array  # (6,) radius for shifts, 1 for strains: one damping serves both
    values: Array  # (6,) eigenvalues of the Hessian with the gain marginalised
    vectors: Array  # (6, 6)


def make_solver(template: Template) -> Solver:
    """Prepare registration steps to `template`."""
    used = template.weights > 0
    weights, points = template.weights[used], template.points[used]
    radius = float(np.sqrt((weights[:, None] * points**2).sum() / weights.sum())) + 1e-9
    unit = np.array([1.0, 1, 1, 1, radius, radius])
    hessian = marginal_hessian(template) * np.outer(unit, unit)
    values, vectors = np.linalg.eigh(hessian)
    basis = template.basis[np.repeat(used, template.values.shape[1])].astype(np.float32)
    return Solver(used, np.sqrt(weights).astype(np.float32), basis, unit, np.maximum(values, 0), vectors)


def marginal_hessian(template: Template) -> Array:
    """(6, 6) Hessian of the registration in (a11, a12, a21, a22, t1, t2) with the gain solved for (Schur complement)."""
    gram = template.gram
    return gram[1:, 1:] - np.outer(gram[1:, 0], gram[0, 1:]) / gram[0, 0]


def explain(template: Template, solver: Solver, patches: Array) -> tuple[Array, Array, Array]:
    """Projections (M, 7) of patches (M, P', C) at the used points, gains (M,) and mean squared residuals (M,) / gain²."""
    d = (patches * solver.root[None, :, None]).reshape(len(patches), -1)
    projected = (d @ solver.basis).astype(np.float64)
    power = template.gram[0, 0]
    gain = np.maximum(projected[:, 0] / power, 1e-6)
    energy = np.maximum(np.einsum("mp,mp->m", d, d, dtype=np.float64) / gain**2 - power, 0)
    return projected, gain, energy / (template.weights.sum() * template.values.shape[1])


def solve_step(template: Template, solver: Solver, projected: Array, gain: Array, damping: Array, limit: float) -> Array:
    """Damped Gauss–Newton steps (M, 6) (strain, shift); steps beyond `limit` (strain, or shift in radii) are shortened."""
    right = (projected[:, 1:] / gain[:, None] - template.gram[1:, 0][None]) * solver.unit
    step = ((right @ solver.vectors) / (solver.values + damping[:, None] * solver.values[-1])) @ solver.vectors.T
    size = np.abs(step).max(1)
    return step * np.minimum(1.0, limit / np.maximum(size, 1e-12))[:, None] * solver.unit


def registration_step(template: Template, patches: Array, damping: float, limit: float = 0.35) -> tuple[Array, Array, Array]:
    """One step for patches (M, P, C) sampled at the template's points: (steps (M, 6), gains (M,), residuals (M,))."""
    solver = make_solver(template)
    projected, gain, residual = explain(template, solver, patches[:, solver.used])
    step = solve_step(template, solver, projected, gain, np.full(len(patches), damping), limit)
    return step, gain, residual


def compose_step(xy: Array, frames: Array, step: Array) -> tuple[Array, Array]:
    """Inverse composition: the template's warp s → (I + D) s + t moves an instance to frames (I + D)⁻¹, xy − frames' t."""
    frames = frames @ np.linalg.inv(np.eye(2) + step[:, :4].reshape(-1, 2, 2))
    return xy - np.einsum("mij,mj->mi", frames, step[:, 4:]), frames


class Registered(NamedTuple):
    """Result of `register`, M instances."""

    xy: Array  # (M, 2)
    frames: Array  # (M, 2, 2)
    gain: Array  # (M,) L_i
    residual: Array  # (M,) mean of w |d / L − µ|² over Σ w


def register(
    image: Array,
    template: Template,
    xy: Array,
    frames: Array,
    steps: int,
    damping: float = 1e-3,
    limit: float = 0.35,
) -> Registered:
    """Affine registration of M patches to a template, the gain solved for.

    Levenberg–Marquardt per instance: a step that raises the residual is taken back and damped more; an instance whose
    step is under 1/1000 of the element rests.
    """
    solver = make_solver(template)
    points = template.points[solver.used]
    xy, frames = xy.copy(), frames.copy()
    lam = np.full(len(xy), damping)
    projected, gain, residual = explain(template, solver, sample(image, xy, frames, points))
    active = np.arange(len(xy))
    for _ in range(steps):
        step = solve_step(template, solver, projected[active], gain[active], lam[active], limit)
        new_xy, new_frames = compose_step(xy[active], frames[active], step)
        new = explain(template, solver, sample(image, new_xy, new_frames, points))
        better = new[2] < residual[active]
        lam[active] = np.clip(np.where(better, lam[active] * 0.3, lam[active] * 10), 1e-6, 1e3)
        moved = active[better]
        xy[moved], frames[moved] = new_xy[better], new_frames[better]
        projected[moved], gain[moved], residual[moved] = (part[better] for part in new)
        active = active[np.abs(step / solver.unit).max(1) > 1e-3]
        if len(active) == 0:
            break
    return Registered(xy, frames, gain, residual)
