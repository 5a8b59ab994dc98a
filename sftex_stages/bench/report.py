"""Tables of a benchmark in Markdown, and what moved between two of them."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from .figures import FIGURES, Numbers, Target, original, targets

_MARKS = {"pass": " ✓", "floor": " ~", "miss": " ✗", "none": " ✗"}
_TABLES = {
    "Summary": ["accepted", "instance_median", "instance_p90", "recall", "signs", "dense_median", "dense_11",
                "coverage", "height", "light", "light_gain", "constant_baseline", "seconds", "cached_seconds",
                "peak_memory"],
    "Instances": ["accepted", "usable_textons", "textons", "instance_median", "instance_p90", "recall",
                  "instance_signs", "instance_signs_given", "instance_light", "instance_light_pooled",
                  "instance_ratio", "instance_beyond_3"],
    "Surface": ["signs", "signs_given", "dense_median", "dense_median_given", "dense_median_better", "dense_mean",
                "dense_p90", "dense_5", "dense_11", "dense_22", "dense_30", "dense_all_11", "coverage", "height",
                "height_scaled", "pixel_ratio", "pixel_beyond_3", "pixel_factor", "frontal_baseline",
                "constant_baseline"],
    "Irradiance": ["light", "light_correlation", "light_gain", "light_blurred", "light_constant", "light_ratio"],
    "Chart and new prints": ["chart_angle", "chart_angle_95", "chart_area", "chart_area_95", "retexture"],
    "Cost": ["seconds", "cached_seconds", "keypoints", "frontal_ms", "frontal_memory", "peak_memory",
             "irradiance_seconds", "render_seconds"],
}  # fmt: skip
_NOISE = {"s": 0.25, "ms": 0.25, "MB": 0.1}  # relative change of a cost that means nothing
_STILL = 0.02  # relative change of any other figure that is not worth a line


def wanted(bench: Mapping[str, Any], name: str) -> list[Target]:
    """The targets of one image of a benchmark."""
    clean = bench["images"].get(original(name)) if original(name) != name else None
    return targets(name, bench["images"][name]["numbers"], clean["numbers"] if clean else None)


def markdown(bench: Mapping[str, Any]) -> str:
    """The whole report: a table per subject, seconds and memory per stage, what failed, what missed its target."""
    images: Mapping[str, Any] = bench["images"]
    marks = {name: _marks(wanted(bench, name)) for name in images}
    lines = [
        "# Benchmark",
        "",
        f"sftex {bench['sftex']}, {bench['date']}, {bench['machine']}, "
        f"{bench['jobs'] or 'as many'} jobs at once. "
        "✓ goal reached, ~ only the floor, ✗ missed. Orthographic scenes: up to one global flip.",
    ]
    for title, names in _TABLES.items():
        lines += ["", f"## {title}", ""]
        head = ["image", *(FIGURES[n].heading for n in names)]
        done = {image: entry["numbers"] for image, entry in images.items() if not entry["failed"]}
        rows = [[image, *(_cell(n, values, marks[image]) for n in names)] for image, values in done.items()]
        lines += _table(head, rows)
    lines += ["", "## Seconds and memory of each stage", "", "Seconds of all jobs (wall, peak of one job).", ""]
    lines += _stage_table(images)
    failed = [f"- **{name}**: {entry['failed']}" for name, entry in images.items() if entry["failed"]]
    lines += ["", "## Failed", "", *(failed or ["none"])]
    lines += ["", "## Targets missed", "", *_missed(bench)]
    return "\n".join(lines) + "\n"


def _marks(of: Sequence[Target]) -> dict[str, str]:
    """The worst state of each figure that has a target."""
    order = ["pass", "floor", "none", "miss"]
    worst: dict[str, str] = {}
    for target in of:
        states = [worst.get(target.figure, "pass"), target.state]
        worst[target.figure] = max(states, key=order.index)
    return {figure: _MARKS[state] for figure, state in worst.items()}


def _cell(figure: str, numbers: Numbers, marks: Mapping[str, str]) -> str:
    value = numbers.get(figure)
    return FIGURES[figure].text(value) + (marks.get(figure, "") if value is not None else "")


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """A Markdown table whose columns are aligned in plain text too."""
    if not rows:
        return ["nothing to show"]
    widths = [max(len(row[c]) for row in [head, *rows]) for c in range(len(head))]

    def line(row: Sequence[str]) -> str:
        first = row[0].ljust(widths[0])
        return "| " + " | ".join([first, *(v.rjust(w) for v, w in zip(row[1:], widths[1:], strict=True))]) + " |"

    rule = "|" + "|".join(["-" * (widths[0] + 2), *("-" * (w + 1) + ":" for w in widths[1:])]) + "|"
    return [line(head), rule, *(line(row) for row in rows)]


def _stage_table(images: Mapping[str, Any]) -> list[str]:
    names = list(dict.fromkeys(stage for entry in images.values() for stage in entry["stages"]))
    rows = []
    for image, entry in images.items():
        cells = [entry["stages"].get(name) for name in names]
        texts = [f"{c['seconds']:.2f} ({c['wall']:.2f}, {c['peak_memory_mb']:.0f} MB)" if c else "–" for c in cells]
        if entry["stages"]:
            rows.append([image, *texts])
    return _table(["image", *names], rows)


def _missed(bench: Mapping[str, Any]) -> list[str]:
    rows, count = [], {"pass": 0, "floor": 0, "miss": 0, "none": 0}
    for name in bench["images"]:
        for target in wanted(bench, name):
            count[target.state] += 1
            if target.state != "pass":
                figure = FIGURES[target.figure]
                sign = "≥" if target.more else "≤"
                limits = [f"{sign} {figure.text(v)}" if v is not None else "" for v in (target.goal, target.floor)]
                rows.append([name, figure.heading, figure.text(target.value), *limits, target.state])
    summary = f"{count['pass']} reached, {count['floor']} at the floor, {count['miss'] + count['none']} missed."
    return [summary, "", *(_table(["image", "figure", "value", "goal", "floor", "state"], rows) if rows else [])]


def compare(old: Mapping[str, Any], new: Mapping[str, Any]) -> str:
    """What moved from one benchmark to another, image by image, and the median ratio of each figure over the images."""
    rows: list[list[str]] = []
    ratios: dict[str, list[float]] = {}
    both = [name for name in old["images"] if name in new["images"]]
    for name in both:
        before, after = old["images"][name], new["images"][name]
        if bool(before["failed"]) != bool(after["failed"]):
            rows.append([name, "run", *("failed" if e["failed"] else "done" for e in (before, after)), ""])
        for key, figure in FIGURES.items():
            a, b = before["numbers"].get(key), after["numbers"].get(key)
            if a is not None and b is not None and a > 0 and b > 0:
                ratios.setdefault(key, []).append(b / a)
            if _moved(a, b, figure.unit):
                rows.append([name, figure.heading, figure.text(a), figure.text(b), _verdict(a, b, figure.more)])
    lines = _table(["image", "figure", "old", "new", ""], rows) if rows else ["nothing moved"]
    medians = {k: float(np.median(r)) for k, r in ratios.items() if FIGURES[k].more is not None}
    total = [[FIGURES[k].heading, f"{m:.3f}", _verdict(1.0, m, FIGURES[k].more)] for k, m in medians.items()]
    only = [f"only in old: {name}" for name in old["images"] if name not in both]
    only += [f"only in new: {name}" for name in new["images"] if name not in both]
    if total:
        lines += ["", f"Median ratio new / old over {len(both)} images:", "", *_table(["figure", "ratio", ""], total)]
    return "\n".join([*lines, *(["", *only] if only else [])])


def _moved(a: float | None, b: float | None, unit: str) -> bool:
    if a is None or b is None:
        return a is not b
    return abs(b - a) > _NOISE.get(unit, _STILL) * max(abs(a), abs(b))


def _verdict(a: float | None, b: float | None, more: bool | None) -> str:
    if a is None or b is None or more is None or a == b:
        return ""
    return "better" if (b > a) == more else "worse"
