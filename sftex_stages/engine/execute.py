"""Running: one flat queue of all jobs that are ready, of all images, worked off by joblib's processes.

Jobs of the first image, and of its latest stage, go first: results appear early and a killed run leaves whole images
behind. An image is planned again whenever all its queued jobs are done. A failed job fails its image only.
"""

from __future__ import annotations

import heapq
import os
import re
import threading
import traceback
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

from ..errors import SftexError
from .plan import Item, Job, Plan, Planner
from .store import DamagedError, Receipt, read_receipt
from .worker import Outcome, Task, perform, start

_MOST_ATTEMPTS = 3  # at one job: a store that loses what was just written is not worked around for ever


@dataclass
class StageResult:
    """What a run did about one stage of one item."""

    jobs: int = 0  # known so far; 0 if the stage was not reached
    computed: int = 0
    seconds: float = 0.0  # of all computed jobs together
    peak_memory_mb: float = 0.0
    reasons: Counter[str] = field(default_factory=Counter)  # of what had to run: words -> number of jobs


@dataclass
class ItemResult:
    """What a run did about one item. `plan` is its last plan (None if it could not be planned)."""

    item: Item
    stages: dict[str, StageResult]
    plan: Plan | None = None
    error: str = ""
    failed_stage: str = ""
    log: Path | None = None

    @property
    def complete(self) -> bool:
        """Everything that was asked for is there."""
        return not self.error and self.plan is not None and self.plan.complete


class Watcher(Protocol):
    """Is told, in the main thread, how far things are."""

    def progress(self, result: ItemResult, stage: str, done: int, jobs: int) -> None:
        """One more job of `stage` is done (0 done: it begins)."""

    def finished(self, result: ItemResult) -> None:
        """The item is complete or failed."""


def execute(
    planner: Planner, items: Sequence[Item], workers: int | None, watcher: Watcher, fail_fast: bool = False
) -> list[ItemResult]:
    """Bring all items up to date. `workers`: processes (None: as many as there are processors).

    Starts no process, and writes nothing, if nothing has to be computed; StoreError if something has to be and the store
    cannot be written. Errors of jobs and items are in the results, never raised. `fail_fast`: after the first of them no
    further job is started; what is running is finished and kept.
    """
    run = _Run(planner, items, watcher, fail_fast)
    for number in range(len(items)):
        run.advance(number)
    if run.queue and not run.stopped:
        planner.store.prepare()
    while run.queue and not run.stopped:
        _wave(run, workers)
    return run.results


@dataclass
class _Entry:
    """A job in the queue or with a worker, and the items that wait for it (two equal images share their jobs)."""

    job: Job
    items: list[int]


