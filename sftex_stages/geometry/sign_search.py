"""Many starts, several smoothnesses, every cue, one measure: the search for the sign pattern of greatest evidence.

Every smoothness of a ladder, smooth to rough, anneals all starts (leading eigenvectors, the paper's cylinder in four
directions, leaning planes, a bowl, lights from six azimuths), those of lights with shading, moves whole regions, and hands its
patterns on as starts of the next. Under every camera that may have been there it does so as well from what the elements'
sizes say of heights, which are in the energy then. The best distinct patterns flip regions of every size
(`sign_regions.py`) and are judged by their evidence, each under the camera that sizes speak for, with its own best
smoothness and noise and with outliers let go, so that patterns found with different settings compare. Those that come near
the best are reconsidered under priors of their own surface, of its curvature (`curvature.py`), and rough where it is
(`roughness.py`): one smoothness of all heights prefers patterns that iron folds out.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from sftex_stages.geometry import (
    blocks,
    curvature,
    gaussian,
    perspective,
    roughness,
    shading,
    sign_regions,
    signs,
    spline,
    surface_em,
    tensors,
)
from sftex_stages.geometry.camera import ORTHOGRAPHIC
from sftex_stages.geometry.climb import climb

Float = NDArray[np.floating]
Int = NDArray[np.integer]

LADDER = ((3.0, 8.0), (1.0, 4.0), (1.0, 2.0), (1.0, 0.7))  # strength, reach in spacings of nodes
EM_SPACING = 1.5  # of the radial functions, in spacings of nodes
ANNEAL_STEPS, LIGHT_EVERY = 24, 6
EXCESS = 0.7  # standard deviation of the log of a noise factor over 1: instances in a node agree, so it is not all noise
OUTLIER = 0.05  # prior share of nodes that are not from the surface
MOST_REGIONS = 400  # that patterns may differ in to be exchanged
AFFORDED, MORE = 1200, 4  # nodes up to which there are more finalists, and times as many at most: where few tell little
AFTERTHOUGHT, PASSES = 100.0, 2  # nats behind the best up to which a pattern is reconsidered, and how often


@dataclass(frozen=True)
class Data:
    """Nodes at `xy` (N, 2) px: gradient up to sign `d` (N, 2), its covariance (N, 2, 2), belief `trust` (N,) in 0…1, log
    density (N,) an outlier would have there; irradiance against normals, and measured heights (None: no such cue); and the
    cameras that may have been there."""

    xy: Float
    d: Float
    covariance: Float
    trust: Float
    log_outlier: Float
    shading: shading.Shading | None
    heights: gaussian.Heights | None = None
    views: "tuple[View, ...]" = ()


@dataclass(frozen=True)
class View:
    """What a camera shows: the nodes as it has them, with the heights that their sizes tell, on the field of its slopes."""

    seen: perspective.View
    data: Data
    field: gaussian.Field


@dataclass(frozen=True)
class Candidate:
    """A sign pattern `s` (N,): evidence of shape, shading and sizes in nats, and the settings it was judged at."""

    s: Float
    shape: float
    shade: float
    size: float
    smooth: gaussian.Smoothness
    noise: float
    inside: Float  # (N,) posterior of being from the surface
    a: Float  # coefficients of the surface on the search's grid
    light: shading.Light | None
    origin: str
    tuned: bool  # whether smoothness and noise were searched for it, or are those it was found at
    data: Data  # the nodes, and
    field: gaussian.Field  # with its prior, the field, that it was judged with
    view: View | None = None  # whose they are; None: orthography
    height_noise: float = 1.0

    @property
    def evidence(self) -> float:
        return self.shape + self.shade + self.size


def starts(data: Data) -> tuple[Float, list[str]]:
    """Signs (N, S) of simple shapes: cylinders (section 4, "Starting the method"), leaning planes, a bulge."""
    centred = data.xy - np.median(data.xy, 0)
    angle = np.arange(4) * np.pi / 4
    axis = np.stack((np.cos(angle), np.sin(angle)))
    lean = data.d @ axis
    columns = [-(centred @ axis) * lean, lean, -(centred * data.d).sum(1, keepdims=True)]
    names = [f"{kind} {45 * k}°" for kind in ("cylinder", "plane") for k in range(4)] + ["sphere"]
    return np.where(np.concatenate(columns, 1) < 0, -1.0, 1.0), names


def seen_by(data: Data, grid: spline.Grid, seen: perspective.View) -> View:
    """The nodes of `data` as a camera has them."""
    d, covariance = tensors.gradient(seen.w, seen.covariance)
    d *= np.where((d * data.d).sum(1) < 0, -1.0, 1.0)[:, None]
    mine = replace(data, d=d, covariance=covariance, heights=seen.heights(data.xy), views=())
    return View(seen, mine, gaussian.make_field(grid, data.xy, seen.camera.stretch(data.xy)))


def lit_starts(data: Data) -> tuple[Float, list[str]]:
    """Signs (N, 6) of surfaces lit from six azimuths in half a turn, by the shading alone."""
    if data.shading is None:
        return np.zeros((len(data.d), 0)), []
    azimuths = np.arange(6) * np.pi / 6
    return np.stack([shading.aligned(data.shading, t) for t in azimuths], 1), [f"light {30 * k}°" for k in range(6)]


def neighbours(xy: Float, count: int = 6) -> tuple[Int, Int]:
    """Pairs (E,), (E,) of points and their nearest `count` neighbours."""
    near = cKDTree(xy).query(xy, min(count + 1, len(xy)))[1]
    return np.repeat(np.arange(len(xy)), near.shape[1] - 1), near[:, 1:].ravel()


def components(n: int, pairs: tuple[Int, Int], keep: NDArray[np.bool_]) -> Int:
    """Label (N,) of the connected components of the kept pairs."""
    i, j = pairs[0][keep], pairs[1][keep]
    return connected_components(coo_matrix((np.ones(len(i)), (i, j)), shape=(n, n)), directed=False)[1].astype(np.int64)


def patches(data: Data, pairs: tuple[Int, Int], level: float) -> Int:
    """Label (N,) of the patches in which the gradient turns slowly and stays steeper than `level`; the rest joins them."""
    i, j = pairs
    size = np.linalg.norm(data.d, axis=1)
    aligned = np.abs((data.d[i] * data.d[j]).sum(1)) > 0.8 * size[i] * size[j]
    label = components(len(size), pairs, aligned & (size[i] > level) & (size[j] > level))
    core = np.bincount(label)[label] >= 3
    if not core.any():
        return np.zeros(len(size), np.int64)
    nearest = cKDTree(data.xy[core]).query(data.xy)[1]
    return np.unique(label[core][nearest], return_inverse=True)[1].astype(np.int64)


def bias_of(
    data: Data, c: signs.Coupling, m: Float, lit: NDArray[np.bool_], lights: list[shading.Light | None]
) -> Float:
    """Fields (N, S) of measured heights and, for those of the patterns `m` (N, S) in `lit` (S,), of shading; refits `lights` in
    place."""
    bias = np.zeros_like(m)
    if data.shading is not None:
        for k in np.flatnonzero(lit):
            lights[k] = light = shading.fit(data.shading, m[:, k], lights[k], 1 if lights[k] else 4)
            bias[:, k] = data.trust * shading.pull(data.shading, light)
    return c.lift[:, None] + bias


def own_bias(data: Data, c: signs.Coupling, s: Float) -> Float:
    """Fields (N,) of heights and shading on the pattern `s` (N,), under its own light and shadows."""
    return c.lift + shaded(data, s)


def shaded(data: Data, s: Float) -> Float:
    """The field (N,) of shading on the pattern `s` (N,), under its own light and shadows."""
    if data.shading is None:
        return np.zeros(len(s))
    return data.trust * shading.pull(data.shading, shading.settled(data.shading, s))


def rung(
    data: Data, c: signs.Coupling, patterns: Float, lit: NDArray[np.bool_], labels: list[Int], hot: float
) -> Float:
    """One smoothness: anneal, descend and move regions of patterns (N, S)."""
    lights: list[shading.Light | None] = [None] * patterns.shape[1]
    m = 0.7 * patterns
    betas = np.geomspace(hot, 1.0, ANNEAL_STEPS)
    for k in range(0, ANNEAL_STEPS, LIGHT_EVERY):
        m = signs.anneal(c, m, bias_of(data, c, m, lit, lights), betas[k : k + LIGHT_EVERY])
    s = np.where(m < 0, -1.0, 1.0)
    for label in [None, *labels]:
        bias = bias_of(data, c, s, lit, lights)
        if label is not None:
            s = np.stack([signs.flip_regions(c, s[:, j], bias[:, j], label) for j in range(s.shape[1])], 1)
        s = signs.descend(c, s, bias)
    return s


def from_sizes(view: View, smooth: gaussian.Smoothness, labels: list[Int], hot: float) -> Float:
    """Patterns (N, 1 or 2), without and with shading, that start from the surface which the elements' sizes make."""
    data = view.data
    weight = np.linalg.inv(data.covariance) * data.trust[:, None, None]
    c = signs.coupling(view.field, data.d, weight, smooth, data.heights)
    lit = np.arange(1 if data.shading is None else 2) > 0
    return rung(data, c, np.where(c.lift < 0, -1.0, 1.0)[:, None].repeat(len(lit), 1), lit, labels, hot)


