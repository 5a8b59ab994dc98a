"""Stage `cluster`: putative instances of one texton share a descriptor (paper, sections 3 and 3.1.1).

k-means, with k following the number of points: too many clusters cost little (each becomes a texton of its own),
too few mix elements and ruin everything.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from .engine.stage import Arrays, Stage, StageParams

Array = NDArray[np.floating]


class Params(StageParams):
    """Parameters of `cluster`."""

    clusters: int | None = Field(None, ge=1, le=5000, description="clusters of points and of regions; null: from their numbers")
    points_per_cluster: float = Field(80.0, ge=3, description="sets the number of clusters when it is not given")
    min_clusters: int = Field(100, ge=1, description="clusters of points are no fewer, where 25 points are left to each")
    regions_per_cluster: float = Field(150.0, ge=3, description="the same for regions, whose frames are affine already")
    max_distance: float = Field(1.6, gt=0, description="members farther from the centre, in median distances, are left out")
    max_scale_ratio: float = Field(2.0, gt=1, description="members whose size differs from the median by more are left out")
    seed: int = Field(0, ge=0, description="seed of k-means")


_FEW = 25  # copies of an element that a sparse print still has, or so


def number_of_clusters(points: int, per_cluster: float, params: Params, fewest: int = 1) -> int:
    """k for `points` descriptors of one kind; `fewest` if it leaves enough of them to each.

    Sparse prints have some tens of copies of each element: clusters as large as those of a dense print would mix elements.
    """
    wanted = max(round(points / per_cluster), min(fewest, points // _FEW)) if params.clusters is None else params.clusters
    return int(np.clip(wanted, 1, max(1, points // 3)))


def run(inputs: Mapping[str, Any], params: Params) -> Arrays:
    """Cluster descriptors. Input `detect`. Returns `label` (N,) int32, −1 for points far from every centre, and `count`."""
    from sklearn.cluster import KMeans  # takes over a second to import, and a cached run does not need it

    detect = inputs["detect"]
    kind = detect["kind"]
    size = np.log(np.sqrt(np.abs(np.linalg.det(detect["frame"].astype(np.float64)))))
    label = np.full(len(kind), -1, np.int32)
    count = 0
    for which, share, fewest in ((0, params.points_per_cluster, params.min_clusters), (1, params.regions_per_cluster, 1)):
        rows = np.flatnonzero(kind == which)
        if len(rows) < 3:
            continue
        k = number_of_clusters(len(rows), share, params, fewest)
        descriptors = detect["descriptor"][rows].astype(np.float32)
        means = KMeans(k, n_init=1, max_iter=60, random_state=params.seed, algorithm="lloyd").fit(descriptors)
        distance = np.linalg.norm(descriptors - means.cluster_centers_[means.labels_], axis=1)
        label[rows] = count + means.labels_
        label[rows[outlying(means.labels_, distance, size[rows], params)]] = -1
        count += k
    return {"label": label, "count": np.array(count, np.int64)}


def outlying(label: Array, distance: Array, size: Array, params: Params) -> Array:
    """Members (N,) bool far from their cluster's centre in descriptor, or from its median in log size."""
    out = np.zeros(len(label), bool)
    order = np.argsort(label, kind="stable")
    for members in np.split(order, np.flatnonzero(np.diff(label[order])) + 1):
        far = distance[members] > params.max_distance * np.median(distance[members])
        odd = np.abs(size[members] - np.median(size[members])) > np.log(params.max_scale_ratio)
        out[members] = far | odd
    return out


STAGE = Stage(name="cluster", version=2, params=Params, run=run, inputs=("detect",))
