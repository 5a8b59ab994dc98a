"""The real pipeline on a real file: killed in every stage; the same bytes with one and two jobs; little time lost."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
import pytest
from faults import LONG, said

from sftex_stages import pipeline

EXAMPLES = Path(__file__).parents[2] / "data" / "examples"
COMMAND = [sys.executable, "-m", "sftex_stages.cli", "run", "in", "--json"]
ENV = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])}
pytestmark = pytest.mark.skipif(not LONG, reason="long set: make faults")


def start(folder, out, jobs):
    """A run of the whole pipeline in a process group of its own."""
    command = [*COMMAND, "--out", out, "--jobs", str(jobs)]
    return subprocess.Popen(
        command, cwd=folder, env=ENV, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    )


def reconstruct(folder, out, jobs):
    """The JSON of such a run."""
    process = start(folder, out, jobs)
    answer, errors = said(process, 3000)
    assert process.returncode == 0, errors
    return json.loads(answer)


def content(out):
    """{path: bytes} of all artefacts and results."""
    found = [*out.glob(".store/*/??/*.h5"), *(p for p in out.glob("*/*") if p.parts[-2] != ".store" and p.is_file())]
    return {str(path.relative_to(out)): path.read_bytes() for path in found}


@pytest.fixture(scope="module")
def picture():
    """The example with the smallest file."""
    return min(EXAMPLES.glob("*.png"), key=lambda path: path.stat().st_size)


def test_same_bytes_and_little_overhead(tmp_path, picture, measured):
    for name in ("one", "two"):
        (tmp_path / name / "in").mkdir(parents=True)
        shutil.copy(picture, tmp_path / name / "in")
    first = reconstruct(tmp_path / "one", "out", 1)
    reconstruct(tmp_path / "two", "somewhere/else", 2)
    one, two = content(tmp_path / "one" / "out"), content(tmp_path / "two" / "somewhere" / "else")
    assert len(one) > 20 and one.keys() == two.keys()
    different = [name for name in one if one[name] != two[name]]
    assert not different
    measured(f"{picture.name} with 1 and 2 jobs, in different folders", 1, f"{len(one)} files, all byte-identical")
    work = sum(stage["seconds"] for stage in first["images"][0]["stages"].values())
    lost = first["seconds"] - work
    again = reconstruct(tmp_path / "one", "out", 1)["seconds"]
    measured(
        "its cold run with 1 job", 1,
        f"{first['seconds']:.1f} s, of which {lost:.1f} s ({100 * lost / first['seconds']:.1f} %) are not in stages; "
        f"cached: {again:.2f} s",
    )  # fmt: skip


def test_killed_in_every_stage(tmp_path, picture, rng, measured):
    """A quarter of the example; every stage is made to run again, and killed thrice before it may end."""
    pixels = cv2.imread(str(picture))
    (tmp_path / "in").mkdir()
    height, width = pixels.shape[:2]
    assert cv2.imwrite(str(tmp_path / "in" / "a.png"), pixels[height // 4 : -height // 4, width // 4 : -width // 4])
    stages = reconstruct(tmp_path, "out", 2)["images"][0]["stages"]
    expected = content(tmp_path / "out")
    assert set(stages) == {*(stage.name for stage in pipeline.PIPELINE), "outputs"}
    killed = 0
    for stage, entry in stages.items():
        shutil.rmtree(tmp_path / "out" / ".store" / stage)
        started = time.monotonic()
        subprocess.run(
            [*COMMAND[:3], "plan", "in"], cwd=tmp_path, env=ENV, capture_output=True, check=True, timeout=300
        )
        starting = time.monotonic() - started  # on a machine as busy as it is now
        for number in range(3):
            process = start(tmp_path, "out", 2)
            try:
                process.wait(starting + rng.uniform(0, 1 + entry["seconds"] / min(2, entry["jobs"])))
            except subprocess.TimeoutExpired:
                killed += 1
                os.killpg(process.pid, signal.SIGKILL) if number % 2 else process.kill()
            said(process, 60)
        reconstruct(tmp_path, "out", 2)
        assert content(tmp_path / "out") == expected, stage
    assert killed > len(stages)
    measured("kill −9 in every stage of the real pipeline", killed, "equal to a clean run")
