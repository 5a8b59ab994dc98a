"""The benchmark around a run: what it finds, reads, asks for and prints. The run itself is a fake command."""

import json
import sys
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
import pytest

from sftex_stages.bench import run
from sftex_stages.bench.__main__ import main
from sftex_stages.bench.figures import FIGURES, Numbers, Target, headline, targets
from sftex_stages.bench.report import compare, markdown, wanted


def numbers(**known: float | None) -> Numbers:
    return dict.fromkeys(FIGURES) | known


def bench_of(**images: Numbers) -> dict[str, Any]:
    entries = {name: {"failed": None, "stages": {}, "numbers": n, "figures": None} for name, n in images.items()}
    return {"sftex": "0", "date": "today", "machine": "here", "jobs": None, "images": entries}


def picture(path: Path, value: int) -> Path:
    cv2.imwrite(str(path), np.full((4, 5, 3), value, np.uint8))
    return path


def test_find_cases_pairs_truths_and_leaves_out_copies(tmp_path: Path) -> None:
    first, second = tmp_path / "a", tmp_path / "b"
    first.mkdir()
    second.mkdir()
    picture(first / "ball.png", 10)
    picture(first / "ball_noise.png", 20)
    picture(first / "ball_noise_q70.jpg", 30)
    (first / "ball.truth.h5").write_bytes(b"")
    picture(second / "ball.png", 10)  # the same bytes
    picture(second / "unknown.png", 40)
    cases = run.find_cases([first, second, tmp_path / "not there"], [])
    assert [c.name for c in cases] == ["ball", "unknown", "ball_noise", "ball_noise_q70"]
    assert [c.truth and c.truth.name for c in cases] == ["ball.truth.h5", None, "ball.truth.h5", "ball.truth.h5"]
    assert [c.name for c in run.find_cases([first, second], ["unk*", "*_q70"])] == ["unknown", "ball_noise_q70"]


@pytest.mark.parametrize(
    ("value", "goal", "floor", "more", "state"),
    [(1.0, 1.2, 3.0, False, "pass"), (2.0, 1.2, 3.0, False, "floor"), (4.0, 1.2, 3.0, False, "miss"),
     (2.0, None, 3.0, False, "pass"), (0.9, 0.85, None, True, "pass"), (0.8, 0.85, None, True, "miss"),
     (None, 1.0, None, True, "none")],
)  # fmt: skip
def test_target_states(value: float | None, goal: float | None, floor: float | None, more: bool, state: str) -> None:
    assert Target("recall", more, goal, floor, value).state == state


def test_goal_and_floor_of_one_figure_are_one_target() -> None:
    asked = {t.figure: t for t in targets("cloth1", numbers(instance_median=10.0), None)}
    assert (asked["instance_median"].goal, asked["instance_median"].floor) == (7, 15)
    assert asked["instance_median"].state == "floor" and asked["accepted"].goal == 2000 and asked["accepted"].more
    assert targets("holiday", numbers(), None) == []


def test_degraded_copies_are_measured_by_the_clean_image() -> None:
    bench = bench_of(
        sphere_dots_sun=numbers(instance_median=1.0, recall=0.9),
        sphere_dots_sun_noise=numbers(instance_median=1.4, recall=0.7),
    )
    asked = wanted(bench, "sphere_dots_sun_noise")
    assert [(t.figure, t.goal, t.state) for t in asked] == [
        ("instance_median", 1.5, "pass"), ("recall", pytest.approx(0.72), "miss"),
    ]  # fmt: skip


def test_headline_takes_the_better_sign_of_orthographic_truths_only() -> None:
    def spread(median: float) -> dict[str, float]:
        return {k: median for k in ("median", "mean", "p90", "under_5", "under_11.25", "under_22.5", "under_30")}

    figures: dict[str, Any] = {
        "frame": {"truth": "orthographic"},
        "normals": {"given": spread(30.0), "flipped": spread(2.0),
                    "given_all": spread(31.0), "flipped_all": spread(3.0), "best": "flipped",
                    "signs_right": 0.1, "signs_right_flipped": 0.9},
        "irradiance": {"error": 0.01, "correlation": 0.98, "blurred": {"error": 0.04}},
    }  # fmt: skip
    free = headline(figures, {"seconds": 7.0, "stages": {}})
    assert (free["dense_median"], free["dense_median_given"], free["signs"]) == (2.0, 30.0, 0.9)
    assert free["dense_all_11"] == 3.0 and free["seconds"] == 7.0 and free["light_gain"] == pytest.approx(4.0)
    assert free["recall"] is None and set(free) == set(FIGURES)
    figures["frame"]["truth"] = "perspective"
    fixed = headline(figures, {})
    assert (fixed["dense_median"], fixed["dense_median_better"], fixed["signs"]) == (30.0, 2.0, 0.1)


def stored(store: Path, stage: str, key: str, finished: str, seconds: float, memory: float) -> None:
    folder = store / stage / key[:2]
    folder.mkdir(parents=True, exist_ok=True)
    receipt = {"finished": finished, "seconds": seconds, "peak_memory_mb": memory}
    (folder / f"{key}.json").write_text(json.dumps(receipt))


