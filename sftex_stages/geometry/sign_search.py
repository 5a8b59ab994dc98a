"""Many starts, several smoothnesses, one measure: the search for the sign pattern of greatest evidence.

Every smoothness of a ladder, smooth to rough, anneals all starts (leading eigenvectors, the paper's cylinder in four
directions, bowl, light directions) and hands its patterns on as starts of the next. The distinct patterns at the end are
judged by their evidence, each with its own best smoothness and noise and with outliers let go, so that patterns found with
different settings compare.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sftex_stages.geometry import gaussian, signs

Float = NDArray[np.float64]

LADDER = ((3.0, 8.0), (1.0, 4.0), (1.0, 2.0), (1.0, 1.0))  # strength, reach in mean spacings of instances
OUTLIER = 0.05  # prior share of instances that are not from the surface


@dataclass(frozen=True)
class Data:
    """Gradients up to sign `d` (N, 2) at `xy` (N, 2), covariance (N, 2, 2), log density (N,) of an outlier there."""

    xy: Float
    d: Float
    covariance: Float
    log_outlier: Float


@dataclass(frozen=True)
class Candidate:
    """A sign pattern `s` (N,) and the evidence of it in nats, with the smoothness, noise factor and outliers it was found at."""

    s: Float
    evidence: float
    smooth: gaussian.Smoothness
    noise: float
    inside: Float  # (N,) posterior of being from the surface
    gradient: Float  # (N, 2) of the surface
    origin: str


def geometric_starts(data: Data) -> tuple[Float, list[str]]:
    """Signs (N, 5) that the paper's cylinder, in four directions, and a bowl would have (section 4, "Starting the method")."""
    centred = data.xy - np.median(data.xy, 0)
    angle = np.arange(4) * np.pi / 4
    axis = np.stack((np.cos(angle), np.sin(angle)))
    slope = -(centred @ axis) * (data.d @ axis)
    bowl = -(centred * data.d).sum(1, keepdims=True)
    both = np.concatenate((slope, bowl), 1)
    return np.where(both < 0, -1.0, 1.0), [f"cylinder {45 * k}" for k in range(4)] + ["bowl"]


