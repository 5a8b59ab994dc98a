"""What the engine knows of a stage: a record. Nothing here (or anywhere in the engine) knows what a stage computes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict

#: The data passed between stages: a flat dictionary, '/' in a name becomes an HDF5 group. Scalars are 0-d arrays,
#: texts are arrays of numpy unicode dtype ('<U…').
Arrays = dict[str, np.ndarray]


class StageParams(BaseModel):
    """Base of every stage's parameters: immutable, no unknown keys. Every field has a default and a description."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


@dataclass(frozen=True)
class Stage:
    """One step of the pipeline.

    ``run(inputs, params)`` is pure and deterministic. ``inputs`` maps the name of every upstream stage in `inputs` to
    its arrays (a list of them, in part order, if that stage is fanned out), every name in `files` to a Path (None if
    there is no such file) and, for a fanned-out stage, "part" to the number of the part.
    """

    name: str
    version: int  # raise it whenever the results change: it is part of every key
    params: type[StageParams]
    run: Callable[[Mapping[str, Any], Any], Arrays]
    inputs: tuple[str, ...] = ()  # upstream stages
    files: tuple[str, ...] = ()  # source files whose bytes are hashed into the key, e.g. ("image", "mask")
    fan_out: str | None = None  # the upstream stage whose output "count" (0-d integer) gives the number of parts