def shade_of(data: Data, s: Float) -> tuple[float, shading.Light | None]:
    """Log likelihood that the shading gives signs `s` (N,), relative to a light that tells nothing."""
    if data.shading is None:
        return 0.0, None
    light = shading.settled(data.shading, s)
    return max(light.log_likelihood - data.shading.null.log_likelihood - 2.0, 0.0), light


def size_of(data: Data, h: Float) -> tuple[float, View | None, float]:
    """Nats, beyond chance, by which the elements' sizes are those of a surface of heights `h` (N,) or of its mirror image; the
    view under which they are (None: they are all the same), and the sign of h."""
    told = [(v.seen.fit(sign * h)[0] - perspective.CHANCE, k, sign) for k, v in enumerate(data.views) for sign in (1.0, -1.0)]
    nats, k, sign = max(told, default=(0.0, 0, 1.0))
    return (nats, data.views[k], sign) if nats > 0 else (0.0, None, 1.0)


def judge_as_seen(
    data: Data, f: gaussian.Field, s: Float, smooth: gaussian.Smoothness, rounds: int, origin: str
) -> Candidate:
    """The evidence of pattern `s` (N,), or of its mirror image, under the camera that sizes speak for."""
    plain = judge(data, f, s, smooth, 1.0, rounds, origin)
    _, view, sign = size_of(data, gaussian.heights(f, plain.a))
    return plain if view is None else judge(view.data, view.field, sign * s, smooth, 1.0, rounds, origin, view)


