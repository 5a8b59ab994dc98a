"""The real pipeline on a real file: the same bytes with one and two jobs, in different folders; little time lost."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from faults import LONG

EXAMPLES = Path(__file__).parents[2] / "data" / "examples"
pytestmark = pytest.mark.skipif(not LONG, reason="long set: make faults")


def reconstruct(folder, out, jobs):
    """The JSON of a run of the whole pipeline."""
    command = [sys.executable, "-m", "sftex_stages.cli", "run", "in", "--out", out, "--jobs", str(jobs), "--json"]
    env = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])}
    done = subprocess.run(command, cwd=folder, env=env, capture_output=True, text=True, timeout=3000)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def content(out):
    """{path: bytes} of all artefacts and results."""
    found = [*out.glob(".store/*/??/*.h5"), *(p for p in out.glob("*/*") if p.parts[-2] != ".store" and p.is_file())]
    return {str(path.relative_to(out)): path.read_bytes() for path in found}


def test_same_bytes_and_little_overhead(tmp_path, measured):
    picture = min(EXAMPLES.glob("*.png"), key=lambda path: path.stat().st_size)
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
