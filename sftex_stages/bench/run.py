"""One image after the other through the command line that users have; what it cost is read from the receipts."""

import hashlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import datetime
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import h5py

from ..errors import InputError, SftexError
from ..evaluate import evaluate
from ..images import discover
from ..results.archive import open_result
from . import dressing
from .figures import headline, original

_SFTEX = [sys.executable, "-c", "import sys; from sftex_stages.cli import main; sys.exit(main())"]


@dataclass(frozen=True)
class Case:
    """An image, its truth (None if unknown) and its name in the report."""

    name: str
    image: Path
    truth: Path | None


def find_cases(folders: Iterable[Path], patterns: Sequence[str]) -> list[Case]:
    """The images of those folders that exist, clean ones before their degraded copies; `patterns` are globs of names.

    An image whose very bytes were found in an earlier folder is left out. NAME_noise and NAME_noise_q70 use NAME's
    truth.
    """
    cases: dict[str, Case] = {}
    for folder in folders:
        if not folder.is_dir():
            continue
        try:
            items = discover(folder)
        except InputError:  # no image in there
            continue
        for item in items:
            if patterns and not any(fnmatch(item.path.stem, p) for p in patterns):
                continue
            digest = hashlib.sha256(item.path.read_bytes()).hexdigest()
            if digest not in cases:
                cases[digest] = Case(item.path.stem, item.path, _truth(item.path))
    return sorted(cases.values(), key=lambda c: (original(c.name) != c.name, c.name))


def _truth(image: Path) -> Path | None:
    for stem in (image.stem, original(image.stem)):
        path = image.with_name(f"{stem}.truth.h5")
        if path.is_file():
            return path
    return None


def measure(case: Case, work: Path, config: Path | None, jobs: int | None, limit: float) -> dict[str, Any]:
    """Reconstruct one image into `work`/<name>, again with everything cached, and evaluate it. Failures are in
    `failed`.

    A run of more than `limit` seconds is stopped. Keys: image, truth, failed, stages, numbers, figures.
    """
    out = work / case.name
    entry: dict[str, Any] = {"image": str(case.image), "truth": str(case.truth) if case.truth else None, "failed": None}
    entry |= {"stages": {}, "numbers": headline(None, {}), "figures": None}
    try:
        seconds = _reconstruct(case.image, out, config, jobs, limit)
        cached = _reconstruct(case.image, out, config, jobs, limit)
        result = _only_result(out)
        spent = costs(result, out / ".store") | {"seconds": seconds, "cached_seconds": cached}
        entry["stages"] = spent.pop("stages")
        entry["figures"] = evaluate(result, case.truth) if case.truth else None
        spent["render_seconds"] = dressing.render_seconds(_SFTEX, result, work)
        if case.truth:
            spent["retexture"] = dressing.round_trip(open_result(result), case.truth)
        entry["numbers"] = headline(entry["figures"], spent)
    except SftexError as error:
        entry["failed"] = str(error)
    except Exception as error:  # a defect met with one image must not take the others' figures along
        entry["failed"] = f"unexpected {type(error).__name__}: {error}"
    return entry


def _reconstruct(image: Path, out: Path, config: Path | None, jobs: int | None, limit: float) -> float:
    """Seconds that `sftex run` took. SftexError with its last words if it failed."""
    command = [*_SFTEX, "run", str(image), "--out", str(out)]
    command += ["--config", str(config)] if config else []
    command += ["--jobs", str(jobs)] if jobs else []
    command.append("--json")
    started = time.perf_counter()
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, errors="replace", start_new_session=True
    )
    try:
        document, words = process.communicate(timeout=limit)
    except subprocess.TimeoutExpired:
        raise SftexError(f"not done after {limit:g} s") from None
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)  # its own session: only what this run has started
            process.wait()
    seconds = time.perf_counter() - started
    if process.returncode:
        raise SftexError(f"exit code {process.returncode}: {_complaint(document, words)}")
    return seconds


def _complaint(document: str, words: str) -> str:
    """What a failed run says of its one image; its last words where it got no further."""
    try:
        return " | ".join(str(row["error"]) for row in json.loads(document)["images"])
    except (ValueError, KeyError, TypeError):
        return " | ".join([line.strip() for line in words.splitlines() if line.strip()][-4:])


def _only_result(out: Path) -> Path:
    found = sorted(out.glob("*/result.h5"))
    if len(found) != 1:
        raise SftexError(f"{out}: {len(found)} results instead of one")
    return found[0]


def costs(result: Path, store: Path) -> dict[str, Any]:
    """What a result cost, from the receipts of the jobs that made it.

    stages: per stage its jobs, `seconds` of all together, `wall` from the first start to the last end, `peak_memory_mb`
    of the worst. The figures `keypoints`, `textons`, `usable_textons`, `frontal_ms`, `frontal_memory`, `peak_memory`,
    `irradiance_seconds`.
    """
    with h5py.File(result, "r", locking=False) as file:
        keys = json.loads(file.attrs["keys"])
        usable = file["textons/usable"][()]
    stages = {}
    for stage, named in keys.items():
        receipts = [_receipt(store, stage, key) for key in ([named] if isinstance(named, str) else named)]
        if receipts:
            stages[stage] = _stage_costs(receipts)
    delivered = [json.loads(path.read_text()) for path in (store / "outputs").glob("??/*.json")]
    if delivered:  # its key is in no result: the newest one is meant
        stages["outputs"] = _stage_costs([max(delivered, key=lambda receipt: receipt["finished"])])
    out: dict[str, Any] = {"stages": stages, "textons": len(usable), "usable_textons": int(usable.sum())}
    detect = keys["detect"]
    with h5py.File(store / "detect" / detect[:2] / f"{detect}.h5", "r", locking=False) as file:
        out["keypoints"] = len(file["xy"])
    if "frontal" in stages:
        out["frontal_ms"] = 1000 * stages["frontal"]["seconds"] / max(out["keypoints"], 1)
        out["frontal_memory"] = stages["frontal"]["peak_memory_mb"]
    out["peak_memory"] = max(cost["peak_memory_mb"] for cost in stages.values())
    out["irradiance_seconds"] = stages["irradiance"]["seconds"]
    return out


def _receipt(store: Path, stage: str, key: str) -> dict[str, Any]:
    receipt: dict[str, Any] = json.loads((store / stage / key[:2] / f"{key}.json").read_text())
    return receipt


def _stage_costs(receipts: Sequence[dict[str, Any]]) -> dict[str, float]:
    ends = [datetime.fromisoformat(r["finished"]).timestamp() for r in receipts]
    starts = [end - r["seconds"] for end, r in zip(ends, receipts, strict=True)]
    return {
        "jobs": len(receipts),
        "seconds": sum(r["seconds"] for r in receipts),
        "wall": max(ends) - min(starts),
        "peak_memory_mb": max(r["peak_memory_mb"] for r in receipts),
    }
