"""Chart stage: flat coordinates of the surface, for prints to be laid on it (what the paper's section 6 leaves to be done)."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from pydantic import Field

from sftex_stages.engine.stage import Arrays, Stage, StageParams
from sftex_stages.geometry import chart


class Params(StageParams):
    """Parameters of the chart stage."""

    vertices: int = Field(10000, ge=100, le=500000, description="Vertices, about, of the mesh that is unrolled")
    turns: int = Field(40, ge=1, le=10000, description="Most turns of the unrolling on each grid")


def run(inputs: Mapping[str, Any], params: Params) -> Arrays:
    """The chart of every piece of the surface, as isometric as its shape allows.

    Returns
    -------
    uv (H, W, 2) px of the surface as seen from straight ahead, rounded to 1/256, u to the right and v down on the whole; NaN
    off the surface. Of the P pieces, median and 95th percentile over their area: angular (P, 2), degrees by which the chart
    changes angles at most, and area (P, 2), |change of area| / area.
    """
    surface = inputs["surface"]
    height, normals, piece = (np.asarray(surface[name]) for name in ("height", "normals", "piece"))
    camera = chart.Pinhole.of(surface)
    found = chart.make_chart(height, normals, piece, camera, params.vertices, params.turns)
    return {
        "uv": (np.round(found.uv * 256) / 256).astype(np.float32),
        "angular": found.angular.astype(np.float32),
        "area": found.area.astype(np.float32),
    }


STAGE = Stage(name="chart", version=1, params=Params, run=run, inputs=("surface",))
