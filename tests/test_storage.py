"""Plan, explain, forced and partial runs, verify, gc, pins, archive and restore: as a user meets them."""

import hashlib
import io
import json
import os
import re
import shutil
import tarfile
import time

import cv2
import h5py
import numpy as np
import pytest
import toy_stages
from test_cli import here, sftex, states  # noqa: F401  the fixtures of the command line

from sftex_stages import cli, pipeline, storage
from sftex_stages.engine import keys, ledger

pytestmark = pytest.mark.usefixtures("here")
ALL = ["image", "detect", "cluster", "frontal", "surface", "irradiance", "chart", "outputs"]


@pytest.fixture
def done(here, sftex):  # noqa: F811
    """A finished run of one image."""
    code, out, _ = sftex("run", "in/a.png", "--json", "--jobs", "1")
    assert code == 0
    return json.loads(out)["run"]


def stage(document, name):
    return document["images"][0]["stages"][name]


def files(folder):
    """{name: content} of everything below a folder but what is only a memo."""
    found = (p for p in folder.rglob("*") if p.is_file() and not {"items", "tmp"} & set(p.parts))
    return {str(p.relative_to(folder)): p.read_bytes() for p in found}


def test_plan_is_what_run_does(here, sftex, done):  # noqa: F811
    before = files(here / "outputs")
    (here / "pipeline.yaml").write_text("frontal: {tol: 1e-7}\nirradiance: {tol: 1e-8}\n")
    code, out, _ = sftex("plan", "in/a.png", "in/b.png", "--json")
    document = json.loads(out)
    assert code == 0 and files(here / "outputs") == before
    assert stage(document, "frontal")["to_run"] == 3 and stage(document, "cluster")["to_run"] == 0
    assert stage(document, "irradiance")["reasons"] == ["irradiance.tol 1e-06 → 1e-08"]
    assert stage(document, "outputs")["expected_jobs"] == 1 and stage(document, "surface")["expected_jobs"] == 1
    assert document["stages"]["image"]["to_run"] == 1 and document["stages"]["frontal"]["to_run"] == 3
    _, out, _ = sftex("plan", "in/a.png")
    assert "3 jobs to run now" in out and "frontal.tol 1e-06 → 1e-07" in out
    _, out, _ = sftex("run", "in/a.png", "--json")
    assert stage(json.loads(out), "frontal")["computed"] == 3 and stage(json.loads(out), "cluster")["computed"] == 0
    assert "nothing to run" in sftex("plan", "in/a.png")[1]


def test_explain_says_old_and_new_value(here, sftex, done):  # noqa: F811
    code, out, _ = sftex("explain", "in/a.png", "detect")
    assert code == 0 and "detect: cached (1 job), computed 20" in out and "threshold = 0.1" in out
    (here / "pipeline.yaml").write_text("detect: {threshold: 0.05}\nsurface: {tol: 1e-7}\n")
    _, out, _ = sftex("explain", "in/a.png")
    assert "detect: 1 of 1 jobs to run, because\n  detect.threshold 0.1 → 0.05" in out
    assert "surface: waits for frontal, 1 job last time; will run in any case\n  surface.tol 1e-06 → 1e-07" in out
    assert "frontal: waits for detect, 3 jobs last time; runs if the outcome of that changes" in out
    picture = np.zeros((20, 30, 3), np.uint8)
    assert cv2.imwrite(str(here / "in" / "a.png"), picture)
    _, out, _ = sftex("explain", "in/a.png", "image", "--json")
    (row,) = json.loads(out)["images"][0]["stages"]
    assert row["reasons"] == {"image file changed": 1} and len(row["identity"]["files"]["image"]) == 64
    code, _, err = sftex("explain", "in/a.png", "frontel")
    assert code == cli.USAGE and "no stage is called 'frontel'; there are image, detect" in err


def test_run_of_one_stage_stops_there(here, sftex):  # noqa: F811
    code, out, _ = sftex("run", "in/a.png", "--stage", "cluster", "--json")
    assert code == 0 and list(states(json.loads(out))) == ["image", "detect", "cluster"]
    assert not (here / "outputs" / "a").exists()
    _, out, _ = sftex("run", "in/a.png", "--json")
    assert states(json.loads(out))["cluster"] == "cached" and states(json.loads(out))["outputs"] == "computed"


