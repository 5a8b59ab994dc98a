"""What runs again, and what does not: by counting the jobs that were executed."""

import json
import shutil

import pytest
import toy_pipeline as toy

PARTS = ["part0", "part1", "part2"]


def reasons(result):
    return {name: sorted(state.reasons) for name, state in result.stages.items() if state.reasons}


def test_first_run_computes_everything_second_nothing(folder):
    results, _ = toy.run(folder / "out", folder / "a.txt", folder / "b.txt")
    assert toy.executed() == sorted(2 * ["deliver", *PARTS, "read", "split", "total"])
    assert all(not r.error and s.computed == s.jobs for r in results.values() for s in r.stages.values())
    results, _ = toy.run(folder / "out", folder / "a.txt", folder / "b.txt")
    assert toy.executed() == []
    assert [s.jobs for s in results["a"].stages.values()] == [1, 1, 3, 1, 1]
    assert not any(s.computed for s in results["a"].stages.values())


def test_adding_an_image_leaves_the_others_alone(folder):
    toy.run(folder / "out", folder / "a.txt")
    toy.executed()
    toy.run(folder / "out", folder / "a.txt", folder / "b.txt")
    assert toy.executed() == ["deliver", *PARTS, "read", "split", "total"]


@pytest.mark.parametrize(
    ("change", "reruns", "why"),
    [
        ({"read": {"scale": 2}}, ["deliver", *PARTS, "read", "split", "total"], {"read": ["read.scale 1.0 → 2.0"]}),
        ({"part": {"power": 2}}, ["deliver", *PARTS, "total"], {"part": ["part.power 1 → 2"]}),
        ({"total": {"offset": 1}}, ["deliver", "total"], {"total": ["total.offset 0.0 → 1.0"]}),
        ({"split": {"comment": "x"}}, ["split"], {"split": ['split.comment "" → "x"']}),  # same outcome: early cut-off
        ({"split": {"parts": 4}}, ["deliver", "part0", "part1", "part2", "part3", "split", "total"], {}),
        ({"title": "new"}, ["deliver"], {"outputs": ['outputs.title "t" → "new"']}),
    ],
)
def test_an_edited_parameter_reruns_its_stage_and_what_depends_on_it(folder, change, reruns, why):
    toy.run(folder / "out", folder / "a.txt")
    toy.executed()
    results, _ = toy.run(folder / "out", folder / "a.txt", **change)
    assert toy.executed() == reruns
    assert why.items() <= reasons(results["a"]).items()
    toy.run(folder / "out", folder / "a.txt")  # back again: everything is still there but the delivered files
    assert set(toy.executed()) <= {"deliver"}


def test_reason_compares_with_the_run_before(folder):
    """Not with the youngest receipt: after 1 → 2 → 1, an edit elsewhere has nothing to do with the 2."""
    for power in (1, 2, 1):
        toy.run(folder / "out", folder / "a.txt", part={"power": power})
    results, _ = toy.run(folder / "out", folder / "a.txt", total={"offset": 1})
    assert reasons(results["a"])["total"] == ["total.offset 0.0 → 1.0"]


def test_edited_file_and_mask_are_inputs_their_names_and_times_are_not(folder):
    toy.run(folder / "out", folder / "a.txt")
    toy.executed()
    shutil.copy(folder / "a.txt", folder / "copy.txt")
    toy.run(folder / "out", folder / "copy.txt")
    assert toy.executed() == ["deliver"]  # into its own folder
    (folder / "a.txt").write_text("7")
    results, _ = toy.run(folder / "out", folder / "a.txt")
    assert "total" in toy.executed()
    assert reasons(results["a"])["read"] == ["text file changed"]
    planner = toy.planner(folder / "out")
    (folder / "mask").write_text("##")
    steps = planner.plan(toy.item(folder / "a.txt", folder / "mask")).steps
    assert [why for _, why in steps["read"].todo] == ["mask file added"]


