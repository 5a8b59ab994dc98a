"""Quick stand-ins for the seven stages, so that the command line is tested without the hours of vision.

The image stage is the real one: bad files must be told apart by the program as it is.
"""

import numpy as np
from pydantic import Field

from sftex_stages import images
from sftex_stages.engine.hdf5 import encode
from sftex_stages.engine.stage import Stage, StageParams
from sftex_stages.errors import StageError


class Detect(StageParams):
    threshold: float = Field(0.1, gt=0, description="contrast")


class Other(StageParams):
    tol: float = Field(1e-6, gt=0, description="smallest step")


def detect(inputs, params):
    rgb = inputs["image"]["rgb"]
    if rgb.std() < params.threshold:
        raise StageError("no interest points; the image has no texture")
    return {"xy": np.argwhere(rgb[..., 0] > 0.5)[:9].astype(np.float32)}


def cluster(inputs, params):
    return {"label": np.zeros(9, np.int32), "count": np.array(3)}


def frontal(inputs, params):
    return {"usable": np.array(inputs["part"] != 1), "x": inputs["detect"]["xy"] * inputs["part"] * params.tol}


def surface(inputs, params):
    return {"instance/xy": np.concatenate([part["x"] for part in inputs["frontal"]])}


def irradiance(inputs, params):
    return {"map": inputs["surface"]["instance/xy"].sum(axis=1)}


def chart(inputs, params):
    return {"uv": inputs["surface"]["instance/xy"] * 2}


PIPELINE = (
    images.STAGE,
    Stage("detect", 1, Detect, detect, inputs=("image",)),
    Stage("cluster", 1, Other, cluster, inputs=("detect",)),
    Stage("frontal", 1, Other, frontal, inputs=("image", "detect", "cluster"), fan_out="cluster"),
    Stage("surface", 1, Other, surface, inputs=("image", "frontal")),
    Stage("irradiance", 1, Other, irradiance, inputs=("surface",)),
    Stage("chart", 1, Other, chart, inputs=("surface",)),
)


def deliver(folder, arrays, meta):
    folder.mkdir(parents=True, exist_ok=True)
    content = encode({"map": arrays["irradiance"]["map"], "meta": np.array(str(meta))})
    (folder / "result.h5").write_bytes(content)
    return [folder / "result.h5"]