def test_forced_stage_is_computed_again_and_what_follows_is_not(here, sftex, done):  # noqa: F811
    before = {name: content for name, content in files(here / "outputs").items() if name.endswith(".h5")}
    _, out, err = sftex("run", "in/a.png", "--force", "frontal", "--force", "outputs", "--json")
    assert [name for name, state in states(json.loads(out)).items() if state == "computed"] == ["frontal", "outputs"]
    assert stage(json.loads(out), "frontal")["reasons"] == {"forced": 3} and "another outcome" not in err
    assert {name: content for name, content in files(here / "outputs").items() if name.endswith(".h5")} == before


def test_forced_stage_with_another_outcome_is_told(here, sftex, done, monkeypatch):  # noqa: F811
    """As after a change of code without a new version."""
    (path,) = (here / "outputs" / ".store" / "surface").glob("??/*.json")
    receipt = json.loads(path.read_text())
    other = path.with_suffix(".h5").read_bytes() + b"\0"
    path.with_suffix(".h5").write_bytes(other)
    receipt.pop("checksum")
    receipt["artefact"] = {"sha256": hashlib.sha256(other).hexdigest(), "bytes": len(other)}
    path.write_text(json.dumps({**receipt, "checksum": keys.digest(receipt)}))
    code, _, err = sftex("run", "in/a.png", "--force", "surface")
    assert code == 0 and "a surface: computed again with another outcome than was cached" in err


def test_fail_fast_starts_nothing_more_keep_going_does(here, sftex):  # noqa: F811
    assert cv2.imwrite(str(here / "in" / "a.png"), np.full((20, 30, 3), 90, np.uint8))
    code, out, _ = sftex("run", "in", "--fail-fast", "--jobs", "1", "--json")
    assert code == cli.ALL_FAILED
    assert [image["status"] for image in json.loads(out)["images"]] == ["failed", "stopped", "stopped"]
    code, out, _ = sftex("run", "in", "--keep-going", "--jobs", "1", "--json")
    assert code == cli.SOME_FAILED
    assert [image["status"] for image in json.loads(out)["images"]] == ["failed", "ok", "ok"]


