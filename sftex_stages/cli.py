"""The command line: ``sftex run | status | evaluate | config``.

Exit codes: 0 success, 1 a defect in sftex, 2 bad configuration or usage (nothing was computed), 3 some images failed
and the others were delivered, 4 every image failed, 130 interrupted. Results go to stdout, the rest to stderr.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
import traceback
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from . import __version__
from .errors import InputError, SftexError

if TYPE_CHECKING:
    from .engine.plan import Item
    from .engine.stage import StageParams

OK, DEFECT, USAGE, SOME_FAILED, ALL_FAILED, INTERRUPTED = 0, 1, 2, 3, 4, 130


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code."""
    args = _parser().parse_args(argv)
    try:
        code: int = args.command(args)
    except SftexError as error:
        print(f"sftex: {error}", file=sys.stderr)
        return USAGE
    except KeyboardInterrupt:
        print("sftex: interrupted; the same command goes on from here", file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:  # `sftex … | head`
        sys.stderr.close()
        return OK
    except Exception:
        traceback.print_exc()
        print("sftex: this is a defect in sftex, not in your images; please report the lines above", file=sys.stderr)
        return DEFECT
    return code


# ------------------------------------------------------------------------------------------------ commands


def _run(args: argparse.Namespace) -> int:
    from . import pipeline, progress, report
    from .engine.execute import execute

    started = time.perf_counter()
    params = _params(args)
    items, missing = _find(args)
    planner = pipeline.planner(args.out, params)
    with progress.watch(len(items)) as watcher:
        results = execute(planner, items, args.jobs, watcher)
    for notice in planner.store.notices:
        print(f"sftex: {notice}", file=sys.stderr)
    rows = report.run_rows(results, args.out, planner.store)
    failed = sum(row["status"] != "ok" for row in rows) + len(missing)
    code = OK if not failed else ALL_FAILED if failed == len(rows) + len(missing) else SOME_FAILED
    seconds = round(time.perf_counter() - started, 2)
    if args.json:
        _print_json(exit_code=code, seconds=seconds, images=rows, not_found=missing, notices=planner.store.notices)
    else:
        print(report.run_text(rows, missing))
        print(f"\n{len(rows)} image{'s' * (len(rows) != 1)} in {seconds:.1f} s")
    return code


def _status(args: argparse.Namespace) -> int:
    from . import pipeline, report

    params = _params(args)
    items, missing = _find(args)
    planner = pipeline.planner(args.out, params, repair=False)
    plans: list[Any] = []
    for item in items:
        try:
            plans.append((item.name, planner.plan(item), ""))
        except SftexError as error:
            plans.append((item.name, None, str(error)))
    plans += [(message.split(":")[0], None, message) for message in missing]
    rows = report.status_rows(plans)
    if args.json:
        _print_json(images=rows)
    else:
        print(report.status_text(rows))
    return SOME_FAILED if any("error" in row for row in rows) else OK


def _evaluate(args: argparse.Namespace) -> int:
    from .evaluate import evaluate, format_text

    figures = evaluate(args.result, args.truth)
    print(json.dumps(figures, indent=1, ensure_ascii=False) if args.json else format_text(figures))
    return OK


def _config(args: argparse.Namespace) -> int:
    from . import config, pipeline

    if args.config:
        print(config.to_yaml(config.load(args.config, pipeline.PIPELINE), pipeline.PIPELINE), end="")
    else:
        print(config.default_yaml(pipeline.PIPELINE), end="")
    return OK


def _params(args: argparse.Namespace) -> dict[str, StageParams]:
    """--config, or pipeline.yaml if there is one here, or the defaults."""
    from . import config, pipeline

    path = args.config
    if path is None and Path("pipeline.yaml").is_file():
        path = Path("pipeline.yaml")
    return config.load(path, pipeline.PIPELINE)


def _find(args: argparse.Namespace) -> tuple[list[Item], list[str]]:
    """The images, and what is wrong with those arguments that name none. InputError if there is no image at all."""
    from . import images, pipeline

    good, missing = [], []
    for argument in args.images:
        try:
            images.discover(argument)
            good.append(argument)
        except InputError as error:
            missing.append(str(error))
    if not good:
        raise InputError("\nsftex: ".join(missing))
    for message in missing:
        print(f"sftex: {message}", file=sys.stderr)
    found = images.discover(good, args.masks)
    print(f"sftex: {images.summary(found)}", file=sys.stderr)
    return pipeline.items(found), missing


def _print_json(**document: Any) -> None:
    print(json.dumps({"sftex": __version__, **document}, indent=1, ensure_ascii=False))


# -------------------------------------------------------------------------------------------------- parser


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="sftex",
        description="Surfaces, normals and light from single photographs of repeated patterns.",
        epilog="exit codes: 0 success; 1 a defect in sftex; 2 bad configuration or usage; "
        "3 some images failed, the others were delivered; 4 every image failed",
    )
    parser.add_argument("--version", action="version", version=f"sftex {__version__}")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)

    run = _command(commands, "run", _run, "reconstruct images (only what is not cached is computed)")
    _image_arguments(run)
    run.add_argument("--jobs", type=_positive, metavar="N", help="processes (default: one per processor)")

    status = _command(commands, "status", _status, "show what is cached, what would run, and why; computes nothing")
    _image_arguments(status)

    evaluate = _command(commands, "evaluate", _evaluate, "compare a result.h5 with the true surface")
    evaluate.add_argument("result", type=Path, metavar="RESULT", help="result.h5, or the folder that holds it")
    evaluate.add_argument("truth", type=Path, metavar="TRUTH", help="truth file (HDF5)")
    evaluate.add_argument("--json", action="store_true", help="print one JSON document")

    config = _command(commands, "config", _config, "print the complete configuration, with comments")
    config.add_argument("--config", type=Path, metavar="FILE", help="complete this file instead of the defaults")
    return parser


def _command(commands: Any, name: str, function: Any, about: str) -> argparse.ArgumentParser:
    parser: argparse.ArgumentParser = commands.add_parser(name, help=about, description=about[0].upper() + about[1:])
    parser.set_defaults(command=function)
    return parser


def _image_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("images", nargs="+", metavar="IMAGES", help="folders, files or globs")
    parser.add_argument(
        "--out", type=Path, default=Path("outputs"), metavar="DIR",
        help="results go to DIR/<image>/, the cache to DIR/.store (default: outputs)",
    )  # fmt: skip
    parser.add_argument(
        "--config", type=Path, metavar="FILE", help="configuration (default: ./pipeline.yaml if there is one)"
    )
    parser.add_argument(
        "--masks", type=Path, metavar="DIR", help="folder of masks (default: <stem>.mask.png beside the image)"
    )
    parser.add_argument("--json", action="store_true", help="print one JSON document on stdout")


def _positive(text: str) -> int:
    if not text.isdigit() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number of processes (1, 2, …)")
    return int(text)


if __name__ == "__main__":
    sys.exit(main())