def judge(
    data: Data,
    f: gaussian.Field,
    s: Float,
    smooth: gaussian.Smoothness,
    noise: float,
    rounds: int,
    origin: str,
    view: View | None = None,
) -> Candidate:
    """The evidence of pattern `s` (N,), tuning smoothness and noise for it and letting outliers go (variational bound).

    `data` and `f` are those of the `view`, if there is one. The surface is that of the gradients alone: what sizes add is
    measured by it.
    """
    precision = np.linalg.inv(data.covariance)
    logdet = np.linalg.slogdet(precision)[1]
    y = data.d * s[:, None]
    fit = np.einsum("ni,nij,nj->n", y, precision, y)
    inside = data.trust.copy()

    def score(x: Float) -> float:
        strength, reach, factor = np.exp(x)
        if not gaussian.reasonable(f, strength, reach):
            return -np.inf
        weight = precision * (inside / factor)[:, None, None]
        own = 0.5 * logdet - np.log(2 * np.pi) - np.log(factor) - 0.5 * fit / factor
        pull = np.einsum("nij,nj->ni", weight, y)
        value = gaussian.log_evidence(f, weight, pull, gaussian.Smoothness(strength, reach)) + float(inside @ own)
        q = np.clip(inside, 1e-9, 1 - 1e-9)
        rest = (1 - q) * (data.log_outlier + np.log(OUTLIER) - np.log(1 - q)) + q * (np.log1p(-OUTLIER) - np.log(q))
        return value + float(rest.sum()) - 0.5 * max(float(np.log(factor)) / EXCESS, 0.0) ** 2

    smooth = gaussian.softened(f, smooth)
    best = np.log([smooth.strength, smooth.reach, noise])
    pace = np.array([0.7, 0.7, 0.7])
    for n in range(rounds + 1):
        if n:
            best, moved = climb(score, best, pace)
            pace = pace if moved else pace / 2
        strength, reach, factor = map(float, np.exp(best))
        smooth = gaussian.Smoothness(strength, reach)
        weight = precision * (inside / factor)[:, None, None]
        pull = np.einsum("nij,nj->ni", weight, y)
        solved = gaussian.posterior(f, weight, gaussian.prior(f, smooth))
        a = blocks.solve(solved, gaussian.pulled(f, pull))
        g = gaussian.gradients(f, a)
        mean, alone = gaussian.without_own(g, gaussian.gradient_covariance(f, solved), weight, pull)
        if n == 0:  # the noise that the residuals show, before any search
            total = np.linalg.inv(alone + factor * data.covariance)
            chi2 = np.einsum("ni,nij,nj->n", y - mean, total, y - mean)
            best[2] = np.log(factor * np.clip(np.median(chi2) / (2 * np.log(2)), 0.1, 10))
            factor = float(np.exp(best[2]))
        inside = data.trust * _inside(data, y - mean, alone, factor)
    shade, light = shade_of(data, s)
    told, height_noise = (perspective.CHANCE, 1.0) if view is None else view.seen.fit(gaussian.heights(f, a))
    size = max(told - perspective.CHANCE, 0.0)
    return Candidate(
        s, score(best), shade, size, smooth, factor, inside, a, light, origin, rounds > 0, data, f, view, height_noise
    )


