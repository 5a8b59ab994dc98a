"""Regions whose signs may be wrong together, at all sizes: the moves that single flips and mean fields do not make.

A region of wrong signs is consistent in itself and at odds with its surroundings only along its rim. Merging neighbours in the
order of how well their signed gradients agree (average linkage over the neighbour graph) therefore leaves such a region in
one piece until late: it is one of the N − 1 regions that appear on the way. Trying each of them costs one product with K.
The same list, once no flip of it helps, holds the best rivals of the pattern found, region by region.
"""

import heapq

import numpy as np
from numpy.typing import NDArray

from sftex_stages.geometry import signs

Float = NDArray[np.floating]
Int = NDArray[np.integer]

CHUNK = 256  # regions tried at a time: bounded memory


def merge(agreement: Float, pairs: tuple[Int, Int], n: int) -> list[Int]:
    """The regions (index arrays) that average linkage over a graph passes through, two nodes to all that is connected.

    Parameters
    ----------
    agreement : (E,)
        of the nodes `pairs` (E,), (E,), each 0 … n − 1; a pair that is listed twice counts once.
    """
    key, first = np.unique(np.minimum(*pairs) * n + np.maximum(*pairs), return_index=True)
    links: list[dict[int, tuple[float, int]]] = [{} for _ in range(2 * n)]  # sum of agreement, number of pairs
    heap: list[tuple[float, int, int]] = []
    for x, y, value in zip((key // n).tolist(), (key % n).tolist(), agreement[first].tolist(), strict=True):
        links[x][y] = links[y][x] = (value, 1)
        heap.append((-value, x, y))
    heapq.heapify(heap)
    member = [[k] for k in range(n)]
    gone: set[int] = set()
    while heap:
        _, x, y = heapq.heappop(heap)
        if x in gone or y in gone:
            continue
        gone |= {x, y}
        new, joined = len(member), links[x]
        for k, (total, count) in links[y].items():
            before = joined.get(k, (0.0, 0))
            joined[k] = (before[0] + total, before[1] + count)
        joined.pop(x, None)
        joined.pop(y, None)
        for k, mean in joined.items():
            theirs = links[k]
            theirs.pop(x, None)
            theirs.pop(y, None)
            theirs[new] = mean
            heapq.heappush(heap, (-mean[0] / mean[1], k, new))
        links[new], links[x], links[y] = joined, {}, {}
        member.append(member[x] + member[y])
    return [np.array(m) for m in member[n:]]


def rises(c: signs.Coupling, s: Float, bias: Float, regions: list[Int]) -> Float:
    """Nats (R,) by which the energy rises if a region of the pattern `s` (N,) flips; negative: flipping it helps."""
    local = signs.product(c, s) + bias
    out = np.empty(len(regions))
    for at in range(0, len(regions), CHUNK):
        part = regions[at : at + CHUNK]
        flipped = np.zeros((len(s), len(part)))
        for k, region in enumerate(part):
            flipped[region, k] = s[region]
        out[at : at + CHUNK] = 2 * (flipped.T @ local - (flipped * signs.product(c, flipped)).sum(0))
    return out


def rivals(c: signs.Coupling, d: Float, s: Float, bias: Float, pairs: tuple[Int, Int]) -> tuple[list[Int], Float]:
    """Regions of at most half the nodes, single nodes included, and the rise (R,) of the energy if each flips.

    Of a region of more than half the nodes, the complement is taken: the global mirror image is another matter.
    """
    i, j = pairs
    n = len(s)
    agreement = (d[i] * d[j]).sum(1) * s[i] * s[j]
    regions = [np.array([k]) for k in range(n)]
    for region in merge(agreement, pairs, n):
        if 2 * len(region) > n:
            rest = np.ones(n, bool)
            rest[region] = False
            region = np.flatnonzero(rest)
        if len(region):
            regions.append(region)
    single = 2 * s * (signs.product(c, s) - c.own * s + bias)
    return regions, np.concatenate((single, rises(c, s, bias, regions[n:])))


def margins(regions: list[Int], rise: Float, n: int) -> Float:
    """Nats (N,) that the best rival pattern costs which differs at a node: the least rise of the regions it is in."""
    out = np.full(n, np.inf)
    for region, value in zip(regions, rise.tolist(), strict=True):
        out[region] = np.minimum(out[region], value)
    return out