def test_verify_finds_every_changed_byte_also_where_times_and_sizes_hide_it(here, sftex, done):  # noqa: F811
    assert sftex("verify")[0] == 0
    (path,) = (here / "outputs" / ".store" / "surface").glob("??/*.h5")
    result = here / "outputs" / "a" / "result.h5"
    for file in (path, result):
        status, content = file.stat(), bytearray(file.read_bytes())
        content[len(content) // 2] ^= 1
        file.write_bytes(content)
        os.utime(file, ns=(status.st_atime_ns, status.st_mtime_ns))
    code, out, _ = sftex("verify", "--json")
    document = json.loads(out)
    assert code == 3 and len(document["damaged"]) == 1 and "surface" in document["damaged"][0]
    assert document["changed"] == ["outputs/a/result.h5 was changed"] and not path.exists()
    _, out, _ = sftex("run", "in/a.png", "--json")
    assert [name for name, s in states(json.loads(out)).items() if s == "computed"] == ["surface", "outputs"]
    assert sftex("verify")[0] == 0


def test_verify_sets_damaged_ledgers_and_records_aside(here, sftex, done):  # noqa: F811
    for name in ("items", "runs"):
        (path,) = (here / "outputs" / ".store" / name).glob("*.json")
        path.write_bytes(path.read_bytes()[:-9] + b"?" * 9)
    code, _, err = sftex("gc")
    assert code == cli.USAGE and "run sftex verify" in err  # what a damaged ledger keeps is not known
    code, out, _ = sftex("verify", "--json")
    assert code == 3 and len(json.loads(out)["damaged"]) == 2
    _, out, _ = sftex("run", "in/a.png", "--json")
    assert set(states(json.loads(out)).values()) == {"cached"} and json.loads(out)["run"] == done


def test_gc_keeps_current_and_pinned_and_tells_before_it_removes(here, sftex, done):  # noqa: F811
    sftex("pin", "last")
    for tol in ("1e-7", "1e-8"):
        (here / "pipeline.yaml").write_text(f"frontal: {{tol: {tol}}}\n")
        sftex("run", "in/a.png")
    sftex("run", "in/b.png", "--stage", "image")
    before = files(here / "outputs")
    assert json.loads(sftex("gc", "--json")[1])["jobs"] == []  # nothing is old enough
    _, out, _ = sftex("gc", "--older-than", "0", "--json")
    document = json.loads(out)
    assert {job["stage"] for job in document["jobs"]} == {"frontal", "surface", "irradiance", "chart", "outputs"}
    assert len(document["jobs"]) == 7 and files(here / "outputs") == before and not document["deleted"]
    assert len(json.loads(sftex("gc", "--older-than", "0", "--max-size", "1G", "--json")[1])["jobs"]) == 0
    limit = str(document["bytes"] - 1)
    assert len(json.loads(sftex("gc", "--older-than", "0", "--max-size", limit, "--json")[1])["jobs"]) == 1
    _, out, _ = sftex("gc", "--older-than", "0", "--delete", "--json")
    assert json.loads(out)["freed"] == document["freed"]
    assert set(states(json.loads(sftex("run", "in/a.png", "--json")[1])).values()) == {"cached"}
    (here / "pipeline.yaml").unlink()  # the pinned run
    found = states(json.loads(sftex("run", "in/a.png", "--json")[1]))
    assert [name for name, state in found.items() if state == "computed"] == ["outputs"]
    (here / "pipeline.yaml").write_text("frontal: {tol: 1e-7}\n")
    assert states(json.loads(sftex("run", "in/a.png", "--json")[1]))["frontal"] == "computed"
    assert len(json.loads(sftex("runs", "--json")[1])["runs"]) >= 2


def test_gc_clears_away_what_killed_runs_left(here, sftex, done):  # noqa: F811
    store = here / "outputs" / ".store"
    for path in (store / "tmp" / "x", store / "surface" / "ab" / ("ab" * 32 + ".h5")):
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(b"half")
        os.utime(path, (time.time() - 90000,) * 2)
    assert "1 unfinished" in sftex("verify")[1]
    sftex("gc", "--delete")
    assert not (store / "tmp" / "x").exists() and not (store / "surface" / "ab" / ("ab" * 32 + ".h5")).exists()
    assert set(states(json.loads(sftex("run", "in/a.png", "--json")[1])).values()) == {"cached"}


@pytest.mark.parametrize("target", ["run.tar", "folder"])
def test_restored_run_is_found_cached(here, sftex, done, target):  # noqa: F811
    (here / "pipeline.yaml").write_text("frontal: {tol: 1e-7}\n")
    sftex("run", "in/a.png")
    code, out, _ = sftex("archive", done, "-o", target)
    assert code == cli.USAGE  # its results were replaced by those of the run after it
    code, out, _ = sftex("archive", "last", "-o", target, "--json")
    run = json.loads(out)["run"]
    assert code == 0
    (here / "pipeline.yaml").unlink()
    code, out, _ = sftex("restore", target, "--out", "elsewhere")
    assert code == 0 and f"--config elsewhere/{run}.yaml" in out
    for name, content in files(here / "outputs" / "a").items():
        assert (here / "elsewhere" / "a" / name).read_bytes() == content
    (here / "moved").mkdir()
    (here / "in" / "a.png").rename(here / "moved" / "a.png")
    _, out, _ = sftex("run", "moved/a.png", "--out", "elsewhere", "--config", f"elsewhere/{run}.yaml", "--json")
    assert set(states(json.loads(out)).values()) == {"cached"} and json.loads(out)["run"] == run
    assert "(0 new files)" in sftex("restore", target, "--out", "elsewhere")[1]
    if target == "folder":
        for line in (here / target / "SHA256SUMS").read_text().splitlines():
            digest, name = line.split("  ")
            assert hashlib.sha256((here / target / name).read_bytes()).hexdigest() == digest
    else:
        sftex("archive", "last", "-o", "again.tar")
        assert (here / "again.tar").read_bytes() == (here / "run.tar").read_bytes()


def rewrite(source, target, change):
    """A tar with `change(name, content)` -> list of (TarInfo or name, content) for every member, sums made right."""
    entries = []
    with tarfile.open(source) as tar:
        for info in tar:
            entries += change(info.name, tar.extractfile(info).read())
    listed = [(i if isinstance(i, str) else i.name, c) for i, c in entries]
    sums = "".join(f"{hashlib.sha256(c).hexdigest()}  {n}\n" for n, c in listed if n != "SHA256SUMS").encode()
    with tarfile.open(target, "w") as tar:
        for entry, content in entries:
            info = entry if isinstance(entry, tarfile.TarInfo) else tarfile.TarInfo(entry)
            content = sums if info.name == "SHA256SUMS" else content
            info.size = len(content) if info.isreg() else 0
            tar.addfile(info, io.BytesIO(content))


def extra(name, kind=tarfile.REGTYPE, link=""):
    def change(old, content):
        info = tarfile.TarInfo(name)
        info.type, info.linkname = kind, link
        return [(old, content)] + ([(info, b"x")] if old == "run.json" else [])

    return change


def swap(suffix, new):
    return lambda name, content: [(name, new(content) if name.endswith(suffix) else content)]


@pytest.mark.parametrize(
    "change, words",
    [
        (extra("../evil"), "no place in a run"),
        (extra("/tmp/evil"), "no place in a run"),
        (extra("results/../evil.txt"), "no place in a run"),
        (extra("results/.store/evil.txt"), "no place in a run"),
        (extra("results/a/../../evil"), "no place in a run"),
        (extra("store/tmp/ab/" + "ab" * 32 + ".h5"), "no place in a run"),
        (extra("results/a/link", tarfile.SYMTYPE, "/etc/passwd"), "not a plain file"),
        (extra("results/a/link", tarfile.LNKTYPE, "run.json"), "not a plain file"),
        (extra("results/a/pipe", tarfile.FIFOTYPE), "not a plain file"),
        (extra("results/a/more.txt"), "does not belong to the run"),
        (lambda name, content: [(name, content)] * (1 + (name == "run.json")), "comes twice|lists 'run.json'"),
        (lambda name, content: [] if name.endswith(".h5") else [(name, content)], "do not belong together"),
        (lambda name, content: [] if name == "SHA256SUMS" else [(name, content)], "not listed in SHA256SUMS"),
        (swap("run.json", lambda c: c[:-20]), "do not belong together"),
        (swap("config.yaml", lambda c: c + b"#"), "config.yaml is another one"),
        (swap(".h5", lambda c: c + b"\0"), "tells of other files"),
        (swap(".json", lambda c: b"[" * 100_000), "do not belong together"),
        (swap(".json", lambda c: b"{}"), "do not belong together"),
    ],
)
def test_bad_archives_leave_no_trace(here, sftex, done, change, words):  # noqa: F811
    sftex("archive", "last", "-o", "run.tar")
    rewrite("run.tar", "bad.tar", change)
    before = set(here.rglob("*"))
    code, out, err = sftex("restore", "bad.tar", "--out", "new")
    assert code == cli.USAGE and out == "" and "Traceback" not in err
    assert re.search(words, err), err
    assert {p.name for p in set(here.rglob("*")) - before} <= {"new", ".store", "tmp"}


def reseal(source, target, change):
    """The folder of a run with one file changed by `change(path)`, and every hash made right: as somebody bad would."""
    shutil.copytree(source, target)
    record = ledger.unseal((target / "run.json").read_bytes())
    for label, item in record["items"].items():
        for stage, many in item["keys"].items():
            for key in many:
                path = target / "store" / stage / key[:2] / f"{key}.json"
                receipt = json.loads(path.read_text())
                receipt.pop("checksum")
                change(stage, path.with_suffix(".h5"), receipt)
                if receipt["artefact"]:
                    content = path.with_suffix(".h5").read_bytes()
                    receipt["artefact"] = {"sha256": hashlib.sha256(content).hexdigest(), "bytes": len(content)}
                for name in receipt.get("files", {}):
                    content = (target / "results" / label / name).read_bytes()
                    receipt["files"][name] = hashlib.sha256(content).hexdigest()
                path.write_text(json.dumps({**receipt, "checksum": keys.digest(receipt)}))
    names = [line.split("  ")[1] for line in (target / "SHA256SUMS").read_text().splitlines()]
    lines = [f"{hashlib.sha256((target / name).read_bytes()).hexdigest()}  {name}\n" for name in names]
    (target / "SHA256SUMS").write_text("".join(lines))


def hdf5(act):
    def change(stage, artefact, receipt):
        if stage == "surface":
            with h5py.File(artefact, "r+") as file:
                act(file)

    return change


def soft(file):
    file["more"] = h5py.SoftLink("/instance/xy")


def external_link(file):
    file["more"] = h5py.ExternalLink("/etc/passwd", "/")


def external_storage(file):
    file.create_dataset("more", (9,), "u1", external=[("/etc/passwd", 0, 9)])


def virtual(file):
    layout = h5py.VirtualLayout((4,), "u1")
    layout[:] = h5py.VirtualSource("/etc/passwd", "x", (4,))
    file.create_virtual_dataset("more", layout)


def absurd(file):
    file.create_dataset("more", (10**13,), "u1", chunks=(10**6,), compression=1)


def ring(file):
    file["more/again"] = file["/"]


def lie(name, value):
    def change(stage, artefact, receipt):
        if stage == "cluster":
            receipt[name] = value

    return change


@pytest.mark.parametrize(
    "change, words",
    [
        (hdf5(soft), "link"), (hdf5(external_link), "link"), (hdf5(external_storage), "another file"),
        (hdf5(virtual), "another file"), (hdf5(absurd), "declares 9313.2 GiB"), (hdf5(ring), "too deep"),
        (hdf5(lambda file: file.create_dataset("more", data=1)), "other arrays than its receipt"),
        (lambda stage, artefact, receipt: stage == "surface" and artefact.write_bytes(b"no HDF5"), "not a whole HDF5 file"),
        (lie("scalars", {"count": []}), r"receipt of cluster: scalars\.count"), (lie("software", []), "cluster: software"),
        (lie("artefact", None), "do not agree"),
    ],
)  # fmt: skip
def test_archives_with_right_hashes_and_bad_content_are_refused(here, sftex, done, change, words):  # noqa: F811
    sftex("archive", "last", "-o", "whole")
    reseal(here / "whole", here / "same", lambda *args: None)
    assert sftex("restore", "same", "--out", "new")[0] == 0  # what was changed is what is refused
    reseal(here / "whole", here / "bad", change)
    code, _, err = sftex("restore", "bad", "--out", "other")
    assert code == cli.USAGE and re.search(words, err) and "bad: " in err, err
    assert not list((here / "other").glob(".store/*/??/*")) and not list((here / "other" / ".store" / "tmp").iterdir())


def test_restore_replaces_no_results_of_another_run(here, sftex, done):  # noqa: F811
    sftex("archive", "last", "-o", "run.tar")
    result = here / "outputs" / "a" / "result.h5"
    result.write_bytes(b"mine")
    code, _, err = sftex("restore", "run.tar")
    assert code == cli.USAGE and "outputs/a/result.h5: differs" in err and result.read_bytes() == b"mine"


def test_an_archive_that_is_not_there_is_named(here, sftex):  # noqa: F811
    code, _, err = sftex("restore", "none.tar", "--out", "new")
    assert code == cli.USAGE and "none.tar: no such archive" in err


def test_runs_are_named(here, sftex, done):  # noqa: F811
    assert sftex("archive", "zzz", "-o", "x.tar")[0] == cli.USAGE
    assert sftex("archive", done[:4], "-o", "x.tar")[0] == 0
    code, _, err = sftex("archive", done, "-o", "x.tar")
    assert code == cli.USAGE and "exists already" in err
    for command in ("verify", "gc", "runs", "pin last"):
        code, _, err = sftex(*command.split(), "--out", "nowhere")
        assert code == cli.USAGE and "nowhere/.store: no cache here" in err


def test_sizes_and_ages():
    assert storage.parse_size("10GB") == 10**10 and storage.parse_size("1.5k") == 1500
    assert storage.parse_age("2h") == 7200 and storage.parse_age("0") == 0
    for bad in ("5", "x", "-1d"):
        with pytest.raises(Exception, match="is not an age"):
            storage.parse_age(bad)


def test_needed_stages(monkeypatch):
    monkeypatch.setattr(pipeline, "PIPELINE", toy_stages.PIPELINE)
    assert [s.name for s in pipeline.needed("cluster")] == ["image", "detect", "cluster"]
    assert [s.name for s in pipeline.needed("irradiance")] == ALL[:-2]
