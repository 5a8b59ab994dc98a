"""Keys: what a job's result depends on, and nothing else.

The identity of a job is a readable dictionary (stage, version, the stage's own parameters, the content of its inputs);
its key is the SHA-256 of that dictionary's canonical JSON. Paths, file times, thread and job counts never enter, so
results may be moved, copied and shared. Upstream artefacts enter by the hash of their *content*: a stage that is
computed again with the same outcome leaves everything downstream cached (early cut-off).
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..errors import InputError
from .stage import Stage, StageParams

Identity = dict[str, Any]
_CANONICAL = json.JSONEncoder(sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False)


def canonical(value: Any) -> bytes:
    """JSON with sorted keys and no blanks. Floats are written by `repr`, so every float64 has exactly one spelling."""
    return _CANONICAL.encode(value).encode()


def digest(value: Any) -> str:
    """SHA-256 (hex) of the canonical JSON of `value`."""
    return hashlib.sha256(canonical(value)).hexdigest()


def file_sha256(path: Path) -> str:
    """SHA-256 (hex) of a source file's bytes; InputError if it cannot be read."""
    try:
        with open(path, "rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check that it exists and is readable") from error


def job_identity(
    stage: Stage,
    params: StageParams,
    upstream: Mapping[str, str | list[str]],
    files: Mapping[str, str | None],
    part: int | None,
) -> Identity:
    """Everything that decides the result of one job, readable.

    `upstream` maps each input stage to its artefact's SHA-256 (a list in part order for a fanned-out one), `files` each
    source file to the SHA-256 of its bytes (None: there is no such file).
    """
    return {
        "stage": stage.name,
        "version": stage.version,
        "params": params.model_dump(mode="json"),
        "inputs": dict(upstream),
        "files": dict(files),
        "part": part,
    }


def differences(old: Identity, new: Identity) -> list[str]:
    """Say in words why `new` is another job than `old`: ``frontal.tol 1e-06 → 1e-07``, ``detect changed``."""
    stage, words = new["stage"], []
    if old.get("version") != new["version"]:
        words.append(f"{stage} version {old.get('version')} → {new['version']}")
    before, after = old.get("params", {}), new["params"]
    for name in sorted(before.keys() | after.keys()):
        if before.get(name) != after.get(name):
            was, now = _show(before, name), _show(after, name)
            long = len(was) + len(now) > 100
            words.append(f"{stage}.{name} changed" if long else f"{stage}.{name} {was} → {now}")
    for kind in ("files", "inputs"):
        words += _changed(old.get(kind, {}), new[kind], " file" if kind == "files" else "")
    return words


def _show(params: Mapping[str, Any], name: str) -> str:
    return json.dumps(params[name], ensure_ascii=False) if name in params else "(none)"


def _changed(before: Mapping[str, Any], after: Mapping[str, Any], suffix: str) -> list[str]:
    words = []
    for name in sorted(before.keys() | after.keys()):
        was, now = before.get(name), after.get(name)
        if was == now:
            continue
        if isinstance(was, list) and isinstance(now, list):
            same = sum(a == b for a, b in zip(was, now, strict=False))
            words.append(f"{name} changed ({max(len(was), len(now)) - same} of {len(now)} parts)")
        else:
            verb = "added" if was is None else "removed" if now is None else "changed"
            words.append(f"{name}{suffix} {verb}")
    return words
