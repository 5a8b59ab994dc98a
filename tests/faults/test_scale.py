"""A thousand images that are all cached: what planning, running and verifying them costs."""

import hashlib
import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from faults import LONG

from sftex_stages import config, images, pipeline
from sftex_stages.engine import keys
from sftex_stages.engine.hdf5 import encode
from sftex_stages.engine.worker import describe

ROOT = Path(__file__).parents[2]
PARTS = 100  # clusters of an image of a megapixel
FILES = 14  # that are delivered for an image


def finish(planner, item, out, stand_in):
    """Publish stand-ins for all that the real pipeline would compute for an item: only their number and place count."""
    while (plan := planner.plan(item)).todo:
        for job, _ in plan.todo:
            receipt = {
                "label": job.item,
                "key": job.key,
                "identity": job.identity,
                "seconds": 1.0,
                "finished": "",
                "host": "",
            }
            receipt |= {"peak_memory_mb": 1.0, "software": {"python": "3", "numpy": "2", "h5py": "3"}}
            if job.stage == "outputs":
                for number in range(FILES):
                    path = out / job.item / f"{number}.png"
                    path.parent.mkdir(parents=True, exist_ok=True)
                    path.write_bytes(hashlib.sha256(f"{job.key} {number}".encode()).digest())
                files = {p.name: keys.file_sha256(p) for p in (out / job.item).iterdir()}
                planner.store.publish(job.stage, job.key, None, {**receipt, "files": files})
            else:
                planner.store.publish(job.stage, job.key, stand_in[0] + job.key.encode(), {**receipt, **stand_in[1]})
            planner.store.accept(job.stage, job.key)


@pytest.mark.skipif(not LONG, reason="long set: make faults")
def test_a_thousand_cached_images(tmp_path, monkeypatch, measured):
    (tmp_path / "in").mkdir()
    for number in range(1000):
        (tmp_path / "in" / f"{number}.png").write_bytes(b"\x89PNG\r\n\x1a\n" + os.urandom(1000))
    arrays = {"count": np.array(PARTS), "usable": np.array(True)}
    arrays["instance/xy"] = np.zeros((9, 2))
    stand_in = encode(arrays), describe(arrays)
    out = tmp_path / "out"
    planner = pipeline.planner(out, config.load(None, pipeline.PIPELINE))
    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", lambda fd: None)
        for item in pipeline.items(images.discover(tmp_path / "in")):
            finish(planner, item, out, stand_in)
    env = {**os.environ, "PYTHONPATH": str(ROOT)}
    try:
        for command, words in {"plan": "planning", "run": "a run", "verify": "verifying"}.items():
            what = [] if command == "verify" else ["in"]
            arguments = [sys.executable, "-m", "sftex_stages.cli", command, *what, "--out", "out", "--json"]
            before = os.times()
            started = time.perf_counter()
            done = subprocess.run(arguments, cwd=tmp_path, env=env, capture_output=True, text=True, timeout=600)
            seconds, after = time.perf_counter() - started, os.times()
            processor = after.children_user + after.children_system - before.children_user - before.children_system
            assert done.returncode == 0, done.stderr[-2000:]
            document = json.loads(done.stdout)
            if command == "plan":
                assert not any(stage["to_run"] or stage["waiting"] for stage in document["stages"].values())
            if command == "run":
                assert not any(s["computed"] for image in document["images"] for s in image["stages"].values())
            if command == "verify":
                assert document["checked"] == 1000 * (PARTS + len(pipeline.PIPELINE))
                words += f", {document['bytes'] / 1e6:.0f} MB in {document['checked']} jobs"
            measured(
                f"1000 cached images, {PARTS} clusters each: {words}",
                1,
                f"{seconds:.1f} s ({processor:.1f} s of processor)",
            )
    finally:
        shutil.rmtree(tmp_path)  # 200 000 files
