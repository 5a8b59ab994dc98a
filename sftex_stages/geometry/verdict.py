"""The sign of every piece of a surface, with what each cue said of it and how sure it is."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sftex_stages.geometry import gaussian, mirror, perspective, pooling, sign_search, signs, support

Float = NDArray[np.floating]
Int = NDArray[np.integer]

RIVAL_SHARE = 0.1  # of a piece that a rival pattern must turn to count as one for the piece


@dataclass(frozen=True)
class Verdict:
    """Signs (P,) of the pieces that nodes lie in, `piece` (N,) from 0; what each cue said of them, {cue: (P,) nats for the sign
    taken}; nats (P,) by which the sign taken beats the other; whether the light found is the mirrored one."""

    piece: Int
    sign: Float
    votes: dict[str, Float]
    margin: Float
    mirrored: bool


def decide(
    nodes: pooling.Nodes,
    field: gaussian.Field,
    coupled: signs.Coupling,
    data: sign_search.Data,
    best: sign_search.Candidate,
    g: Float,
    sizes: perspective.Sizes | None,
    choice: perspective.Choice,
    hints: mirror.Hints,
    spacing: float,
) -> Verdict:
    """The sign of every piece of the surface of slopes `g` (N, 2) at the nodes, by all cues (`mirror.py`)."""
    piece = mirror.pieces(nodes.xy, 2 * support.reach(nodes.xy, spacing))
    count = int(piece.max()) + 1
    h = gaussian.heights(field, best.a)
    ties, lit = sign_search.ties(data, coupled, best.s, piece)
    votes: dict[str, Float] = {name: np.zeros(count) for name in ("scale", "light", "bulge", "hint")}
    if sizes is not None:
        votes["scale"] = mirror.scale(choice.sign, sizes.value, sizes.trust / sizes.variance, h, piece, count)
    if best.light is not None:
        votes["light"] = mirror.light(best.light.direction[2:], best.shade, lit, hints.light)
    votes["bulge"] = mirror.bulge(nodes.xy, g, piece, count)
    votes["hint"] = mirror.hint(hints, nodes.xy, g, h, piece, count)
    sign = mirror.decide(np.sum(list(votes.values()), 0), ties)
    tied = sign * ((ties - np.diag(np.diag(ties))) @ sign)
    margin = 2 * (sign * np.sum(list(votes.values()), 0) + tied)
    given = {name: sign * v for name, v in votes.items()} | {"smoothness": tied, "shading": np.abs(lit)}
    return Verdict(piece, sign, given, margin, bool((lit * sign).sum() < 0 or (not lit.any() and sign[0] < 0)))


def by_piece(label: NDArray[np.int32], xy: Float, verdict: Verdict, regions: list[Int], rise: Float) -> dict[str, NDArray]:
    """What is known of the sign of every piece of the map `label` (H, W), from nodes at `xy` (N, 2).

    A piece of the map that has no node takes what the nearest node says.
    """
    count = int(label.max())
    at = np.rint(xy).astype(int)
    inside = (at >= 0).all(1) & (at < label.shape[::-1]).all(1)
    on = np.zeros(len(xy), np.int64)
    on[inside] = label[at[inside, 1], at[inside, 0]]
    tree, owner = cKDTree(xy), np.zeros(count, np.int64)
    worse = np.full(count, np.inf)
    for k in range(count):
        here = np.flatnonzero(on == k + 1)
        if not len(here):
            y, x = np.argwhere(label == k + 1).mean(0)
            here = np.array([tree.query([x, y])[1]])
        owner[k] = np.bincount(verdict.piece[here]).argmax()
        on[here] = k + 1
    size = np.bincount(on, minlength=count + 1)
    for region, value in zip(regions, rise.tolist(), strict=True):
        turned = np.bincount(on[region], minlength=count + 1)
        rival = (turned >= np.maximum(RIVAL_SHARE * size, 1))[1:] & (turned < size)[1:]
        worse[rival] = np.minimum(worse[rival], value)
    votes = {f"vote/{name}": v[owner].astype(np.float32) for name, v in verdict.votes.items()}
    margins = {"region_margin": worse.astype(np.float32), "mirror_margin": verdict.margin[owner].astype(np.float32)}
    return votes | margins
