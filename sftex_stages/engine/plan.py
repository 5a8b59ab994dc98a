"""The planner: which jobs an image needs, which of them are done, and why the others are not.

State is derived, each time, from the stages' records, the parameters, the source files and the receipts in the store.
A stage's keys contain the hashes of its upstream artefacts, so they are known only once everything upstream is
published: a plan ends in front of the first stage that has work to do, and is made again when that work is done.
The same plan serves running, planning, status and explaining. An item's ledger saves looking again at what was found
intact before.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from ..errors import StoreError
from . import keys, ledger
from .keys import Identity
from .stage import Arrays, Stage, StageParams
from .store import Receipt, Store, stamp

_MOST_PARTS = 100_000  # of one item: a receipt from elsewhere may claim anything


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


class Source(NamedTuple):
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
    identity: Identity
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
    ahead: list[str] = field(default_factory=list)  # why it will run in any case, known while it still waits
    expected: int | None = None  # number of jobs: the last run's while it waits, None if there was none
    identity: Identity | None = None  # of all parts together
    remembered: bool = False  # all of it was in the item's ledger
    delivered: dict[str, str] = field(default_factory=dict)  # of a delivery: its intact files and their stamps
    _sources: list[Source] | None = None

    @property
    def complete(self) -> bool:
        """All parts are published."""
        return self.waits_for is None and not self.todo

    def sources(self) -> Source | list[Source]:
        """This complete step's artefacts, as input of others."""
        if self._sources is None:  # in part order, as they were planned
            self._sources = [Source(self.stage, r["key"], r["artefact"]["sha256"]) for r in self.done.values()]
        return self._sources if self.fanned else self._sources[0]


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

    @property
    def complete(self) -> bool:
        """Nothing is left to do."""
        return all(step.complete for step in self.steps.values())


