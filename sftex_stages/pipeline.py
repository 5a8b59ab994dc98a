"""The pipeline: the stages in their order, and what becomes of their results. Add a stage here and nowhere else."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from . import chart, cluster, config, detect, enrich, frontal, images, irradiance, surface
from .engine.plan import Delivery, Item, Plan, Planner
from .engine.stage import Arrays, Stage
from .engine.store import Store, read_receipt
from .errors import StoreError
from .results import VERSION as RESULTS_VERSION

PIPELINE: tuple[Stage, ...] = (
    images.STAGE, detect.STAGE, cluster.STAGE, frontal.STAGE, enrich.STAGE, surface.STAGE, irradiance.STAGE,
    chart.STAGE,
)  # fmt: skip


def items(found: Sequence[images.ImageItem]) -> list[Item]:
    """The engine's view of images and their masks."""
    return [Item(image.name, {"image": image.path, "mask": image.mask}) for image in found]


def planner(
    out: Path, params: config.Params, repair: bool = True, until: str | None = None, force: Sequence[str] = ()
) -> Planner:
    """A planner of the pipeline with the store in ``out/.store`` and results in ``out/<image name>``.

    `until`: only this stage and what it needs, and no results. `force`: stages that are done again in any case.
    """
    text = config.to_yaml(params, PIPELINE)

    def meta(item: Item, plan: Plan) -> dict[str, Any]:
        return describe(item, plan, text)

    delivery = Delivery(RESULTS_VERSION, deliver, ("image", "frontal", "surface", "irradiance", "chart"), out, meta)
    whole = until in (None, delivery.name)
    stages = PIPELINE if whole else needed(until)
    return Planner(stages, params, Store(out / ".store"), delivery if whole else None, repair, frozenset(force))


def needed(stage: str | None) -> list[Stage]:
    """The stage and all that it needs, in order."""
    wanted = {stage}
    for other in reversed(PIPELINE):
        if other.name in wanted:
            wanted.update(other.inputs)
    return [other for other in PIPELINE if other.name in wanted]


def deliver(folder: Path, arrays: Mapping[str, Arrays | list[Arrays]], meta: dict[str, Any]) -> list[Path]:
    """Write result.h5 and everything beside it."""
    from .results import write_outputs  # pictures and meshes: imported only where they are made

    return write_outputs(folder, arrays, meta)


def describe(item: Item, plan: Plan, config_yaml: str) -> dict[str, Any]:
    """What the archive says of its origin: image, configuration, keys and versions of what computed it."""
    path = item.files["image"]
    steps = [plan.steps[stage.name] for stage in PIPELINE]
    versions: dict[str, str] = {}
    for step in steps:
        for receipt in step.done.values():
            versions.update(receipt["software"])
    return {
        "image_name": path.name if path else item.name,
        "image_sha256": plan.file_hashes["image"],
        "config_yaml": config_yaml,
        "keys": {step.stage: step.keys if step.fanned else step.keys[0] for step in steps},
        "versions": versions,
    }


def figures(plan: Plan, store: Store) -> dict[str, Any]:
    """Numbers for the table, from the receipts of a complete plan: instances, textons usable and tried."""
    textons = list(plan.steps["frontal"].done.values())
    try:
        receipt, _ = read_receipt(store.path("surface", plan.steps["surface"].keys[0], ".json"))
    except (OSError, ValueError) as error:
        raise StoreError(f"surface of {plan.item.name}: its receipt cannot be read ({error}); run sftex again") from error
    return {
        "instances": receipt["arrays"]["instance/xy"]["shape"][0],
        "textons_used": sum(bool(receipt["scalars"]["usable"]) for receipt in textons),
        "textons": len(textons),
    }
