"""The commands that look after a store: ``sftex verify | gc | runs | pin | archive | restore``."""

from __future__ import annotations

import argparse
import re
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .errors import InputError

if TYPE_CHECKING:
    from .engine.store import Store

Say = Callable[[dict[str, Any], str], None]  # prints the document (--json) or the text


def _store(args: argparse.Namespace) -> Store:
    from .engine.store import Store

    store = Store(args.out / ".store")
    if not store.root.is_dir():
        raise InputError(f"{store.root}: no cache here; check --out")
    return store


def verify(args: argparse.Namespace, say: Say) -> int:
    """Hash everything again. 0: all is well, 3: something was damaged or changed."""
    from .engine import upkeep

    started = time.perf_counter()
    health = upkeep.verify(_store(args), args.out)
    seconds = time.perf_counter() - started
    lines = [f"damaged: {line}" for line in health.damaged] + [f"results: {line}" for line in health.changed]
    rate = health.bytes / max(seconds, 1e-9)
    lines.append(
        f"{health.checked} jobs and {health.results} result files, {size(health.bytes)} hashed in {seconds:.1f} s "
        f"({size(rate)}/s): {len(health.damaged)} damaged, {len(health.changed)} results missing or changed"
        + (f", {health.unfinished} unfinished artefacts (never used; gc removes them)" if health.unfinished else "")
    )
    if health.damaged or health.changed:
        lines.append("the next sftex run of these images computes again what is missing")
    say({**vars(health), "seconds": round(seconds, 3)}, "\n".join(lines))
    return 3 if health.damaged or health.changed else 0


def gc(args: argparse.Namespace, say: Say) -> int:
    """Tell, or with --delete remove, what nothing refers to any more."""
    from .engine import upkeep

    found = upkeep.collect(_store(args), args.older_than, args.max_size, args.delete)
    freed = sum(job.bytes for job in found.remove)
    stages = sorted({job.stage for job in found.remove})
    lines = []
    for stage in stages:
        mine = [job for job in found.remove if job.stage == stage]
        lines.append(f"  {stage}: {len(mine)} jobs, {size(sum(job.bytes for job in mine))}")
    verb = "removed" if args.delete else "to remove"
    lines.append(
        f"store {size(found.bytes)}, {size(found.reached)} of it in use by current configurations and pinned runs; "
        f"{verb}: {len(found.remove)} jobs, {size(freed)}"
    )
    if found.remove and not args.delete:
        lines.append("nothing was removed; --delete does it")
    if args.max_size is not None and found.bytes - freed > args.max_size:
        lines.append(f"the store stays over {size(args.max_size)}: the rest is in use, or younger than --older-than")
    jobs = [{"stage": job.stage, "key": job.key, "bytes": job.bytes} for job in found.remove]
    say(
        {"bytes": found.bytes, "in_use": found.reached, "deleted": args.delete, "freed": freed, "jobs": jobs},
        "\n".join(lines),
    )
    return 0


def list_runs(args: argparse.Namespace, say: Say) -> int:
    """The recorded runs, the latest first."""
    from .engine import runs

    rows: list[dict[str, Any]] = []
    for run in runs.load_all(_store(args).root):
        when = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(run.last))
        rows.append({"run": run.id, "last": when, "images": sorted(run.items), "pinned": run.pinned})
    lines = [
        f"{row['run']}  {row['last'][:16].replace('T', ' ')}  {len(row['images'])} images"
        + ("  pinned" if row["pinned"] else "")
        for row in rows
    ]
    say({"runs": rows}, "\n".join(lines) or "no runs yet")
    return 0


def pin(args: argparse.Namespace, say: Say) -> int:
    """Keep what a run reached from gc."""
    from .engine import runs

    store = _store(args)
    run = runs.find(store.root, args.run)
    runs.pin(store.root, run, not args.remove)
    say({"run": run.id, "pinned": not args.remove}, f"{run.id} is {'no longer ' * args.remove}pinned")
    return 0


