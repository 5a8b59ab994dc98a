"""What runs reached: records by which results are kept from being cleared away, archived, and found again.

::

    <root>/runs/<id>.json    configuration; per item its source files' hashes and every finished stage's keys
    <root>/runs/<id>.pin     keeps what the run reached from `gc`

The id is the hash of the content: a run that changes nothing is the same run. The file's time is when it was last done.
"""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..errors import InputError, StoreError
from . import keys, ledger
from .plan import Plan
from .store import write_atomically

Place = tuple[str, str]  # stage, key


@dataclass(frozen=True)
class Run:
    """One recorded run. `items`: label -> {"files": {name: SHA-256}, "keys": {stage: [key, ...]}}."""

    id: str
    config: str
    items: dict[str, dict[str, Any]]
    last: float  # seconds since 1970
    pinned: bool

    def reached(self) -> set[Place]:
        """All artefacts and deliveries that belong to it."""
        found = (item["keys"].items() for item in self.items.values())
        return {(stage, key) for steps in found for stage, many in steps for key in many}


def record(root: Path, config: str, plans: Sequence[Plan]) -> str:
    """Write the record of a run that ended with `plans`; its id. StoreError if it cannot be written."""
    items = {}
    for plan in plans:
        done = {name: step.keys for name, step in plan.steps.items() if step.complete}
        items[plan.item.name] = {"files": plan.file_hashes, "keys": done}
    document = {"config": config, "items": items}
    name = keys.digest(document)[:12]
    path = root / "runs" / f"{name}.json"
    content = ledger.seal(document)
    try:
        if path.exists() and path.read_bytes() == content:
            with contextlib.suppress(OSError):  # a store that may only be read
                os.utime(path)
        else:
            write_atomically(path, content, root / "tmp")
    except OSError as error:
        raise StoreError(f"{path}: cannot be written ({error.strerror}); this run cannot be archived") from error
    return name


def load_all(root: Path) -> list[Run]:
    """All readable records, the latest first; damaged ones are `verify`'s business."""
    found = []
    for path in (root / "runs").glob("*.json"):
        with contextlib.suppress(OSError, ValueError, KeyError):
            found.append(_load(path))
    return sorted(found, key=lambda run: -run.last)


def find(root: Path, name: str) -> Run:
    """The run with this id, or the beginning of it, or "last". InputError if there is none, or several."""
    everything = load_all(root)
    if not everything:
        raise InputError(f"{root}: no run is recorded here; check --out, or run sftex first")
    if name == "last":
        return everything[0]
    found = [run for run in everything if run.id.startswith(name)] if name else []
    if len(found) != 1:
        known = ", ".join(run.id for run in (found or everything)[:5])
        raise InputError(
            f"{name}: {'several runs' if found else 'no run'} of that name; there are {known} (sftex runs)"
        )
    return found[0]


def pin(root: Path, run: Run, on: bool) -> None:
    """Keep what the run reached from being cleared away, or no more."""
    path = root / "runs" / f"{run.id}.pin"
    try:
        if on:
            write_atomically(path, time.strftime("%Y-%m-%dT%H:%M:%SZ\n", time.gmtime()).encode(), root / "tmp")
        else:
            path.unlink(missing_ok=True)
    except OSError as error:
        raise StoreError(f"{path}: cannot be changed ({error.strerror})") from error


def _load(path: Path) -> Run:
    document = ledger.unseal(path.read_bytes())
    return Run(
        path.stem, document["config"], document["items"], path.stat().st_mtime, path.with_suffix(".pin").exists()
    )
