"""Faults, and one invariant: after any of them a rerun equals a clean run byte for byte, or says loudly why not.

A short set runs with all tests; SFTEX_FAULTS=long (``make faults``) runs the whole of it and prints what was measured.
"""

import os
import random
import sys
from pathlib import Path

import pytest
from joblib.externals.loky import get_reusable_executor

from sftex_stages.engine import execute, worker

sys.path.insert(0, str(Path(__file__).parents[1] / "engine"))  # the toy pipeline
LONG = os.environ.get("SFTEX_FAULTS") == "long"
_MEASURED: list[str] = []


def pytest_terminal_summary(terminalreporter):
    if LONG and _MEASURED:
        terminalreporter.write_line("")
        terminalreporter.write_line("| fault | times | outcome |\n|---|---|---|")
        for line in _MEASURED:
            terminalreporter.write_line(line)


@pytest.fixture
def measured():
    """Note a line of the table: measured(fault, times, outcome)."""
    return lambda fault, times, outcome: _MEASURED.append(f"| {fault} | {times} | {outcome} |")


@pytest.fixture
def rng():
    return random.Random(7)


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    """Where the toy stages tell that they began."""
    path = tmp_path_factory.mktemp("log")
    get_reusable_executor().shutdown(wait=True)  # workers of other tests do not know the variable
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TOY_LOG", str(path))
        yield path
    get_reusable_executor().shutdown(wait=True)


@pytest.fixture
def folder(tmp_path, log):
    """Two inputs, nothing computed."""
    (tmp_path / "a.txt").write_text("1 2 3")
    (tmp_path / "b.txt").write_text("4 5")
    for path in log.iterdir():
        path.unlink()
    return tmp_path


@pytest.fixture
def serial(monkeypatch):
    """Jobs in this process, one after another: faults can be planted, and counted, from here."""
    monkeypatch.setattr(execute, "_parallel", lambda tasks, workers: (worker.perform(task) for task in tasks))
    monkeypatch.setattr(worker, "_crash_log", lambda root: None)
    worker._cache.clear()
