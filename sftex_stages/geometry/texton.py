"""EM for one texton: appearance, texture imaging transforms, irradiance and inliers (paper, section 3.1).

All lengths are pixels of one image (a pyramid level chosen by the caller). The steps: congeal the patches with free
affine frames, upgrade the frames to metric (Lemma 4), then EM with every frame held to the manifold s R F R, while the
domain grows to where the patches agree.
"""

import functools
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from .imaging import tensor_of
from .metric import Upgrade, circle_metric, gram_lift, leading_eigenpair, metric_upgrade, project_tensors
from .registration import (
    Template,
    blur,
    compose_step,
    estimate_spread,
    learn_variation,
    make_template,
    marginal_hessian,
    patch_grid,
    registration_step,
    sample,
    variation_ridge,
    without_variation,
)

Array = NDArray[np.floating]

PROGRESS = (1, 5, 10, 20)  # EM iterations whose frontal estimate is kept (the paper's Fig. 4)


class Settings(NamedTuple):
    """What the caller decides; lengths in grid points."""

    half: int  # half width of the first domain
    half_limit: int  # half width to which the domain may grow
    iterations: int  # EM iterations
    affine_iterations: int  # of which with free affine frames
    noise_floor: float  # standard deviation of a texton pixel that no agreement can undercut, in units of contrast
    trend_order: int  # order of the trend of log s
    agreement: float  # share of the unrelated variance below which a pixel belongs to the element
    spread: float  # variance of the image's point spread, px², before looking
    fit_spread: bool
    most: int = 100  # instances that are carried on once they show to be copies


class Estimate(NamedTuple):
    """A texton and the instances it was estimated from."""

    template: Template
    values: Array  # (n, n, C) µ
    weights: Array  # (n, n)
    half: int
    spacing: float  # pixels between grid points of `values`
    founders: NDArray[np.integer]  # (M,) which of the instances handed in are left
    xy: Array  # (M, 2)
    frames: Array  # (M, 2, 2)
    inlier: Array  # (M,) posterior of δ_i
    noise: float  # σ: root of the weighted residual variance of inliers
    prior: float  # mixing weight of the inliers
    history: list[tuple[int, Array, Array, Array]]  # (iteration, xy, frames, inlier)


@functools.lru_cache(maxsize=64)
def centre_window(half: int) -> Array:
    """Soft round window (n, n): 1 at the centre, 0 outside the inscribed circle."""
    axis = np.arange(-half, half + 1) / (half + 0.5)
    r2 = axis[:, None] ** 2 + axis[None, :] ** 2
    window = np.where(r2 < 1, np.exp(-1.5 * r2), 0.0)
    window.setflags(write=False)
    return window


