"""Progress on stderr: bars on a terminal, plain lines elsewhere."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from .engine.execute import ItemResult, Watcher

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID

_ROWS = 8  # images shown at once


class Lines:
    """One line per finished stage and image."""

    def progress(self, result: ItemResult, stage: str, done: int, jobs: int) -> None:
        """Says so when all jobs of a stage are done."""
        if done == jobs:
            state = result.stages[stage]
            many = f"{state.computed} jobs, " if jobs > 1 else ""
            _say(f"{result.item.name}: {stage} done ({many}{state.seconds:.1f} s)")

    def finished(self, result: ItemResult) -> None:
        """Says how it ended."""
        computed = any(state.computed for state in result.stages.values())
        _say(failure(result) if result.error else f"{result.item.name}: {'finished' if computed else 'up to date'}")


class Bars:
    """A bar for all images and one for each image that is being worked on."""

    def __init__(self, progress: Progress, images: int) -> None:
        self.bars = progress
        self.total = progress.add_task("images", total=images)
        self.rows: dict[str, TaskID] = {}

    def progress(self, result: ItemResult, stage: str, done: int, jobs: int) -> None:
        """Moves the image's bar."""
        name = result.item.name
        first = next(iter(result.stages))
        if name not in self.rows and (len(self.rows) >= _ROWS or (stage == first and done == 0 and len(self.rows) > 0)):
            return  # merely queued
        if name not in self.rows:
            self.rows[name] = self.bars.add_task("", total=jobs)
        self.bars.update(self.rows[name], description=f"{name} · {stage}", completed=done, total=jobs)

    def finished(self, result: ItemResult) -> None:
        """Removes the image's bar; a failure is told at once."""
        if result.item.name in self.rows:
            self.bars.remove_task(self.rows.pop(result.item.name))
        self.bars.advance(self.total)
        if result.error:
            self.bars.console.print(failure(result), style="red", markup=False, highlight=False, soft_wrap=True)


def failure(result: ItemResult) -> str:
    """One failed image in words."""
    return f"{result.item.name}: failed: {result.error}"


@contextmanager
def watch(images: int) -> Iterator[Watcher]:
    """The display that suits stderr."""
    if not sys.stderr.isatty():
        yield Lines()
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    text = TextColumn("{task.description}", markup=False)
    columns = (SpinnerColumn(), text, BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        yield Bars(progress, images)


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)
