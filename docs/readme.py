"""The parts of README.md that follow from the program: filled here, held true by tests/test_readme.py.

    python docs/readme.py                                   # commands, parameters, outputs, archive: from the code
    python docs/readme.py --bench outputs/bench/bench.json  # the measured tables too
    python docs/readme.py --picture outputs                 # images/overview.png, from results of data/examples

A part stands between ``<!-- NAME:begin -->`` and ``<!-- NAME:end -->``.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, get_args

import cv2
import numpy as np

from sftex_stages import cli, config, images, open_result
from sftex_stages.bench.figures import FIGURES
from sftex_stages.bench.report import _table as aligned
from sftex_stages.pipeline import PIPELINE
from sftex_stages.results import FILES, exports, pictures, render
from sftex_stages.results.archive import SCHEMA

ROOT = Path(__file__).resolve().parents[1]
README = ROOT / "README.md"
PICTURE = ROOT / "docs/images/overview.png"
SCENES = ("spherecap_glyphs_side", "cylinder_flowers_sun")  # of data/examples
CELL = 300, 276  # px, width and height of one view
ACCURACY = ("accepted", "instance_median", "recall", "dense_median", "dense_median_given", "dense_11", "coverage",
            "light", "constant_baseline")  # fmt: skip
COST = ("keypoints", "textons", "seconds", "cached_seconds", "peak_memory")


# ---------------------------------------------------------------------------------------------------- from the code


def commands() -> str:
    """Every command with its arguments, and what the options mean."""
    parser = cli._parser()
    choices = next(a for a in parser._actions if isinstance(a, argparse._SubParsersAction))
    about = {action.dest: action.help or "" for action in choices._choices_actions}
    rows: list[str] = []
    options: dict[str, str] = {}  # the first command that has an option says what it means
    for name, command in choices.choices.items():
        words = [f"sftex {name}"]
        for action in command._actions:
            if isinstance(action, argparse._HelpAction):
                continue
            spelled = _spelled(action)
            words.append(spelled if action.required else f"[{spelled}]")  # argparse asks for positionals unless "?"
            if action.option_strings:
                options.setdefault(spelled, _cell(action.help or ""))
        rows.append(f"| `{' '.join(words)}` | {_cell(about[name])} |")
    meant = [f"| `{spelled}` | {meaning} |" for spelled, meaning in options.items()]
    return "\n".join(
        ["| command | what it does |", "|---|---|", *rows, "", "| option | meaning |", "|---|---|", *meant]
    )


def _spelled(action: argparse.Action) -> str:
    """An argument as it is typed: ``--out DIR``, ``IMAGES…``."""
    if not action.option_strings:
        return str(action.metavar or action.dest) + ("…" if action.nargs in ("+", "*") else "")
    value = "" if action.nargs == 0 else f" {action.metavar or action.dest.upper()}"
    return action.option_strings[-1] + value + ("…" if action.nargs in ("+", "*") else "")


def parameters() -> str:
    """Every parameter of every stage: default, what is allowed, meaning."""
    lines = ["| parameter | default | allowed | meaning |", "|---|---|---|---|"]
    for stage in PIPELINE:
        schema = stage.params.model_json_schema().get("properties", {})
        values = stage.params().model_dump(mode="json")
        for key, field in stage.params.model_fields.items():
            named = get_args(field.annotation)
            allowed = config._bounds(schema[key]).strip(" ()")
            if not allowed and named and all(isinstance(v, str) for v in named):
                allowed = ", ".join(f"`{v}`" for v in named)
            allowed = allowed or ("`true`, `false`" if field.annotation is bool else "")
            default, meaning = json.dumps(values[key]), _uncapped(field.description or "")
            lines.append(f"| `{stage.name}.{key}` | `{default}` | {_cell(allowed)} | {_cell(meaning)} |")
    return "\n".join(lines)


def outputs() -> str:
    """Every file of an image's folder."""
    return "\n".join(["| file | what it is |", "|---|---|", *(f"| `{n}` | {_cell(a)} |" for n, a in FILES.items())])


def archive() -> str:
    """Every dataset of result.h5."""
    kinds = {"f4": "float32", "i4": "int32", "?": "bool", "U": "UTF-8"}
    lines = ["| dataset | type | shape | unit | what it is |", "|---|---|---|---|---|"]
    for name, entry in SCHEMA.items():
        shape, unit = ", ".join(entry.axes.split()), "" if entry.unit == "1" else entry.unit
        lines.append(f"| `{name}` | {kinds[entry.dtype]} | {shape} | {unit} | {_cell(entry.about)} |")
    return "\n".join(lines)


def _uncapped(text: str) -> str:
    """The words without a capital at their head, unless it belongs to an abbreviation."""
    return text[:1].lower() + text[1:] if text[1:2].islower() else text