def judge_again(x: Candidate, s: Float) -> Candidate:
    """The evidence of the signs `s` (N,) under the prior of `x`, from its settings on."""
    return judge(x.data, x.field, s, x.smooth, x.noise, 2, x.origin, x.view)


def _inside(data: Data, residual: Float, alone: Float, noise: float) -> Float:
    """Posterior (N,) of being from the surface, given the residual against what the others predict."""
    total = alone + data.covariance * noise
    chi2 = np.einsum("ni,nij,nj->n", residual, np.linalg.inv(total), residual)
    log_in = -0.5 * chi2 - 0.5 * np.linalg.slogdet(total)[1] - np.log(2 * np.pi) + np.log1p(-OUTLIER)
    return 1 / (1 + np.exp(np.clip(data.log_outlier + np.log(OUTLIER) - log_in, -60, 60)))


def distinct(patterns: Float, trust: Float, limit: float = 0.99) -> list[int]:
    """Indices of the patterns (N, S) that no earlier one equals up to a global sign."""
    keep: list[int] = []
    for j in range(patterns.shape[1]):
        if all(abs(np.average(patterns[:, j] * patterns[:, i], weights=trust)) < limit for i in keep):
            keep.append(j)
    return keep


def search(
    data: Data, f: gaussian.Field, spacing: float, finalists: int, start: str = "auto", survivors: int = 10
) -> list[Candidate]:
    """Sign patterns, best first: `finalists` whose settings were tuned, then those that fell behind.

    `f` has the points of `data`, on a grid about as fine as their mean `spacing` (px). `start`: "auto", or the one kind of
    shape to start from, "cylinder", "sphere" or "plane".
    """
    weight = np.linalg.inv(data.covariance) * data.trust[:, None, None]
    finalists *= int(np.clip(AFFORDED // len(data.d), 1, MORE))
    patterns, names = starts(data)
    if start != "auto":
        kind = [k for k, name in enumerate(names) if name.startswith(start)]
        patterns, names = patterns[:, kind], [names[k] for k in kind]
    pairs = neighbours(data.xy)
    labels = [patches(data, pairs, level) for level in (0.15, 0.3)]
    lit = np.zeros(len(names), bool)
    none: tuple[Float, list[str]] = patterns[:, :0], []
    shaded, labels_lit = lit_starts(data) if start == "auto" else none
    pool: list[tuple[float, Float, gaussian.Smoothness, str]] = []
    for k, (strength, reach) in enumerate(LADDER):
        smooth = gaussian.Smoothness(strength, reach * spacing)
        c = signs.coupling(f, data.d, weight, smooth)
        spectral = signs.spectral_starts(c, 3) if k < 2 and start == "auto" else patterns[:, :0]
        patterns = np.concatenate((patterns, spectral, shaded), 1)
        names = names + [f"spectral {j + 1}" for j in range(spectral.shape[1])] + labels_lit
        lit = np.concatenate((lit, np.zeros(spectral.shape[1], bool), np.ones(shaded.shape[1], bool)))
        hot = min(5.0 / max(float(np.median(c.own[c.own > 0])), 1e-9), 1.0)
        patterns = rung(data, c, patterns, lit, labels, hot)
        for view in data.views if start == "auto" else ():
            sized = from_sizes(view, smooth, labels, hot)
            patterns, names = np.concatenate((patterns, sized), 1), names + ["sizes"] * sized.shape[1]
            lit = np.concatenate((lit, np.arange(sized.shape[1]) > 0))
        shape = 0.5 * c.log_det - signs.energies(c, patterns, np.zeros_like(patterns))
        found = signs.surface_of(c, patterns)
        told = [size_of(data, gaussian.heights(f, found[:, j]))[0] for j in range(len(names))]
        value = np.array([shape[j] + shade_of(data, patterns[:, j])[0] + told[j] for j in range(len(names))])
        order = np.argsort(-value, kind="stable")
        order = order[distinct(patterns[:, order], data.trust)][:survivors]
        patterns, names, lit = patterns[:, order], [names[j] for j in order], lit[order]
        pool += [(float(value[j]), patterns[:, n], smooth, names[n]) for n, j in enumerate(order)]
    first = [judge_as_seen(data, f, s, smooth, 0, name) for _, s, smooth, name in shortlist(pool, data, 3 * finalists)]
    first.sort(key=lambda x: -x.evidence)
    moved = [settle(x) for x in first[:finalists]]
    last = [judge_again(first[k], moved[k]) for k in distinct(np.stack(moved, 1), data.trust, 0.995)]
    best = max(x.evidence for x in last)
    near = [x for x in last if x.evidence > best - AFTERTHOUGHT]
    behind = [replace(x, tuned=False) for x in last if x.evidence <= best - AFTERTHOUGHT]
    last = sorted([*reconsider(near, pairs), *near], key=lambda x: -x.evidence)
    return last + behind + first[finalists:]


def reconsider(found: list[Candidate], pairs: tuple[Int, Int]) -> list[Candidate]:
    """The candidates under priors of their own surface: of its curvature or of its heights, and rough where it is, each where
    that has the greater evidence, which includes what local roughness costs. They come as judged under the prior of heights.

    What they disagree in are regions (of the graph of `pairs`) that may be exchanged: each takes over what helps it.
    """
    plain = [x.field for x in found]
    for n in range(PASSES):
        label = disputed(np.stack([x.s for x in found], 1), found[0].data.trust, pairs)
        found = [_rethink(x, f, label, last=n == PASSES - 1) for x, f in zip(found, plain, strict=True)]
    return found


def disputed(patterns: Float, trust: Float, pairs: tuple[Int, Int]) -> Int:
    """Label (N,) of the regions within which the patterns (N, S), turned as a whole to agree best, differ alike."""
    relative = patterns * patterns[:, :1]
    relative = relative * np.where(trust @ relative < 0, -1.0, 1.0)
    return components(len(patterns), pairs, (relative[pairs[0]] == relative[pairs[1]]).all(1))


def _rethink(x: Candidate, plain: gaussian.Field, label: Int, last: bool) -> Candidate:
    """One pass of `reconsider`, from the `plain` field, with the prior of heights; the `last` pass states the evidence at the
    roughness of the surface found, or without."""
    a = signs.surface_of(own_coupling(x), x.s)
    curved = curvature.follow(plain, a, ORTHOGRAPHIC if x.view is None else x.view.seen.camera)
    x = max((judge_again(replace(x, field=f), x.s) for f in (plain, curved)), key=lambda y: y.evidence)
    c = own_coupling(x)
    rough = replace(x, field=roughness.learn(x.field, signs.surface_of(c, x.s), c.factor, x.smooth).field)
    if 0 < label.max() < MOST_REGIONS:
        c = own_coupling(rough)
        rough = replace(rough, s=signs.flip_regions(c, rough.s, own_bias(rough.data, c, rough.s), label))
    s = settle(rough)
    rough = judge_again(rough, s)
    if not last:
        return rough
    c = own_coupling(rough)
    cost = roughness.learn(x.field, signs.surface_of(c, rough.s), c.factor, rough.smooth).bound
    return max(replace(rough, shape=rough.shape + cost), judge_again(x, s), key=lambda y: y.evidence)


def own_coupling(x: Candidate) -> signs.Coupling:
    """The coupling at the candidate's own view, prior and noise, without its outliers."""
    weight = np.linalg.inv(x.data.covariance) * (x.inside / x.noise)[:, None, None]
    height = None if x.data.heights is None else x.data.heights.over(x.height_noise)
    return signs.coupling(x.field, x.data.d, weight, x.smooth, height)


def rivals(data: Data, c: signs.Coupling, s: Float) -> tuple[list[Int], Float]:
    """Regions that rival patterns of `s` (N,) turn, and by how many nats (R,) they are worse (`sign_regions.py`)."""
    return sign_regions.rivals(c, data.d, s, own_bias(data, c, s), neighbours(data.xy))


def ties(data: Data, c: signs.Coupling, s: Float, piece: Int) -> tuple[Float, Float]:
    """Nats (P, P) by which smoothness ties the pieces (N,) of a pattern `s` (N,) together, and (P,) shading to its light."""
    member = np.zeros((len(s), int(piece.max()) + 1))
    member[np.arange(len(s)), piece] = s
    return member.T @ signs.product(c, member), member.T @ shaded(data, s)


def settle(found: Candidate, rounds: int = 12) -> Float:
    """The signs (N,) of `found` after flips of regions of all sizes, as long as one helps.

    Energies are those of its own smoothness, noise and outliers.
    """
    c, data, s = own_coupling(found), found.data, found.s
    pairs = neighbours(data.xy)
    for _ in range(rounds):
        bias = own_bias(data, c, s)
        regions, rise = sign_regions.rivals(c, data.d, s, bias, pairs)
        best = int(rise.argmin())
        if rise[best] > -0.1:
            break
        s = s.copy()
        s[regions[best]] *= -1
        s = signs.descend(c, s[:, None], bias[:, None])[:, 0]
    # What did not fit the former pattern had no say, and no energy of its own: it follows the surface.
    g = gaussian.gradients(found.field, signs.surface_of(c, s))
    lost = (found.inside < 0.5 * data.trust) & ((data.d * g).sum(1) * s < 0)
    return np.where(lost, -s, s)


def by_em(data: Data, f: gaussian.Field, spacing: float, finalists: int, start: str = "auto") -> list[Candidate]:
    """The signs that the paper's EM finds, judged alike: from a cylinder in four directions (it was aligned by hand), or from
    the `start` "sphere", or planes in four directions."""
    smooth = gaussian.Smoothness(1.0, 2.0 * spacing)
    found = []
    kind = "cylinder" if start == "auto" else start
    shape = getattr(surface_em, kind)
    for k in range(1 if start == "sphere" else 4):
        g = shape(data.xy, k * np.pi / 4)
        result = surface_em.run(data.xy, data.d, data.covariance, data.log_outlier, g, EM_SPACING * spacing)
        s = np.where(result.state[:, 0] < result.state[:, 1], -1.0, 1.0)
        found.append(judge_as_seen(data, f, s, smooth, 1, f"em, {kind} {45 * k}°"))
    return sorted(found, key=lambda x: -x.evidence)[:finalists]


def shortlist(
    pool: list[tuple[float, Float, gaussian.Smoothness, str]], data: Data, count: int
) -> list[tuple[float, Float, gaussian.Smoothness, str]]:
    """The best distinct patterns, from every smoothness in turn: values of different smoothness do not yet compare."""
    rungs: dict[gaussian.Smoothness, list[tuple[float, Float, gaussian.Smoothness, str]]] = {}
    for item in pool:
        rungs.setdefault(item[2], []).append(item)
    mixed = [row[k] for k in range(max(map(len, rungs.values()))) for row in rungs.values() if k < len(row)]
    keep = distinct(np.stack([item[1] for item in mixed], 1), data.trust, 0.995)
    return [mixed[k] for k in keep[:count]]


def states(data: Data, g: Float, covariance: Float, noise: float) -> Float:
    """Posteriors (N, 3) of {+, −, not from the surface} (section 4) against gradients `g` (N, 2) of that covariance."""
    total = covariance + noise * data.covariance
    inverse, logdet = np.linalg.inv(total), np.linalg.slogdet(total)[1]
    log = np.empty((len(g), 3))
    for k, sign in enumerate((1.0, -1.0)):
        r = sign * data.d - g
        chi2 = np.einsum("ni,nij,nj->n", r, inverse, r)
        log[:, k] = -0.5 * (chi2 + logdet) - np.log(4 * np.pi) + np.log1p(-OUTLIER)
    log[:, 2] = data.log_outlier + np.log(OUTLIER)
    log -= log.max(1, keepdims=True)
    return np.exp(log) / np.exp(log).sum(1, keepdims=True)