class _Run:
    """The state of one run. `take` is called from joblib's thread, everything else from the main thread."""

    def __init__(self, planner: Planner, items: Sequence[Item], watcher: Watcher, fail_fast: bool) -> None:
        names = [stage.name for stage in planner.stages] + ([planner.delivery.name] if planner.delivery else [])
        self.planner, self.watcher = planner, watcher
        self.fail_fast, self.stopped = fail_fast, False
        self.depth = {name: number for number, name in enumerate(names)}
        self.results = [ItemResult(item, {name: StageResult() for name in names}) for item in items]
        self.queue: list[tuple[tuple[int, int, int], str]] = []  # heap of (priority, key)
        self.entries: dict[str, _Entry] = {}
        self.in_flight: dict[str, Task] = {}
        self.pending: list[Counter[str]] = [Counter() for _ in items]  # stage -> queued or running jobs
        self.attempts: Counter[str] = Counter()
        self.lock = threading.Lock()

    def advance(self, number: int) -> None:
        """Plan an item and queue what it needs; or it is complete."""
        result = self.results[number]
        try:
            plan = result.plan = self.planner.plan(result.item)
        except SftexError as error:
            return self.fail(number, str(error))
        except Exception as error:  # a defect met with this image: the others go on
            where = traceback.extract_tb(error.__traceback__)[-1]
            return self.fail(number, f"unexpected {type(error).__name__} at {where.filename}:{where.lineno}: {error}")
        for name, step in plan.steps.items():
            result.stages[name].jobs = len(step.keys)
        for job, reason in plan.todo:
            self._enqueue(number, job, reason)
        if result.error:
            return
        for name in {job.stage for job, _ in plan.todo}:
            self._tell(number, name)
        if not plan.todo:
            self.watcher.finished(result)

    def _enqueue(self, number: int, job: Job, reason: str) -> None:
        self.attempts[job.key] += 1
        if self.attempts[job.key] > _MOST_ATTEMPTS * len(self.results):
            return self.fail(number, f"published {_MOST_ATTEMPTS} times and never found intact; check the disk", job)
        self.results[number].stages[job.stage].reasons[reason] += 1
        self.pending[number][job.stage] += 1
        priority = (number, -self.depth[job.stage], -1 if job.part is None else job.part)
        with self.lock:
            if job.key in self.entries:
                self.entries[job.key].items.append(number)
            else:
                self.entries[job.key] = _Entry(job, [number])
                heapq.heappush(self.queue, (priority, job.key))

    def take(self) -> Iterator[Task]:
        """Tasks, most urgent first, until the queue is empty."""
        while True:
            with self.lock:
                if not self.queue or self.stopped:
                    return
                entry = self.entries[heapq.heappop(self.queue)[1]]
                if all(self.results[number].error for number in entry.items):
                    del self.entries[entry.job.key]
                    continue
                task = self.in_flight[entry.job.key] = self._task(entry.job)
            yield task

    def _task(self, job: Job) -> Task:
        planner = self.planner
        if planner.delivery and job.stage == planner.delivery.name:
            return Task(os.getcwd(), planner.store.root, planner.delivery, None, job)
        stage = next(stage for stage in planner.stages if stage.name == job.stage)
        return Task(os.getcwd(), planner.store.root, stage, planner.params[stage.name], job)

    def settle(self, outcome: Outcome) -> None:
        """Take note of what a worker did; plan those items again that have nothing left to wait for."""
        job = outcome.job
        with self.lock:
            self.in_flight.pop(job.key, None)
            entry = self.entries.pop(job.key)
        if outcome.damage:
            outcome = self._set_aside(outcome, outcome.damage)
        if outcome.receipt:
            self.planner.store.accept(job.stage, job.key)
            self._compare(job, outcome.receipt)
        for number in entry.items:
            result = self.results[number]
            self.pending[number][job.stage] -= 1
            if result.error:
                continue
            if outcome.error:
                self.fail(number, outcome.error, job, outcome.log)
                continue
            if outcome.receipt:
                stage = result.stages[job.stage]
                stage.computed += 1
                stage.seconds += outcome.receipt["seconds"]
                stage.peak_memory_mb = max(stage.peak_memory_mb, outcome.receipt["peak_memory_mb"])
                self._tell(number, job.stage)
            if not self.pending[number].total():
                self.advance(number)

    def _compare(self, job: Job, receipt: Receipt) -> None:
        """A forced job must have the outcome that it replaces: keys promise it."""
        before = self.planner.replaced.pop(job.key, None)
        if before and before != receipt["artefact"]["sha256"]:
            part = "" if job.part is None else f" (part {job.part})"
            self.planner.store.notices.append(
                f"{job.item} {job.stage}{part}: computed again with another outcome than was cached; other versions of "
                "libraries, or the stage changed without a new version, or it is not deterministic"
            )

    def _tell(self, number: int, stage: str) -> None:
        jobs = self.results[number].stages[stage].jobs
        self.watcher.progress(self.results[number], stage, jobs - self.pending[number][stage], jobs)

    def _set_aside(self, outcome: Outcome, damage: DamagedError) -> Outcome:
        """Planning again then recomputes the damaged input."""
        try:
            self.planner.store.reject(damage)
        except SftexError as error:
            return Outcome(outcome.job, error=str(error))
        return outcome

    def fail(self, number: int, error: str, job: Job | None = None, log: Path | None = None) -> None:
        """Mark an item as failed; its queued jobs are dropped when their turn comes."""
        result = self.results[number]
        if job:
            part = "" if job.part is None else f" (part {job.part})"
            result.failed_stage, error = job.stage, f"{job.stage}{part}: {error}"
        result.error, result.log = error, log
        self.stopped = self.stopped or self.fail_fast
        self.watcher.finished(result)


def _wave(run: _Run, workers: int | None) -> None:
    """Work until the queue has run empty once; jobs that become ready meanwhile are taken along."""
    from joblib.externals.loky import cpu_count
    from joblib.externals.loky.process_executor import BrokenProcessPool

    try:
        for outcome in _parallel(run.take(), workers or cpu_count()):
            run.settle(outcome)
    except BrokenProcessPool:
        # A job has taken its process, and joblib's whole pool, with it; which one is not known.
        for task in list(run.in_flight.values()):
            run.settle(_alone(task, run.planner))


def _alone(task: Task, planner: Planner) -> Outcome:
    """Run a suspect in a process of its own; if that dies too, the suspect is the killer."""
    from joblib.externals.loky.process_executor import BrokenProcessPool

    job, store = task.job, planner.store
    if job.stage not in planner.force and store.find(job.stage, job.key)[0]:  # it was published just before the crash
        return Outcome(job, receipt=read_receipt(store.path(job.stage, job.key, ".json"))[0])
    try:
        return next(iter(_parallel(iter([task]), 1)))
    except BrokenProcessPool as error:
        found = re.search(r"\{(.*)\}", str(error))
        how = found.group(1) if found else "unknown exit code"
        memory = "; probably for want of memory, try fewer --jobs" if "SIGKILL" in how else ""
        log = planner.store.root / "crashes.log"
        return Outcome(task.job, error=f"the process that computed it died ({how}){memory}; see {log}", log=log)


def _parallel(tasks: Iterator[Task], workers: int) -> Iterator[Outcome]:
    """Outcomes as they come. Always in other processes with one thread each: same bytes whatever the number of jobs."""
    from joblib import Parallel, delayed, parallel_config

    # joblib runs n_jobs=1 in this process, where a crash would end everything: one task at a time in a pool of two.
    ahead = workers + 1 if workers > 1 else 1
    with parallel_config("loky", inner_max_num_threads=1, initializer=start, initargs=(os.getpid(),)):
        parallel = Parallel(
            n_jobs=max(2, workers), return_as="generator_unordered", batch_size=1, pre_dispatch=ahead, max_nbytes=None
        )
    calls = (delayed(perform)(task) for task in tasks)
    outcomes: Iterator[Outcome] = parallel(calls)
    return outcomes
