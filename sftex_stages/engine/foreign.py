"""What is asked of receipts and HDF5 files that come from elsewhere, before they are put into a store."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from ..errors import InputError
from ..guarded import survey_hdf5

_Digest = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]


class _Form(BaseModel):
    model_config = ConfigDict(strict=True)


class _Identity(_Form):
    stage: str
    version: int
    params: dict[str, Any]
    inputs: dict[str, _Digest | list[_Digest]]
    files: dict[str, _Digest | None]
    part: int | None


class _Artefact(_Form):
    sha256: _Digest
    bytes: int


class _Array(_Form):
    dtype: str
    shape: list[Annotated[int, Field(ge=0)]]


class _Receipt(_Form):
    """All that plans and reports read of a receipt."""

    label: str
    key: _Digest
    identity: _Identity
    artefact: _Artefact | None
    software: dict[str, str]
    seconds: float
    peak_memory_mb: float
    finished: str
    host: str
    arrays: dict[str, _Array] = {}
    scalars: dict[str, bool | int | float | str | None] = {}
    files: dict[str, _Digest] = {}


def check_receipt(receipt: Mapping[str, Any], stage: str) -> None:
    """ValueError unless it has the form of those that workers write for a job of `stage`."""
    try:
        form = _Receipt.model_validate(receipt)
    except ValidationError as error:
        first = error.errors()[0]
        raise ValueError(f"receipt of {stage}: {'.'.join(map(str, first['loc']))}: {first['msg']}") from error
    if form.identity.stage != stage or (form.artefact is None) != (not form.arrays):
        raise ValueError(f"receipt of {stage}: stage, artefact and arrays do not agree")


def check_hdf5(path: Path, name: str, arrays: Mapping[str, Any] | None) -> None:
    """InputError unless a file (called `name` in messages) is plain HDF5; ValueError if not `arrays` are in it."""
    try:
        declared = survey_hdf5(path)
    except InputError as error:
        raise InputError(f"{name}: {str(error).removeprefix(f'{path}: ')}") from error
    found = {
        array: ("text" if dtype == "U" else np.dtype(dtype).name, shape) for array, (dtype, shape) in declared.items()
    }
    if arrays is not None and found != {k: (array["dtype"], tuple(array["shape"])) for k, array in arrays.items()}:
        raise ValueError(f"{name} holds other arrays than its receipt says")