def _cell(text: str) -> str:
    return re.sub(r"<(?=\w)", "&lt;", text.replace("|", "\\|"))  # a < before a letter would begin an HTML tag


PARTS: Mapping[str, Callable[[], str]] = {
    "commands": commands, "parameters": parameters, "outputs": outputs, "archive": archive,
}  # fmt: skip


def put(text: str, name: str, content: str) -> str:
    """`text` with `content` as its part `name`. ValueError if it has no such part."""
    pattern = re.compile(rf"(<!-- {name}:begin -->\n).*?(<!-- {name}:end -->)", re.DOTALL)
    if len(pattern.findall(text)) != 1:
        raise ValueError(f"README.md needs exactly one part <!-- {name}:begin --> … <!-- {name}:end -->")
    return pattern.sub(lambda found: f"{found[1]}{content}\n{found[2]}", text)


def filled(text: str) -> str:
    """`text` with all parts that follow from the code."""
    for name, content in PARTS.items():
        text = put(text, name, content())
    return text


# --------------------------------------------------------------------------------------------------------- measured


def bench(report: Mapping[str, Any]) -> str:
    """Accuracy and cost of every image of a bench.json, and what failed."""
    done = {name: entry["numbers"] for name, entry in report["images"].items() if not entry["failed"]}
    failed = [f"- `{name}` failed: {entry['failed']}" for name, entry in report["images"].items() if entry["failed"]]
    known = {name: numbers for name, numbers in done.items() if numbers["dense_median"] is not None}
    jobs = f"{report['jobs']} processes" if report["jobs"] else "one process per processor"
    head = f"sftex {report['sftex']}, {report['date'][:10]}, {report['machine']}, {jobs}."
    lines = [head, "", *_measured(known, ACCURACY), "", *_measured(done, COST)]
    return "\n".join([*lines, *([""] if failed else []), *failed])


def _measured(images_: Mapping[str, Mapping[str, float | None]], names: tuple[str, ...]) -> list[str]:
    head = ["image", *(FIGURES[name].heading for name in names)]
    return aligned(head, [[image, *(FIGURES[n].text(row[n]) for n in names)] for image, row in images_.items()])


# ---------------------------------------------------------------------------------------------------------- picture


def overview(out: Path) -> np.ndarray:
    """Photograph, surface, the surface dressed, normals and irradiance of `SCENES`, a row each, (h, w, 3) uint8 RGB.

    `out` holds the results of ``sftex run data/examples --out OUT``.
    """
    rows = []
    for name in SCENES:
        photo = exports.to_display(images.load_image(ROOT / f"data/examples/{name}.png")[0])
        result = open_result(out / name / "result.h5")
        textured, grey = render.render(result.height, result.normals, result.valid, (photo, None))
        normals = pictures.normal_map(result.normals, result.valid)
        light = pictures.irradiance(result.irradiance, result.valid)[:, : photo.shape[1]]  # without its bar
        rows.append(np.hstack([_fit(view) for view in (photo, grey, textured, normals, light)]))
    head = np.full((40, rows[0].shape[1], 3), render.BACKGROUND, np.uint8)
    for k, title in enumerate(("photograph", "surface", "with the photograph", "normals", "irradiance")):
        font, at = cv2.FontFace("sans"), (k * CELL[0] + 12, 27)
        cv2.putText(head, title, at, pictures.INK, font, 19, 500)
    return np.vstack([head, *rows])


def _fit(view: np.ndarray) -> np.ndarray:
    """The view in the middle of a cell."""
    width, height = CELL
    scale = min((width - 16) / view.shape[1], (height - 16) / view.shape[0])
    small = cv2.resize(view, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    cell = np.full((height, width, 3), render.BACKGROUND, np.uint8)
    y, x = (height - small.shape[0]) // 2, (width - small.shape[1]) // 2
    cell[y : y + small.shape[0], x : x + small.shape[1]] = small
    return cell


def main() -> int:
    """Write what is asked for; returns the exit code."""
    parser = argparse.ArgumentParser(description="Fill the parts of README.md that follow from the program.")
    parser.add_argument("--bench", type=Path, metavar="FILE", help="a benchmark's bench.json")
    parser.add_argument("--picture", type=Path, metavar="OUT", help="folder of results of data/examples")
    args = parser.parse_args()
    text = filled(README.read_text(encoding="utf-8"))
    if args.bench:
        text = put(text, "bench", bench(json.loads(args.bench.read_text(encoding="utf-8"))))
    README.write_text(text, encoding="utf-8")
    if args.picture:
        PICTURE.parent.mkdir(exist_ok=True)
        cv2.imwrite(str(PICTURE), overview(args.picture)[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 9])
    return 0


if __name__ == "__main__":
    sys.exit(main())
