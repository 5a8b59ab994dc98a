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

    clusters: int | None = Field(None, ge=1, le=5000, description="number of clusters; null: from the number of points")
    points_per_cluster: float = Field(80.0, ge=3, description="sets the number of clusters when it is not given")
    max_distance: float = Field(1.6, gt=0, description="members farther from the centre than this × the median distance are left out")
    max_scale_ratio: float = Field(2.0, gt=1, description="members whose size differs from the median by more are left out")
    seed: int = Field(0, ge=0, description="seed of k-means")


def number_of_clusters(points: int, params: Params) -> int:
    """k for `points` descriptors."""
    wanted = params.clusters if params.clusters is not None else round(points / params.points_per_cluster)
    return int(np.clip(wanted, 1, max(1, points // 3)))


def run(inputs: Mapping[str, Any], params: Params) -> Arrays:
    """Cluster descriptors. Input `detect`. Returns `label` (N,) int32, −1 for points far from every centre, and `count`."""
    from sklearn.cluster import KMeans  # takes over a second to import, and a cached run does not need it

    detect = inputs["detect"]
    descriptors = detect["descriptor"].astype(np.float32)
    k = number_of_clusters(len(descriptors), params)
    means = KMeans(k, n_init=1, max_iter=60, random_state=params.seed, algorithm="lloyd").fit(descriptors)
    label = means.labels_.astype(np.int32)
    distance = np.linalg.norm(descriptors - means.cluster_centers_[label], axis=1)
    size = np.log(np.sqrt(np.abs(np.linalg.det(detect["frame"].astype(np.float64)))))
    for c in range(k):
        members = np.flatnonzero(label == c)
        if len(members) == 0:
            continue
        far = distance[members] > params.max_distance * np.median(distance[members])
        odd = np.abs(size[members] - np.median(size[members])) > np.log(params.max_scale_ratio)
        label[members[far | odd]] = -1
    return {"label": label, "count": np.int64(k)}


STAGE = Stage(name="cluster", version=1, params=Params, run=run, inputs=("detect",))
