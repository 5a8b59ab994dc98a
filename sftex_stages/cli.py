"""The command line: ``sftex run | plan | status | explain | evaluate | render | config``, and those of `storage`.

Exit codes: 0 success, 1 a defect in sftex, 2 bad configuration or usage (nothing was computed), 3 some images failed
and the others were delivered, 4 every image failed, 130 interrupted. Results go to stdout, the rest to stderr.
"""

from __future__ import annotations

import argparse
import gc
import json
import sys
import time
import traceback
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from . import __version__, dressing, storage
from .errors import InputError, SftexError, StoreError

if TYPE_CHECKING:
    from .engine.plan import Item, Planner
    from .engine.stage import StageParams

OK, DEFECT, USAGE, SOME_FAILED, ALL_FAILED, INTERRUPTED = 0, 1, 2, 3, 4, 130


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code."""
    gc.set_threshold(100_000, 50, 100)  # plans of thousands of images are millions of objects, and hardly a cycle
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
    from . import config, pipeline, progress, report
    from .engine import runs
    from .engine.execute import execute

    started = time.perf_counter()
    params = _params(args)
    items, missing = _find(args)
    planner = pipeline.planner(args.out, params, until=args.stage, force=args.force)
    with progress.watch(len(items)) as watcher:
        results = execute(planner, items, args.jobs, watcher, args.fail_fast)
    notices = planner.store.notices
    run = None
    try:
        text = config.to_yaml(params, pipeline.PIPELINE)
        run = runs.record(planner.store.root, text, [result.plan for result in results if result.plan])
    except StoreError as error:
        notices.append(str(error))
    for notice in notices:
        print(f"sftex: {notice}", file=sys.stderr)
    rows = report.run_rows(results, args.out, planner.store)
    failed = sum(row["status"] != "ok" for row in rows) + len(missing)
    code = OK if not failed else ALL_FAILED if failed == len(rows) + len(missing) else SOME_FAILED
    seconds = round(time.perf_counter() - started, 2)
    if args.json:
        _print_json(exit_code=code, seconds=seconds, run=run, images=rows, not_found=missing, notices=notices)
    else:
        print(report.run_text(rows, missing))
        print(f"\n{len(rows)} image{'s' * (len(rows) != 1)} in {seconds:.1f} s" + (f"; run {run}" if run else ""))
    return code


def _plan(args: argparse.Namespace) -> int:
    from . import report

    rows = report.status_rows(_plans(args, args.stage, args.force)[0])
    if args.json:
        _print_json(images=rows, stages=report.plan_summary(rows))
    else:
        print(report.plan_text(rows))
    return SOME_FAILED if any("error" in row for row in rows) else OK


def _status(args: argparse.Namespace) -> int:
    from . import report

    rows = report.status_rows(_plans(args)[0])
    if args.json:
        _print_json(images=rows)
    else:
        print(report.status_text(rows))
    return SOME_FAILED if any("error" in row for row in rows) else OK


def _explain(args: argparse.Namespace) -> int:
    from . import report

    args.images = [args.image]
    plans, planner = _plans(args)
    documents, texts = [], []
    for name, plan, error in plans:
        if plan is None:
            raise InputError(error)
        rows = report.explain_rows(plan, planner.store, args.stage)
        documents.append({"image": name, "stages": rows})
        texts.append((f"{name}\n" if len(plans) > 1 else "") + report.explain_text(rows))
    if args.json:
        _print_json(images=documents)
    else:
        print("\n\n".join(texts))
    return OK


def _plans(args: argparse.Namespace, until: str | None = None, force: Sequence[str] = ()) -> tuple[list[Any], Planner]:
    """(image, plan or None, error) of every image, by the planner that also runs; nothing is touched."""
    from . import pipeline

    params = _params(args)
    items, missing = _find(args)
    planner = pipeline.planner(args.out, params, repair=False, until=until, force=force)
    plans: list[Any] = []
    for item in items:
        try:
            plans.append((item.name, planner.plan(item), ""))
        except SftexError as error:
            plans.append((item.name, None, str(error)))
    return plans + [(message.split(":")[0], None, message) for message in missing], planner


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
    _selection(run)
    going = run.add_mutually_exclusive_group()
    going.add_argument("--keep-going", action="store_true", help="a failed image stops no other (default)")
    going.add_argument("--fail-fast", action="store_true", help="start nothing more after the first failure")

    plan = _command(commands, "plan", _plan, "show what a run would do: jobs, and why; computes nothing")
    _image_arguments(plan)
    _selection(plan)

    status = _command(commands, "status", _status, "show what is cached, what would run, and why; computes nothing")
    _image_arguments(status)

    explain = _command(commands, "explain", _explain, "say why a stage would run again: old value → new value")
    explain.add_argument("image", metavar="IMAGE", help="file")
    explain.add_argument("stage", nargs="?", metavar="STAGE", type=_stage, help="this stage only, and its key's parts")
    _run_options(explain)

    evaluate = _command(commands, "evaluate", _evaluate, "compare a result.h5 with the true surface")
    evaluate.add_argument("result", type=Path, metavar="RESULT", help="result.h5, or the folder that holds it")
    evaluate.add_argument("truth", type=Path, metavar="TRUTH", help="truth file (HDF5)")
    evaluate.add_argument("--json", action="store_true", help="print one JSON document")

    dressing.add_parser(partial(_command, commands))

    config = _command(commands, "config", _config, "print the complete configuration, with comments")
    config.add_argument("--config", type=Path, metavar="FILE", help="complete this file instead of the defaults")

    def stored(name: str, function: Any, about: str) -> argparse.ArgumentParser:
        return _command(commands, name, lambda args: function(args, _say(args)), about)

    storage.add_parsers(stored)
    return parser


def _say(args: argparse.Namespace) -> storage.Say:
    """How a command of `storage` tells its outcome."""
    return lambda document, text: _print_json(**document) if args.json else print(text)


def _command(commands: Any, name: str, function: Any, about: str) -> argparse.ArgumentParser:
    parser: argparse.ArgumentParser = commands.add_parser(name, help=about, description=about[0].upper() + about[1:])
    parser.set_defaults(command=function)
    return parser


def _image_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("images", nargs="+", metavar="IMAGES", help="folders, files or globs")
    _run_options(parser)


def _run_options(parser: argparse.ArgumentParser) -> None:
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


def _selection(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--stage", type=_stage, metavar="STAGE", help="only this stage and what it needs")
    parser.add_argument(
        "--force", type=_stage, metavar="STAGE", action="append", default=[],
        help="compute this stage again even where it is cached (may be repeated)",
    )  # fmt: skip


def _stage(text: str) -> str:
    from . import pipeline

    names = [*(stage.name for stage in pipeline.PIPELINE), "outputs"]
    if text not in names:
        raise argparse.ArgumentTypeError(f"no stage is called {text!r}; there are {', '.join(names)}")
    return text


def _positive(text: str) -> int:
    if not text.isdigit() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number of processes (1, 2, …)")
    return int(text)


if __name__ == "__main__":
    sys.exit(main())
