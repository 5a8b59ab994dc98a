"""Whatever happens to the files of the store: found, set aside, computed again with the same bytes."""

import os
import random
import time

import pytest
import toy_pipeline as toy

from sftex_stages.engine.store import Store


@pytest.fixture(scope="module")
def pristine(tmp_path_factory, log):
    """A finished run: its store's files."""
    folder = tmp_path_factory.mktemp("pristine")
    (folder / "a.txt").write_text("1 2 3")
    toy.run(folder / "out", folder / "a.txt")
    root = folder / "out" / ".store"
    return {path.relative_to(root): path.read_bytes() for path in root.glob("*/??/*")}


def restore(folder, files):
    root = folder / "out" / ".store"
    for path, content in files.items():
        (root / path).parent.mkdir(parents=True, exist_ok=True)
        (root / path).write_bytes(content)
    (folder / "out" / "a").mkdir(exist_ok=True)
    return root


def damages(content, rng):
    """(name, damaged content): bits flipped in every region, and every kind of truncation."""
    size = len(content)
    for where in (0, 8, size // 3, size // 2, size - 1, *(rng.randrange(size) for _ in range(12))):
        flipped = bytearray(content)
        flipped[where] ^= 1 << rng.randrange(8)
        yield f"bit in byte {where}", bytes(flipped)
    for length in (0, 1, size // 2, size - 1):
        yield f"cut to {length}", content[:length]
    yield "a byte more", content + b"\0"
    yield "zeros", bytes(size)


@pytest.mark.parametrize("suffix", [".h5", ".json"])
def test_every_damage_is_detected(folder, pristine, suffix):
    """The planner's check alone, so that hundreds of cases are quick."""
    root = restore(folder, pristine)
    rng = random.Random(1)
    victims = [path for path in pristine if path.suffix == suffix and path.parts[0] != "outputs"]
    assert len(victims) == 6
    cases = 0
    for path in victims:
        stage, key = path.parts[0], path.stem
        for name, content in damages(pristine[path], rng):
            (root / path).write_bytes(content)
            receipt, problem = toy.planner(folder / "out").store.find(stage, key)
            assert receipt is None and "damaged" in problem, (path, name)
            assert not (root / path).exists() and list((root / "damaged").iterdir())
            cases += 1
            restore(folder, pristine)
        assert toy.planner(folder / "out").store.find(stage, key)[0]  # the undamaged files are accepted
    assert cases > 100


@pytest.mark.parametrize("stage", ["read", "part", "total"])
@pytest.mark.parametrize("suffix", [".h5", ".json"])
def test_damage_is_recomputed_with_the_same_bytes(folder, pristine, stage, suffix):
    root = restore(folder, pristine)
    path = next(path for path in pristine if path.parts[0] == stage and path.suffix == suffix)
    (root / path).write_bytes(pristine[path][:-7])
    results, planner = toy.run(folder / "out", folder / "a.txt")
    ran = toy.executed()
    assert [name.rstrip("012") for name in ran if name != "deliver"] == [stage]
    assert len(planner.store.notices) == 1 and stage in planner.store.notices[0]
    assert any("damaged" in why for why in results["a"].stages[stage].reasons)
    assert toy.artefacts(folder / "out") == {str(p): b for p, b in pristine.items() if p.suffix == ".h5"}


def test_damage_after_planning_is_found_by_the_worker_that_reads(folder):
    """The artefact was verified when the plan was made, and goes bad before a job reads it."""

    (folder / "a.txt").write_text(f"{time.time_ns()}")  # what no worker has in memory yet

    class Vandal(toy.Quiet):
        done = False

        def progress(self, result, stage, done, jobs):
            if stage == "read" and done and not self.done:
                self.done = True
                (path,) = (folder / "out" / ".store" / "read").glob("??/*.h5")
                path.write_bytes(path.read_bytes()[:100])

    results, planner = toy.run(folder / "out", folder / "a.txt", watcher=Vandal())
    assert not results["a"].error
    assert toy.executed() == ["deliver", "part0", "part1", "part2", "read", "read", "split", "total"]
    assert len(planner.store.notices) == 1


def test_store_that_never_keeps_what_is_written_fails_the_image_and_ends(folder):
    (folder / "a.txt").write_text(f"{time.time_ns()}")

    class Vandal(toy.Quiet):
        def progress(self, result, stage, done, jobs):
            if stage == "read" and done:
                (path,) = (folder / "out" / ".store" / "read").glob("??/*.h5")
                path.write_bytes(b"")

    results, _ = toy.run(folder / "out", folder / "a.txt", watcher=Vandal())
    assert "check the disk" in results["a"].error


def test_what_killed_runs_left_is_cleared_away(folder):
    """Files of runs, folders of restores; young ones may belong to a run that is going on."""
    store = toy.planner(folder / "out").store
    for name, age in {"old": 90000, "young": 100}.items():
        for kind in ("file", "folder"):
            path = store.root / "tmp" / f"{name}-{kind}"
            if kind == "folder":
                path.mkdir(parents=True)
                (path / "1").write_text("x")
            else:
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_text("x")
            os.utime(path, (time.time() - age,) * 2)
    store.prepare()
    assert sorted(p.name for p in (store.root / "tmp").iterdir()) == ["young-file", "young-folder"]


def test_absurd_number_of_parts_is_refused(folder):
    results, _ = toy.run(folder / "out", folder / "a.txt", split={"parts": 10**9})
    assert "split of a claims 1000000000 parts" in results["a"].error


def test_unchanged_item_is_planned_from_its_ledger_alone(folder, monkeypatch):
    """No receipt is opened, no artefact hashed: that is what makes thousands of cached images quick."""
    toy.run(folder / "out", folder / "a.txt")
    with monkeypatch.context() as patch:
        patch.setattr(Store, "find", lambda *args: pytest.fail("looked up"))
        plan = toy.planner(folder / "out").plan(toy.item(folder / "a.txt"))
    assert plan.complete
    (path,) = (folder / "out" / ".store" / "total").glob("??/*.h5")
    os.utime(path)  # touched: hashed again, found intact
    found = []
    real = Store.find
    monkeypatch.setattr(Store, "find", lambda self, *args: found.append(args[0]) or real(self, *args))
    assert toy.planner(folder / "out").plan(toy.item(folder / "a.txt")).complete and found == ["total"]