def seed_members(patches: Array, window: Array) -> Array:
    """Weights (M,) of the members of the largest group of mutually similar patches (M, P, C).

    Similarity is zero-mean normalised correlation over the window; the seed is the patch that has the most good
    neighbours, and the members near it found the first template: a cluster that mixes elements starts from one.
    """
    w = window.astype(np.float32).ravel()[None, :, None]
    mean = (patches * w).sum(1, keepdims=True) / w.sum()
    detail = ((patches - mean) * np.sqrt(w)).reshape(len(patches), -1)
    detail /= np.maximum(np.linalg.norm(detail, axis=1, keepdims=True), 1e-9)
    similar = detail @ detail.T
    score = np.sort(similar, axis=1)[:, -max(3, len(patches) // 3) :].mean(1)
    near = similar[int(score.argmax())]
    cut = np.sort(near)[-max(3, int(0.6 * len(near)))]
    return np.where(near >= max(cut, 0.5), np.clip(near, 0.0, 1.0) ** 4, 0.0)


def weighted_mean(patches: Array, gain: Array, weights: Array) -> tuple[Array, Array]:
    """Mean and variance over instances of the patches (M, P, C) divided by their gain (M,): (P, C), (P,)."""
    share = weights / weights.sum()
    flat = patches.reshape(len(patches), -1)
    mean = ((share / gain).astype(np.float32) @ flat).reshape(patches.shape[1:])
    square = ((share / gain**2).astype(np.float32) @ np.square(flat)).reshape(patches.shape[1:])
    effective = 1 / (share**2).sum()
    var = np.maximum(square - mean**2, 0).mean(1) * effective / max(effective - 1, 0.5)
    return mean.astype(np.float64), var.astype(np.float64)


def posterior(residual: Array, noise2: float, contrast2: float, prior: float, samples: float) -> Array:
    """E[δ_i] for mean squared residuals (M,): inliers have variance noise2, others contrast2, `samples` independent."""
    spread = max(contrast2, 2 * noise2)
    log_odds = 0.5 * samples * (np.log(spread / noise2) - residual * (1 / noise2 - 1 / spread))
    return 1 / (1 + np.exp(-np.clip(log_odds + np.log(prior / (1 - prior)), -500, 500)))


def domain_weights(values: Array, var: Array, half: int, floor: float, agreement: float) -> Array:
    """Inverse-variance weights (n, n) of the texton's pixels.

    A pixel belongs to the element while its variance across instances is below `agreement` × the variance that
    unrelated pixels have; only the part connected with the centre counts. Weights are 1 at best.
    """
    n = 2 * half + 1
    window = (centre_window(half) > 0).ravel()
    inner = centre_window(half).ravel()
    share = inner / inner.sum()
    contrast2 = float(((values - share @ values) ** 2 * share[:, None]).sum() / values.shape[1])
    base = max(floor**2 * contrast2, 1e-10)
    image = cv2.GaussianBlur(var.reshape(n, n).astype(np.float32), (0, 0), 0.8).ravel()
    agree = window & (image < agreement * max(contrast2, base))
    mask = agree.reshape(n, n).astype(np.uint8)
    _, labels = cv2.connectedComponents(mask, connectivity=4)
    core = slice(half - max(1, half // 4), half + max(1, half // 4) + 1)
    touching = np.zeros(labels.max() + 1, bool)
    touching[labels[core, core]] = True
    touching[0] = False
    keep = touching[labels].ravel()
    weights = np.where(keep, base / (base + image), 0.0)
    return weights.reshape(n, n)


def grow(values: Array, var: Array, half: int, agreement: float, contrast2: float) -> bool:
    """Whether the outermost ring of the domain still agrees in a fair part, so that a larger domain is worth trying."""
    n = 2 * half + 1
    axis = np.arange(-half, half + 1) / half
    r = np.sqrt(axis[:, None] ** 2 + axis[None, :] ** 2).ravel()
    ring = (r <= 1) & (r > 0.75)
    # a flat ring agrees always and tells nothing: it must carry some of the contrast
    rim = values.reshape(n * n, -1)[ring]
    busy = ((rim - rim.mean(0)) ** 2).mean() > 0.02 * contrast2
    return bool((var[ring] < agreement * contrast2).mean() > 0.25 and busy)


def estimate_texton(image: Array, xy: Array, frames: Array, where: Array, settings: Settings) -> Estimate | None:
    """EM of section 3.1 on the members of one cluster.

    `image` (H, W, C) linear; `xy` (M, 2), `frames` (M, 2, 2): detector frames in pixels of `image`, one grid point a
    unit; `where` (M, 2) positions in [−1, 1]. None when no group of three similar patches exists.
    """
    half = settings.half
    n = 2 * half + 1
    window = centre_window(half)
    patches = sample(image, xy, frames, patch_grid(half, 1.0))
    inlier = seed_members(patches, window)
    if (inlier > 0).sum() < 3:
        return None
    gain = np.maximum(np.einsum("mpc,p->m", patches, window.ravel()) / window.sum(), 1e-6)
    gain /= np.median(gain[inlier > 0])
    values, var = weighted_mean(patches, gain, inlier)
    mean_blur = inlier @ blur(frames) / inlier.sum()
    weights, noise2, prior, contrast2 = window, 0.0, 0.7, 1.0
    history: list[tuple[int, Array, Array, Array]] = []
    scale = np.ones(len(xy))
    last_growth, spacing, spread = 0, 1.0, settings.spread
    ridge: Array | None = None
    founders: NDArray[np.integer] = np.arange(len(xy))
    for iteration in range(1, settings.iterations + 1):
        template = make_template(values.reshape(n, n, -1), weights, spacing, spread, mean_blur, ridge)
        contrast2 = weighted_contrast(template)
        # M-step for the transforms and gains, E-step for δ, all from the patches in hand
        step, own = registration_step(template, patches, frames, _DAMPING)
        gain, variation, residual = own.gain, own.variation, own.residual
        if iteration == 1:
            noise2 = max(float(np.median(residual[inlier > 0.3])), 1e-12)
        samples = independent_samples(template)
        for _ in range(3):
            inlier = posterior(residual, noise2, contrast2, prior, samples)
            noise2 = float(max((inlier * residual).sum() / max(inlier.sum(), 1e-6), settings.noise_floor**2 * contrast2, 1e-12))
            prior = min(max(float(inlier.mean()), 0.05), 0.98)
        if inlier.sum() < 2.5:
            return None
        seen_by = frames  # the frames that `patches` were sampled through
        xy, frames = compose_step(xy, frames, step)
        if iteration == settings.affine_iterations:
            # what is no view of this element by now is left to the last registration
            keep, copies = np.flatnonzero(inlier > 1e-3), np.flatnonzero(inlier > 0.5)
            if len(copies) > settings.most:
                keep = copies[np.linspace(0, len(copies) - 1, settings.most).astype(int)]
            founders = founders[keep]
            xy, frames, inlier, gain = xy[keep], frames[keep], inlier[keep], gain[keep]
            residual, step, variation = residual[keep], step[keep], variation[keep]
            where = where[keep]
            history = [(k, a[keep], b[keep], c[keep]) for k, a, b, c in history]
        if iteration >= settings.affine_iterations:
            if ridge is None:
                variance = np.full(variation.shape[1], _VARIES**2)
            else:
                variance = learn_variation(template, variation, inlier, noise2, variance)
            ridge = variation_ridge(variance, noise2, values.shape[-1])
            since = iteration - settings.affine_iterations
            if since % _UPGRADE_EVERY == 0:
                if settings.fit_spread and since > 0:
                    spread = estimate_spread(template, patches, seen_by, inlier, noise2, settings.spread)
                order = settings.trend_order if len(xy) >= 12 else 0
                upgrade, _ = upgrade_texton(template, frames, where, inlier + 1e-6, order, 30 if since == 0 else 5, since > 0)
                frames, scale = frames @ np.linalg.cholesky(upgrade.gram), np.exp(upgrade.log_scale)
            frames = hold_to_manifold(frames, scale, template, residual)
            # the normal that an element tells is the one where its detail lies, not where the detector put its point
            xy = xy + frames @ information_centre(template)
            if iteration - last_growth >= 2 and half * spacing < settings.half_limit:
                if grow(values, var, half, settings.agreement, contrast2):
                    reach, last_growth = min(1.3 * half * spacing, settings.half_limit), iteration
                    half = min(int(np.ceil(reach)), _HALF)
                    spacing, n = max(1.0, reach / half), 2 * half + 1
        if iteration in PROGRESS:
            history.append((iteration, xy, frames, inlier))
        # M-step for the appearance
        points = patch_grid(half, spacing)
        patches = sample(image, xy, frames, points)
        sure = inlier > 0.5
        gain = gain / np.median(gain[sure]) if sure.any() else gain
        shares = inlier * _sharpness(frames)
        values, var = weighted_mean(without_variation(template, patches, points, gain, variation), gain, shares)
        mean_blur = shares @ blur(frames) / shares.sum()
        weights = domain_weights(values, var, half, 0.1, settings.agreement)
        if (weights > 0).sum() < 9:
            return None
        settled = iteration >= max(settings.affine_iterations, last_growth) + 2 * _UPGRADE_EVERY
        if settled and np.median(np.abs(step[sure, :4]).max(1)) < _SETTLED:
            break
    # EM that has settled would not change any more: its last state stands for the iterations that were not needed
    history += [(k, xy, frames, inlier) for k in PROGRESS if iteration < k <= settings.iterations]
    template = make_template(values.reshape(n, n, -1), weights, spacing, spread, mean_blur, ridge)
    noise = float(np.sqrt(noise2))
    values = values.reshape(n, n, -1)
    return Estimate(template, values, weights, half, spacing, founders, xy, frames, inlier, noise, prior, history)


_DAMPING = 1e-3
_VARIES = 0.1  # standard deviation of an instance's light and tint, before looking
_FREE_STRAIN = 1.0
_UPGRADE_EVERY = 3  # iterations on the manifold between metric upgrades

_SETTLED = 1e-2  # strain of a step that moves no edge of an element by a twentieth of a pixel
_HALF = 15  # a domain of more grid points is sampled more coarsely: large elements have large detail
_CIRCLE = 0.15  # a turn that costs less than this share of the next strain is none
_ROUND = 1.2  # a circle may fit this much worse than a free stretch, which has two numbers more


def circle_of(template: Template) -> Array | None:
    """M (2, 2) up to size of an element that a turn leaves alone (section 2.2.2), None for any other."""
    ratio, gram = circle_metric(marginal_strain(template))
    if gram is None or ratio > _CIRCLE or np.linalg.cond(gram) > 6:
        return None  # a long ellipse is an edge or a line rather than a tilted disc
    return gram


def upgrade_texton(
    template: Template, frames: Array, where: Array, weights: Array, order: int, steps: int = 30, warm: bool = False
) -> tuple[Upgrade, bool]:
    """The metric upgrade of a texton's frames, and whether its element was taken for a circle (section 2.2.2).

    An element that a turn leaves alone is set to a circle where equal major axes fit its instances about as well as a
    free stretch does: a dot whose neighbours show, or a leaf that happens to be round, keeps its own.
    """
    upgrade = metric_upgrade(frames, where, weights, order, steps, warm)
    gram = circle_of(template)
    if gram is None:
        return upgrade, False
    round_ = metric_upgrade(frames, where, weights, order, steps, warm, gram)
    return (round_, True) if round_.residual < _ROUND * upgrade.residual else (upgrade, False)


def marginal_strain(template: Template) -> Array:
    """(4, 4) Hessian of the strain with gain and shift solved for."""
    h = marginal_hessian(template)
    return h[:4, :4] - h[:4, 4:] @ np.linalg.solve(h[4:, 4:] + 1e-9 * np.trace(h[4:, 4:]) * np.eye(2), h[4:, :4])


def information_centre(template: Template) -> Array:
    """Centre (2,) of the detail that fixes the transform: mean position weighted by w |∇µ|²."""
    power = (template.columns[5:7] ** 2).sum((0, 2))
    return power @ template.points / max(power.sum(), 1e-30)


def element_radius(weights: Array) -> float:
    """Radius, in grid points, of a disc as large as the part of a domain of `weights` that counts."""
    return float(np.sqrt((weights > 0.3 * weights.max()).sum() / np.pi))


def independent_samples(template: Template) -> float:
    """Number of independent residuals that a patch is judged by: neighbouring grid points share the image's blur."""
    return float(np.clip((template.weights > 0.02 * template.weights.max()).sum() / 8, 6, 40))


def weighted_contrast(template: Template) -> float:
    """Variance of µ over its domain, mean of the channels."""
    share = template.weights / template.weights.sum()
    mean = share @ template.values
    return float(((template.values - mean) ** 2 * share[:, None]).sum() / template.values.shape[1])


def _sharpness(frames: Array) -> Array:
    """Steep instances show less detail: weight by cos σ."""
    l1, l2, _ = leading_eigenpair(frames @ np.swapaxes(frames, 1, 2))
    return np.sqrt(np.maximum(l2, 0) / np.maximum(l1, 1e-18))


def strain_covariance(template: Template, residual: Array) -> Array:
    """Covariance (M, 3, 3) of the symmetric strain (2 d11, d12 + d21, 2 d22) of a registration, up to one factor.

    From the information of the template (its Hessian with gain and translation marginalised) and each instance's mean
    squared `residual` (M,). Neighbouring samples are not independent, and models are never exact: `calibrate` finds the factor.
    """
    values, vectors = np.linalg.eigh(marginal_strain(template))
    # a strain that nothing holds is known to its own size: the free turn of a circle, a stretch along an edge
    spread = 1 / (np.maximum(values, 0) / residual[:, None].clip(1e-30) + 1 / _FREE_STRAIN**2)
    fold = np.array([[2.0, 0, 0, 0], [0, 1, 1, 0], [0, 0, 0, 2]]) @ vectors
    return (fold * spread[:, None, :]) @ fold.T


def strain_error(template: Template, residual: float) -> float:
    """Standard deviation of the symmetric strain in the direction that the element holds least (section 3.1.2).

    `residual` is the mean squared residual of its typical instance, of which eight neighbouring samples count as one.
    """
    return float(np.sqrt(np.linalg.eigvalsh(strain_covariance(template, np.array([8 * residual]))[0])[-1]))


def tensor_covariance(frames: Array, scale: Array, strain: Array) -> Array:
    """Covariance (M, 3, 3) of (xx, xy, yy) of G Gᵀ/s² from that of the strain."""
    g = frames / scale[:, None, None]
    lift = gram_lift(g)
    return lift @ strain @ np.swapaxes(lift, 1, 2) + 1e-8 * np.eye(3)


def hold_to_manifold(frames: Array, scale: Array, template: Template, residual: Array) -> Array:
    """Frames (M, 2, 2) moved to the nearest s R F R in the metric of their own information."""
    cov = tensor_covariance(frames, scale, strain_covariance(template, residual))
    projected, _, _ = project_tensors(tensor_of(frames, scale), cov)
    return with_tensor(frames, projected, scale)


def with_tensor(frames: Array, tensor: Array, scale: Array) -> Array:
    """The matrices nearest in rotation to `frames` whose T Tᵀ is s² `tensor`, the tensor clipped to valid slants."""
    mat = np.stack([tensor[:, 0], tensor[:, 1], tensor[:, 1], tensor[:, 2]], -1).reshape(-1, 2, 2)
    _, l2, u = leading_eigenpair(mat)
    v = np.stack([-u[:, 1], u[:, 0]], -1)
    minor = np.sqrt(np.clip(l2, 0.01, 1.0))
    root = u[:, :, None] * u[:, None, :] + minor[:, None, None] * v[:, :, None] * v[:, None, :]
    return scale[:, None, None] * (root @ nearest_turn(root @ frames))


def nearest_turn(m: Array) -> Array:
    """The rotations or reflections (M, 2, 2) nearest to `m` (M, 2, 2): their polar factors."""
    side = np.where(m[:, 0, 0] * m[:, 1, 1] >= m[:, 0, 1] * m[:, 1, 0], 1.0, -1.0)
    c, s = m[:, 0, 0] + side * m[:, 1, 1], m[:, 1, 0] - side * m[:, 0, 1]
    length = np.maximum(np.hypot(c, s), 1e-30)
    c, s = c / length, s / length
    return np.stack([c, -side * s, s, side * c], -1).reshape(-1, 2, 2)
