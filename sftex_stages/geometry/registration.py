"""Affine registration of many image patches to one template at once.

Inverse-compositional steps (Baker & Matthews, IJCV 2004): the template's gradient and Hessian are computed once,
so that a step for all instances is one bilinear sampling and one matrix product. The relative irradiance (gain) is
solved for together with the six affine parameters: a patch d is explained as L (µ + ∇µ · Δ), which is linear in
(L, L Δ).

The image is blurred by its pixels, whatever the slant: seen on the element, the point spread of an instance with
transform T is T⁻¹ T⁻ᵀ wide, so that a steep instance is blurred more along its tilt than the mean of all. To first order
in that difference C the patch is µ + ½ C : ∇∇µ. Left out, small detail looks too wide where it is foreshortened, and
slants come out too small.

No two copies are quite alike beyond that. Light changes across an element that lies in a fold, and prints differ in tint:
a copy shows L (µ (1 + γ · b) + τ), b(s) the first and second powers of position, which vanish at the centre, and τ one number
a channel. This variation (γ, τ) is solved for together with L, each of its numbers held by a prior as wide as the texton's
copies show it to vary (`learn_variation`): what does not vary costs no information.
"""

import functools
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating]

_MOST_BLUR = 2.0  # texton units²: beyond it the first order says nothing
_SPREAD_PRIOR, _SPREAD_DOUBT = 0.7, 0.25  # of the logarithm of the point spread: before looking, and at best
_SHARED = 8  # neighbouring samples of one patch that share their noise
_LEAST_TOLD, _LEAST_VARIATION = 0.02, 1e-3
_POWERS = 5  # of position, that light may follow
# columns, after µ: light comes first in the variation, tints follow
_MOTION, _BLUR, _VARIATION, _LIGHT = slice(1, 7), slice(7, 10), slice(10, None), slice(10, 10 + _POWERS)
_ROWS = 30_000  # cv2.remap takes maps of fewer than 32768 rows


@functools.lru_cache(maxsize=64)
def patch_grid(half: int, spacing: float) -> Array:
    """Sample points ((2 half + 1)², 2) of a square patch, row by row, in texton units; the centre is the origin. Read-only."""
    axis = np.arange(-half, half + 1, dtype=np.float32) * np.float32(spacing)
    points = np.stack(np.meshgrid(axis, axis), -1).reshape(-1, 2)
    points.setflags(write=False)
    return points


def sample(image: Array, xy: Array, frames: Array, points: Array) -> Array:
    """Bilinear samples of `image` (H, W, C) float32 at xy_i + frames_i · points: (M, P, C) float32.

    `xy` (M, 2) and `frames` (M, 2, 2) are in pixels of `image`, pixel centres at integers; beyond the border the
    border's value is repeated.
    """
    warp = np.concatenate([frames, xy[..., None]], 2).astype(np.float32)
    lifted = np.stack([points[:, 0], points[:, 1], np.ones(len(points))]).astype(np.float32)
    out = np.empty((len(xy), len(points), image.shape[2]), np.float32)
    for start in range(0, len(xy), _ROWS):
        part = slice(start, start + _ROWS)
        x, y = warp[part, 0] @ lifted, warp[part, 1] @ lifted
        cv2.remap(image, x, y, cv2.INTER_LINEAR, dst=out[part], borderMode=cv2.BORDER_REPLICATE)
    return out


class Template(NamedTuple):
    """A texton prepared for registration; P sample points, C channels."""

    points: Array  # (P, 2) texton units
    values: Array  # (P, C) µ
    weights: Array  # (P,) inverse-variance weights, 0 outside the domain
    columns: Array  # (B, P, C) √w [µ, ∂µ/∂A (a11, a12, a21, a22), ∂µ/∂t, ½ ∂²µ (xx, xy + yx, yy), µ b (5), level (C)]
    gram: Array  # (B, B) of the columns' products
    radius: float  # of the grid, texton units
    spread: float  # variance of the image's point spread, px²
    mean_blur: Array  # (3,) mean of `blur` over the instances that µ is the mean of
    level: float  # root mean square of µ, the unit of tints
    ridge: Array  # (V,) prior precision of the variation (γ, τ), in the gram's units

    @property
    def basis(self) -> Array:
        """(P·C, B): the columns."""
        return self.columns.reshape(len(self.columns), -1).T


