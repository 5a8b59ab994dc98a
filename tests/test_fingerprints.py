"""No stage's source changes without a word about its results; and every parameter reaches exactly the keys it should."""

import dataclasses
import hashlib
import types
import typing

import fingerprints
import numpy as np
import pytest
from pydantic import ValidationError

from sftex_stages import pipeline
from sftex_stages.engine.hdf5 import encode
from sftex_stages.engine.plan import Item, Planner
from sftex_stages.engine.stage import StageParams
from sftex_stages.engine.store import Store
from sftex_stages.engine.worker import describe


def test_every_change_of_a_stage_is_stated():
    recorded, now = fingerprints.load(), fingerprints.current()
    questions = fingerprints.open_questions(recorded, now)
    assert not questions, "\n\n" + fingerprints.message(questions, recorded, now)


def test_guard_sees_code_and_not_comments(tmp_path):
    text = fingerprints.source("surface").read_text()
    path = tmp_path / "surface.py"

    def hashed(text):
        path.write_text(text)
        return fingerprints.tree_hash(path)

    before = hashed(text)
    assert hashed(text.replace('"""', '"""Another word. ', 1) + "\n# a comment\n") == before
    assert hashed(text + "\nX = 1\n") != before
    assert hashed(text.replace("version=", "version=9", 1)) == before  # what the guard asks for must not set it off


def test_guard_follows_imports():
    modules = {stage: set(entry["modules"]) for stage, entry in fingerprints.current().items()}
    assert "sftex_stages/geometry/metric.py" in modules["frontal"]
    assert "sftex_stages/geometry/spline.py" in modules["surface"]  # by way of others
    assert "sftex_stages/results/pictures.py" in modules["outputs"]
    left_out = ("sftex_stages/engine/", "sftex_stages/cli.py")
    assert not any(name.startswith(left_out) for names in modules.values() for name in names)
    recorded = fingerprints.current()
    recorded["frontal"]["modules"]["sftex_stages/geometry/metric.py"] = "another"
    recorded["surface"]["version"] -= 1
    questions = fingerprints.open_questions(recorded, fingerprints.current())
    assert questions == {"frontal": ["sftex_stages/geometry/metric.py"], "surface": []}
    words = fingerprints.message(questions, recorded, fingerprints.current())
    assert "fingerprints.py changed frontal surface" in words and "unchanged" in words


@pytest.mark.parametrize("stage", fingerprints.current())
def test_versions_are_raised_in_the_source(stage, tmp_path):
    copy = tmp_path / "module.py"
    copy.write_text(fingerprints.source(stage).read_text())
    version = fingerprints.current()[stage]["version"]
    before = fingerprints.tree_hash(copy)
    fingerprints.raise_version(stage, copy, version)
    changed = [a for a, b in zip(copy.read_text().split("\n"), fingerprints.source(stage).read_text().split("\n"), strict=True) if a != b]  # fmt: skip  # noqa: E501
    assert len(changed) == 1 and str(version + 1) in changed[0] and fingerprints.tree_hash(copy) == before


# ------------------------------------------------------------------------------------- parameters and keys


def content(stage, inputs, params):
    """A quick stand-in whose outcome depends on everything that the stage is given."""
    return {"count": np.array(2), "usable": np.array(True), "x": np.frombuffer(hashlib.sha256(
        repr((stage, sorted(inputs.items()), params.model_dump())).encode()).digest(), np.uint8)}  # fmt: skip


def all_keys(store, item, params):
    """{stage: keys} by the planner, which is given stand-ins' results until it wants nothing more."""
    planner = Planner(pipeline.PIPELINE, params, store)
    while (plan := planner.plan(item)).todo:
        for job, _ in plan.todo:
            arrays = content(job.stage, {**job.identity["inputs"], **job.identity["files"]}, params[job.stage])
            arrays["x"] = np.append(arrays["x"], np.uint8(job.part or 0))
            receipt = {"label": job.item, "key": job.key, "identity": job.identity, "software": {}, **describe(arrays)}
            store.publish(job.stage, job.key, encode(arrays), receipt)
    return {name: tuple(step.keys) for name, step in plan.steps.items()}


def followers(stage):
    """The stage and all that depends on it."""
    found = {stage}
    for other in pipeline.PIPELINE:
        if found & set(other.inputs):
            found.add(other.name)
    return found


