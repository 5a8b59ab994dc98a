"""Jobs that fail, crash or are killed: only their own image suffers, and a rerun goes on from there."""

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
import toy_pipeline as toy

from sftex_stages.engine.store import Store
from sftex_stages.errors import StoreError

OK = ["deliver", "part0", "part1", "part2", "read", "split", "total"]


def clean(folder, **params):
    """Artefacts of an undisturbed run."""
    toy.run(folder / "clean", folder / "a.txt", folder / "b.txt", **params)
    toy.executed()
    return toy.artefacts(folder / "clean")


def test_a_users_error_fails_its_image_alone_and_has_no_traceback(folder):
    (folder / "a.txt").write_text("")
    results, _ = toy.run(folder / "out", folder / "a.txt", folder / "b.txt")
    assert results["a"].error == f"read: {folder / 'a.txt'}: has no numbers; put some in"
    assert results["a"].failed_stage == "read" and results["a"].log is None
    assert not results["b"].error and (folder / "out" / "b" / "sum.txt").exists()
    assert toy.executed() == sorted([*OK, "read"])


def test_missing_file_fails_its_image_alone(folder):
    results, _ = toy.run(folder / "out", folder / "none.txt", folder / "b.txt")
    assert "none.txt: cannot be read" in results["none"].error
    assert not results["b"].error


def test_a_defect_leaves_its_traceback_in_a_log_until_it_is_mended(folder):
    trouble = {"trouble": "defect", "trouble_if": 1.0}
    results, _ = toy.run(folder / "out", folder / "a.txt", folder / "b.txt", part=trouble)
    assert not results["b"].error
    log = results["a"].log
    assert "part (part 1): unexpected IndexError" in results["a"].error and str(log) in results["a"].error
    assert "Traceback" in log.read_text() and "toy_pipeline.py" in log.read_text()
    toy.executed()
    log.rename(log.with_name("kept"))  # an unchanged rerun tries again
    results, _ = toy.run(folder / "out", folder / "a.txt", folder / "b.txt", part=trouble)
    assert "part1" in toy.executed() and results["a"].error


def test_a_stage_cannot_change_the_inputs_of_others(folder):
    results, _ = toy.run(folder / "out", folder / "a.txt", part={"trouble": "mutate"})
    assert "read-only" in results["a"].error


@pytest.mark.parametrize(("trouble", "word", "workers"), [("exit", "EXIT(3)", 2), ("segv", "SIGSEGV", 1)])
def test_a_crashing_job_fails_its_image_alone(folder, trouble, word, workers):
    params = {"part": {"trouble": trouble, "trouble_if": 1.0}}
    results, _ = toy.run(folder / "out", folder / "a.txt", folder / "b.txt", workers=workers, **params)
    assert "part (part 1): the process that computed it died" in results["a"].error and word in results["a"].error
    assert not results["b"].error and (folder / "out" / "b" / "sum.txt").exists()
    if trouble == "segv":
        assert "toy_pipeline.py" in results["a"].log.read_text()
    mended, _ = toy.run(folder / "out", folder / "a.txt", folder / "b.txt")
    assert not mended["a"].error


def test_killed_run_goes_on_where_it_was(folder, log):
    """kill −9 of the main process at several moments; in the end the store equals that of an undisturbed run."""
    expected = clean(folder, part={"sleep": 0.05}, split={"parts": 12})
    command = [sys.executable, str(Path(toy.__file__)), str(folder / "out"), "0.05", "a.txt", "b.txt"]
    path = os.pathsep.join([str(Path(toy.__file__).parent), str(Path(toy.__file__).parents[2])])
    for jobs in (1, 8):  # started jobs after which the run is killed
        process = subprocess.Popen(command, cwd=folder, env={**os.environ, "PYTHONPATH": path})
        deadline = time.monotonic() + 30
        while len(list(log.iterdir())) < jobs and time.monotonic() < deadline:
            assert process.poll() is None
            time.sleep(0.005)
        process.kill()
        process.wait(timeout=60)
        toy.executed()
    for _ in range(15):  # the workers do not outlive the run
        time.sleep(2)
        if not toy.executed():
            break
    else:
        pytest.fail("workers of a killed run go on")
    published = len(list((folder / "out" / ".store").glob("*/??/*.json")))
    assert 0 < published < 32
    toy.run(folder / "out", folder / "a.txt", folder / "b.txt", part={"sleep": 0.05}, split={"parts": 12})
    assert len(toy.executed()) == 32 - published
    assert toy.artefacts(folder / "out") == expected


def test_unwritable_store_is_an_error_that_names_it(tmp_path):
    (tmp_path / "file").write_text("not a folder")
    with pytest.raises(StoreError, match=r"file/out: cannot be written .* --out"):
        Store(tmp_path / "file" / "out" / ".store").prepare()


def test_full_disk_is_an_error_of_the_image(folder, monkeypatch):
    """The write of an artefact fails: the message names the file, nothing half-written stays."""
    store = Store(folder / "out" / ".store")
    store.prepare()
    monkeypatch.setattr(os, "fsync", lambda fd: (_ for _ in ()).throw(OSError(28, "No space left on device")))
    with pytest.raises(StoreError, match="No space left on device"):
        store.publish("read", "ab" * 32, b"x", {"label": "a"})
    assert not list((folder / "out").rglob("*.h5")) and not list((folder / "out" / ".store" / "tmp").iterdir())