@dataclass
class Planner:
    """Plans items against a store. Remembers file hashes and verified receipts, so planning again costs little."""

    stages: Sequence[Stage]
    params: Mapping[str, StageParams]
    store: Store
    delivery: Delivery | None = None
    repair: bool = True  # set damaged artefacts aside, keep ledgers (False: only look)
    force: frozenset[str] = frozenset()  # stages that are done again even where they are cached
    replaced: dict[str, str] = field(default_factory=dict)  # key -> SHA-256 of what a forced job is about to replace
    _hashes: dict[Path, str] = field(default_factory=dict)
    _ledgers: dict[str, ledger.Steps] = field(default_factory=dict)

    def plan(self, item: Item) -> Plan:
        """The item's state now. InputError if a source file, StoreError if the store cannot be read."""
        hashes = {name: self._hash(path) for name, path in item.files.items()}
        if item.name not in self._ledgers:
            self._ledgers[item.name] = ledger.read(self.store.root, item.name)
        plan = Plan(item, {}, hashes)
        for stage in self.stages:
            plan.steps[stage.name] = self._step(stage, plan)
        if self.delivery:
            plan.steps[self.delivery.name] = self._delivery(self.delivery, plan)
        if self.repair:
            self._remember(plan)
        return plan

    def _hash(self, path: Path | None) -> str | None:
        if path is None:
            return None
        if path not in self._hashes:
            self._hashes[path] = keys.file_sha256(path)
        return self._hashes[path]

    def _step(self, stage: Stage, plan: Plan) -> Step:
        step = Step(stage.name, fanned=stage.fan_out is not None)
        last = self._ledgers[plan.item.name].get(stage.name)
        files = {name: plan.file_hashes[name] for name in stage.files}
        step.waits_for = next((name for name in stage.inputs if not plan.steps[name].complete), None)
        if step.waits_for:
            identity = keys.job_identity(stage, self.params[stage.name], {}, files, None)
            if last:
                step.ahead = keys.differences({**last["identity"], "inputs": {}}, identity)
                step.expected = len(last["jobs"])
            if stage.name in self.force:
                step.ahead.append("forced")
            return step
        inputs = {name: plan.steps[name].sources() for name in stage.inputs}
        upstream = {name: _content(sources) for name, sources in inputs.items()}
        paths = {name: str(path) if (path := plan.item.files[name]) else None for name in stage.files}
        identity = step.identity = keys.job_identity(stage, self.params[stage.name], upstream, files, None)
        # the same identity has the same keys: they, and what was verified, need not be worked out again
        known = {part: receipt for part, receipt in last["jobs"]} if last and last["identity"] == identity else {}
        step.remembered = bool(known)
        for part in _parts(stage, plan):
            receipt = known.get(part)
            if receipt and self.store.trust(stage.name, receipt):
                key, problem = receipt["key"], ""
            else:
                step.remembered = False
                key = keys.digest({**identity, "part": part})
                receipt, problem = self.store.find(stage.name, key, self.repair)
            step.keys.append(key)
            if receipt and stage.name in self.force and (stage.name, key) not in self.store.fresh:
                self.replaced[key] = receipt["artefact"]["sha256"]
                receipt, problem = None, "forced"
            if receipt:
                step.done[part] = receipt
            else:
                named = {**identity, "part": part}
                job = Job(plan.item.name, stage.name, part, key, named, inputs, paths)
                step.todo.append((job, problem or self._why(job) or "not in the cache any more"))
        step.expected = len(step.keys)
        return step

    def _delivery(self, delivery: Delivery, plan: Plan) -> Step:
        last = self._ledgers[plan.item.name].get(delivery.name)
        step = Step(delivery.name, expected=1 if last else None)
        step.waits_for = next((name for name, other in plan.steps.items() if not other.complete), None)
        if step.waits_for:
            step.ahead = ["forced"] if delivery.name in self.force else []
            return step
        inputs = {name: plan.steps[name].sources() for name in delivery.inputs}
        meta = delivery.meta(plan.item, plan)
        # the hashed inputs look like a stage's, with the meta data in place of parameters
        identity = step.identity = {
            "stage": delivery.name, "version": delivery.version, "params": {**meta, "folder": plan.item.name},
            "inputs": {name: _content(sources) for name, sources in inputs.items()}, "files": {}, "part": None,
        }  # fmt: skip
        folder = delivery.folder / plan.item.name
        receipt, problem = last["jobs"][0][1] if last and last["identity"] == identity else None, ""
        if receipt and self.store.trust(delivery.name, receipt):
            key = receipt["key"]
        else:
            key = keys.digest(identity)
            receipt, problem = self.store.find(delivery.name, key, self.repair)
        step.keys.append(key)
        if receipt and delivery.name in self.force and (delivery.name, key) not in self.store.fresh:
            receipt, problem = None, "forced"
        if receipt:
            # what a file of an earlier delivery was known to hold says nothing if this one wants something else in it
            same = last is not None and last["jobs"][0][1]["files"] == receipt["files"]
            known = last.get("files", {}) if last and same else {}
            step.delivered, problem = _intact(folder, receipt["files"], known)
        if receipt and not problem:
            step.done[None] = receipt
        else:
            job = Job(plan.item.name, delivery.name, None, key, identity, inputs, {}, str(folder), meta)
            # files that belong to another outcome are not damaged: that outcome was the last, and this one differs
            step.todo.append((job, self._why(job) or problem or "not in the cache any more"))
        return step

    def _why(self, job: Job) -> str:
        """Compare with what the last run of the same item found; "" if there is no difference."""
        last = self._ledgers[job.item].get(job.stage)
        if last is None or all(part != job.part for part, _ in last["jobs"]):
            return "new"
        return "; ".join(keys.differences(last["identity"], job.identity))

    def _remember(self, plan: Plan) -> None:
        """Bring the item's ledger up to date. A store that cannot be written keeps its old one, which does no harm."""
        old = self._ledgers[plan.item.name]
        steps = dict(old)
        for name, step in plan.steps.items():
            if step.complete and step.identity and not step.remembered:
                steps[name] = ledger.entry(step.identity, step.done, step.delivered)
        if steps != old:
            self._ledgers[plan.item.name] = steps
            with contextlib.suppress(OSError):
                ledger.write(self.store.root, plan.item.name, steps)


def _content(sources: Source | list[Source]) -> str | list[str]:
    return [source.sha256 for source in sources] if isinstance(sources, list) else sources.sha256


def _parts(stage: Stage, plan: Plan) -> Sequence[int | None]:
    if stage.fan_out is None:
        return [None]
    receipt = plan.steps[stage.fan_out].done[None]
    count = receipt["scalars"].get("count", -1)
    if not 0 <= count <= _MOST_PARTS:
        raise StoreError(f"{stage.fan_out} of {plan.item.name} claims {count} parts; at most {_MOST_PARTS} are planned")
    return range(count)


def _intact(folder: Path, files: Mapping[str, str], known: Mapping[str, str]) -> tuple[dict[str, str], str]:
    """Stamps of delivered files ({name: SHA-256}), and what is wrong with them ("" if nothing).

    `known`: stamps of files that were found intact before; files that have them still are not hashed again.
    """
    stamps: dict[str, str] = {}
    for name, sha256 in files.items():
        path = folder / name
        try:
            stamps[name] = stamp(os.stat(path))
        except OSError:
            return {}, f"{name} is missing"
        if known.get(name) != stamps[name] and keys.file_sha256(path) != sha256:
            return {}, f"{name} was changed"
    return stamps, ""
