"""The real stages as a pipeline: consistent records, the shipped configuration, the first stages on a real file."""

from pathlib import Path

import numpy as np
import pytest

from sftex_stages import config, pipeline
from sftex_stages.engine import keys

ROOT = Path(__file__).parents[1]


def test_shipped_configuration_is_the_default():
    """If this fails after a change of parameters: ``sftex config > pipeline.yaml``."""
    assert (ROOT / "pipeline.yaml").read_text(encoding="utf-8") == config.default_yaml(pipeline.PIPELINE)


def test_records_are_consistent():
    names = [stage.name for stage in pipeline.PIPELINE]
    assert names == ["image", "detect", "cluster", "frontal", "enrich", "surface", "irradiance", "chart"]
    for number, stage in enumerate(pipeline.PIPELINE):
        assert set(stage.inputs) <= set(names[:number]), "a stage depends on earlier ones only"
        assert stage.fan_out is None or stage.fan_out in stage.inputs
        for key, field in stage.params.model_fields.items():
            assert field.description, f"{stage.name}.{key} needs a description"


def test_every_parameter_is_in_the_key_of_its_stage_alone():
    for stage in pipeline.PIPELINE:
        identity = keys.job_identity(stage, stage.params(), {}, {}, None)
        assert identity["params"].keys() == stage.params.model_fields.keys()


@pytest.mark.parametrize("stage", pipeline.PIPELINE, ids=lambda stage: stage.name)
def test_parameters_survive_the_key(stage):
    """Numbers that differ in the last bit give different keys."""
    for key, value in stage.params().model_dump().items():
        if isinstance(value, float):
            other = stage.params().model_copy(update={key: np.nextafter(value, 0).item()})
            assert len({keys.digest(keys.job_identity(stage, p, {}, {}, None)) for p in (stage.params(), other)}) == 2
