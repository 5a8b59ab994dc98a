"""Command line of the benchmark: ``python -m sftex_stages.bench``."""

import argparse
import json
import os
import platform
import signal
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from .. import __version__
from ..errors import InputError, SftexError
from .report import compare, markdown
from .run import find_cases, measure

_ROOT = Path(__file__).resolve().parents[2]
_FOLDERS = [_ROOT / "../shared/scenes", _ROOT / "../shared/real", _ROOT / "data/examples"]


def main(argv: Sequence[str] | None = None) -> int:
    """Run or compare benchmarks. Returns the exit code: 0, or 2 if there is nothing to do."""
    args = _parse(argv)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that the run in hand is stopped too
    try:
        if args.compare:
            print(compare(_read(args.compare[0]), _read(args.compare[1])))
            return 0
        patterns = args.scenes.replace(",", " ").split()
        cases = find_cases(args.folders, patterns)
        if not cases:
            looked = ", ".join(str(folder) for folder in args.folders)
            raise InputError(f"no image matches {args.scenes or 'anything'} in {looked}")
        args.out.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix="sftex-bench-") as fresh:
            _run(cases, args, args.work or Path(fresh))
        return 0
    except SftexError as error:
        print(f"sftex bench: {error}", file=sys.stderr)
        return 2


def _run(cases: list[Any], args: argparse.Namespace, work: Path) -> None:
    """Measure every case; both files are written again after each, so that a stopped run leaves what it had."""
    bench: dict[str, Any] = {
        "sftex": __version__,
        "date": time.strftime("%Y-%m-%d %H:%M"),
        "machine": f"{platform.system()} {platform.machine()} with {os.cpu_count()} processors",
        "python": platform.python_version(),
        "jobs": args.jobs,
        "config": args.config.read_text() if args.config else "",
        "images": {},
    }
    for number, case in enumerate(cases, 1):
        print(f"[{number}/{len(cases)}] {case.name} ... ", end="", file=sys.stderr, flush=True)
        entry = measure(case, work, args.config, args.jobs, args.limit)
        bench["images"][case.name] = entry
        print(_line(entry), file=sys.stderr, flush=True)
        (args.out / "bench.json").write_text(json.dumps(bench, indent=1) + "\n")
        (args.out / "bench.md").write_text(markdown(bench))
    print((args.out / "bench.md").read_text())
    print(f"written: {args.out / 'bench.md'}, {args.out / 'bench.json'}", file=sys.stderr)


def _line(entry: dict[str, Any]) -> str:
    if entry["failed"]:
        return f"FAILED: {entry['failed']}"
    numbers = entry["numbers"]
    shown = [("instances", "instance_median", "°"), ("surface", "dense_median", "°"), ("light", "light", "")]
    words = [f"{title} {numbers[key]:.3g}{unit}" for title, key, unit in shown if numbers[key] is not None]
    return ", ".join([f"{numbers['seconds']:.1f} s", *words])


def _read(path: Path) -> dict[str, Any]:
    try:
        bench: dict[str, Any] = json.loads(path.read_text())
        bench["images"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path}: not a benchmark's JSON file ({error})") from error
    return bench


def _parse(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m sftex_stages.bench", description=__doc__)
    parser.add_argument("folders", nargs="*", type=Path, default=_FOLDERS, help="of images")
    parser.add_argument("--scenes", default="", help="globs of image names, separated by spaces or commas")
    parser.add_argument("--out", type=Path, default=Path("outputs/bench"), help="where bench.md and bench.json go")
    parser.add_argument("--work", type=Path, help="keep the results there (default: fresh, removed at the end)")
    parser.add_argument("--config", type=Path, help="configuration (default: sftex's own)")
    parser.add_argument("--jobs", type=int, help="processes (default: all processors)")
    parser.add_argument("--limit", type=float, default=1800.0, help="seconds after which a run counts as failed")
    parser.add_argument("--compare", nargs=2, type=Path, metavar=("OLD", "NEW"), help="say what moved, run nothing")
    return parser.parse_args(argv)


if __name__ == "__main__":
    sys.exit(main())
