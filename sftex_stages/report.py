"""What a run or a status says in the end: a table for people, a JSON document for machines."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from . import pipeline
from .engine.execute import ItemResult, StageResult
from .engine.plan import Plan, Step
from .engine.store import Store, read_receipt

Row = dict[str, Any]


def run_rows(results: Sequence[ItemResult], out: Path, store: Store) -> list[Row]:
    """One JSON object per image of a run."""
    return [_run_row(result, out, store) for result in results]


def _run_row(result: ItemResult, out: Path, store: Store) -> Row:
    row: Row = {"image": result.item.name, "path": str(result.item.files["image"]), "status": "ok"}
    if result.error:
        row.update(status="failed", error=result.error, log=str(result.log) if result.log else None)
    elif not result.complete:
        row.update(status="stopped", error="not finished: the run was stopped by another image's failure")
    row["stages"] = {name: _stage_entry(name, state, result) for name, state in result.stages.items()}
    if result.complete and result.plan and "outputs" in result.stages:
        row.update(pipeline.figures(result.plan, store))
        folder = out / result.item.name
        receipt = result.plan.steps["outputs"].done[None]
        row.update(folder=str(folder), files=[str(folder / name) for name in receipt["files"]])
    return row


def _stage_entry(name: str, state: StageResult, result: ItemResult) -> Row:
    if result.error and (name == result.failed_stage or not state.jobs):
        word = "failed" if name == result.failed_stage else "not reached"
    elif state.jobs and result.plan and not result.plan.steps[name].complete:
        word = "stopped"
    else:
        word = "computed" if state.computed else "cached" if state.jobs else "not reached"
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
    if "files" not in row:
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
            if reason != "new" and not (stage == "outputs" and lines):
                lines.append(f"  {stage}: {reason}" + (f"  ({count} of {len(rows)} images)" if len(rows) > 1 else ""))
    return ["", "computed again because", *lines] if lines else []


def _where(rows: Sequence[Row], missing: Sequence[str]) -> list[str]:
    failed = [f"  {row['image']}: {row['error']}" for row in rows if row["status"] != "ok"]
    failed += [f"  {message}" for message in missing]
    total = len(rows) + len(missing)
    written = [f"  {row['folder']}" for row in rows if "folder" in row]
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
        return {"state": "waiting", "waits_for": step.waits_for, "expected_jobs": step.expected, "reasons": step.ahead}
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
            lines += [f"  {row['image']} {stage}: {reason}" for reason in row["stages"][stage]["reasons"]]
    return "\n".join([*columns(["image", *stages], table), *(["", *lines] if lines else [])])


def _status_cell(entry: Row) -> str:
    if entry["state"] == "waiting":
        return f"after {entry['waits_for']}"
    if entry["state"] == "stale":
        return f"{entry['to_run']} of {entry['jobs']} to run"
    return "cached" if entry["jobs"] <= 1 else f"cached ({entry['jobs']})"


def plan_summary(rows: Sequence[Row]) -> dict[str, Row]:
    """Per stage: jobs cached and to run now, images that wait, jobs that those had last time, reasons with images."""
    summary: dict[str, Row] = {}
    for row in rows:
        for stage, entry in row.get("stages", {}).items():
            total = summary.setdefault(
                stage, {"cached": 0, "to_run": 0, "images": 0, "waiting": 0, "expected": 0, "reasons": Counter()}
            )
            waiting = entry["state"] == "waiting"
            total["waiting"] += waiting
            total["expected"] += (entry["expected_jobs"] or 0) if waiting else 0
            total["to_run"] += 0 if waiting else entry["to_run"]
            total["cached"] += 0 if waiting else entry["jobs"] - entry["to_run"]
            total["images"] += entry["state"] == "stale"
            total["reasons"].update(set(entry["reasons"]))
    return summary


def plan_text(rows: Sequence[Row]) -> str:
    """What a run would do now, by stage, and what it may have to do then."""
    summary = plan_summary(rows)
    table, why = [], []
    for stage, total in summary.items():
        then = _many(total["waiting"], "image") if total["waiting"] else "–"
        if total["expected"]:
            then += f" ({_many(total['expected'], 'job')} last time)"
        table.append([stage, str(total["cached"]), f"{total['to_run']} ({_many(total['images'], 'image')})", then])
        why += [f"  {stage}: {reason}  ({_many(count, 'image')})" for reason, count in total["reasons"].most_common()]
    lines = columns(["stage", "cached jobs", "to run now", "decided by what runs before"], table)
    failed = [f"  {row['image']}: {row['error']}" for row in rows if "error" in row]
    jobs = sum(total["to_run"] for total in summary.values())
    verdict = f"{_many(jobs, 'job')} to run now" if jobs else "nothing to run"
    return "\n".join([*lines, *(["", "because", *why] if why else []), *(["", *failed] if failed else []), "", verdict])


def explain_rows(plan: Plan, store: Store, only: str | None) -> list[Row]:
    """One JSON object per stage: its state, why, what its key is made of and, if it is cached, where it came from."""
    rows = []
    for step in plan.steps.values():
        if only in (None, step.stage):
            row: Row = {"stage": step.stage, **_status_entry(step), "identity": step.identity, "keys": step.keys}
            if step.complete and step.keys:
                row["origin"] = _origin(step, store)
            rows.append(row)
    return rows


def _origin(step: Step, store: Store) -> Row | None:
    """Where and when the first job of a cached stage was computed."""
    try:
        receipt, _ = read_receipt(store.path(step.stage, step.keys[0], ".json"))
    except (OSError, ValueError):
        return None
    return {name: receipt[name] for name in ("finished", "host", "seconds", "software")}


def explain_text(rows: Sequence[Row]) -> str:
    """The same for people."""
    lines: list[str] = []
    for row in rows:
        reasons = [f"  {reason}" for reason in row["reasons"]]
        if row["state"] == "waiting":
            times = f", {_many(row['expected_jobs'], 'job')} last time" if row["expected_jobs"] else ""
            sure = "will run in any case" if reasons else "runs if the outcome of that changes"
            lines += [f"{row['stage']}: waits for {row['waits_for']}{times}; {sure}", *reasons]
        elif row["state"] == "stale":
            many = [f"  {reason}" + (f"  ({n} jobs)" if n > 1 else "") for reason, n in row["reasons"].items()]
            lines += [f"{row['stage']}: {row['to_run']} of {row['jobs']} jobs to run, because", *many]
        else:
            origin = row["origin"]
            where = f", computed {origin['finished'][:16].replace('T', ' ')} UTC on {origin['host']}" if origin else ""
            lines.append(f"{row['stage']}: cached ({_many(row['jobs'], 'job')}){where}")
        if len(rows) == 1 and row["identity"]:
            lines += _identity(row["identity"])
    return "\n".join(lines)


def _identity(identity: Row) -> list[str]:
    """What a stage's key is made of."""
    lines = [f"  its key is made of: version {identity['version']}"]
    values = {name: v for name, v in identity["params"].items() if len(str(v)) < 100}
    lines += [f"    {name} = {value}" for name, value in values.items()]
    for name, content in {**identity["files"], **identity["inputs"]}.items():
        hashes = content if isinstance(content, list) else [content]
        text = "(none)" if content is None else " ".join(h[:12] for h in hashes[:3]) + " …" * (len(hashes) > 3)
        lines.append(f"    {name}: {text}")
    return lines


def _many(count: int, what: str) -> str:
    return f"{count} {what}{'s' * (count != 1)}"


def columns(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Lines of an aligned table, first column left, the others right."""
    widths = [max(len(line[i]) for line in [head, *rows]) for i in range(len(head))]
    return [
        "  ".join([line[0].ljust(widths[0]), *(cell.rjust(w) for cell, w in zip(line[1:], widths[1:], strict=True))])
        for line in [head, *rows]
    ]
