"""What happens inside a worker process: read verified inputs, run one job, publish. Errors go back as values."""

from __future__ import annotations

import ctypes
import faulthandler
import importlib
import os
import platform
import resource
import sys
import threading
import time
import traceback
from collections import OrderedDict
from dataclasses import dataclass
from functools import lru_cache
from importlib import metadata
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from ..errors import InputError, SftexError
from . import keys
from .hdf5 import decode, encode
from .plan import Delivery, Job, Source
from .stage import Arrays, Stage, StageParams
from .store import DamagedError, Receipt, Store

_CACHE_BYTES = 512 << 20
_cache: OrderedDict[str, Arrays] = OrderedDict()  # content hash -> arrays: the jobs of an image share its artefacts
_LIBRARIES = ("numpy", "scipy", "h5py", "scikit-learn", "OpenImageIO", "joblib", "pydantic")


@dataclass(frozen=True)
class Task:
    """Everything a worker needs for one job; no arrays."""

    folder: (
        str  # the run's working directory: workers may be older than it, paths in messages stay as the user wrote them
    )
    root: Path  # of the store
    work: Stage | Delivery
    params: StageParams | None
    job: Job


@dataclass(frozen=True)
class Outcome:
    """What came of a job: a receipt, or damage found in its inputs, or an error (with a log if it was unexpected)."""

    job: Job
    receipt: Receipt | None = None
    damage: DamagedError | None = None
    error: str = ""
    log: Path | None = None


def start(run: int) -> None:
    """Initialiser of a worker: one thread in OpenCV (joblib's limit does not reach it), no life after the run's process.

    `run` is that process's number: it may have been killed before this is called, and the parent is then another.
    """
    try:
        importlib.import_module("cv2").setNumThreads(1)
    except ImportError:  # pipelines without vision
        pass

    def follow() -> None:
        while os.getppid() == run:
            time.sleep(1.0)
        os._exit(1)  # the run was killed: nobody will read what is computed here

    threading.Thread(target=follow, daemon=True).start()


def perform(task: Task) -> Outcome:
    """Run one job and publish its artefact."""
    store, job = Store(task.root), task.job
    try:
        os.chdir(task.folder)
        _crash_log(task.root.absolute())
        reset_peak = _reset_peak_memory()
        started = time.perf_counter()
        image, extra = _compute(task, store)
        receipt = {
            "label": job.item,
            "key": job.key,
            "identity": job.identity,
            **extra,
            "seconds": round(time.perf_counter() - started, 4),
            "peak_memory_mb": _peak_memory_mb(reset_peak),
            "finished": time.strftime("%Y-%m-%dT%H:%M:%S", time.gmtime()) + f".{time.time_ns() // 1000 % 10**6:06d}Z",
            "host": platform.node(),
            "software": _software(),
        }
        return Outcome(job, receipt=store.publish(job.stage, job.key, image, receipt))
    except DamagedError as damage:
        return Outcome(job, damage=damage)
    except SftexError as error:
        return Outcome(job, error=str(error))
    except Exception as error:  # whatever a stage raises must not take the other images with it
        return _unexpected(store, job, error)
    finally:
        if job.part is None:
            _give_back()


def _give_back() -> None:
    """Return freed memory to the system, which glibc may never do: a job on a whole image leaves hundreds of megabytes that
    the many small jobs after it would be charged with. Takes milliseconds, hence not after each of those."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if sys.platform == "linux" else None
    if trim is not None:  # other C libraries have none
        trim(0)


def _compute(task: Task, store: Store) -> tuple[bytes | None, dict[str, Any]]:
    """The artefact's bytes and the receipt's part that describes the outcome."""
    job, work = task.job, task.work
    inputs: dict[str, Any] = {name: _load(store, sources) for name, sources in job.inputs.items()}
    if isinstance(work, Delivery):
        folder = Path(job.folder or "")
        written = work.write(folder, inputs, dict(job.meta))
        return None, {"files": {str(p.relative_to(folder)): keys.file_sha256(p) for p in sorted(written)}}
    for name, path in job.files.items():
        inputs[name] = Path(path) if path is not None else None
    if job.part is not None:
        inputs["part"] = job.part
    arrays = work.run(inputs, task.params)
    for name, path in job.files.items():
        if path is not None and keys.file_sha256(Path(path)) != job.identity["files"][name]:
            raise InputError(f"{path}: changed while it was being read; run again")
    return encode(arrays), describe(arrays)


def describe(arrays: Arrays) -> dict[str, Any]:
    """Readable summary for the receipt: type and shape of every array, and the value of every scalar."""
    shapes, scalars = {}, {}
    for name, value in sorted(arrays.items()):
        array = np.asarray(value)
        shapes[name] = {"dtype": "text" if array.dtype.kind == "U" else str(array.dtype), "shape": list(array.shape)}
        if array.ndim == 0:
            scalar = array.item()
            scalars[name] = None if isinstance(scalar, float) and not np.isfinite(scalar) else scalar
    return {"arrays": shapes, "scalars": scalars}


def _load(store: Store, sources: Source | list[Source]) -> Arrays | list[Arrays]:
    if isinstance(sources, list):
        return [_artefact(store, source) for source in sources]
    return _artefact(store, sources)


def _artefact(store: Store, source: Source) -> Arrays:
    """Verified arrays, from this worker's memory if it has read the same content before."""
    if source.sha256 in _cache:
        _cache.move_to_end(source.sha256)
    else:
        _cache[source.sha256] = decode(store.read_artefact(source.stage, source.key, source.sha256))
        while len(_cache) > 1 and sum(_nbytes(arrays) for arrays in _cache.values()) > _CACHE_BYTES:
            _cache.popitem(last=False)
    return dict(_cache[source.sha256])


def _nbytes(arrays: Arrays) -> int:
    return sum(array.nbytes for array in arrays.values())


@lru_cache
def _crash_log(root: Path) -> TextIO:
    """Let the interpreter write there where it was when a signal killed it, rather than into the progress display."""
    log = open(root / "crashes.log", "a")  # stays open as long as the process lives
    faulthandler.enable(log)
    return log


def _unexpected(store: Store, job: Job, error: Exception) -> Outcome:
    text = f"{job.item} {job.stage} part {job.part}\n\n{traceback.format_exc()}"
    summary = f"unexpected {type(error).__name__}: {error}"
    try:
        log = store.write_log(job.stage, job.key, text)
    except SftexError as second:
        return Outcome(job, error=f"{summary}; no log: {second}")
    return Outcome(job, error=f"{summary}; see {log}", log=log)


@lru_cache
def _software() -> dict[str, str]:
    """Versions of sftex and of what it computes with."""
    versions = {"python": platform.python_version()}
    versions["sftex"] = str(getattr(sys.modules[__name__.partition(".")[0]], "__version__", "unknown"))
    for name in _LIBRARIES:
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    if "cv2" in sys.modules:  # its distribution has several names
        versions["opencv"] = sys.modules["cv2"].__version__
    return versions


def _reset_peak_memory() -> bool:
    try:
        Path("/proc/self/clear_refs").write_text("5")  # Linux: the peak of this job, not of this process's whole life
    except OSError:
        return False
    return True


def _peak_memory_mb(was_reset: bool) -> float:
    if was_reset:
        for line in Path("/proc/self/status").read_text().splitlines():
            if line.startswith("VmHWM:"):
                return round(int(line.split()[1]) / 1024, 1)
    unit = 1 if sys.platform == "darwin" else 1024  # ru_maxrss: bytes there, kilobytes elsewhere
    return round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 2**20, 1)
