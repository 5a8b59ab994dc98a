"""Constellations: textons that lie on one printed motif, or on a regular print, predict one another's instances.

A print is flat. Near an instance i of texton A, seen through T_i at x_i, the surface is its tangent plane, and an
instance j of texton B printed with it keeps its place o = T_i⁻¹ (x_j − x_i) and its turn T_i⁻¹ T_j in A's frontal frame,
however the surface bends elsewhere. Offsets that recur for a fair share of the instances are rules A → B; where a
rule's B is missing, it says where to look and what for. No sign is involved: T is that of the normal and of its mirror
image alike.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

Array = NDArray[np.floating]
Ints = NDArray[np.integer]
Bools = NDArray[np.bool_]

SAME = 0.5  # radii: instances of a texton nearer to one another, on the print, are one instance
_NEIGHBOURS = 24  # most that a rule is looked for among, around one instance
_SOURCES = 60  # instances of a texton that are enough to find its rules
_NEAR, _BEND = 0.2, 0.15  # reach of one offset: share of the elements' radius, and of the offset (surfaces are bent)
_FLAT = 0.05  # of an offset, by which the surface leaves its tangent plane
_TURN = 0.35  # radians by which turns of one rule differ
_LEAST = 4  # instances that a rule needs
_CHANCE = 2.5  # a rule recurs so many times as often as neighbours that lie anywhere
_WITNESSES = 25  # nearest instances that one is compared with
_CELL = 4.0  # px


class Known(NamedTuple):
    """Instances of K textons, N of them, in pixels of the image."""

    xy: Array  # (N, 2)
    transform: Array  # (N, 2, 2) from the texton's frontal frame
    texton: Ints  # (N,) from 0
    log_light: Array  # (N,) log L, each texton on a scale of its own


class Rules(NamedTuple):
    """R rules: with an instance of `source` there is one of `target`."""

    source: Ints  # (R,)
    target: Ints  # (R,)
    offset: Array  # (R, 2) of the target, in the source's frontal frame
    relative: Array  # (R, 2, 2) T_source⁻¹ T_target
    light: Array  # (R,) log L_target − log L_source
    spread: Array  # (R,) standard deviation of the offset, px of the frontal frame

    def take(self, rows: Ints | Bools) -> "Rules":
        """Some of them."""
        return Rules._make(column[rows] for column in self)


class Candidates(NamedTuple):
    """Where an instance of a texton should be: M of them."""

    xy: Array  # (M, 2)
    transform: Array  # (M, 2, 2)
    texton: Ints  # (M,)
    log_light: Array  # (M,)
    doubt: Array  # (M,) standard deviation of xy in the candidate's frontal frame, radii

    @staticmethod
    def none() -> "Candidates":
        """Not one."""
        return Candidates(np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros(0, np.int64), np.zeros(0), np.zeros(0))

    def take(self, rows: Ints | Bools) -> "Candidates":
        """Some of them."""
        return Candidates._make(column[rows] for column in self)

    def join(self, other: "Candidates") -> "Candidates":
        """These and those."""
        return Candidates._make(np.concatenate(columns) for columns in zip(self, other, strict=True))


def disagreement(xy: Array, tensor: Array, texton: Ints, count: int) -> Array:
    """How far each texton's instances are off their neighbours of other textons, in units of what these scatter: (count,).

    Compared is what is free of scale of their `tensor` (N, 3), T Tᵀ / s² less its trace. NaN without such neighbours.
    """
    w = np.stack([tensor[:, 2] - tensor[:, 0], -2 * tensor[:, 1]], -1)
    near = cKDTree(xy).query(xy, min(_WITNESSES, len(xy)))[1].reshape(len(xy), -1)
    own = texton[near] == texton[:, None]
    others = np.where(own[..., None], np.nan, w[near])
    seen = np.flatnonzero((~own).sum(1) >= 3)
    others = others[seen]
    middle = np.nanmedian(others, axis=1)
    scatter = np.nanmedian(np.linalg.norm(others - middle[:, None], axis=2), axis=1)
    off = np.linalg.norm(w[seen] - middle, axis=1)
    out = np.full(count, np.nan)
    for rows in _groups(texton[seen]):
        out[texton[seen[rows[0]]]] = np.median(off[rows]) / max(float(np.median(scatter[rows])), 1e-12)
    return out


def learn(known: Known, radius: Array, turns: Bools, reach: float, share: float) -> Rules:
    """The rules that instances obey, by the textons' frontal `radius` (K,), px.

    Neighbours are looked for up to `reach` radii away. A rule holds for at least `share` of the instances of the rarer
    texton. Textons that may turn without anyone seeing it (`turns` (K,), circles) predict nothing.
    """
    chosen = _sources(known.texton, turns)
    k = min(_NEIGHBOURS + 1, len(known.xy))
    if k < 2 or len(chosen) == 0:
        return _rules([])
    inverse = np.linalg.inv(known.transform)
    i, j = np.repeat(chosen, k), cKDTree(known.xy).query(known.xy[chosen], k)[1].ravel()
    i, j = i[i != j], j[i != j]
    offset = np.einsum("nij,nj->ni", inverse[i], known.xy[j] - known.xy[i])
    near = np.linalg.norm(offset, axis=1) < reach * radius[known.texton[i]]
    i, j, offset = i[near], j[near], offset[near]
    relative = inverse[i] @ known.transform[j]
    light = known.log_light[j] - known.log_light[i]
    count = len(radius)
    total, asked = (np.bincount(t, minlength=count) for t in (known.texton, known.texton[chosen]))
    found: list[tuple] = []
    for rows in _groups(known.texton[i].astype(np.int64) * count + known.texton[j]):
        a, b = int(known.texton[i[rows[0]]]), int(known.texton[j[rows[0]]])
        least = max(_LEAST, share * min(1.0, total[b] / total[a]) * asked[a])
        if len(rows) < least:
            continue
        size = (radius[a] + radius[b]) / 2
        modes = _recurring(offset[rows], relative[rows], i[rows], size, least, bool(turns[b]), reach * radius[a])
        for middle, spread, members in modes:
            mine = rows[members]
            found.append((a, b, middle, np.median(relative[mine], axis=0), float(np.median(light[mine])), spread))
    return _rules(found)


def _sources(texton: Ints, turns: Bools) -> Ints:
    """Some instances of every texton that may predict, evenly taken."""
    some = [rows[:: -(-len(rows) // _SOURCES)] for rows in _groups(texton) if not turns[texton[rows[0]]]]
    return np.sort(np.concatenate(some)) if some else np.zeros(0, np.int64)


def _groups(labels: Ints) -> list[Ints]:
    """The rows of each label, in order."""
    order = np.argsort(labels, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(labels[order])) + 1) if len(order) else []


def _rules(found: list[tuple]) -> Rules:
    if not found:
        none = np.zeros(0)
        return Rules(none.astype(int), none.astype(int), np.zeros((0, 2)), np.zeros((0, 2, 2)), none, none)
    return Rules._make(np.array(column) for column in zip(*found, strict=True))


def _recurring(
    offset: Array, relative: Array, source: Ints, size: float, least: float, turns: bool, reach: float
) -> list[tuple[Array, float, Ints]]:
    """(offset, its spread, rows) of the places where `least` or more of the sources see the target.

    Offsets (n, 2) of at most `reach`, and frames `relative` (n, 2, 2), as instances `source` (n,) see them. With `turns` the
    target's turn is free.
    """
    width = _NEAR * size + _BEND * np.linalg.norm(offset, axis=1)
    apart = np.linalg.norm(offset[:, None] - offset[None], axis=2) / width[:, None]
    alike = np.ones(len(offset))  # share of the others that have the same turn
    if not turns:
        angle = np.arctan2(relative[:, 1, 0] - relative[:, 0, 1], relative[:, 0, 0] + relative[:, 1, 1])
        turned = np.abs((angle[:, None] - angle[None] + np.pi) % (2 * np.pi) - np.pi)
        apart, alike = np.maximum(apart, turned / _TURN), (turned < _TURN).mean(1)
    together = apart < 1
    free = np.ones(len(offset), bool)
    out: list[tuple[Array, float, Ints]] = []
    while True:
        votes = together[:, free].sum(1) * free
        best = int(votes.argmax())
        if votes[best] < least:
            return out
        rows = np.flatnonzero(together[best] & free)
        free[rows] = False
        # neighbours scattered over the whole reach fall into one place so often
        by_chance = len(offset) * (width[best] / reach) ** 2 * alike[best]
        if len(np.unique(source[rows])) < max(least, _CHANCE * by_chance):
            continue
        middle = np.median(offset[rows], axis=0)
        # of a Gaussian in two dimensions the median distance is 1.18 standard deviations
        spread = float(np.median(np.linalg.norm(offset[rows] - middle, axis=1))) / 1.18
        out.append((middle, spread + 0.02 * size, rows))


def predict(
    known: Known, rules: Rules, radius: Array, max_doubt: float, crowd: int, mask: Bools, tried: Candidates
) -> Candidates:
    """Where `rules` miss an instance that would tell something new, within `mask` (H, W).

    `radius` (K,) of the textons, px. An instance is missed where none of its texton lies within half a radius, on the
    print, nor one of those `tried`. It would tell something new where fewer than `crowd` instances, of any texton, lie
    within its radius; and no more are asked for than make a crowd, the surest first, with a doubt of `max_doubt` radii at most.
    """
    # on a bent surface the tangent plane serves the less the farther away
    doubt = np.hypot(rules.spread, _FLAT * np.linalg.norm(rules.offset, axis=1)) / radius[rules.target]
    by_source = {int(known.texton[rows[0]]): rows for rows in _groups(known.texton)}
    empty = np.zeros(0, np.int64)
    sure = np.flatnonzero(doubt <= max_doubt)
    sources = [by_source.get(int(a), empty) for a in rules.source[sure]]
    rule, source = np.repeat(sure, [len(rows) for rows in sources]), np.concatenate([*sources, empty])
    xy = known.xy[source] + np.einsum("nij,nj->ni", known.transform[source], rules.offset[rule])
    area = np.abs(np.linalg.det(known.transform))[source] * np.abs(np.linalg.det(rules.relative))[rule]
    size = radius[rules.target[rule]] * np.sqrt(area)
    keep = np.flatnonzero(_within(xy, mask) & (area > 1e-3))
    keep = keep[~_crowded(xy[keep], size[keep], known.xy, crowd)]
    rule, source = rule[keep], source[keep]
    found = Candidates(
        xy[keep], known.transform[source] @ rules.relative[rule], rules.target[rule],
        known.log_light[source] + rules.light[rule], doubt[rule],
    )  # fmt: skip
    found = found.take(np.argsort(found.doubt, kind="stable"))
    missing = [rows[_missing(found.take(rows), known, tried, radius)] for rows in _groups(found.texton)]
    found = found.take(np.sort(np.concatenate([*missing, empty])))
    return found.take(_few(found, known.xy, radius, crowd))


def _within(xy: Array, mask: Bools) -> Bools:
    """Whether the pixels of xy (n, 2) are in the image and in its `mask` (H, W)."""
    column, row = np.rint(xy).astype(np.int64).T
    h, w = mask.shape
    inside = (column >= 0) & (row >= 0) & (column < w) & (row < h)
    inside[inside] = mask[row[inside], column[inside]]
    return inside


def _crowded(xy: Array, size: Array, others: Array, crowd: int) -> Bools:
    """Whether `crowd` of `others` (m, 2) or more lie within `size` (n,) of xy (n, 2)."""
    if len(others) < crowd or len(xy) == 0:
        return np.zeros(len(xy), bool)
    tree = cKDTree(others)
    # what the middle of its cell says for certain is not asked again: most places are crowded
    cell = np.rint(xy / _CELL).astype(np.int64)
    cells, place = np.unique(cell[:, 1] * 2**32 + cell[:, 0], return_inverse=True)
    middle = np.stack([cells % 2**32, cells // 2**32], -1) * _CELL
    out = tree.query(middle, [crowd])[0][place, 0] < size - _CELL / np.sqrt(2)
    rest = np.flatnonzero(~out)
    out[rest] = tree.query(xy[rest], [crowd])[0][:, 0] < size[rest]
    return out


def _missing(found: Candidates, known: Known, tried: Candidates, radius: Array) -> Ints:
    """Rows of candidates of one texton that no instance has and that were not tried, one for each place, the first."""
    texton = int(found.texton[0])
    close = SAME * radius[texton]
    others = np.concatenate([known.xy[known.texton == texton], tried.xy[tried.texton == texton]])
    return first_of_each(found.xy, found.transform, close, ~near_any(found.xy, found.transform, others, close))


def _few(found: Candidates, others: Array, radius: Array, crowd: int) -> Ints:
    """Rows that make no crowd with `others` (m, 2) and the rows before them."""
    if len(found.xy) == 0:
        return np.zeros(0, np.int64)
    size = radius[found.texton] * np.sqrt(np.abs(np.linalg.det(found.transform)))
    count = cKDTree(others).query_ball_point(found.xy, size, return_length=True)
    near = cKDTree(found.xy).query_ball_point(found.xy, size)
    kept = []
    for i in range(len(found.xy)):
        if count[i] < crowd:
            kept.append(i)
            count[near[i]] += 1
    return np.array(kept, np.int64)


def first_of_each(xy: Array, transform: Array, close: float, free: Bools) -> Ints:
    """Rows, of those that are `free` (n,), that lie farther than `close` from every one before, in its frontal frame."""
    if len(xy) == 0:
        return np.zeros(0, np.int64)
    free, inverse, tree = free.copy(), np.linalg.inv(transform), cKDTree(xy)
    reach = close * np.linalg.norm(transform, 2, axis=(1, 2))
    kept = []
    for i in range(len(xy)):
        if not free[i]:
            continue
        kept.append(i)
        near = np.array(tree.query_ball_point(xy[i], reach[i]))
        off = (xy[near] - xy[i]) @ inverse[i].T
        free[near[(off**2).sum(1) < close**2]] = False
    return np.array(kept, np.int64)


def near_any(xy: Array, transform: Array, others: Array, close: float) -> Bools:
    """Whether any of `others` (m, 2) lies within `close` of instances at xy (n, 2), in their frontal frames."""
    if len(others) == 0 or len(xy) == 0:
        return np.zeros(len(xy), bool)
    k = min(4, len(others))  # in the image; on the print the nearest may be another of them
    near = cKDTree(others).query(xy, k)[1].reshape(len(xy), k)
    off = np.linalg.solve(transform[:, None], (others[near] - xy[:, None])[..., None])[..., 0]
    return ((off**2).sum(-1) < close**2).any(1)
