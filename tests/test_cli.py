"""The command line as a user meets it: what is said, where it is said, and the exit codes. Quick stages stand in."""

import json

import cv2
import numpy as np
import pytest
import toy_stages

from sftex_stages import cli, pipeline


@pytest.fixture
def here(tmp_path, monkeypatch):
    """A working directory with three images, and the toy pipeline."""
    monkeypatch.setattr(pipeline, "PIPELINE", toy_stages.PIPELINE)
    monkeypatch.setattr(pipeline, "deliver", toy_stages.deliver)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "in").mkdir()
    for number, name in enumerate(["a", "b", "c"]):
        picture = np.random.default_rng(number).integers(0, 256, (20, 30, 3), np.uint8)
        assert cv2.imwrite(str(tmp_path / "in" / f"{name}.png"), picture)
    return tmp_path


@pytest.fixture
def sftex(capfd):
    """Run a command: (exit code, stdout, stderr)."""

    def run(*words):
        try:
            code = cli.main([str(word) for word in words])
        except SystemExit as leaving:
            code = leaving.code
        return code, *capfd.readouterr()

    return run


def states(document, image=0):
    return {name: entry["state"] for name, entry in document["images"][image]["stages"].items()}


def test_run_tells_everything_and_the_second_run_is_cached(here, sftex):
    code, out, err = sftex("run", "in", "--jobs", "2")
    assert code == cli.OK
    head, *rows = out.splitlines()[:4]
    assert head.split() == [
        "image", "image", "detect", "cluster", "frontal", "surface", "irradiance", "chart", "outputs", "instances",
        "textons", "files",
    ]  # fmt: skip
    assert [row.split()[0] for row in rows] == ["a", "b", "c"]
    assert "(3 of 3)" in rows[0] and rows[0].split()[-5:] == ["27", "2", "of", "3", "1"]
    assert "3 images, none with a mask" in err and "a: frontal done (3 jobs" in err and "c: finished" in err
    assert (here / "outputs" / "a" / "result.h5").exists()
    code, out, err = sftex("run", "in")
    assert code == cli.OK
    assert out.splitlines()[1].split()[1:9] == ["cached"] * 8
    assert "a: up to date" in err and "again" not in out


def test_edited_parameter_is_the_reason(here, sftex):
    sftex("run", "in/a.png", "--out", "o")
    (here / "pipeline.yaml").write_text("frontal:\n  tol: 1e-7\n")  # found without being named
    code, out, _ = sftex("run", "in/a.png", "--out", "o", "--json")
    document = json.loads(out)
    assert code == document["exit_code"] == cli.OK
    computed = ["frontal", "surface", "irradiance", "chart", "outputs"]
    assert states(document) == {
        **dict.fromkeys(["image", "detect", "cluster"], "cached"), **dict.fromkeys(computed, "computed"),
    }  # fmt: skip
    (image,) = document["images"]
    assert image["stages"]["frontal"]["reasons"] == {"frontal.tol 1e-06 → 1e-07": 3}
    assert image["files"] == ["o/a/result.h5"] and (here / image["files"][0]).exists()
    assert (image["instances"], image["textons"], image["textons_used"]) == (27, 3, 2)
    (here / "pipeline.yaml").write_text("irradiance:\n  tol: 1e-8\n")
    _, out, _ = sftex("run", "in/a.png", "--out", "o")
    assert "computed again because" in out  # compared with the run before: the other edit was taken back
    assert "  irradiance: irradiance.tol 1e-06 → 1e-08; surface changed\n" in out


def test_status_before_during_and_after(here, sftex):
    code, out, _ = sftex("status", "in/a.png", "--json")
    assert code == cli.OK and not (here / "outputs").exists()
    entry = json.loads(out)["images"][0]["stages"]
    assert entry["image"] == {"state": "stale", "jobs": 1, "to_run": 1, "reasons": {"new": 1}}
    assert entry["surface"] == {"state": "waiting", "waits_for": "image", "expected_jobs": None, "reasons": []}
    sftex("run", "in/a.png")
    _, out, _ = sftex("status", "in/a.png")
    assert out.splitlines()[1].split() == "a cached cached cached cached (3) cached cached cached cached".split()
    (here / "pipeline.yaml").write_text("frontal:\n  tol: 1e-7\n")
    _, out, _ = sftex("status", "in/a.png", "in/none.png")
    assert "3 of 3 to run" in out and "after frontal" in out and "frontal.tol 1e-06 → 1e-07" in out
    assert "in/none.png: no such file or folder" in out


def test_bad_configuration_stops_before_anything_is_computed(here, sftex):
    (here / "my.yaml").write_text("frontal:\n\n  toll: 3\n")
    code, out, err = sftex("run", "in", "--config", "my.yaml")
    assert code == cli.USAGE and out == "" and not (here / "outputs").exists()
    assert err == 'sftex: my.yaml:3:3: frontal.toll: unknown key; did you mean "tol"?\n'
    code, _, err = sftex("run", "in", "--config", "none.yaml")
    assert code == cli.USAGE and "none.yaml: cannot be read" in err


