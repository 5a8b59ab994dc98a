"""Nodes: what all the instances in a small cell of the image say together, before any sign is known.

Many textons lie on one printed motif, so instances come in crowds that share one normal, and one sign. The tensor's w and
the logarithms of irradiance and scale are blind to the sign and may be averaged; the sign search then has one sign a node.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.floating]
Int = NDArray[np.integer]

FREEDOM = 3.0


@dataclass(frozen=True)
class Nodes:
    """`xy` (M, 2), `w` (M, 2) with `covariance` (M, 2, 2), `weight` (M,) ≤ 1 believed share, `member` (N,) node or −1, `share`
    (N, 2, 2) that an instance's w has in its node's: they add up to the identity."""

    xy: Float
    w: Float
    covariance: Float
    weight: Float
    member: Int
    share: Float


def cells(xy: Float, cell: float | Float) -> Int:
    """Number (N,) of the square cell of `cell` px, (N,) or of all, that every point lies in: occupied cells only, from 0.

    Cells of different sizes are different cells.
    """
    size = np.broadcast_to(cell, len(xy))
    key = np.column_stack((size, np.floor((xy - xy.min(0)) / size[:, None])))
    return np.unique(key, axis=0, return_inverse=True)[1].reshape(-1).astype(np.int64)


def pool(xy: Float, w: Float, covariance: Float, trust: Float, cell: float | Float, floor: float) -> Nodes:
    """Pool instances with positive `trust` (N,) in square cells of `cell` px, (N,) or of all.

    Parameters
    ----------
    xy, w, covariance : (N, 2), (N, 2), (N, 2, 2)
    floor
        standard deviation of w that no crowd can average away: curvature within the cell, errors the textons share.
    """
    used = np.flatnonzero(trust > 0.1)
    cellnumber = cells(xy[used], np.broadcast_to(cell, len(xy))[used])
    count = int(cellnumber.max()) + 1
    precision = np.linalg.inv(covariance[used])
    robust = np.ones(len(used))
    for _ in range(4):
        strength = trust[used] * robust
        normal, right = np.zeros((count, 2, 2)), np.zeros((count, 2))
        np.add.at(normal, cellnumber, strength[:, None, None] * precision)
        np.add.at(right, cellnumber, strength[:, None] * np.einsum("nij,nj->ni", precision, w[used]))
        inverse = np.linalg.inv(normal)
        mean = np.einsum("nij,nj->ni", inverse, right)
        r = w[used] - mean[cellnumber]
        chi2 = np.einsum("ni,nij,nj->n", r, precision, r)
        robust = (FREEDOM + 2) / (FREEDOM + chi2)
    total = np.bincount(cellnumber, strength, count)
    number = np.bincount(cellnumber, minlength=count)
    # Scatter beyond the stated noise makes the mean less certain; one prior member says that the noise is as stated.
    scatter = (np.bincount(cellnumber, strength * chi2 / 2, count) + 1) / (number + 1)
    centre = np.stack([np.bincount(cellnumber, strength * xy[used, k], count) / total for k in range(2)], 1)
    spread = inverse * np.maximum(scatter, 1)[:, None, None] + floor**2 * np.eye(2)
    member = np.full(len(xy), -1, np.int64)
    member[used] = cellnumber
    share = np.zeros((len(xy), 2, 2))
    share[used] = inverse[cellnumber] @ (strength[:, None, None] * precision)
    return Nodes(centre, mean, spread, np.minimum(total / number, 1), member, share)


def average(value: Float, variance: Float, nodes: Nodes, trust: Float, floor: float) -> tuple[Float, Float]:
    """Robust means (M,) of `value` (N,) with `variance` (N,) over the nodes, and their variance (M,), at least floor²."""
    used = nodes.member >= 0
    number, count = nodes.member[used], len(nodes.xy)
    v, strength = value[used], trust[used] / variance[used]
    robust = np.ones(len(v))
    mean = np.zeros(count)
    for _ in range(4):
        total = np.bincount(number, strength * robust, count)
        mean = np.bincount(number, strength * robust * v, count) / total
        chi2 = (v - mean[number]) ** 2 / variance[used]
        robust = (FREEDOM + 1) / (FREEDOM + chi2)
    members = np.bincount(number, minlength=count)
    scatter = (np.bincount(number, robust * chi2, count) + 1) / (members + 1)
    return mean, np.maximum(scatter, 1) / total + floor**2
