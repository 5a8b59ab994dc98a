"""The pipeline: the stages in their order, and what becomes of their results. Add a stage here and nowhere else."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from . import cluster, config, detect, frontal, images, irradiance, surface
from .engine.plan import Delivery, Item, Plan, Planner
from .engine.stage import Arrays, Stage
from .engine.store import Store
from .results import VERSION as RESULTS_VERSION

PIPELINE: tuple[Stage, ...] = (
    images.STAGE, detect.STAGE, cluster.STAGE, frontal.STAGE, surface.STAGE, irradiance.STAGE,
)  # fmt: skip


def items(found: Sequence[images.ImageItem]) -> list[Item]:
    """The engine's view of images and their masks."""
    return [Item(image.name, {"image": image.path, "mask": image.mask}) for image in found]


def planner(out: Path, params: config.Params, repair: bool = True) -> Planner:
    """A planner of the whole pipeline with the store in ``out/.store`` and results in ``out/<image name>``."""
    text = config.to_yaml(params, PIPELINE)

    def meta(item: Item, plan: Plan) -> dict[str, Any]:
        return describe(item, plan, text)

    delivery = Delivery(RESULTS_VERSION, deliver, ("image", "frontal", "surface", "irradiance"), out, meta)
    return Planner(PIPELINE, params, Store(out / ".store"), delivery, repair)


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


def figures(plan: Plan) -> dict[str, Any]:
    """Numbers for the table, from the receipts of a complete plan: instances, textons usable and tried."""
    textons = list(plan.steps["frontal"].done.values())
    surface_arrays = plan.steps["surface"].done[None]["arrays"]
    return {
        "instances": surface_arrays["instance/xy"]["shape"][0],
        "textons_used": sum(bool(receipt["scalars"]["usable"]) for receipt in textons),
        "textons": len(textons),
    }
