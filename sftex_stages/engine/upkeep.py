"""Looking after a store: hash everything again (`verify`), remove what nothing refers to any more (`collect`)."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from ..errors import StoreError
from . import keys, ledger, runs
from .runs import Place
from .store import RESERVED, Store


@dataclass
class Health:
    """What `verify` found. Damaged files of the store were set aside; changed results were left as they are."""

    checked: int = 0
    bytes: int = 0
    damaged: list[str] = field(default_factory=list)
    unfinished: int = 0  # artefacts without a receipt: of killed runs, never used
    results: int = 0
    changed: list[str] = field(default_factory=list)  # delivered files: edited, damaged or removed


def verify(store: Store, out: Path) -> Health:
    """Hash every artefact, receipt, ledger, record and delivered file again. StoreError if the store cannot be read."""
    health = Health()
    places = list(store.receipts())
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        for size, notices in pool.map(partial(_verify, store.root), _batches(places)):
            health.bytes += size
            health.damaged += notices
    health.checked = len(places)
    health.unfinished = sum(
        not path.with_suffix(".json").exists()
        for path in store.root.glob("*/??/*.h5")
        if path.parts[-3] not in RESERVED
    )
    delivered: list[tuple[Path, str]] = []
    for path, label, steps in ledger.read_all(store.root):
        if not label:
            health.damaged.append(_set_aside(store.root, path))
            continue
        for stage in steps.values():
            files = stage["jobs"][0][1].get("files", {}) if stage["jobs"] else {}
            delivered += [(out / label / name, sha256) for name, sha256 in files.items()]
    health.results = len(delivered)
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        for size, problem in pool.map(_compare, delivered):
            health.bytes += size
            health.changed += problem
    for path in sorted((store.root / "runs").glob("*.json")):
        try:
            ledger.unseal(path.read_bytes())
        except ValueError:
            health.damaged.append(_set_aside(store.root, path))
    return health


def _batches(places: list[Place]) -> list[list[Place]]:
    return [places[start : start + 256] for start in range(0, len(places), 256)]


def _verify(root: Path, places: list[Place]) -> tuple[int, list[str]]:
    """Bytes of the intact artefacts among some jobs, and what is wrong with the others."""
    store, size = Store(root), 0  # a new one: it has verified nothing yet
    for stage, key in places:
        before = len(store.notices)
        receipt, problem = store.find(stage, key)
        if receipt is None and len(store.notices) == before and problem:
            store.notices.append(f"{stage} {key[:12]}: {problem}; computed again when it is next needed")
        size += receipt["artefact"]["bytes"] if receipt and receipt["artefact"] else 0
    return size, store.notices


def _compare(delivered: tuple[Path, str]) -> tuple[int, list[str]]:
    """Bytes of a delivered file, or what is wrong with it."""
    path, sha256 = delivered
    if not path.is_file():
        return 0, [f"{path} is missing"]
    if keys.file_sha256(path) != sha256:
        return 0, [f"{path} was changed"]
    return path.stat().st_size, []


def _set_aside(root: Path, path: Path) -> str:
    folder = root / "damaged"
    try:
        folder.mkdir(exist_ok=True)
        os.replace(path, folder / f"{path.parent.name}-{path.stem[:16]}-{time.time_ns()}.json")
    except OSError as error:
        raise StoreError(f"{path}: is damaged and cannot be set aside ({error.strerror})") from error
    return f"{path.parent.name}/{path.name}: wrong checksum; set aside in {folder}"


# ----------------------------------------------------------------------------------------------------- gc


@dataclass(frozen=True)
class Garbage:
    """One job's files that no item's last run and no pinned run reaches."""

    stage: str
    key: str
    bytes: int
    last_used: float  # seconds since 1970
    files: tuple[Path, ...]  # the receipt first: what has none does not count


@dataclass
class Collection:
    """What `collect` found: kept and removable bytes, and what goes."""

    bytes: int = 0  # of the whole store
    reached: int = 0  # of it
    remove: list[Garbage] = field(default_factory=list)


def collect(store: Store, older_than: float, max_bytes: int | None, delete: bool) -> Collection:
    """Find (and `delete`) what no current configuration and no pinned run reaches.

    Current is what every item's last run found. Of the rest go those not used for `older_than` seconds; with
    `max_bytes` the longest unused of these first, and only until the store is no larger. StoreError if a ledger is
    damaged (what it reaches is not known) or a file cannot be removed.
    """
    if not store.root.is_dir():
        raise StoreError(f"{store.root}: no store here; check --out")
    everything = runs.load_all(store.root)
    reached = _current(store.root).union(*(run.reached() for run in everything if run.pinned))
    used: dict[Place, float] = {}
    for run in everything:
        for place in run.reached():
            used[place] = max(used.get(place, 0.0), run.last)
    found = Collection()
    candidates = []
    now = time.time()
    for garbage in _jobs(store.root, used):
        found.bytes += garbage.bytes
        if (garbage.stage, garbage.key) in reached:
            found.reached += garbage.bytes
        elif now - garbage.last_used >= older_than:
            candidates.append(garbage)
    left = found.bytes
    for garbage in sorted(candidates, key=lambda g: g.last_used):
        if max_bytes is not None and left <= max_bytes:
            break
        found.remove.append(garbage)
        left -= garbage.bytes
    if delete:
        _delete(store.root, found.remove, everything, now - older_than)
    return found


def _current(root: Path) -> set[Place]:
    reached = set()
    for path, label, steps in ledger.read_all(root):
        if not label:
            raise StoreError(f"{path}: is damaged, so what it keeps is not known; run sftex verify, then sftex run")
        reached |= {(stage, receipt["key"]) for stage, entry in steps.items() for _, receipt in entry["jobs"]}
    return reached


def _jobs(root: Path, used: dict[Place, float]) -> Iterator[Garbage]:
    """All files of the store by job, and what is left over in its other folders."""
    groups: dict[Place, list[tuple[Path, os.stat_result]]] = {}
    for path in root.glob("*/??/*"):
        if path.parts[-3] not in RESERVED:
            with contextlib.suppress(OSError):
                groups.setdefault((path.parts[-3], path.name.partition(".")[0]), []).append((path, path.stat()))
    for name in ("damaged", "tmp"):
        for path in (root / name).glob("*"):
            with contextlib.suppress(OSError):
                if path.is_file():
                    groups[name, path.name] = [(path, path.stat())]
    for (stage, key), files in sorted(groups.items()):
        files.sort(key=lambda entry: entry[0].suffix != ".json")
        last = max(used.get((stage, key), 0.0), *(status.st_mtime for _, status in files), 0.0)
        yield Garbage(stage, key, sum(s.st_size for _, s in files), last, tuple(path for path, _ in files))


def _delete(root: Path, garbage: list[Garbage], everything: list[runs.Run], before: float) -> None:
    try:
        for job in garbage:
            for path in job.files:
                path.unlink(missing_ok=True)
        gone = {(job.stage, job.key) for job in garbage}
        for run in everything:  # a record of what is not there any more is of no use
            if not run.pinned and run.last <= before and run.reached() & gone:
                (root / "runs" / f"{run.id}.json").unlink(missing_ok=True)
    except OSError as error:
        raise StoreError(f"{error.filename}: cannot be removed ({error.strerror})") from error
