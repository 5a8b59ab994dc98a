"""Which of a surface and its mirror image, piece by piece: what each cue says, and the decision.

Smoothness and shading hold alike for a surface and its mirror image (the light mirrored too). What remains is measured
(element size, under perspective), told (hints), or a habit of the world: light comes from above, things bulge toward the
camera. Pieces that lie apart have a sign each; smoothness and a common light may still tie them together.
"""

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

Float = NDArray[np.floating]
Int = NDArray[np.integer]

LIGHT_ABOVE, BULGE = 3.0, 0.5  # nats of what is usual, when nothing measured tells
HINT = 1e4  # nats of what a user says: over all that is measured
EXHAUSTIVE = 12  # pieces up to which all patterns of signs are tried


@dataclass(frozen=True)
class Hints:
    """What is known beforehand: `near`, `far` (K, 2) px stand out toward the camera or lie back; discs `convex` (K, 3) = (x, y,
    radius) bulge toward it, or `everything` does; unit direction `light` (2,) in the image that light comes from, None if not
    told."""

    near: Float
    far: Float
    convex: Float
    light: Float | None
    everything: bool = False


def pieces(xy: Float, reach: float) -> Int:
    """Piece (N,) of points `xy` (N, 2), from 0, the largest first: what is linked by steps of at most `reach` px."""
    pairs = cKDTree(xy).query_pairs(reach, output_type="ndarray")
    graph = coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(xy), len(xy)))
    label = connected_components(graph, directed=False)[1]
    order = np.argsort(-np.bincount(label), kind="stable")
    return np.argsort(order)[label].astype(np.int64)


def bulge(xy: Float, g: Float, piece: Int, count: int) -> Float:
    """Nats (P,) for surfaces that bulge toward the camera; slopes `g` (N, 2) at `xy` (N, 2) in pieces (N,)."""
    size = np.maximum(np.bincount(piece, minlength=count), 1)
    centre = np.stack([np.bincount(piece, xy[:, k], count) / size for k in range(2)], 1)
    out = ((xy - centre[piece]) * g).sum(1)
    return -BULGE * np.sign(np.bincount(piece, out, count))


def light(direction: Float, shade: float, tie: Float, told: Float | None) -> Float:
    """Nats (P,) for light from above, or from where it is `told` to come from.

    `direction` (2,) of the light found in the image, whose evidence is `shade` nats; `tie` (P,) nats between it and the
    pieces: what it does not shade it does not turn.
    """
    length = float(np.linalg.norm(direction))
    if shade <= 10 or length == 0:
        return np.zeros(len(tie))
    say = -LIGHT_ABOVE * direction[1] / length if told is None else HINT * float(direction @ told) / length
    return np.asarray(say * np.tanh(tie))


def scale(total: float, size: Float, weight: Float, h: Float, piece: Int, count: int) -> Float:
    """Nats (P,) of element size, `total` over all pieces, as the sizes of each go with its heights `h` (N,).

    `size`, `weight` (N,): logarithm of element size, and its precision.
    """
    if count == 1 or total == 0:
        return np.full(count, total)
    mass = np.maximum(np.bincount(piece, weight, count), 1e-12)

    def centred(v: Float) -> Float:
        return np.asarray(v - (np.bincount(piece, weight * v, count) / mass)[piece])

    along = np.bincount(piece, weight * centred(size) * centred(h), count)
    return np.asarray(abs(total) * along / max(float(np.abs(along).sum()), 1e-300))


def hint(hints: Hints, xy: Float, g: Float, h: Float, piece: Int, count: int) -> Float:
    """Nats (P,) of near and far points and convex places, for heights `h` (N,) and slopes `g` (N, 2) of nodes `xy` (N, 2)."""
    votes = np.zeros(count)
    tree = cKDTree(xy)
    for points, toward in ((hints.near, 1.0), (hints.far, -1.0)):
        at = tree.query(points)[1] if len(points) else np.zeros(0, np.int64)
        other = hints.far if toward > 0 else hints.near
        against = tree.query(other)[1] if len(other) else np.zeros(0, np.int64)
        for node in at:
            p = piece[node]
            rest = against[piece[against] == p]
            level = h[rest].mean() if len(rest) else h[piece == p].mean()
            votes[p] += toward * HINT * np.sign(h[node] - level)
    for x, y, radius in hints.convex:
        inside = np.flatnonzero(np.hypot(xy[:, 0] - x, xy[:, 1] - y) <= radius)
        if len(inside) < 3:
            inside = tree.query([x, y], min(6, len(xy)))[1].reshape(-1)
        p = int(np.bincount(piece[inside]).argmax())
        votes[p] += HINT * _convex(xy, g, inside[piece[inside] == p])
    if hints.everything:
        votes += HINT * np.array([_convex(xy, g, np.flatnonzero(piece == p)) for p in range(count)])
    return votes


def _convex(xy: Float, g: Float, inside: Int) -> float:
    """1 if the surface of slopes `g` (N, 2) bulges toward the camera over the nodes `inside`, −1 if away, 0 if neither: by its
    mean curvature, so that a lean does not count."""
    offset = xy[inside] - xy[inside].mean(0)
    return -float(np.sign((offset * (g[inside] - g[inside].mean(0))).sum()))


def decide(votes: Float, ties: Float) -> Float:
    """Signs (P,) of greatest `votes·t + ½ tᵀ ties t` for votes (P,) and ties (P, P) in nats: all tried, or greedy flips."""
    count = len(votes)
    ties = ties - np.diag(np.diag(ties))
    if count <= EXHAUSTIVE:
        t = np.array(list(product((1.0, -1.0), repeat=count))).T
    else:
        t = np.stack((np.ones(count), np.where(votes < 0, -1.0, 1.0)), 1)
        for _ in range(20 * count):
            gain = -t * (ties @ t + votes[:, None])
            site = gain.argmax(0)
            move = gain[site, np.arange(2)] > 1e-12
            if not move.any():
                break
            t[site[move], np.flatnonzero(move)] *= -1
    value = votes @ t + 0.5 * (t * (ties @ t)).sum(0)
    return np.asarray(t[:, value.argmax()])
