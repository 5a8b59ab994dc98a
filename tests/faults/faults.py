"""What the fault tests share."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import toy_pipeline as toy

from sftex_stages.engine import upkeep, worker
from sftex_stages.engine.store import Store

HERE = Path(__file__).parent
ENGINE = HERE.parent / "engine"
LONG = os.environ.get("SFTEX_FAULTS") == "long"
HANG = 10.0 if LONG else 60.0  # seconds; the short set runs beside other work


def results(out):
    """{path: bytes} of everything that must be the same after a fault: artefacts and delivered files."""
    delivered = {str(p.relative_to(out)): p.read_bytes() for p in sorted(Path(out).glob("*/sum.txt"))}
    return toy.artefacts(out) | delivered


def check(folder, out, expected, **params):
    """Rerun after a fault: everything is as it would be without one, and the store is sound."""
    found, planner = toy.run(out, folder / "a.txt", folder / "b.txt", **params)
    assert not any(result.error for result in found.values()), found
    assert results(out) == expected
    worker._cache.clear()
    health = upkeep.verify(Store(Path(out) / ".store"), Path(out))
    assert not health.damaged and not health.changed, health
    return planner


def launch(folder, out, *names, seconds=0.0, preexec=None, **params):
    """A run in a process (group) of its own; prints {image: error}."""
    path = os.pathsep.join([str(ENGINE), str(HERE.parents[1])])
    job = json.dumps({"out": str(out), "files": names or ["a.txt", "b.txt"], "params": params, "seconds": seconds})
    return subprocess.Popen(
        [sys.executable, str(HERE / "fault_driver.py"), job], cwd=folder, env={**os.environ, "PYTHONPATH": path},
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True, preexec_fn=preexec,
    )  # fmt: skip


def said(process, seconds=300.0):
    """What a launched run printed, and its errors; one that hangs is ended with all its workers."""
    try:
        return process.communicate(timeout=seconds)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        raise


def wait_until(condition, seconds=60.0):
    """True as soon as the condition holds, False after a time."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if condition():
            return True
        time.sleep(0.002)
    return False