def test_new_version_reruns_the_stage(folder):
    toy.run(folder / "out", folder / "a.txt")
    toy.executed()
    import dataclasses

    stages = [dataclasses.replace(s, version=2) if s.name == "total" else s for s in toy.STAGES]
    results, _ = toy.run(folder / "out", folder / "a.txt", stages=stages)
    assert toy.executed() == ["total"]  # same outcome, so nothing is delivered again
    assert reasons(results["a"]) == {"total": ["total version 1 → 2"]}


def test_two_equal_images_share_their_jobs(folder):
    (folder / "b.txt").write_text("1 2 3")
    results, _ = toy.run(folder / "out", folder / "a.txt", folder / "b.txt")
    assert toy.executed() == sorted([*PARTS, "deliver", "deliver", "read", "split", "total"])
    assert not results["a"].error and not results["b"].error


def test_removed_cluster_artefact_recomputes_that_cluster_alone(folder):
    _, planner = toy.run(folder / "out", folder / "a.txt")
    before = toy.artefacts(folder / "out")
    toy.executed()
    key = planner.plan(toy.item(folder / "a.txt")).steps["part"].keys[1]
    planner.store.path("part", key).unlink()
    results, _ = toy.run(folder / "out", folder / "a.txt")
    assert toy.executed() == ["part1"]
    assert reasons(results["a"]) == {"part": ["artefact removed"]}
    assert toy.artefacts(folder / "out") == before


def test_delivered_files_are_written_again_when_missing_or_changed(folder):
    toy.run(folder / "out", folder / "a.txt")
    path = folder / "out" / "a" / "sum.txt"
    content = path.read_bytes()
    toy.executed()
    for damage in (path.unlink, lambda: path.write_bytes(b"?")):
        damage()
        toy.run(folder / "out", folder / "a.txt")
        assert toy.executed() == ["deliver"]
        assert path.read_bytes() == content


def test_same_bytes_with_one_and_two_jobs_in_different_folders(folder):
    toy.run(folder / "out1", folder / "a.txt", folder / "b.txt", workers=1)
    (folder / "elsewhere").mkdir()
    moved = [shutil.copy(folder / name, folder / "elsewhere" / name) for name in ("a.txt", "b.txt")]
    toy.run(folder / "out2", *moved, workers=2)
    assert toy.artefacts(folder / "out1") == toy.artefacts(folder / "out2")
    assert len(toy.artefacts(folder / "out1")) == 12


def test_receipt_is_readable_and_complete(folder):
    _, planner = toy.run(folder / "out", folder / "a.txt", part={"power": 2})
    key = planner.plan(toy.item(folder / "a.txt")).steps["part"].keys[1]
    receipt = json.loads(planner.store.path("part", key, ".json").read_text())
    assert receipt["label"] == "a" and receipt["key"] == key
    assert receipt["identity"]["params"]["power"] == 2 and receipt["identity"]["part"] == 1
    assert len(receipt["identity"]["inputs"]["read"]) == 64
    assert receipt["scalars"] == {"word": "Teil 1 äöü"}
    assert receipt["arrays"]["x"] == {"dtype": "float64", "shape": [3]}
    assert {"numpy", "h5py", "python", "sftex"} <= receipt["software"].keys()
    assert receipt["seconds"] > 0 and receipt["peak_memory_mb"] > 10 and receipt["host"]
    assert str(folder) not in json.dumps(receipt["identity"])


def test_status_tells_without_touching(folder):
    """Looking (repair off) gives the same plan as running, moves nothing and creates nothing."""
    item = toy.item(folder / "a.txt")
    steps = toy.planner(folder / "out", repair=False).plan(item).steps
    assert [why for _, why in steps["read"].todo] == ["new"]
    assert [steps[name].waits_for for name in ("split", "part", "total", "outputs")] == ["read", "read", "part", "read"]
    assert not (folder / "out").exists()
    _, planner = toy.run(folder / "out", folder / "a.txt")
    path = planner.store.path("split", planner.plan(item).steps["split"].keys[0])
    path.write_bytes(path.read_bytes()[:-1])
    steps = toy.planner(folder / "out", repair=False).plan(item).steps
    assert "damaged artefact" in steps["split"].todo[0][1]
    assert path.exists()
