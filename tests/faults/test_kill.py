"""Runs and jobs that are killed; runs at the same time on one store."""

import json
import os
import signal
import time

import pytest
import toy_pipeline as toy
from faults import LONG, check, launch, results, said, wait_until

STAGES = ["read", "split", "part", "total", "deliver"]
PARAMS = {"part": {"sleep": 0.01}, "split": {"parts": 6}}


@pytest.fixture
def clean(folder):
    """What an undisturbed run leaves."""
    found, _ = toy.run(folder / "clean", folder / "a.txt", folder / "b.txt", **PARAMS)
    assert not any(result.error for result in found.values())
    return results(folder / "clean")


@pytest.mark.parametrize("stage", STAGES)
def test_killed_at_random_moments(folder, log, clean, rng, measured, stage):
    """kill −9 of the run, or of it and all its workers, at random moments after a stage began."""
    times = 50 if LONG else 1
    for number in range(times):
        out = folder / f"out{number}"
        for path in log.iterdir():
            path.unlink()
        process = launch(folder, out, **PARAMS)
        assert wait_until(lambda: any(p.name.startswith(stage) for p in log.iterdir()))
        time.sleep(rng.uniform(0, 0.05))
        if number % 2:
            os.killpg(process.pid, signal.SIGKILL)
        else:
            process.kill()
        said(process)
        check(folder, out, clean, **PARAMS)
    measured(
        f"kill −9 in stage {STAGES.index(stage) + 1} of 5, then rerun", times, "equal to a clean run, byte for byte"
    )


@pytest.mark.parametrize("runs", [2, 8] if LONG else [2])
def test_runs_at_once_on_one_store(folder, clean, measured, runs):
    times = 5 if LONG else 1
    for number in range(times):
        out = folder / f"out{number}"
        processes = [launch(folder, out, **PARAMS) for _ in range(runs)]
        for process in processes:
            answer, errors = said(process)
            assert process.returncode == 0 and json.loads(answer) == {"a": "", "b": ""}, errors
        assert results(out) == clean
        check(folder, out, clean, **PARAMS)
        assert not list((out / ".store" / "tmp").iterdir())
        assert not (out / ".store" / "damaged").exists()
    measured(
        f"{runs} runs at once on one store", times, "all succeed; equal to a clean run; nothing damaged or left over"
    )


@pytest.mark.parametrize("survivors", [7] if LONG else [1])
def test_a_run_killed_among_others_holds_nobody_up(folder, log, clean, measured, survivors):
    times = 5 if LONG else 1
    for number in range(times):
        out = folder / f"out{number}"
        for path in log.iterdir():
            path.unlink()
        processes = [launch(folder, out, **PARAMS) for _ in range(survivors + 1)]
        assert wait_until(lambda: any(p.name.startswith("part") for p in log.iterdir()))
        os.killpg(processes[0].pid, signal.SIGKILL)
        said(processes[0])
        for process in processes[1:]:
            answer, errors = said(process)
            assert process.returncode == 0 and json.loads(answer) == {"a": "", "b": ""}, errors
        check(folder, out, clean, **PARAMS)
    measured(f"one of {survivors + 1} runs at once killed", times, "the others succeed; equal to a clean run")


@pytest.mark.parametrize("trouble", ["segv", "kill"] if LONG else ["kill"])  # segv: see the engine's tests
def test_a_job_that_takes_its_process_with_it(folder, measured, trouble):
    """SIGSEGV, and SIGKILL as for want of memory: that image is failed, with its part; all others are delivered."""
    images = [f"{number}.txt" for number in range(20 if LONG else 3)]
    for number, name in enumerate(images):
        (folder / name).write_text(f"{number} 7 7")
    process = launch(folder, folder / "out", *images, part={"trouble": trouble, "trouble_if": 1.0})
    answer, errors = said(process)
    failed = {name: error for name, error in json.loads(answer).items() if error}
    assert failed.keys() == {"1"}, errors
    signals = {"segv": "SIGSEGV", "kill": "SIGKILL"}
    assert "part (part 1): the process that computed it died" in failed["1"] and signals[trouble] in failed["1"]
    assert ("want of memory" in failed["1"]) == (trouble == "kill")
    assert len(list((folder / "out").glob("*/sum.txt"))) == len(images) - 1
    mended, _ = toy.run(folder / "out", *[folder / name for name in images])
    assert not any(result.error for result in mended.values())
    words = f"1 of {len(images)} images failed, with its job's name; the others delivered; mended by a rerun"
    measured(f"a job dies of {signals[trouble]}", 1, words)