def blur(frames: Array) -> Array:
    """(M, 3): xx, xy, yy of T⁻¹ T⁻ᵀ, the point spread of instances with `frames` (M, 2, 2) as their element sees it."""
    a, b, c, d = frames[:, 0, 0], frames[:, 0, 1], frames[:, 1, 0], frames[:, 1, 1]
    area = (a * d - b * c) ** 2
    return np.stack([(b * b + d * d) / area, -(a * b + c * d) / area, (a * a + c * c) / area], -1)


def light_powers(points: Array, radius: float) -> Array:
    """b (5, P) = (x, y, x², 2 x y, y²) of `points` (P, 2) in units of `radius`: how light may change over an element."""
    x, y = points.T / radius
    return np.stack([x, y, x * x, 2 * x * y, y * y])


def make_template(
    values: Array,
    weights: Array,
    spacing: float,
    spread: float = 0.0,
    mean_blur: Array | None = None,
    ridge: Array | None = None,
) -> Template:
    """Template from the texton's appearance `values` (n, n, C), pixel weights (n, n) and grid spacing.

    `spread` (px²) and `mean_blur` (3,) describe the blur that `values` contain; without them blur is taken to be common.
    Without a `ridge` (V,) (`variation_ridge`) light may slope by a third of itself over the radius, and nothing else varies:
    before an element is known, whatever may vary makes strangers alike.
    """
    n, channels = values.shape[0], values.shape[2]
    points = patch_grid(n // 2, spacing)
    radius = n // 2 * spacing
    sx, sy = points.T.reshape(2, n, n, 1)
    # one more row and column on all sides, in a straight line: central differences are then one-sided at the border
    v = np.empty((n + 2, n + 2, channels))
    v[1:-1, 1:-1] = values
    v[0], v[-1] = 2 * v[1] - v[2], 2 * v[-2] - v[-3]
    v[:, 0], v[:, -1] = 2 * v[:, 1] - v[:, 2], 2 * v[:, -2] - v[:, -3]
    level = float(np.sqrt((weights[..., None] * values**2).sum() / max(channels * weights.sum(), 1e-30)))
    columns = np.zeros((_VARIATION.start + _POWERS + channels, n, n, channels))
    gx, gy = columns[5], columns[6]
    gx[:] = (v[1:-1, 2:] - v[1:-1, :-2]) / (2 * spacing)
    gy[:] = (v[2:, 1:-1] - v[:-2, 1:-1]) / (2 * spacing)
    columns[0] = values
    columns[1], columns[2], columns[3], columns[4] = gx * sx, gx * sy, gy * sx, gy * sy
    columns[7] = (v[1:-1, 2:] - 2 * values + v[1:-1, :-2]) / (2 * spacing**2)
    columns[8] = (v[2:, 2:] - v[2:, :-2] - v[:-2, 2:] + v[:-2, :-2]) / (4 * spacing**2)
    columns[9] = (v[2:, 1:-1] - 2 * values + v[:-2, 1:-1]) / (2 * spacing**2)
    columns[_LIGHT] = values * light_powers(points, radius).reshape(_POWERS, n, n, 1)
    for c in range(channels):
        columns[_LIGHT.stop + c, ..., c] = level
    columns *= np.sqrt(weights)[..., None]
    size = len(columns)
    gram = columns.reshape(size, -1) @ columns.reshape(size, -1).T
    if ridge is None:
        ridge = gram[0, 0] * np.where(np.arange(size - _VARIATION.start) < 2, 1e-3, 1e6)
    mean_blur = np.zeros(3) if mean_blur is None else mean_blur
    flat = columns.reshape(size, n * n, channels)
    return Template(
        points, values.reshape(-1, channels), weights.ravel(), flat, gram, radius, spread, mean_blur, level, ridge
    )


def excess_blur(template: Template, frames: Array) -> Array:
    """(M, 3): what the point spread of instances is wider than the template's."""
    if template.spread == 0:
        return np.zeros((len(frames), 3))
    return np.clip(template.spread * (blur(frames) - template.mean_blur), -_MOST_BLUR, _MOST_BLUR)


class Solver(NamedTuple):
    """The part of a registration step that depends on the template alone."""

    used: NDArray[np.bool_]  # (P,), points that patches are asked at; P' of them
    weights: Array  # (P'·C,) w there
    basis: Array  # (P'·C, B) float32, √w × that of the template
    unit: Array  # (6,) radius for shifts, 1 for strains: one damping serves both
    values: Array  # (6,) eigenvalues of the Hessian with the gain marginalised
    vectors: Array  # (6, 6)


def make_solver(template: Template, everywhere: bool = False) -> Solver:
    """Prepare registration steps to `template`, from patches at the points with weight or at all of its points."""
    used = (template.weights > 0) | everywhere
    channels = template.values.shape[1]
    weights, points = template.weights[used], template.points[used]
    radius = float(np.sqrt((weights @ points**2).sum() / weights.sum())) + 1e-9
    unit = np.array([1.0, 1, 1, 1, radius, radius])
    values, vectors = np.linalg.eigh(marginal_hessian(template) * np.outer(unit, unit))
    columns = template.columns if everywhere else template.columns[:, used]
    basis = (columns * np.sqrt(weights)[:, None]).astype(np.float32).reshape(len(columns), -1).T
    return Solver(used, np.repeat(weights.astype(np.float32), channels), basis, unit, np.maximum(values, 0), vectors)


def own_gram(template: Template) -> Array:
    """(1 + V, 1 + V) normal matrix of what is a copy's own, gain and variation, with the variation's prior."""
    own = _own(template)
    return template.gram[np.ix_(own, own)] + np.diag(np.r_[0.0, template.ridge])


def _own(template: Template) -> Array:
    return np.r_[0, _VARIATION.start : len(template.gram)]


def marginal_hessian(template: Template) -> Array:
    """(6, 6) Hessian of the registration in (a11, a12, a21, a22, t1, t2), gain and variation solved for (Schur complement)."""
    gram = template.gram
    cross = gram[_own(template), _MOTION]
    return gram[_MOTION, _MOTION] - cross.T @ np.linalg.solve(own_gram(template), cross)


def variation_ridge(variance: Array, noise2: float, channels: int) -> Array:
    """The `ridge` of a variation of that `variance` (V,) where residuals have variance `noise2`.

    Neighbouring samples share their noise, eight to one, and so do channels.
    """
    return _SHARED * channels * noise2 / variance


def learn_variation(template: Template, variation: Array, weights: Array, noise2: float, variance: Array) -> Array:
    """The variance (V,) of the `variation` (M, V) of instances with `weights` (M,), found under a prior of `variance` (V,).

    One step of MacKay's fixed point (Bayesian interpolation, Neural Computation 4, 1992): the mean square over the share that
    the data, and not the prior, determine. What does not vary is gone after a few steps.
    """
    unsure = _SHARED * template.values.shape[1] * noise2 * np.diag(np.linalg.inv(own_gram(template)))[1:]
    told = np.maximum(1 - unsure / variance, _LEAST_TOLD)
    return np.clip(weights @ variation**2 / weights.sum() / told, _LEAST_VARIATION**2, 1.0)


class Explained(NamedTuple):
    """What `explain` finds of M patches."""

    left: Array  # (M, 6) projections of what is left of d / L on the derivatives
    gain: Array  # (M,) L
    variation: Array  # (M, V) γ, τ
    residual: Array  # (M,) mean of w |d / L − µ (1 + γ b) − τ|² over Σ w, the prior's share included


def explain(template: Template, solver: Solver, patches: Array, excess: Array) -> Explained:
    """Fit gain and variation of patches (M, P', C) at the used points, with `excess` (M, 3) blur."""
    d = patches.reshape(len(patches), -1)
    projected = (d @ solver.basis).astype(np.float64)
    gram = template.gram
    blurred = gram[0] + excess @ gram[_BLUR]  # (M, B) of the blurred template on all columns
    own = _own(template)
    normal = np.repeat(own_gram(template)[None], len(patches), 0)
    normal[:, 0, 0] = blurred[:, 0] + np.einsum("mi,mi->m", excess, blurred[:, _BLUR])
    normal[:, 0, 1:] = normal[:, 1:, 0] = blurred[:, _VARIATION]
    right = projected[:, own]
    right[:, 0] += np.einsum("mi,mi->m", excess, projected[:, _BLUR])
    found = np.linalg.solve(normal, right[..., None])[..., 0]
    gain = np.maximum(found[:, 0], 1e-6)
    energy = np.square(d) @ solver.weights - np.einsum("mi,mi->m", found, right)
    left = projected[:, _MOTION] - gain[:, None] * blurred[:, _MOTION] - found[:, 1:] @ gram[_VARIATION, _MOTION]
    variation = np.clip(found[:, 1:] / gain[:, None], -1, 1)
    mass = template.weights.sum() * template.values.shape[1]
    return Explained(left / gain[:, None], gain, variation, np.maximum(energy / gain**2, 0) / mass)


def solve_step(solver: Solver, left: Array, damping: Array, limit: float) -> Array:
    """Damped Gauss–Newton steps (M, 6) (strain, shift) from what `explain` left; steps beyond `limit` (strain, or shift in
    radii) are shortened."""
    right = left * solver.unit
    stiff = np.maximum(solver.values + damping[:, None] * solver.values[-1], 1e-30)  # a plain template holds nothing
    step = ((right @ solver.vectors) / stiff) @ solver.vectors.T
    size = np.abs(step).max(1)
    return step * np.minimum(1.0, limit / np.maximum(size, 1e-12))[:, None] * solver.unit


def without_variation(template: Template, patches: Array, points: Array, gain: Array, variation: Array) -> Array:
    """Patches (M, P, C), sampled at `points` (P, 2), of gain (M,), as they would be did nothing but the gain vary."""
    light, tint = variation[:, :_POWERS].astype(np.float32), variation[:, _POWERS:]
    even = patches - (template.level * gain[:, None] * tint).astype(np.float32)[:, None]
    across = 1 + light @ light_powers(points, template.radius).astype(np.float32)
    even /= np.clip(across, 0.25, 4, out=across)[..., None]
    return even


def channel_gains(template: Template, patches: Array, frames: Array, variation: Array) -> Array:
    """(M, C) gain of each channel of patches (M, P, C) sampled at the template's points through `frames` (M, 2, 2).

    By least squares on the model (µ + ½ C : ∇∇µ) (1 + γ · b), which is a sum of 24 products of one part each.
    `variation` (M, V) is the one that registration found. Its light is taken out; its tint is not, because what looks like
    a tint to all channels together is what light of another colour does to each.
    """
    powers = np.concatenate([np.ones((1, len(template.points))), light_powers(template.points, template.radius)])
    parts = template.columns[[0, *range(_BLUR.start, _BLUR.stop)], None] * powers[None, :, :, None]  # (4, 6, P, C)
    blurred = np.concatenate([np.ones((len(frames), 1)), excess_blur(template, frames)], 1)
    lit = np.concatenate([np.ones((len(frames), 1)), variation[:, :_POWERS]], 1)
    share = (blurred[:, :, None] * lit[:, None, :]).reshape(len(frames), -1)
    root = np.sqrt(template.weights)
    gains = np.empty((len(patches), patches.shape[2]))
    for c, seen in enumerate(np.moveaxis(patches, 2, 0)):
        part = parts[..., c].reshape(share.shape[1], -1)
        along = seen @ (root * part).astype(np.float32).T
        gains[:, c] = (share * along).sum(1) / np.maximum((share @ (part @ part.T) * share).sum(1), 1e-30)
    return np.maximum(gains, 1e-6)


def estimate_spread(template: Template, patches: Array, frames: Array, weights: Array, noise2: float, prior: float) -> float:
    """Variance of the point spread (px²) that best explains how patches (M, P, C) differ from their mean.

    One number for all instances: the part of the residual along ½ C : ∇∇µ that neither the gain nor an affine step takes
    up. In logarithms, against `prior` (known to a factor of two); `noise2` is the residuals' variance.
    """
    projected = (patches.reshape(len(patches), -1) @ make_solver(template, everywhere=True).basis).astype(np.float64)
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
    solver = make_solver(template, everywhere=True)
    got = explain(template, solver, patches, excess_blur(template, frames))
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
    variation: Array  # (M, V) γ_i, τ_i
    residual: Array  # (M,) mean of w |d / L − µ (1 + γ b) − τ|² over Σ w, the prior's share included


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
    return Registered(xy, frames, got.gain, got.variation, got.residual)