def others(value, annotation):
    """Values near `value` of which at least one is allowed."""
    if typing.get_origin(annotation) is typing.Literal:
        return [v for v in typing.get_args(annotation) if v != value]
    if typing.get_origin(annotation) in (typing.Union, types.UnionType):
        return [v for a in typing.get_args(annotation) if a is not type(None) for v in others(value, a)] + [None]
    if isinstance(value, bool):
        return [not value]
    if isinstance(value, int):
        return [value + 1, value - 1, value + 2, value - 2]
    if isinstance(value, float) or value is None:
        number = value or 1.0
        return [number * 1.01, number * 0.99, number + 0.01, 1, 0.5, 2]
    if value == ():
        return [((1.0, 2.0),), ((1.0, 2.0, 3.0),), (1.0,), ("x",)]
    if isinstance(value, tuple | list):
        return [value[:-1], (*value[:-1], value[-1] * 1.01), (*value, value[-1] + 1)]
    return [value + "x"]


def leaves(params, *above):
    """(names that lead to it, value, annotation) of every parameter, those within parameters included."""
    for name, field in type(params).model_fields.items():
        value = getattr(params, name)
        if isinstance(value, StageParams):
            yield from leaves(value, *above, name)
        else:
            yield (*above, name), value, field.annotation


def edited(params, names, value):
    """The parameters with another value of one of them."""
    first, *more = names
    inner = edited(getattr(params, first), more, value) if more else value
    return type(params).model_validate({**dict(params), first: inner})


FIELDS = [(s.name, *leaf) for s in pipeline.PIPELINE for leaf in leaves(s.params())]


@pytest.fixture(scope="module")
def before(tmp_path_factory):
    """A store, an item, and its keys with all defaults."""
    folder = tmp_path_factory.mktemp("keys")
    (folder / "a.png").write_bytes(b"picture")
    store = Store(folder / "out" / ".store")
    item = Item("a", {"image": folder / "a.png", "mask": None})
    return store, item, all_keys(store, item, {stage.name: stage.params() for stage in pipeline.PIPELINE})


@pytest.mark.parametrize("stage, names, default, annotation", FIELDS, ids=[".".join((f[0], *f[1])) for f in FIELDS])
def test_a_parameter_changes_the_keys_of_its_stage_and_of_what_follows(
    before, stage, names, default, annotation, monkeypatch
):
    store, item, keys = before
    monkeypatch.setattr("os.fsync", lambda fd: None)
    params = {s.name: s.params() for s in pipeline.PIPELINE}
    for value in others(default, annotation):
        try:
            other = edited(params[stage], names, value)
        except ValidationError:
            continue
        if other != params[stage]:
            break
    else:
        pytest.fail(f"no other value of {stage}.{'.'.join(names)} found to test with; teach `others` about it")
    params[stage] = other
    now = all_keys(store, item, params)
    assert {name for name in keys if now[name] != keys[name]} == followers(stage)
    assert all_keys(store, item, {s.name: s.params() for s in pipeline.PIPELINE}) == keys


@pytest.mark.parametrize("stage", [s.name for s in pipeline.PIPELINE])
def test_a_version_changes_the_keys_of_its_stage_and_of_what_follows(before, stage, monkeypatch):
    """Of what follows only if the outcome changed: here it does not, as the stand-ins do not know the version."""
    store, item, keys = before
    stages = tuple(dataclasses.replace(s, version=s.version + 1) if s.name == stage else s for s in pipeline.PIPELINE)
    monkeypatch.setattr(pipeline, "PIPELINE", stages)
    now = all_keys(store, item, {s.name: s.params() for s in stages})
    assert {name for name in keys if now[name] != keys[name]} == {stage}


def test_pictures_and_masks_are_in_the_keys_their_places_and_times_are_not(before, tmp_path):
    store, item, keys = before
    params = {stage.name: stage.params() for stage in pipeline.PIPELINE}
    other = tmp_path / "elsewhere.png"
    other.write_bytes(item.files["image"].read_bytes())
    assert all_keys(store, Item("b", {"image": other, "mask": None}), params) == keys
    assert all_keys(Store(tmp_path / "new"), Item("b", {"image": other, "mask": None}), params) == keys
    for files in ({"image": other, "mask": other}, {"image": tmp_path / "changed", "mask": None}):
        (tmp_path / "changed").write_bytes(b"another")
        now = all_keys(store, Item("b", files), params)
        assert all(now[name] != keys[name] for name in keys)


@pytest.mark.parametrize("stage", pipeline.PIPELINE, ids=lambda s: s.name)
def test_every_parameter_is_read(stage):
    """A parameter that nothing reads would make stages run again for nothing."""
    text = fingerprints.source(stage.name).read_text()
    for field in stage.params.model_fields:
        assert f".{field}" in text, f"{stage.name}.{field} is declared but never read in {stage.name}'s module"
