"""The metric upgrade: from affine registrations to texture imaging transforms.

Registration gives frames G_i known up to one common affine map A. By Lemma 4 of the paper three generic instances
fix A up to rotation and flip: every G_i A must have its larger singular value equal to the local scale s_i. Only
M = A Aᵀ enters, because G_i M G_iᵀ = s_i² (I − n_xy n_xyᵀ).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating]

_NOISY = 0.15  # anisotropy below which the larger singular value is biased by noise
_STILL = 1e-5  # a step that changes no normal
_TREND_SIGMA = 0.1  # prior of each coefficient of log s over the image: a tenth is a strong perspective
_RELIEFS = (0.03, 0.1, 0.3, 1.0)  # amplitudes of log s, at the longest wave, that are tried
_WAVES = 6  # half waves of log s over the image, at most
_QUIET = 0.008  # log s that stays so near to its trend has no relief in it
_RELIEF_GAIN = 5.0  # nats that relief must bring: instances' errors are not independent
_STUDENT = 4.0  # freedom of the noise in that


class Upgrade(NamedTuple):
    """Result of `metric_upgrade`."""

    gram: Array  # (2, 2) M = A Aᵀ
    trend: Array  # (K,) coefficients of log s over the columns of `trend_basis`
    log_scale: Array  # (N,) log s at the instances
    residual: float  # robust standard deviation of log σ_max − log s over instances that inform it
    relief: float  # amplitude of the waves in log s; 0: it follows the polynomial alone


def trend_basis(where: Array, order: int = 2, relief: float = 0.0) -> Array:
    """Columns x, y, x², xy, y² of normalised positions (N, 2) in [−1, 1]: (N, 5); order 0 or 1 zeroes the rest.

    With `relief` cosine waves besides, (N, K): what perspective adds where the surface stands out or lies back. They are scaled
    to one prior with the others, their amplitudes as those of a Brownian surface (wave number to the power −3/2).
    """
    x, y = where[:, 0], where[:, 1]
    columns = np.stack([x, y, x * x, x * y, y * y], -1)
    if order < 2:
        columns[:, 2:] = 0.0
    if order < 1:
        columns[:] = 0.0
    if relief == 0:
        return columns
    i, j = np.mgrid[0 : _WAVES + 1, 0 : _WAVES + 1].reshape(2, -1)
    k = np.hypot(i, j)
    i, j, k = (v[(k > 0) & (k <= _WAVES)] for v in (i, j, k))
    waves = np.cos(np.pi / 2 * i * (x[:, None] + 1)) * np.cos(np.pi / 2 * j * (y[:, None] + 1))
    return np.concatenate([columns, waves * (relief / _TREND_SIGMA * k**-1.5)], 1)


def find_relief(r: Array, jac: Array, where: Array, weights: Array, order: int) -> tuple[float, float]:
    """Amplitude of the waves in log s of greatest evidence, 0 if none is worth it, and the noise that is left beside them.

    `r` (N,): log σ_max − log s of a fit without waves, `jac` (N, F) its derivatives by M, `weights` (N,) in 0…1. Coefficients
    are integrated out, in the eigenbasis of their information; Gaussian noise, once the richest fit has told the outliers.
    """
    say = weights * _inlying(r, jac, where, weights, order)
    total, best, first = float(say.sum()), (-np.inf, 0.0, 0.0), -np.inf
    for relief in (0.0, *_RELIEFS):
        basis = _scaled(jac, where, order, relief)
        values, vectors = np.linalg.eigh(basis.T @ (say[:, None] * basis))
        values, seen = np.maximum(values, 0)[:, None], ((say * r) @ basis @ vectors)[:, None] ** 2
        variance = np.geomspace(1e-3, 0.3, 40) ** 2
        fit = (say @ r**2 - (seen / (values + variance)).sum(0)) / variance
        evidence = -0.5 * (fit + np.log1p(values / variance).sum(0) + total * np.log(variance))
        k = int(evidence.argmax())
        first = max(first, evidence[k]) if relief == 0 else first
        if relief == 0 or evidence[k] > max(best[0], first + _RELIEF_GAIN):
            best = (float(evidence[k]), relief, float(np.sqrt(variance[k])))
    return best[1:]


def _scaled(jac: Array, where: Array, order: int, relief: float) -> Array:
    """Columns (N, F + K) of M, next to free, and of log s, all scaled to unit priors."""
    return np.concatenate([10 * jac, _TREND_SIGMA * trend_basis(where, order, relief)], 1)


def _inlying(r: Array, jac: Array, where: Array, weights: Array, order: int) -> Array:
    """Student weights (N,) of residuals against the richest fit."""
    basis, left = _scaled(jac, where, order, _RELIEFS[-1]), r
    say, taken = np.ones(len(r)), 0.0
    for _ in range(4):
        heavy = weights * say
        variance = max(_weighted_mad(left, weights), 1e-3) ** 2 * heavy.sum() / max(heavy.sum() - taken, 0.1 * heavy.sum())
        say = (_STUDENT + 1) / (_STUDENT + left**2 / variance)
        information = basis.T @ ((weights * say)[:, None] * basis) / variance
        inverse = np.linalg.inv(information + np.eye(basis.shape[1]))
        left = r - basis @ (inverse @ (basis.T @ (weights * say * r))) / variance
        taken = float(basis.shape[1] - np.trace(inverse))
    return say


def leading_eigenpair(tensors: Array) -> tuple[Array, Array, Array]:
    """(λ1, λ2, unit eigenvector of λ1) of symmetric (N, 2, 2) matrices, λ1 ≥ λ2."""
    xx, xy, yy = tensors[:, 0, 0], tensors[:, 0, 1], tensors[:, 1, 1]
    mean, half = (xx + yy) / 2, np.hypot((xx - yy) / 2, xy)
    angle = 0.5 * np.arctan2(2 * xy, xx - yy)
    return mean + half, mean - half, np.stack([np.cos(angle), np.sin(angle)], -1)


def linear_start(frames: Array, weights: Array) -> Array | None:
    """M from det(G)² d − tr(G M Gᵀ) + 1 = 0, linear in (M, d = det M) (Lemma 1); None if it is not positive.

    Needs four instances or more; `frames` (N, 2, 2) must be scaled so that M is near the identity.
    """
    g = frames
    det2 = np.linalg.det(g) ** 2
    gtg = np.swapaxes(g, -1, -2) @ g
    rows = np.stack([gtg[:, 0, 0], 2 * gtg[:, 0, 1], gtg[:, 1, 1], -det2], -1)
    root = np.sqrt(weights)[:, None]
    if len(g) < 4:
        return None
    solution = np.linalg.lstsq(rows * root, root[:, 0], rcond=None)[0]
    gram = np.array([[solution[0], solution[1]], [solution[1], solution[2]]])
    return gram if np.linalg.eigvalsh(gram)[0] > 1e-3 else None


def circle_metric(hessian: Array) -> tuple[float, Array | None]:
    """Whether an element looks the same when turned (section 2.2.2): (ratio, M with determinant 1 or None).

    `hessian` (4, 4) is the registration's over the strain D = (d11, d12, d21, d22), gain and shift marginalised. Its weakest
    direction, against the next: a small `ratio` with a D of complex eigenvalues is a rotation seen in the frame of
    an ellipse, D ∝ A J A⁻¹, so that M = A Aᵀ ∝ D J⁻¹ makes the element a circle.
    """
    values, vectors = np.linalg.eigh(hessian)
    ratio = float(max(values[0], 0) / max(values[1], 1e-30))
    d = vectors[:, 0].reshape(2, 2)
    d = d - np.eye(2) * np.trace(d) / 2
    gram = d @ np.array([[0.0, 1.0], [-1.0, 0.0]])
    gram = (gram + gram.T) / 2
    det = np.linalg.det(gram)
    if det <= 1e-3 * np.trace(gram) ** 2:
        return ratio, None
    return ratio, gram * np.sign(np.trace(gram)) / np.sqrt(det)


def metric_upgrade(
    frames: Array,
    where: Array,
    weights: Array,
    order: int = 1,
    steps: int = 30,
    warm: bool = False,
    circle: Array | None = None,
) -> Upgrade:
    """Find M and the trend of log s so that the larger singular value of every G_i A is s_i.

    Robust Gauss–Newton on log σ_max(G_i A) − log s(x_i) in the three entries of M and the trend; s is 1 at the centre
    of `where` (N, 2) in [−1, 1]. Instances that are nearly frontal count little: there the larger of two equal and
    noisy singular values is biased upward. Several starts, and the lowest robust cost wins; `warm` says that the frames
    are nearly metric already. Where what is left follows the place, log s gets waves as well (`find_relief`). For a circular
    element its M up to size is given by `circle` (`circle_metric`): equal major axes then fix the size alone.
    """
    base = float(np.sqrt(np.median(leading_eigenpair(frames @ np.swapaxes(frames, 1, 2))[0])))
    g = frames / base
    shape = np.eye(3) if circle is None else np.array([[circle[0, 0], circle[0, 1], circle[1, 1]]])
    starts: list[Array] = [np.eye(2)]
    if circle is not None:
        l1, _, _ = leading_eigenpair(g @ circle @ np.swapaxes(g, -1, -2))
        starts = [circle / np.median(l1)]
    elif not warm:
        start = linear_start(g, weights)
        if start is not None:
            starts.append(start)
        spread = np.swapaxes(g, -1, -2) @ g
        starts.append(np.linalg.inv(np.einsum("n,nij->ij", weights, spread) / weights.sum()))
    best: tuple[float, Array, Array, Array] | None = None
    basis = trend_basis(where, order)
    for gram in starts:
        solved = _refine(g, basis, weights, gram, shape, steps)
        if best is None or solved[0] < best[0]:
            best = solved
    assert best is not None
    _, gram, trend, residuals = best
    spread_, relief = _weighted_mad(residuals, weights * _informs(g, gram)), 0.0
    if order > 0 and spread_ > _QUIET:
        _, jac, w = _look(gram_lift(g), gram[[0, 0, 1], [0, 1, 1]], basis @ trend, weights)
        relief, noise = find_relief(residuals, jac @ shape.T, where, w, order)
    if relief > 0:
        basis = trend_basis(where, order, relief)
        _, gram, trend, residuals = _refine(g, basis, weights, gram, shape, steps, noise)
        spread_ = max(_weighted_mad(residuals, weights * _informs(g, gram)), noise)
    return Upgrade(gram / base**2, trend, basis @ trend, spread_, relief)


def _informs(g: Array, gram: Array) -> Array:
    """Weight in [0, 1] of an instance: its anisotropy against the level where σ_max is biased by noise."""
    l1, l2, _ = leading_eigenpair(g @ gram @ np.swapaxes(g, -1, -2))
    kappa = 1 - np.clip(l2, 0, None) / np.maximum(l1, 1e-12)
    return kappa**2 / (kappa**2 + _NOISY**2) + 0.02


def _weighted_mad(values: Array, weights: Array) -> float:
    order = np.argsort(np.abs(values))
    cumulative = np.cumsum(weights[order])
    return float(1.4826 * np.abs(values)[order][np.searchsorted(cumulative, cumulative[-1] / 2)])


def _refine(
    g: Array, basis: Array, weights: Array, gram: Array, shape: Array, steps: int, noise: float = 3e-3
) -> tuple[float, Array, Array, Array]:
    """(log of the residuals' spread, M, trend, residuals) from the start `gram`; `noise` is the least spread assumed."""
    lift = gram_lift(g)
    m = np.array([gram[0, 0], gram[0, 1], gram[1, 1]])
    trend = np.zeros(basis.shape[1])
    free = len(shape)  # M moves along the rows of `shape` (free, 3)
    prior = np.r_[np.full(free, 1e-6), np.full(len(trend), 1 / _TREND_SIGMA**2)]

    def look(m: Array, trend: Array) -> tuple[Array, Array, Array]:
        return _look(lift, m, basis @ trend, weights)

    def cost(r: Array, w: Array, scale: float) -> float:
        return float(w @ np.log1p((r / scale) ** 2) / w.sum())

    r, jac, w = look(m, trend)
    for _ in range(steps):
        scale = max(_weighted_mad(r, w), noise)
        robust = w / (1 + (r / (2 * scale)) ** 2)
        full = np.concatenate([jac @ shape.T, -basis], 1)
        normal = full.T @ (robust[:, None] * full) / scale**2 + np.diag(prior)
        grad = full.T @ (robust * r) / scale**2
        grad[free:] += trend / _TREND_SIGMA**2
        step = -np.linalg.solve(normal, grad)
        move = step[:free] @ shape
        here = cost(r, w, 2 * scale)
        for fraction in (1.0, 0.5, 0.25, 0.1):
            new = m + fraction * move
            if _smallest(new) < 0.02:
                continue
            new_trend = trend + fraction * step[free:]
            new_r, new_jac, new_w = look(new, new_trend)
            if cost(new_r, w, 2 * scale) < here + 1e-9:
                m, trend, r, jac, w = new, new_trend, new_r, new_jac, new_w
                break
        else:
            break
        if np.abs(step).max() * fraction < _STILL:
            break
    # starts are compared on one robust scale: the log of their own spread
    return float(np.log(max(_weighted_mad(r, w), 1e-4))), np.array([[m[0], m[1]], [m[1], m[2]]]), trend, r


def _look(lift: Array, m: Array, log_scale: Array, weights: Array) -> tuple[Array, Array, Array]:
    """Residuals (N,) log σ_max − log s, their derivatives by m (N, 3), the instances' weights (N,); `lift` of the frames."""
    xx, xy, yy = (lift @ m).T  # of G M Gᵀ
    half = (xx - yy) / 2
    radius = np.maximum(np.sqrt(half**2 + xy**2), 1e-12)
    l1 = np.maximum((xx + yy) / 2 + radius, 1e-9)
    cos, sin = half / radius, xy / radius  # of twice the leading direction's angle
    squares = np.stack([(1 + cos) / 2, sin, (1 - cos) / 2], -1)
    jac = (squares[:, None, :] @ lift)[:, 0] / (2 * l1[:, None])
    kappa2 = np.minimum(2 * radius / l1, 1.0) ** 2
    return 0.5 * np.log(l1) - log_scale, jac, weights * (kappa2 / (kappa2 + _NOISY**2) + 0.02)


def _smallest(m: Array) -> float:
    """Smaller eigenvalue of ((m1, m2), (m2, m3))."""
    return float((m[0] + m[2]) / 2 - np.hypot((m[0] - m[2]) / 2, m[1]))


def metric_covariance(
    frames: Array,
    where: Array,
    weights: Array,
    order: int,
    residual: float,
    turn: Array | float = 0.0,
    circular: bool = False,
    relief: float = 0.0,
) -> Array:
    """Covariance (3 + K, 3 + K) of (M11, M12, M22, trend) around M = I, for frames (N, 2, 2) that are metric already.

    `residual` is the standard deviation of one instance's log σ_max, `turn` (N,) the variance (rad²) of the direction that
    keeps its length (`turn_variance`): directions that differ by their noise alone are one direction. Where all instances
    keep nearly the same direction of the element (section 2.2.2) it is large, and says along which stretch of the element.
    """
    l1, _, u = leading_eigenpair(frames @ np.swapaxes(frames, -1, -2))
    v = np.einsum("nji,nj->ni", frames, u) / np.sqrt(np.maximum(l1, 1e-9))[:, None]
    squares = np.stack([v[:, 0] ** 2, 2 * v[:, 0] * v[:, 1], v[:, 1] ** 2], -1)
    full = np.concatenate([squares / 2, -trend_basis(where, order, relief)], 1)
    w = weights * _informs(frames, np.eye(2))
    effective = w.sum() ** 2 / max((w**2).sum(), 1e-12)
    # instances of one cluster share errors (a domain that is not flat, blur that goes with slant): a quarter of them count
    variance = max(residual, 2e-3) ** 2 * 4 * effective / max(effective - 3, 0.5)
    # a circular element has one freedom, its size
    size, trends = full.shape[1], full.shape[1] - 3
    basis = np.eye(size) if not circular else np.vstack([np.r_[1.0, 0, 1, np.zeros(trends)], np.eye(size)[3:]])
    prior = np.diag(np.r_[np.full(len(basis) - trends, 1.0), np.full(trends, 1 / _TREND_SIGMA**2)])
    information = full.T @ (w[:, None] * full)
    # noise of v makes its directions seem to differ: what it adds to their scatter is taken off (errors in variables)
    slope = np.stack([-v[:, 0] * v[:, 1], v[:, 0] ** 2 - v[:, 1] ** 2, v[:, 0] * v[:, 1]], -1)
    information[:3, :3] -= slope.T @ ((w * turn)[:, None] * slope)
    values, vectors = np.linalg.eigh(basis @ information @ basis.T)
    information = (vectors * np.maximum(values, 0)) @ vectors.T
    return basis.T @ np.linalg.inv(information / variance + prior) @ basis


def turn_variance(tensor: Array, cov: Array) -> Array:
    """Variance (N,), rad², of the leading direction of tensors (N, 3) with covariance (N, 3, 3); 0.5 where it is unknown."""
    l1, l2, u = leading_eigenpair(tensor[:, [0, 1, 1, 2]].reshape(-1, 2, 2))
    across = np.stack([-u[:, 0] * u[:, 1], u[:, 0] ** 2 - u[:, 1] ** 2, u[:, 0] * u[:, 1]], -1)
    variance = np.einsum("ni,nij,nj->n", across, cov, across)
    return np.minimum(variance / np.maximum((l1 - l2) ** 2, 1e-12), 0.5)


def common_covariance(frames: Array, where: Array, scale: Array, order: int, cov: Array, relief: float = 0.0) -> Array:
    """What an uncertain M and trend add to the covariances (N, 3, 3) of G M Gᵀ/s²; frames metric, `cov` (3 + K, 3 + K)."""
    g = frames / scale[:, None, None]
    tensor = np.stack([(g[:, 0] ** 2).sum(-1), (g[:, 0] * g[:, 1]).sum(-1), (g[:, 1] ** 2).sum(-1)], -1)
    jac = np.concatenate([gram_lift(g), -2 * tensor[:, :, None] * trend_basis(where, order, relief)[:, None, :]], 2)
    return jac @ cov @ np.swapaxes(jac, 1, 2)


def gram_lift(g: Array) -> Array:
    """(N, 3, 3) matrices that take (e1, e2, e3) of a symmetric E to (xx, xy, yy) of G E Gᵀ."""
    a, b, c, d = g[:, 0, 0], g[:, 0, 1], g[:, 1, 0], g[:, 1, 1]
    rows = [
        np.stack([a * a, 2 * a * b, b * b], -1),
        np.stack([a * c, a * d + b * c, b * d], -1),
        np.stack([c * c, 2 * c * d, d * d], -1),
    ]
    return np.stack(rows, 1)


def constraint_gap(tensor: Array, cov: Array) -> tuple[Array, Array]:
    """λ1 − 1 of tensors (N, 3), which is 0 on the manifold, and its variance (N,) by `cov` (N, 3, 3)."""
    l1, _, u = leading_eigenpair(np.stack([tensor[:, 0], tensor[:, 1], tensor[:, 1], tensor[:, 2]], -1).reshape(-1, 2, 2))
    grad = np.stack([u[:, 0] ** 2, 2 * u[:, 0] * u[:, 1], u[:, 1] ** 2], -1)
    return l1 - 1.0, np.maximum(np.einsum("ni,nij,nj->n", grad, cov, grad), 1e-12)


def leading_bias(tensor: Array, variance: Array) -> Array:
    """How much noise of `variance` (N,) raises the larger eigenvalue of tensors (N, 3) on average, to second order."""
    apart = np.hypot(tensor[:, 0] - tensor[:, 2], 2 * tensor[:, 1])
    return variance / np.maximum(apart, 2 * np.sqrt(variance))


def noise_split(gap: Array, variance: Array, weights: Array) -> tuple[float, float]:
    """(factor, scale variance): the spread of λ1 − 1 is factor × `variance` + 4 var(log s), by maximum likelihood.

    Registration noise and the scale's own departure from its trend (perspective over relief) both take an instance off
    the manifold; they differ in how they go with the instance's information. Student-t with 4 degrees of freedom, on a grid.
    """
    factors = np.geomspace(1, 400, 19)
    scales = np.r_[0.0, np.geomspace(2e-3, 0.3, 16)] ** 2
    total = factors[:, None, None] * variance + scales[None, :, None]
    loss = weights * (0.5 * np.log(total) + 2.5 * np.log1p(gap**2 / (4 * total)))
    # neighbouring samples are correlated, about ten to one independent: where the data cannot tell, that is the guess
    cost = loss.sum(-1) + 0.5 * (np.log(factors / 8) / 1.2)[:, None] ** 2
    at = np.unravel_index(int(cost.argmin()), cost.shape)
    # the variance of Student's t with 4 degrees of freedom is twice its squared scale
    return 2 * float(factors[at[0]]), 2 * float(scales[at[1]])


def project_tensors(tensor: Array, cov: Array, steps: int = 4) -> tuple[Array, Array, Array]:
    """Nearest tensors with larger eigenvalue 1, in the metric of their covariance.

    `tensor` (N, 3) holds (xx, xy, yy) of G M Gᵀ/s², `cov` (N, 3, 3) its covariance. Returns the projected tensors, the
    covariance left on the constraint, and chi² (N,) with one degree of freedom, of the distance: a patch that is no
    view of the texton shows there.
    """
    out = tensor
    grad = np.empty_like(tensor)
    for _ in range(steps):
        half, cross = (out[:, 0] - out[:, 2]) / 2, out[:, 1]
        radius = np.maximum(np.hypot(half, cross), 1e-30)
        cos, sin = half / radius, cross / radius  # of twice the leading direction's angle
        grad[:, 0], grad[:, 1], grad[:, 2] = (1 + cos) / 2, sin, (1 - cos) / 2
        # the constraint linearised at `out`: λ1(out) + grad·(new − out) = 1, and λ1(out) = grad·out
        gap = (grad * tensor).sum(1) - 1.0
        lever = (cov @ grad[..., None])[..., 0]
        spread = np.maximum((grad * lever).sum(1), 1e-12)
        out = tensor - lever * (gap / spread)[:, None]
    left = cov - lever[:, :, None] * lever[:, None, :] / spread[:, None, None]
    return out, left, gap**2 / spread