def regions(data: Data, level: float) -> NDArray[np.int64]:
    """Label (N,) of the connected patches in which the gradient turns slowly and is steeper than `level`."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    n = len(data.xy)
    tree = cKDTree(data.xy)
    _, near = tree.query(data.xy, min(9, n))
    i = np.repeat(np.arange(n), near.shape[1] - 1)
    j = near[:, 1:].ravel()
    size = np.linalg.norm(data.d, axis=1)
    aligned = np.abs((data.d[i] * data.d[j]).sum(1)) > 0.8 * size[i] * size[j]
    keep = aligned & (size[i] > level) & (size[j] > level)
    _, label = connected_components(coo_matrix((keep[keep], (i[keep], j[keep])), shape=(n, n)), directed=False)
    count = np.bincount(label)
    core = count[label] >= 3
    if not core.any():
        return np.zeros(n, np.int64)
    nearest = cKDTree(data.xy[core]).query(data.xy)[1]
    return np.unique(label[core][nearest], return_inverse=True)[1]


def judge(
    data: Data, f: gaussian.Field, s: Float, smooth: gaussian.Smoothness, noise: float, trust: Float, rounds: int, origin: str
) -> Candidate:
    """The evidence of pattern `s` (N,), tuning smoothness and noise for it and letting outliers go (variational bound)."""
    precision = np.linalg.inv(data.covariance)
    logdet = np.linalg.slogdet(precision)[1]
    y = data.d * s[:, None]
    fit = np.einsum("ni,nij,nj->n", y, precision, y)
    inside = trust.copy()

    def score(x: Float) -> float:
        strength, reach, factor = np.exp(x)
        weight = precision * (inside / factor)[:, None, None]
        own = 0.5 * logdet - np.log(2 * np.pi) - np.log(factor) - 0.5 * fit / factor
        pull = np.einsum("nij,nj->ni", weight, y)
        value = gaussian.log_evidence(f, weight, pull, gaussian.Smoothness(strength, reach)) + float(inside @ own)
        q = np.clip(inside, 1e-9, 1 - 1e-9)
        rest = (1 - q) * (data.log_outlier + np.log(OUTLIER) - np.log(1 - q)) + q * (np.log1p(-OUTLIER) - np.log(q))
        return value + float(rest.sum())

    best = np.log([smooth.strength, smooth.reach, noise])
    g = np.zeros_like(y)
    value = -np.inf
    pace = np.array([0.7, 0.5, 0.5])
    for n in range(rounds + 1):
        if n:
            value = score(best)
            for k in range(3):
                for sign in (1, -1):
                    trial = best.copy()
                    trial[k] += sign * pace[k]
                    new = score(trial)
                    if new > value:
                        best, value = trial, new
                        break
        factor = np.exp(best[2])
        weight = precision * (inside / factor)[:, None, None]
        a_factor = gaussian.posterior(f, weight, gaussian.prior(f, gaussian.Smoothness(*np.exp(best[:2]))))
        pull = np.einsum("nij,nj->ni", weight, y)
        g = gaussian.gradients(f, _solve(f, a_factor, pull))
        mean, alone = gaussian.without_own(g, gaussian.gradient_covariance(f, a_factor), weight, pull)
        inside = trust * _inside(data, y - mean, alone, factor)
    return Candidate(s, score(best), gaussian.Smoothness(*map(float, np.exp(best[:2]))), float(factor), inside, g, origin)


def _solve(f: gaussian.Field, factor: signs.blocks.Factor, pull: Float) -> Float:
    return signs.blocks.solve(factor, f.design.T @ pull.ravel())


def _inside(data: Data, residual: Float, alone: Float, noise: float) -> Float:
    """Posterior (N,) of being from the surface, given the residual against what the others predict."""
    total = alone + data.covariance * noise
    chi2 = np.einsum("ni,nij,nj->n", residual, np.linalg.inv(total), residual)
    log_in = -0.5 * chi2 - 0.5 * np.linalg.slogdet(total)[1] - np.log(2 * np.pi) + np.log1p(-OUTLIER)
    return 1 / (1 + np.exp(np.clip(data.log_outlier + np.log(OUTLIER) - log_in, -60, 60)))


def search(data: Data, f: gaussian.Field, spacing: float, trust: Float, finalists: int = 4) -> list[Candidate]:
    """The best sign patterns, best first.

    Parameters
    ----------
    f : Field
        with the points of `data`, on a grid about as fine as the instances' mean `spacing` (px).
    trust : (N,)
        0…1, how far the instance may be believed at all.
    """
    weight = np.linalg.inv(data.covariance) * trust[:, None, None]
    patterns, names = geometric_starts(data)
    labels = [regions(data, level) for level in (0.15, 0.3)]
    found: list[tuple[Float, gaussian.Smoothness, str]] = []
    for k, (strength, reach) in enumerate(LADDER):
        smooth = gaussian.Smoothness(strength, reach * spacing)
        c = signs.coupling(f, data.d, weight, smooth)
        if k < 2:
            spectral = signs.spectral_starts(c, 3)
            patterns = np.concatenate((patterns, spectral), 1)
            names = names + [f"spectral {j + 1} at {k}" for j in range(spectral.shape[1])]
        bias = np.zeros_like(patterns)
        hot = 3.0 / max(float(np.median(c.own[c.own > 0])), 1e-9)
        patterns = signs.descend(c, signs.anneal(c, 0.5 * patterns, bias, min(hot, 1.0), 30), bias)
        for label in labels:
            moved = [signs.flip_regions(c, patterns[:, j], bias[:, j], label) for j in range(patterns.shape[1])]
            patterns = signs.descend(c, np.stack(moved, 1), bias)
        patterns, names = distinct(patterns, names, trust)
        found += [(patterns[:, j], smooth, names[j]) for j in range(patterns.shape[1])]
    first = [judge(data, f, s, smooth, 1.0, trust, 1, name) for s, smooth, name in found]
    first.sort(key=lambda x: -x.evidence)
    kept: list[Candidate] = []
    for x in first:
        if all(abs(np.average(x.s * y.s, weights=trust)) < 0.995 for y in kept):
            kept.append(x)
    last = [judge(data, f, x.s, x.smooth, x.noise, trust, 3, x.origin) for x in kept[:finalists]]
    return sorted(last, key=lambda x: -x.evidence)


def distinct(patterns: Float, names: list[str], trust: Float) -> tuple[Float, list[str]]:
    """Patterns (N, S) without repetitions up to a global sign and 0.5 % of the sites."""
    keep: list[int] = []
    for j in range(patterns.shape[1]):
        if all(abs(np.average(patterns[:, j] * patterns[:, i], weights=trust)) < 0.99 for i in keep):
            keep.append(j)
    return patterns[:, keep], [names[j] for j in keep]


def states(data: Data, g: Float, covariance: Float, noise: float) -> Float:
    """Posteriors (N, 3) of {+, −, not from the surface} (section 4) against gradients `g` (N, 2) of that covariance."""
    total = covariance + noise * data.covariance
    inverse, logdet = np.linalg.inv(total), np.linalg.slogdet(total)[1]
    log = np.empty((len(g), 3))
    for k, sign in enumerate((1.0, -1.0)):
        r = sign * data.d - g
        log[:, k] = -0.5 * np.einsum("ni,nij,nj->n", r, inverse, r) - 0.5 * logdet - np.log(4 * np.pi) + np.log1p(-OUTLIER)
    log[:, 2] = data.log_outlier + np.log(OUTLIER)
    log -= log.max(1, keepdims=True)
    return np.exp(log) / np.exp(log).sum(1, keepdims=True)
