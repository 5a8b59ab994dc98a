"""Flipped bits and cut files of every kind: detected, and computed again with the same bytes."""

import pytest
import toy_pipeline as toy
from faults import LONG, check, results

from sftex_stages.engine import bundle, runs, upkeep, worker
from sftex_stages.engine.store import Store
from sftex_stages.errors import InputError

KINDS = {
    "artefact": ".store/*/??/*.h5", "receipt": ".store/*/??/*.json", "ledger": ".store/items/*.json",
    "record": ".store/runs/*.json", "result": "*/sum.txt",
}  # fmt: skip


def damages(content, rng, times):
    """A flipped bit in each of `times` equal regions; every kind of cut; bytes too many."""
    size = len(content)
    for region in range(times):
        flipped = bytearray(content)
        flipped[min(size - 1, size * region // times + rng.randrange(max(1, size // times)))] ^= 1 << rng.randrange(8)
        yield bytes(flipped)
    for length in {0, 1, size // 4, size // 2, size - 1}:
        yield content[:length]
    yield content + b"\0"
    yield bytes(size)


@pytest.mark.parametrize("kind", KINDS)
def test_damage_is_found_and_mended(folder, serial, rng, measured, kind):
    found, planner = toy.run(folder / "out", folder / "a.txt", folder / "b.txt")
    plans = [result.plan for result in found.values()]
    runs.record(planner.store.root, "", plans)
    out = folder / "out"
    expected = results(out)
    whole = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    cases = 0
    for path in sorted(out.glob(KINDS[kind])):
        for damaged in damages(whole[path], rng, 64 if LONG else 2):
            path.write_bytes(damaged)
            health = upkeep.verify(Store(out / ".store"), out)
            assert len(health.damaged) + len(health.changed) == 1, (path, len(damaged))
            for other, content in whole.items():
                if not other.exists() or other == path:
                    other.write_bytes(content)
            if kind == "record":  # of no use to a run but the next of the same writes it again
                path.write_bytes(damaged)
                runs.record(planner.store.root, "", plans)
                assert path.read_bytes() == whole[path]
            elif LONG or cases % 5 == 0:  # the same, found by a run
                path.write_bytes(damaged)
                worker._cache.clear()
                check(folder, out, expected)
                path.write_bytes(whole[path])
            cases += 1
    words = "100 % found by verify and by the next run; computed again with the same bytes"
    measured(f"a flipped bit in each region, every cut: {kind}", cases, words)


def test_damaged_archives_are_refused_or_restored_whole(folder, serial, rng, measured):
    """Headers of a tar have a checksum, its members a SHA-256; what is left between them says nothing."""
    found, planner = toy.run(folder / "out", folder / "a.txt", folder / "b.txt")
    name = runs.record(planner.store.root, "", [result.plan for result in found.values()])
    source, damaged = folder / "run.tar", folder / "bad.tar"
    bundle.archive(planner.store, folder / "out", runs.find(planner.store.root, name), source)
    expected = results(folder / "out")
    cases = refused = 0
    for content in damages(source.read_bytes(), rng, 400 if LONG else 8):
        damaged.write_bytes(content)
        out = folder / f"restored{cases}"
        try:
            bundle.restore(Store(out / ".store"), out, damaged)
        except InputError as error:
            assert "bad.tar" in str(error)
            assert not results(out) and not list((out / ".store" / "tmp").iterdir())
            refused += 1
        else:
            assert results(out) == expected
        cases += 1
    assert refused >= 5
    words = f"{refused} refused without a trace, {cases - refused} restored whole (padding)"
    measured("a flipped bit in each region, every cut: archive", cases, words)
