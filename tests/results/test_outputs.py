"""The folder of one photograph: complete, reproducible, each file whole or not at all."""

from __future__ import annotations

import errno
from pathlib import Path

import cv2
import numpy as np
import pytest

from sftex_stages import open_result, results
from sftex_stages.errors import StoreError


def test_everything_is_written_twice_the_same(tmp_path: Path, arrays: dict, meta: dict) -> None:
    folder = tmp_path / "out" / "photo"
    (folder / ".tmp").mkdir(parents=True)
    (folder / ".tmp" / "left by a killed run").write_bytes(b"x")
    written = results.write_outputs(folder, arrays, meta)
    assert [p.name for p in written] == list(results.FILES)
    assert sorted(p.name for p in folder.iterdir()) == sorted(results.FILES)  # and nothing else
    first = {p.name: p.read_bytes() for p in written}
    results.write_outputs(folder, arrays, meta)
    assert {p.name: p.read_bytes() for p in written} == first
    assert open_result(folder / "result.h5").attributes["image_name"] == "Stoff — 1.png"
    for name in results.FILES:
        if name.endswith(".png"):
            picture = cv2.imread(str(folder / name))
            assert picture is not None and min(picture.shape[:2]) >= 80 and picture.std() > 3, name
    normal = cv2.imread(str(folder / "normals.png"))[45, 20]  # left of the left dome's top: leans left, BGR
    assert normal[2] < 128 and abs(int(normal[1]) - 128) < 3 and normal[0] > 200


def test_a_folder_that_cannot_be_written_is_named(tmp_path: Path, arrays: dict, meta: dict) -> None:
    (tmp_path / "out").write_text("a file, not a folder")
    with pytest.raises(StoreError, match=r"out.*cannot be written.*choose another folder"):
        results.write_outputs(tmp_path / "out" / "photo", arrays, meta)


def test_a_full_disk_leaves_old_files_whole(
    tmp_path: Path, arrays: dict, meta: dict, monkeypatch: pytest.MonkeyPatch
) -> None:
    results.write_outputs(tmp_path, arrays, meta)
    before = {p.name: p.read_bytes() for p in tmp_path.iterdir()}

    def full(fd: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    arrays["surface"]["height"] = arrays["surface"]["height"] * np.float32(2)
    with pytest.raises(StoreError, match=r"result\.h5: cannot be written \(No space left on device\)"):
        results.write_outputs(tmp_path, arrays, meta)
    assert {p.name: p.read_bytes() for p in tmp_path.iterdir()} == before