def test_costs_come_from_the_receipts_of_the_result(tmp_path: Path) -> None:
    keys = {"detect": "d1", "frontal": ["f1", "f2"], "irradiance": "i1"}
    with h5py.File(tmp_path / "result.h5", "w") as f:
        f.attrs["keys"] = json.dumps(keys)
        f["textons/usable"] = np.array([True, False])
    store = tmp_path / ".store"
    stored(store, "detect", "d1", "2026-01-01T10:00:01.000000Z", 1.0, 100.0)
    stored(store, "frontal", "f1", "2026-01-01T10:00:04.000000Z", 3.0, 150.0)
    stored(store, "frontal", "f2", "2026-01-01T10:00:04.500000Z", 2.5, 250.0)
    stored(store, "irradiance", "i1", "2026-01-01T10:00:05.000000Z", 0.5, 90.0)
    stored(store, "frontal", "f9", "2026-01-01T11:00:00.000000Z", 99.0, 999.0)  # of another configuration
    with h5py.File(store / "detect/d1/d1.h5", "w") as f:
        f["xy"] = np.zeros((1100, 2))
    got = run.costs(tmp_path / "result.h5", store)
    assert got["stages"]["frontal"] == {"jobs": 2, "seconds": 5.5, "wall": pytest.approx(3.5), "peak_memory_mb": 250.0}
    assert got["frontal_ms"] == pytest.approx(5.0) and got["frontal_memory"] == got["peak_memory"] == 250.0
    assert (got["keypoints"], got["textons"], got["usable_textons"]) == (1100, 2, 1)


def fake_sftex(monkeypatch: pytest.MonkeyPatch, code: str) -> None:
    monkeypatch.setattr(run, "_SFTEX", [sys.executable, "-c", code])


def test_a_failing_image_is_reported_and_the_next_one_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    row = '{"images": [{"error": "detect: no keypoints"}]}'
    fake_sftex(monkeypatch, f"import sys; print('''{row}'''); print('noise', file=sys.stderr); sys.exit(4)")
    for name in ("one", "two"):
        picture(tmp_path / f"{name}.png", len(name) + ord(name[0]) % 7)
    assert main([str(tmp_path), "--out", str(tmp_path / "report")]) == 0
    bench = json.loads((tmp_path / "report/bench.json").read_text())
    assert [e["failed"] for e in bench["images"].values()] == ["exit code 4: detect: no keypoints"] * 2
    assert "**two**: exit code 4: detect: no keypoints" in (tmp_path / "report/bench.md").read_text()
    assert "[2/2]" in capsys.readouterr().err


def test_a_run_that_crashes_or_hangs_is_a_failure(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    case = run.Case("one", picture(tmp_path / "one.png", 1), None)
    fake_sftex(monkeypatch, "import sys; print('last words', file=sys.stderr); sys.exit(1)")
    assert run.measure(case, tmp_path / "w", None, None, 60)["failed"] == "exit code 1: last words"
    fake_sftex(monkeypatch, "import time; time.sleep(60)")
    assert run.measure(case, tmp_path / "w", None, None, 0.3)["failed"] == "not done after 0.3 s"


def test_nothing_to_do_is_a_usage_error(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(tmp_path), "--scenes", "x*"]) == 2
    assert "no image matches x*" in capsys.readouterr().err


def test_markdown_marks_targets_and_lists_what_was_missed() -> None:
    bench = bench_of(cloth1=numbers(instance_median=10.0, instance_p90=19.0, accepted=1000.0, seconds=50.0))
    text = markdown(bench)
    lines = [line for line in text.splitlines() if line.startswith("| cloth1")]
    assert "10.00 ~" in lines[0] and "19.00 ✓" in lines[0] and "1000 ✗" in lines[0]
    missed = text.partition("## Targets missed")[2]
    assert " accepted |" in missed and "≥ 2000" in missed and "instances, p90" not in missed
    unmeasured = [line for line in missed.splitlines() if "coverage" in line]
    assert len(unmeasured) == 1 and unmeasured[0].rstrip(" |").endswith("none")


def test_compare_says_what_moved_and_which_way() -> None:
    old = bench_of(a=numbers(dense_median=4.0, recall=0.5, seconds=10.0), gone=numbers())
    new = bench_of(a=numbers(dense_median=2.0, recall=0.4, seconds=11.0), b=numbers())
    text = compare(old, new)
    rows = {line.split("|")[2].strip(): line for line in text.splitlines() if line.startswith("| a ")}
    assert "better" in rows["surface, median °"] and "worse" in rows["recall %"]
    assert "cold run s" not in rows  # 10 % of a wall time means nothing
    assert "only in old: gone" in text and "only in new: b" in text
    assert compare(old, old).startswith("nothing moved")
    new["images"]["a"]["failed"] = "exit code 1"
    assert "| failed |" in compare(old, new).replace("  ", " ")


def test_compare_refuses_other_files(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "x.json").write_text("[]")
    assert main(["--compare", str(tmp_path / "x.json"), str(tmp_path / "x.json")]) == 2
    assert "x.json" in capsys.readouterr().err
