"""The planner: which jobs an image needs, which of them are done, and why the others are not.

State is derived, each time, from the stages' records, the parameters, the source files and the receipts in the store.
A stage's keys contain the hashes of its upstream artefacts, so they are known only once everything upstream is
published: a plan ends in front of the first stage that has work to do, and is made again when that work is done.
The same plan serves running, status and explaining.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from . import keys
from .stage import Arrays, Stage, StageParams
from .store import Receipt, Store


@dataclass(frozen=True)
class Item:
    """One unit of input (an image with its mask): a label for people, and the source files by name."""

    name: str
    files: Mapping[str, Path | None]


@dataclass(frozen=True)
class Delivery:
    """What is done with an item's finished artefacts: ``write(folder, arrays, meta)`` returns the files it wrote.

    `arrays` holds the artefacts of `inputs` (a list of them for a fanned-out stage). The delivery is done again when
    its version, an input, the meta data or any of the files changed.
    """

    version: int
    write: Callable[[Path, Mapping[str, Arrays | list[Arrays]], dict[str, Any]], list[Path]]
    inputs: tuple[str, ...]
    folder: Path  # files go to folder/<item name>
    meta: Callable[[Item, Plan], dict[str, Any]]
    name: str = "outputs"


@dataclass(frozen=True)
class Source:
    """An upstream artefact: where it is and what it must hash to."""

    stage: str
    key: str
    sha256: str


@dataclass(frozen=True)
class Job:
    """One job, self-contained: a worker needs this, the stage's record and its parameters."""

    item: str  # label
    stage: str
    part: int | None
    key: str
    identity: keys.Identity
    inputs: Mapping[str, Source | list[Source]]
    files: Mapping[str, str | None]  # paths
    folder: str | None = None  # of a delivery
    meta: Mapping[str, Any] = field(default_factory=dict)  # of a delivery


@dataclass
class Step:
    """One stage of one item."""

    stage: str
    waits_for: str | None = None  # upstream stage that has work to do: keys are not known yet
    fanned: bool = False
    done: dict[int | None, Receipt] = field(default_factory=dict)
    todo: list[tuple[Job, str]] = field(default_factory=list)  # with the reason in words
    keys: list[str] = field(default_factory=list)  # of all parts, in order

    @property
    def complete(self) -> bool:
        """All parts are published."""
        return self.waits_for is None and not self.todo

    def sources(self) -> Source | list[Source]:
        """This complete step's artefacts, as input of others."""
        receipts = self.done.values()  # in part order, as they were planned
        found = [Source(self.stage, r["key"], r["artefact"]["sha256"]) for r in receipts]
        return found if self.fanned else found[0]


@dataclass
class Plan:
    """All steps of one item, in order."""

    item: Item
    steps: dict[str, Step]
    file_hashes: dict[str, str | None]

    @property
    def todo(self) -> list[tuple[Job, str]]:
        """Jobs that can run now, with reasons."""
        return [entry for step in self.steps.values() for entry in step.todo]


@dataclass
class Planner:
    """Plans items against a store. Remembers file hashes and verified receipts, so planning again costs little."""

    stages: Sequence[Stage]
    params: Mapping[str, StageParams]
    store: Store
    delivery: Delivery | None = None
    repair: bool = True  # set damaged artefacts aside (False: only look)
    _hashes: dict[Path, str] = field(default_factory=dict)
    _history: dict[str, dict[tuple[str, int | None], Receipt]] = field(default_factory=dict)

    def plan(self, item: Item) -> Plan:
        """The item's state now. InputError if a source file cannot be read."""
        hashes = {name: self._hash(path) for name, path in item.files.items()}
        plan = Plan(item, {}, hashes)
        for stage in self.stages:
            plan.steps[stage.name] = self._step(stage, plan)
        if self.delivery:
            plan.steps[self.delivery.name] = self._delivery(self.delivery, plan)
        return plan

    def _hash(self, path: Path | None) -> str | None:
        if path is None:
            return None
        if path not in self._hashes:
            self._hashes[path] = keys.file_sha256(path)
        return self._hashes[path]

    def _step(self, stage: Stage, plan: Plan) -> Step:
        step = Step(stage.name, fanned=stage.fan_out is not None)
        step.waits_for = next((name for name in stage.inputs if not plan.steps[name].complete), None)
        if step.waits_for:
            return step
        inputs = {name: plan.steps[name].sources() for name in stage.inputs}
        upstream = {name: _content(sources) for name, sources in inputs.items()}
        files = {name: plan.file_hashes[name] for name in stage.files}
        paths = {name: str(path) if (path := plan.item.files[name]) else None for name in stage.files}
        identity = keys.job_identity(stage, self.params[stage.name], upstream, files, None)
        for part in _parts(stage, plan):
            named = {**identity, "part": part}
            key = keys.digest(named)
            step.keys.append(key)
            receipt, problem = self.store.find(stage.name, key, self.repair)
            if receipt:
                step.done[part] = receipt
            else:
                job = Job(plan.item.name, stage.name, part, key, named, inputs, paths)
                step.todo.append((job, problem or self._why(job) or "not in the cache any more"))
        return step

    def _delivery(self, delivery: Delivery, plan: Plan) -> Step:
        step = Step(delivery.name)
        step.waits_for = next((name for name, other in plan.steps.items() if not other.complete), None)
        if step.waits_for:
            return step
        inputs = {name: plan.steps[name].sources() for name in delivery.inputs}
        meta = delivery.meta(plan.item, plan)
        # the hashed inputs look like a stage's, with the meta data in place of parameters
        identity = {
            "stage": delivery.name, "version": delivery.version, "params": {**meta, "folder": plan.item.name},
            "inputs": {name: _content(sources) for name, sources in inputs.items()}, "files": {}, "part": None,
        }  # fmt: skip
        folder = delivery.folder / plan.item.name
        key = keys.digest(identity)
        step.keys.append(key)
        receipt, problem = self.store.find(delivery.name, key, self.repair)
        if receipt:
            problem = _files_problem(folder, receipt["files"])
        if receipt and not problem:
            step.done[None] = receipt
        else:
            job = Job(plan.item.name, delivery.name, None, key, identity, inputs, {}, str(folder), meta)
            # files that belong to another outcome are not damaged: that outcome was the last, and this one differs
            step.todo.append((job, self._why(job) or problem or "not in the cache any more"))
        return step

    def _why(self, job: Job) -> str:
        """Compare with the last result of the same image and stage; "" if there is no difference."""
        if job.stage not in self._history:
            self._history[job.stage] = self.store.history(job.stage)
        previous = self._history[job.stage].get((job.item, job.part))
        if previous is None:
            return "new"
        return "; ".join(keys.differences(previous["identity"], job.identity))


def _content(sources: Source | list[Source]) -> str | list[str]:
    return [source.sha256 for source in sources] if isinstance(sources, list) else sources.sha256


def _parts(stage: Stage, plan: Plan) -> Sequence[int | None]:
    if stage.fan_out is None:
        return [None]
    receipt = plan.steps[stage.fan_out].done[None]
    return range(int(receipt["scalars"]["count"]))


def _files_problem(folder: Path, files: Mapping[str, str]) -> str:
    """What is wrong with delivered files ({name: SHA-256}), "" if they are all intact."""
    for name, sha256 in files.items():
        path = folder / name
        if not path.is_file():
            return f"{name} is missing"
        if keys.file_sha256(path) != sha256:
            return f"{name} was changed"
    return ""
