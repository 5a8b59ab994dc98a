"""Affine registration of many image patches to one template at once.

Inverse-compositional steps (Baker & Matthews, IJCV 2004): the template's gradient and Hessian are computed once,
so that a step for all instances is one bilinear sampling and one matrix product. The relative irradiance (gain) is
solved for together with the six affine parameters: a patch d is explained as L (µ + ∇µ · Δ), which is linear in
(L, L Δ).

The image is blurred by its pixels, whatever the slant: seen on the element, the point spread of an instance with
transform T is T⁻¹ T⁻ᵀ wide, so that a steep instance is blurred more along its tilt than the mean of all. To first order
in that difference C the patch is µ + ½ C : ∇∇µ. Left out, small detail looks too wide where it is foreshortened, and
slants come out too small.

Light changes across an element that lies in a fold: its gain is L (1 + γ · s), and γ is solved for together with L.
"""

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating]

_MOST_BLUR = 2.0  # texton units²: beyond it the first order says nothing
_SPREAD_PRIOR, _SPREAD_DOUBT = 0.7, 0.25  # of the logarithm of the point spread: before looking, and at best
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
    basis: Array  # (P·C, 12) √w [µ, ∂µ/∂A (a11, a12, a21, a22), ∂µ/∂t, ½ ∂²µ (xx, xy + yx, yy), µ s / radius (x, y)]
    gram: Array  # (12, 12) basisᵀ basis
    radius: float  # of the grid, texton units
    spread: float  # variance of the image's point spread, px²
    mean_blur: Array  # (3,) mean of `blur` over the instances that µ is the mean of


def blur(frames: Array) -> Array:
    """(M, 3): xx, xy, yy of T⁻¹ T⁻ᵀ, the point spread of instances with `frames` (M, 2, 2) as their element sees it."""
    a, b, c, d = frames[:, 0, 0], frames[:, 0, 1], frames[:, 1, 0], frames[:, 1, 1]
    area = (a * d - b * c) ** 2
    return np.stack([(b * b + d * d) / area, -(a * b + c * d) / area, (a * a + c * c) / area], -1)