def test_broken_images_do_not_stop_the_others(here, sftex):
    (here / "in" / "empty.png").write_bytes(b"")
    (here / "in" / "text.png").write_text("this is text")
    (here / "in" / "cut.png").write_bytes((here / "in" / "a.png").read_bytes()[:300])
    assert cv2.imwrite(str(here / "in" / "flat.png"), np.full((20, 30, 3), 90, np.uint8))
    assert cv2.imwrite(str(here / "in" / "b.mask.png"), np.full((9, 9), 255, np.uint8))
    code, out, err = sftex("run", "in", "--json")
    assert code == cli.SOME_FAILED
    images = {image["image"]: image for image in json.loads(out)["images"]}
    failed = {name: image["error"] for name, image in images.items() if image["status"] == "failed"}
    assert failed.keys() == {"empty", "text", "cut", "flat", "b"}
    for name, words in {
        "empty": "empty.png: the file is empty", "text": "not an image", "cut": "damaged or cut short",
        "flat": "detect: no interest points", "b": "the mask is 9 × 9 pixels",
    }.items():  # fmt: skip
        assert words in failed[name] and f"{name}: failed: " in err
    assert images["flat"]["stages"]["detect"]["state"] == "failed"
    assert images["flat"]["stages"]["surface"]["state"] == "not reached"
    assert all((here / "outputs" / name / "result.h5").exists() for name in "ac")
    code, out, _ = sftex("run", "in")
    assert code == cli.SOME_FAILED and "failed: 5 of 7 images" in out and "the file is empty" in out


def test_every_image_failed(here, sftex):
    (here / "in" / "a.png").write_bytes(b"")
    code, _, err = sftex("run", "in/a.png")
    assert code == cli.ALL_FAILED and "Traceback" not in err


def test_images_that_are_not_there(here, sftex):
    code, out, err = sftex("run", "in/none.png", "nowhere/*.jpg")
    assert code == cli.USAGE and out == ""
    assert "in/none.png: no such file or folder" in err and "nowhere/*.jpg: no image matches" in err
    code, out, _ = sftex("run", "in/none.png", "in/a.png", "--json")
    assert code == cli.SOME_FAILED
    assert [image["status"] for image in json.loads(out)["images"]] == ["ok"]
    assert json.loads(out)["not_found"] == ["in/none.png: no such file or folder"]


def test_output_folder_that_cannot_be_written(here, sftex):
    (here / "file").write_text("")
    code, out, err = sftex("run", "in", "--out", "file/out")
    assert code == cli.USAGE and out == ""
    assert "file/out: cannot be written" in err and "--out" in err and "done" not in err


def test_masks_folder(here, sftex):
    (here / "m").mkdir()
    assert cv2.imwrite(str(here / "m" / "a.png"), np.full((20, 30), 255, np.uint8))
    _, _, err = sftex("run", "in/a.png", "--masks", "m")
    assert "1 image, 1 with a mask" in err
    code, _, err = sftex("run", "in/a.png", "--masks", "nowhere")
    assert code == cli.USAGE and "nowhere: no such folder" in err


def test_damage_is_reported_and_mended(here, sftex):
    sftex("run", "in/a.png")
    result = (here / "outputs" / "a" / "result.h5").read_bytes()
    (path,) = (here / "outputs" / ".store" / "surface").glob("??/*.h5")
    path.write_bytes(path.read_bytes()[:-100])
    (here / "outputs" / "a" / "result.h5").unlink()
    code, out, err = sftex("run", "in/a.png", "--json")
    document = json.loads(out)
    assert code == cli.OK and "damaged artefact" in err and "set aside" in document["notices"][0]
    assert [name for name, state in states(document).items() if state == "computed"] == ["surface", "outputs"]
    assert (here / "outputs" / "a" / "result.h5").read_bytes() == result


def test_a_defect_is_not_hidden(here, sftex, monkeypatch):
    monkeypatch.setattr(pipeline, "items", lambda found: 1 / 0)
    code, out, err = sftex("run", "in")
    assert code == cli.DEFECT and out == "" and "ZeroDivisionError" in err and "defect in sftex" in err


def test_interrupt(here, sftex, monkeypatch):
    def interrupt(found):
        raise KeyboardInterrupt

    monkeypatch.setattr(pipeline, "items", interrupt)
    code, _, err = sftex("run", "in")
    assert code == cli.INTERRUPTED and "goes on from here" in err and "Traceback" not in err


def test_config_command(here, sftex):
    (here / "my.yaml").write_text("frontal:\n  tol: 1e-7\n")
    _, out, _ = sftex("config", "--config", "my.yaml")
    assert "  tol: 1.0e-07\n" in out and "threshold: 0.1" in out


@pytest.mark.parametrize("words", [(), ("run",), ("fly",), ("run", "in", "--jobs", "0"), ("run", "in", "--job", "x")])
def test_wrong_usage(here, sftex, words):
    code, out, err = sftex(*words)
    assert code == cli.USAGE and out == "" and "usage: sftex" in err


def test_help_and_version(sftex):
    code, out, _ = sftex("--help")
    assert code == 0 and all(word in out for word in ("run", "status", "evaluate", "config", "exit codes"))
    for command in ("run", "status", "evaluate", "config"):
        assert sftex(command, "--help")[0] == 0
    code, out, _ = sftex("--version")
    assert code == 0 and out.startswith("sftex 0.")
