"""A pipeline of toy stages. Every execution leaves a file in $TOY_LOG, so that tests count what really ran."""

import os
import signal
import time
import uuid
from pathlib import Path

import numpy as np
from pydantic import Field

from sftex_stages.engine.execute import execute
from sftex_stages.engine.plan import Delivery, Item, Planner
from sftex_stages.engine.stage import Stage, StageParams
from sftex_stages.engine.store import Store, write_atomically
from sftex_stages.errors import StageError, StoreError


def _log(name):
    Path(os.environ["TOY_LOG"], f"{name}-{uuid.uuid4().hex}").touch()


def executed():
    """Names of the jobs that ran since the last call, sorted."""
    found = sorted(Path(os.environ["TOY_LOG"]).iterdir())
    for path in found:
        path.unlink()
    return sorted(path.name.rsplit("-", 1)[0] for path in found)


class ReadParams(StageParams):
    scale: float = Field(1.0, gt=0, description="factor of all numbers")


class SplitParams(StageParams):
    parts: int = Field(3, ge=0, description="number of parts")
    comment: str = Field("", description="has no effect on the result")


class PartParams(StageParams):
    power: int = Field(1, description="exponent")
    trouble: str = Field("", description="what goes wrong in part 1")
    trouble_if: float = Field(-1.0, description="only for images that begin with this number")
    sleep: float = Field(0.0, description="seconds")


class SumParams(StageParams):
    offset: float = Field(0.0, description="added to the sum")


def read(inputs, params):
    _log("read")
    if not (text := inputs["text"].read_text().split()):
        raise StageError(f"{inputs['text']}: has no numbers; put some in")
    mask = inputs["mask"]
    return {"x": params.scale * np.array(text, float), "n": np.array(len(mask.read_text()) if mask else 0)}


def split(inputs, params):
    _log("split")
    return {"count": np.array(params.parts), "first": inputs["read"]["x"][:1]}


def part(inputs, params):
    number = inputs["part"]
    _log(f"part{number}")
    time.sleep(params.sleep)
    if number == 1 and params.trouble_if in (-1.0, float(inputs["split"]["first"][0])):
        if params.trouble == "mended":
            raise StageError("this part cannot be done")
        if params.trouble == "defect":
            return {"x": np.zeros(3)[7]}
        if params.trouble == "exit":
            os._exit(3)
        if params.trouble == "segv":
            os.kill(os.getpid(), signal.SIGSEGV)
        if params.trouble == "kill":  # as the kernel does when memory runs out
            os.kill(os.getpid(), signal.SIGKILL)
        if params.trouble == "mutate":
            inputs["read"]["x"][0] = 7
    # a big matrix product, which a multi-threaded BLAS would sum in another order
    noise = np.random.default_rng(number).standard_normal((150, 150))
    return {"x": inputs["read"]["x"] ** params.power * (noise @ noise).sum(), "word": np.array(f"Teil {number} äöü")}


def total(inputs, params):
    _log("total")
    return {"sum": np.array(sum(p["x"].sum() for p in inputs["part"]) + params.offset), "words": np.array(
        [str(p["word"]) for p in inputs["part"]], dtype=np.str_)}  # fmt: skip


STAGES = [
    Stage("read", 1, ReadParams, read, files=("text", "mask")),
    Stage("split", 1, SplitParams, split, inputs=("read",)),
    Stage("part", 1, PartParams, part, inputs=("read", "split"), fan_out="split"),
    Stage("total", 1, SumParams, total, inputs=("part",)),
]


def deliver(folder, arrays, meta):
    _log("deliver")
    try:
        write_atomically(folder / "sum.txt", f"{arrays['total']['sum']} {meta['title']}".encode(), folder)
    except OSError as error:
        raise StoreError(f"{folder}: cannot be written ({error.strerror})") from error
    return [folder / "sum.txt"]


def delivery(out, title="t"):
    return Delivery(1, deliver, ("read", "part", "total"), Path(out), lambda item, plan: {"title": title})


class Quiet:
    """A watcher that checks what it is told."""

    def progress(self, result, stage, done, jobs):
        assert 0 <= done <= jobs

    def finished(self, result):
        pass


def planner(out, repair=True, stages=None, title="t", **params):
    """A planner on out/.store; params: stage name -> dict of values."""
    stages = stages or STAGES
    values = {stage.name: stage.params(**params.get(stage.name, {})) for stage in stages}
    return Planner(stages, values, Store(Path(out) / ".store"), delivery(out, title), repair)


def item(path, mask=None):
    return Item(Path(path).stem, {"text": Path(path), "mask": mask})


def run(out, *paths, workers=2, watcher=None, **params):
    """Run the toys; returns (results by name, planner)."""
    plan = planner(out, **params)
    plan.store.prepare()
    results = execute(plan, [item(path) for path in paths], workers, watcher or Quiet())
    return {result.item.name: result for result in results}, plan


def artefacts(out):
    """{path below the store: bytes} of all artefacts."""
    root = Path(out) / ".store"
    return {str(path.relative_to(root)): path.read_bytes() for path in sorted(root.glob("*/??/*.h5"))}


if __name__ == "__main__":  # a run of its own, to be killed: toy_pipeline.py OUT SLEEP FILES…
    import sys

    # under its importable name, as the workers will see it
    import toy_pipeline

    toy_pipeline.run(sys.argv[1], *sys.argv[3:], part={"sleep": float(sys.argv[2])}, split={"parts": 12})