def archive(args: argparse.Namespace, say: Say) -> int:
    """Write a run to a file or folder."""
    from .engine import bundle, runs

    store = _store(args)
    run = runs.find(store.root, args.run)
    files = bundle.archive(store, args.out, run, args.output)
    total = sum(p.stat().st_size for p in ([args.output] if args.output.is_file() else args.output.rglob("*")))
    say(
        {"run": run.id, "archive": str(args.output), "files": files, "bytes": total},
        f"{args.output}: run {run.id}, {len(run.items)} images, {files} files, {size(total)}; the photographs themselves "
        "are not in it",
    )
    return 0


def restore(args: argparse.Namespace, say: Say) -> int:
    """Put an archived run into a store."""
    from .engine import bundle, runs
    from .engine.store import Store

    run, new = bundle.restore(Store(args.out / ".store"), args.out, args.archive)
    config = args.out / f"{run}.yaml"
    config.write_text(runs.find(args.out / ".store", run).config, encoding="utf-8")
    say(
        {"run": run, "new_files": new, "config": str(config)},
        f"run {run} restored to {args.out} ({new} new files); go on with: "
        f"sftex run IMAGES --out {args.out} --config {config}",
    )
    return 0


# --------------------------------------------------------------------------------------------------- parsing


def size(count: float) -> str:
    """Bytes for people."""
    for unit in ("bytes", "kB", "MB", "GB"):
        if count < 1000:
            return f"{count:.0f} {unit}" if unit == "bytes" else f"{count:.1f} {unit}"
        count /= 1000
    return f"{count:.1f} TB"


def parse_size(text: str) -> int:
    """``10GB``, ``500M``: bytes."""
    found = re.fullmatch(r"(\d+(?:\.\d+)?)\s*([kMGT]?)B?", text)
    if not found:
        raise argparse.ArgumentTypeError(f"{text!r} is not a size (10GB, 500MB, …)")
    return int(float(found[1]) * 1000 ** "_kMGT".index(found[2] or "_"))


def parse_age(text: str) -> float:
    """``30d``, ``12h``, ``0``: seconds."""
    found = re.fullmatch(r"(\d+(?:\.\d+)?)([dhms]?)", text)
    if not found or (not found[2] and float(found[1])):
        raise argparse.ArgumentTypeError(f"{text!r} is not an age (30d, 12h, 0, …)")
    return float(found[1]) * {"d": 86400, "h": 3600, "m": 60, "s": 1, "": 0}[found[2]]


def add_parsers(command: Callable[..., argparse.ArgumentParser]) -> None:
    """Their command lines; `command(name, function, about)` makes a parser."""
    parser = command("verify", verify, "hash everything in the cache and all results again; set damaged files aside")
    _options(parser)
    parser = command("gc", gc, "show what no image's last run and no pinned run uses; with --delete, remove it")
    parser.add_argument("--delete", action="store_true", help="remove it (default: only tell)")
    parser.add_argument(
        "--older-than", type=parse_age, default=86400.0, metavar="AGE",
        help="only what was not used for so long (30d, 12h, 0; default: 1d, which also spares runs that are going on)",
    )  # fmt: skip
    parser.add_argument(
        "--max-size", type=parse_size, metavar="SIZE", help="only until the cache is no larger, longest unused first"
    )
    _options(parser)
    parser = command("runs", list_runs, "list the runs that can be pinned and archived")
    _options(parser)
    parser = command("pin", pin, "keep everything that a run used from gc")
    parser.add_argument("run", metavar="RUN", help="its id, the beginning of it, or: last")
    parser.add_argument("--remove", action="store_true", help="keep it no longer")
    _options(parser)
    parser = command("archive", archive, "write a run (cache, results, configuration) to one file or folder")
    parser.add_argument("run", metavar="RUN", help="its id, the beginning of it, or: last")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="FILE", help="run.tar, or a new folder")
    _options(parser)
    parser = command("restore", restore, "put an archived run into the cache of --out")
    parser.add_argument("archive", type=Path, metavar="ARCHIVE", help="what sftex archive wrote")
    _options(parser)


def _options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--out", type=Path, default=Path("outputs"), metavar="DIR", help="results and cache (default: outputs)"
    )
    parser.add_argument("--json", action="store_true", help="print one JSON document on stdout")
