"""What a run or a status says in the end: a table for people, a JSON document for machines."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from . import pipeline
from .engine.execute import ItemResult, StageResult
from .engine.plan import Plan, Step
from .engine.store import Store

Row = dict[str, Any]


def run_rows(results: Sequence[ItemResult], out: Path, store: Store) -> list[Row]:
    """One JSON object per image of a run."""
    return [_run_row(result, out, store) for result in results]


def _run_row(result: ItemResult, out: Path, store: Store) -> Row:
    row: Row = {"image": result.item.name, "path": str(result.item.files["image"]), "status": "ok"}
    if result.error:
        row.update(status="failed", error=result.error, log=str(result.log) if result.log else None)
    row["stages"] = {name: _stage_entry(name, state, result) for name, state in result.stages.items()}
    if not result.error and result.plan:
        row.update(pipeline.figures(result.plan, store))
        folder = out / result.item.name
        receipt = result.plan.steps["outputs"].done[None]
        row.update(folder=str(folder), files=[str(folder / name) for name in receipt["files"]])
    return row


def _stage_entry(name: str, state: StageResult, result: ItemResult) -> Row:
    if result.error and (name == result.failed_stage or not state.jobs):
        word = "failed" if name == result.failed_stage else "not reached"
    else:
        word = "computed" if state.computed else "cached"
    return {
        "state": word,
        "jobs": state.jobs,
        "computed": state.computed,
        "seconds": round(state.seconds, 3),
        "peak_memory_mb": state.peak_memory_mb,
        "reasons": dict(state.reasons),
    }


def run_text(rows: Sequence[Row], missing: Sequence[str]) -> str:
    """The final table: per image the time of every stage or "cached"; why anything was computed; what failed."""
    stages = list(rows[0]["stages"])
    head = ["image", *stages, "instances", "textons", "files"]
    table = [[row["image"], *(_cell(row["stages"][s]) for s in stages), *_counts(row)] for row in rows]
    return "\n".join([*columns(head, table), *_why(rows, stages), *_where(rows, missing)])


def _cell(entry: Row) -> str:
    if entry["state"] != "computed":
        return "–" if entry["state"] == "not reached" else str(entry["state"])
    part = f" ({entry['computed']} of {entry['jobs']})" if entry["jobs"] > 1 else ""
    return f"{entry['seconds']:.1f} s{part}"


def _counts(row: Row) -> list[str]:
    if row["status"] != "ok":
        return ["–", "–", "–"]
    return [str(row["instances"]), f"{row['textons_used']} of {row['textons']}", str(len(row["files"]))]


def _why(rows: Sequence[Row], stages: Sequence[str]) -> list[str]:
    """Reasons, grouped over images; a plain "new" needs no explanation, nor do results that follow a stage."""
    lines: list[str] = []
    for stage in stages:
        images: Counter[str] = Counter()
        for row in rows:
            images.update(set(row["stages"][stage]["reasons"]))
        for reason, count in images.most_common():
            if reason != "new" and not (stage == stages[-1] and lines):
                lines.append(f"  {stage}: {reason}" + (f"  ({count} of {len(rows)} images)" if len(rows) > 1 else ""))
    return ["", "computed again because", *lines] if lines else []


def _where(rows: Sequence[Row], missing: Sequence[str]) -> list[str]:
    failed = [f"  {row['image']}: {row['error']}" for row in rows if row["status"] != "ok"]
    failed += [f"  {message}" for message in missing]
    total = len(rows) + len(missing)
    written = [f"  {row['folder']}" for row in rows if row["status"] == "ok"]
    lines = ["", "results in", *written] if written else []
    return lines + (["", f"failed: {len(failed)} of {total} images", *failed] if failed else [])


def status_rows(plans: Sequence[tuple[str, Plan | None, str]]) -> list[Row]:
    """One JSON object per (image, plan, error)."""
    rows = []
    for name, plan, error in plans:
        row: Row = {"image": name}
        if plan is None:
            row["error"] = error
        else:
            row["stages"] = {step.stage: _status_entry(step) for step in plan.steps.values()}
        rows.append(row)
    return rows


def _status_entry(step: Step) -> Row:
    if step.waits_for:
        return {"state": "waiting", "waits_for": step.waits_for}
    reasons = Counter(reason for _, reason in step.todo)
    return {"state": "stale" if step.todo else "cached", "jobs": len(step.keys), "to_run": len(step.todo),
            "reasons": dict(reasons)}  # fmt: skip


def status_text(rows: Sequence[Row]) -> str:
    """A table of what is cached, what would run and why."""
    stages = list(next((row["stages"] for row in rows if "stages" in row), {}))
    table, lines = [], []
    for row in rows:
        if "error" in row:
            lines.append(f"  {row['image']}: {row['error']}")
            continue
        table.append([row["image"], *(_status_cell(row["stages"][s]) for s in stages)])
        for stage in stages:
            for reason in row["stages"][stage].get("reasons", ()):
                lines.append(f"  {row['image']} {stage}: {reason}")
    return "\n".join([*columns(["image", *stages], table), *(["", *lines] if lines else [])])


def _status_cell(entry: Row) -> str:
    if entry["state"] == "waiting":
        return f"after {entry['waits_for']}"
    if entry["state"] == "stale":
        return f"{entry['to_run']} of {entry['jobs']} to run"
    return "cached" if entry["jobs"] <= 1 else f"cached ({entry['jobs']})"


def columns(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Lines of an aligned table, first column left, the others right."""
    widths = [max(len(line[i]) for line in [head, *rows]) for i in range(len(head))]
    return [
        "  ".join([line[0].ljust(widths[0]), *(cell.rjust(w) for cell, w in zip(line[1:], widths[1:], strict=True))])
        for line in [head, *rows]
    ]
