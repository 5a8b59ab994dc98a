"""Shading as a cue for signs: irradiance against normals, one unknown light.

    E_i = a + b n_z,i + s_i (c_x, c_y)·n_xy,i + u(x_i) + noise

with E_i the relative irradiance on the textons' common scale, (a, b, c) the light, and u a slowly varying remainder (a near
light, interreflection, soft shadows) with a prior; noise is Student distributed (highlights). Given the signs all this is
linear; given the light, the data are a linear field on the signs.

Where something else stands in the light, E is what is left of it whatever the normal: log e_0 + noise. `Light.lit` is the
posterior that it is not so. Darkness that a shadow explains says nothing of signs, and a pattern that turns a shadowed part
away from the light explains it no better. A pattern with its signs wrong leaves dark nodes unexplained as well, so shadows are
believed only where they are alike, pay for themselves, and are left out of the search until it knows most signs.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln

from sftex_stages.geometry import spline

Float = NDArray[np.floating]

FREEDOM = 4.0
REMAINDER_CELLS = 3  # along the longer side: u must not follow folds
REMAINDER_SPREAD = 0.25  # standard deviation of u, of the mean irradiance
QUIET = 0.03  # least noise believed, of the mean irradiance: model error of "one light"
STUDENT = float(gammaln((FREEDOM + 1) / 2) - gammaln(FREEDOM / 2) - 0.5 * np.log(np.pi * FREEDOM))
SHADE = 0.12  # standard deviation of log e in shadow
DARK, FEWEST = 4.0, 5  # noise scales below what the light gives at which nodes start a shadow, and how many there must be
COUNTS = (1.0, 20.0)  # pseudo-counts of nodes in shadow, and in the light
COST = 20.0  # nats that shadows must gain
SETTLED = 12  # rounds after which a light hardly changes


@dataclass(frozen=True)
class Shading:
    """Irradiance `e` (M,) of mean 1, its variance (M,), measured normals (M, 3) with any sign, the basis (M, U) of u."""

    e: Float
    variance: Float
    normal: Float
    basis: Float

    @cached_property
    def null(self) -> "Light":
        """The best light that tells nothing of signs."""
        return settled(self, np.zeros(len(self.e)), directed=False)


@dataclass(frozen=True)
class Light:
    """`direction` (a, b, c_x, c_y), `remainder` (U,), noise scale, Student weights (M,) times the posterior `lit` (M,) of not
    lying in shadow, log likelihood in nats."""

    direction: Float
    remainder: Float
    noise: float
    weight: Float
    lit: Float
    log_likelihood: float


def make_shading(xy: Float, e: Float, variance: Float, normal: Float) -> Shading:
    """Shading data of nodes at `xy` (M, 2) px."""
    low, high = xy.min(0), xy.max(0)
    grid = spline.cover(low, high, float((high - low).max()) / REMAINDER_CELLS)
    return Shading(e, variance, normal, np.asarray(spline.design(grid, xy).todense()))


def settled(data: Shading, s: Float, directed: bool = True) -> Light:
    """The light for signs `s` (M,), with shadows where they are believed; `directed=False` leaves (c_x, c_y) at zero."""
    plain, other = (fit(data, s, rounds=SETTLED, directed=directed, shadows=shadows) for shadows in (False, True))
    return other if other.log_likelihood > plain.log_likelihood + COST else plain


def fit(
    data: Shading, m: Float, start: Light | None = None, rounds: int = 3, directed: bool = True, shadows: bool = False
) -> Light:
    """The light for mean signs `m` (M,); `directed=False` leaves (c_x, c_y) at zero, the null hypothesis; with `shadows` some
    nodes may lie in shadow."""
    n = data.normal
    ones: Float = np.ones(len(n))
    columns = [ones, n[:, 2], m * n[:, 0], m * n[:, 1]] if directed else [ones, n[:, 2]]
    x = np.concatenate((np.stack(columns, 1), data.basis), 1)
    k = len(columns)
    weight = ones if start is None else start.weight
    noise, lit = 0.1 if start is None else start.noise, ones
    ridge = np.concatenate((np.full(k, 1e-4), np.full(data.basis.shape[1], 1 / REMAINDER_SPREAD**2)))
    beta = np.zeros(x.shape[1])
    for _ in range(rounds):
        strength = weight / (noise**2 + data.variance)
        normal = x.T @ (strength[:, None] * x) + np.diag(ridge)
        if directed:  # E[s²] = 1 although E[s]² = m² < 1
            lost = strength * (1 - m**2)
            normal[2:4, 2:4] += n[:, :2].T @ (lost[:, None] * n[:, :2])
        beta = np.linalg.solve(normal, x.T @ (strength * data.e))
        r = data.e - x @ beta
        unsure = (1 - m**2) * (n[:, :2] @ beta[2:4]) ** 2 if directed else 0.0
        r2 = r**2 + unsure
        own = noise**2 + data.variance
        if shadows:
            lit = cast(data.e, r, r2, own, lit)[1]
        weight = lit * (FREEDOM + 1) / (FREEDOM + r2 / own)
        noise = max(float(np.sqrt(np.average(np.maximum(r2 * weight - lit * data.variance, 0)) / lit.mean())), QUIET)
    own = noise**2 + data.variance
    log, lit = cast(data.e, r, r2, own, lit) if shadows else (student(r2, own), ones)
    direction = np.zeros(4)
    direction[:k] = beta[:k]
    penalty = 0.5 * float((beta[k:] ** 2).sum()) / REMAINDER_SPREAD**2
    return Light(direction, beta[k:], noise, weight, lit, float(log.sum()) - penalty)


def student(r2: Float, variance: Float) -> Float:
    """Log density (M,) of residuals, squared, of that variance."""
    return np.asarray(STUDENT - 0.5 * (FREEDOM + 1) * np.log1p(r2 / variance / FREEDOM) - 0.5 * np.log(variance))


def cast(e: Float, r: Float, r2: Float, variance: Float, lit: Float) -> tuple[Float, Float]:
    """Log density (M,) of irradiance `e` (M,), in the light, where it is off by `r` (M,), squared `r2`, of that variance, or in
    shadow; and the posterior (M,) of the light, from the one `lit` (M,) before."""
    log = student(r2, variance)
    dark = 1 - lit
    if dark.sum() < FEWEST:
        dark = ((r < 0) & (r2 > DARK**2 * variance) & (e > 0)).astype(float)
    count = float(dark.sum())
    if count < FEWEST:
        return log, np.ones_like(lit)
    tone = np.log(np.maximum(e, 1e-3))
    off = (tone - float(dark @ tone) / count) / SHADE
    share = (count + COUNTS[0]) / (len(e) + sum(COUNTS))
    shade = np.log(share) - 0.5 * off**2 - tone - np.log(SHADE * np.sqrt(2 * np.pi))
    log = np.log1p(-share) + log
    total = np.logaddexp(log, shade)
    return total, np.exp(log - total)


def pull(data: Shading, light: Light) -> Float:
    """The linear field h (M,) on the signs: log odds of + over − are 2 h."""
    n = data.normal
    swing = n[:, :2] @ light.direction[2:]
    rest = data.e - light.direction[0] - light.direction[1] * n[:, 2] - data.basis @ light.remainder
    return light.weight * swing * rest / (light.noise**2 + data.variance)


def aligned(data: Shading, azimuth: float) -> Float:
    """Signs (M,) of a surface lit from that azimuth, where brighter than the slant explains means facing the light."""
    null, n = data.null, data.normal
    rest = data.e - null.direction[0] - null.direction[1] * n[:, 2] - data.basis @ null.remainder
    return np.where(rest * (n[:, 0] * np.cos(azimuth) + n[:, 1] * np.sin(azimuth)) < 0, -1.0, 1.0)