def make_template(
    values: Array, weights: Array, spacing: float, spread: float = 0.0, mean_blur: Array | None = None
) -> Template:
    """Template from the texton's appearance `values` (n, n, C), pixel weights (n, n) and grid spacing.

    `spread` (px²) and `mean_blur` (3,) describe the blur that `values` contain; without them blur is taken to be common.
    """
    n, channels = values.shape[0], values.shape[2]
    gy, gx = np.gradient(values, spacing, axis=(0, 1))
    points = patch_grid(n // 2, spacing)
    sx, sy = points[:, :1], points[:, 1:]
    gx, gy = gx.reshape(-1, channels), gy.reshape(-1, channels)
    flat = values.reshape(-1, channels)
    padded = np.pad(values, ((1, 1), (1, 1), (0, 0)), mode="edge")
    xx = (padded[1:-1, 2:] - 2 * values + padded[1:-1, :-2]) / (2 * spacing**2)
    yy = (padded[2:, 1:-1] - 2 * values + padded[:-2, 1:-1]) / (2 * spacing**2)
    xy = (padded[2:, 2:] - padded[2:, :-2] - padded[:-2, 2:] + padded[:-2, :-2]) / (4 * spacing**2)
    second = [a.reshape(-1, channels) for a in (xx, xy, yy)]
    radius = n // 2 * spacing
    columns = [flat, gx * sx, gx * sy, gy * sx, gy * sy, gx, gy, *second, flat * sx / radius, flat * sy / radius]
    root = np.sqrt(weights.reshape(-1, 1))
    basis = np.stack([(c * root).ravel() for c in columns], -1).astype(np.float64)
    mean_blur = np.zeros(3) if mean_blur is None else mean_blur
    return Template(points, flat, weights.ravel(), basis, basis.T @ basis, radius, spread, mean_blur)


def excess_blur(template: Template, frames: Array) -> Array:
    """(M, 3): what the point spread of instances is wider than the template's."""
    if template.spread == 0:
        return np.zeros((len(frames), 3))
    return np.clip(template.spread * (blur(frames) - template.mean_blur), -_MOST_BLUR, _MOST_BLUR)


class Solver(NamedTuple):
    """The part of a registration step that depends on the template alone."""

    used: NDArray[np.bool_]  # (P,), points with weight
    root: Array  # (P',) √w there
    basis: Array  # (P'·C, 12) float32
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


_MOTION, _BLUR, _LIGHT = slice(1, 7), slice(7, 10), [0, 10, 11]  # columns of the basis


def light_gram(template: Template) -> Array:
    """(3, 3) normal matrix of the gain and its slope, the slope held by a weak prior (a third of the gain per radius)."""
    return template.gram[np.ix_(_LIGHT, _LIGHT)] + 1e-3 * template.gram[0, 0] * np.diag([0.0, 1, 1])


def marginal_hessian(template: Template) -> Array:
    """(6, 6) Hessian of the registration in (a11, a12, a21, a22, t1, t2) with the light solved for (Schur complement)."""
    gram = template.gram
    cross = gram[_LIGHT, _MOTION]
    return gram[_MOTION, _MOTION] - cross.T @ np.linalg.solve(light_gram(template), cross)


class Explained(NamedTuple):
    """What `explain` finds of M patches."""

    left: Array  # (M, 6) projections of what is left of d / L on the derivatives
    gain: Array  # (M,) L
    slope: Array  # (M, 2) γ, of the gain per texton unit
    residual: Array  # (M,) mean of w |d / L − (1 + γ s) µ|² over Σ w


def explain(template: Template, solver: Solver, patches: Array, excess: Array) -> Explained:
    """Fit the light of patches (M, P', C) at the used points, with `excess` (M, 3) blur."""
    d = (patches * solver.root[None, :, None]).reshape(len(patches), -1)
    projected = (d @ solver.basis).astype(np.float64)
    gram = template.gram
    blurred = gram[0] + excess @ gram[_BLUR]  # (M, 12) of the blurred template on all columns
    normal = np.repeat(light_gram(template)[None], len(patches), 0)
    normal[:, 0, 0] = blurred[:, 0] + np.einsum("mi,mi->m", excess, blurred[:, _BLUR])
    normal[:, 0, 1:] = normal[:, 1:, 0] = blurred[:, 10:]
    right = projected[:, _LIGHT]
    right[:, 0] += np.einsum("mi,mi->m", excess, projected[:, _BLUR])
    light = np.linalg.solve(normal, right[..., None])[..., 0]
    gain = np.maximum(light[:, 0], 1e-6)
    energy = np.einsum("mp,mp->m", d, d, dtype=np.float64) - np.einsum("mi,mi->m", light, right)
    left = projected[:, _MOTION] - gain[:, None] * blurred[:, _MOTION] - light[:, 1:] @ gram[10:, _MOTION]
    slope = np.clip(light[:, 1:] / gain[:, None], -1, 1) / template.radius
    mass = template.weights.sum() * template.values.shape[1]
    return Explained(left / gain[:, None], gain, slope, np.maximum(energy / gain**2, 0) / mass)


def solve_step(solver: Solver, left: Array, damping: Array, limit: float) -> Array:
    """Damped Gauss–Newton steps (M, 6) (strain, shift) from what `explain` left; steps beyond `limit` (strain, or shift in
    radii) are shortened."""
    right = left * solver.unit
    step = ((right @ solver.vectors) / (solver.values + damping[:, None] * solver.values[-1])) @ solver.vectors.T
    size = np.abs(step).max(1)
    return step * np.minimum(1.0, limit / np.maximum(size, 1e-12))[:, None] * solver.unit


def channel_gains(template: Template, patches: Array, frames: Array, slope: Array) -> Array:
    """(M, C) gain of each channel of patches (M, P, C) sampled at the template's points through `frames` (M, 2, 2)."""
    _, points, channels = patches.shape
    second = template.basis[:, _BLUR].reshape(points, channels, 3)
    root = np.sqrt(template.weights)[:, None]
    model = template.basis[:, 0].reshape(points, channels) + np.einsum("pck,mk->mpc", second, excess_blur(template, frames))
    model *= (1 + slope @ template.points.T)[..., None]
    seen = np.einsum("mpc,mpc->mc", patches * root, model)
    return np.maximum(seen / np.maximum(np.einsum("mpc,mpc->mc", model, model), 1e-30), 1e-6)


def estimate_spread(template: Template, patches: Array, frames: Array, weights: Array, noise2: float, prior: float) -> float:
    """Variance of the point spread (px²) that best explains how patches (M, P, C) differ from their mean.

    One number for all instances: the part of the residual along ½ C : ∇∇µ that neither the gain nor an affine step takes
    up. In logarithms, against `prior` (known to a factor of two); `noise2` is the residuals' variance.
    """
    plain = template._replace(spread=0.0)
    solver = make_solver(plain)
    d = (patches[:, solver.used] * solver.root[None, :, None]).reshape(len(patches), -1)
    projected = (d @ solver.basis).astype(np.float64)
    gram = template.gram
    other = [k for k in range(len(gram)) if not _BLUR.start <= k < _BLUR.stop]
    left = projected / np.maximum(projected[:, :1] / gram[0, 0], 1e-6) - gram[0]
    wide = blur(frames) - template.mean_blur
    sure = weights * (np.abs(prior * wide).max(1) < _MOST_BLUR)
    cross = wide @ gram[_BLUR, other]
    solid = gram[np.ix_(other, other)]
    taken = np.linalg.solve(solid + 1e-6 * np.diag(np.diag(solid)), cross.T).T
    seen = sure @ (np.einsum("mi,mi->m", wide, left[:, _BLUR]) - np.einsum("mi,mi->m", taken, left[:, other]))
    power = sure @ (np.einsum("mi,ij,mj->m", wide, gram[_BLUR, _BLUR], wide) - np.einsum("mi,mi->m", taken, cross))
    if power <= 0:
        return prior
    found = max(seen / power, 0.05 * prior)
    # neighbouring samples share their noise (eight to one), and no model is exact: a quarter
    doubt = _SPREAD_DOUBT**2 + 8 * noise2 / power / found**2
    share = _SPREAD_PRIOR**2 / (_SPREAD_PRIOR**2 + doubt)
    return float(prior * (found / prior) ** share)


def registration_step(
    template: Template, patches: Array, frames: Array, damping: float, limit: float = 0.35
) -> tuple[Array, Explained]:
    """One step (M, 6) for patches (M, P, C) sampled at the template's points through `frames` (M, 2, 2), and their light."""
    solver = make_solver(template)
    got = explain(template, solver, patches[:, solver.used], excess_blur(template, frames))
    return solve_step(solver, got.left, np.full(len(patches), damping), limit), got


def compose_step(xy: Array, frames: Array, step: Array) -> tuple[Array, Array]:
    """Inverse composition: the template's warp s → (I + D) s + t moves an instance to frames (I + D)⁻¹, xy − frames' t."""
    a, b, c, d = 1 + step[:, 0], step[:, 1], step[:, 2], 1 + step[:, 3]
    inverse = np.stack([d, -b, -c, a], -1) / (a * d - b * c)[:, None]
    frames = frames @ inverse.reshape(-1, 2, 2)
    return xy - np.einsum("mij,mj->mi", frames, step[:, 4:]), frames


class Registered(NamedTuple):
    """Result of `register`, M instances."""

    xy: Array  # (M, 2)
    frames: Array  # (M, 2, 2)
    gain: Array  # (M,) L_i
    slope: Array  # (M, 2) γ_i, per texton unit
    residual: Array  # (M,) mean of w |d / L − (1 + γ s) µ|² over Σ w


def register(
    image: Array,
    template: Template,
    xy: Array,
    frames: Array,
    steps: int,
    damping: float = 1e-3,
    limit: float = 0.35,
) -> Registered:
    """Affine registration of M patches to a template, the light solved for.

    Levenberg–Marquardt per instance: a step that raises the residual is taken back and damped more; an instance whose
    step is under 1/1000 of the element rests.
    """
    solver = make_solver(template)
    points = template.points[solver.used]

    def look(xy: Array, frames: Array) -> Explained:
        return explain(template, solver, sample(image, xy, frames, points), excess_blur(template, frames))

    xy, frames = xy.copy(), frames.copy()
    lam = np.full(len(xy), damping)
    got = look(xy, frames)
    active = np.arange(len(xy))
    for _ in range(steps):
        step = solve_step(solver, got.left[active], lam[active], limit)
        new_xy, new_frames = compose_step(xy[active], frames[active], step)
        new = look(new_xy, new_frames)
        better = new.residual < got.residual[active]
        lam[active] = np.clip(np.where(better, lam[active] * 0.3, lam[active] * 10), 1e-6, 1e3)
        moved = active[better]
        xy[moved], frames[moved] = new_xy[better], new_frames[better]
        for old, now in zip(got, new, strict=True):
            old[moved] = now[better]
        active = active[np.abs(step / solver.unit).max(1) > 1e-3]
        if len(active) == 0:
            break
    return Registered(xy, frames, got.gain, got.slope, got.residual)
