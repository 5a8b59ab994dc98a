"""The configuration: what is accepted, and where each mistake is said to be."""

import pytest
from pydantic import Field

from sftex_stages import config
from sftex_stages.engine.stage import Stage, StageParams
from sftex_stages.errors import ConfigError


class Find(StageParams):
    tolerance: float = Field(1e-6, gt=0, le=1, description="smallest step")
    count: int | None = Field(None, ge=1, description="how many; null: as many as there are")
    kind: str = Field("a", pattern="^[ab]$", description="which")


class Fit(StageParams):
    weights: tuple[float, ...] = Field((1.0, 0.5), description="of the terms")
    robust: bool = Field(True, description="leave outliers out")


class Nothing(StageParams):
    pass


STAGES = [Stage("load", 1, Nothing, dict), Stage("find", 1, Find, dict), Stage("fit", 1, Fit, dict)]


def message(text):
    with pytest.raises(ConfigError) as caught:
        config.parse(text, STAGES)
    return str(caught.value)


@pytest.mark.parametrize("text", ["", "# nothing\n", "find:\n", "find: {}\nload:\n", "---\n"])
def test_what_is_missing_has_its_default(text):
    assert config.parse(text, STAGES) == {"load": Nothing(), "find": Find(), "fit": Fit()}


def test_values_are_read_as_they_are_written():
    params = config.parse("fit:\n  weights: [1, 2e-3]\n  robust: false\nfind:\n  tolerance: 1e-7\n  count: 3\n", STAGES)
    assert params["fit"] == Fit(weights=(1.0, 2e-3), robust=False)
    assert params["find"] == Find(tolerance=1e-7, count=3)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("find:\n  tolerence: 1", 'pipeline.yaml:2:3: find.tolerence: unknown key; did you mean "tolerance"?'),
        ("\nfind:\n  x: 1", "pipeline.yaml:3:3: find.x: unknown key; find has tolerance, count, kind"),
        ("find:\n  robust: true", 'pipeline.yaml:2:3: find.robust: unknown key; it belongs in section "fit"'),
        ("load:\n  x: 1", "pipeline.yaml:2:3: load.x: unknown key; load has no parameters"),
        ("fnd:\n  count: 1", 'pipeline.yaml:1:1: fnd: unknown section; did you mean "find"?'),
        ("xyz: 1", "pipeline.yaml:1:1: xyz: unknown section; there are load, find, fit"),
        ("count: 3", 'pipeline.yaml:1:1: count: not a section; the key belongs in section "find"'),
        ("find: 3", "pipeline.yaml:1:1: find: expected keys indented below it, not 3"),
        ("- find", "pipeline.yaml:1:1: expected sections such as 'frontal:' with keys indented below them"),
        ("find:\n  count: '3'", 'pipeline.yaml:2:3: find.count: should be a valid integer, not "3"'),
        ("find:\n  count: 3.5", "find.count: should be a valid integer"),
        ("find:\n  count: 0", "pipeline.yaml:2:3: find.count: should be greater than or equal to 1, not 0"),
        ("find:\n  tolerance: 1e-6x", 'find.tolerance: should be a valid number, not "1e-6x"'),
        ("find:\n  tolerance: .inf", "find.tolerance: should be"),
        ("find:\n  tolerance: null", "find.tolerance: should be a valid number, not null"),
        ("find:\n  kind: c", "pipeline.yaml:2:3: find.kind: "),
        ("fit:\n  robust: off", 'pipeline.yaml:2:3: fit.robust: should be a valid boolean, not "off"'),
        ("fit:\n  robust: 1", "fit.robust: should be a valid boolean, not 1"),
        ("fit:\n  weights: [1, x]", 'pipeline.yaml:2:3: fit.weights.1: should be a valid number, not "x"'),
        ("find:\n  count: 1\n  count: 2", "pipeline.yaml:3:3: find.count: given twice, first in line 2; keep one"),
        ("find:\n  count: 1\nfind:\n", "pipeline.yaml:3:1: find: given twice, first in line 1; keep one"),
        ("find: [", "pipeline.yaml:1:8: not valid YAML: "),
        ("find:\n\tcount: 1", "pipeline.yaml:2:1: not valid YAML: "),
        ("find: \x00", "pipeline.yaml: not valid YAML: "),
        ("find:\n  count: !!python/object:os.system 1", "pipeline.yaml:2:10: find.count: tags (!) and anchors"),
        ("find: &a\n  count: *a", "tags (!) and anchors (&, *) are not supported; write it out"),
        ("? [1, 2]\n: 3", "pipeline.yaml:1:3: a key must be one word"),
    ],
)
def test_a_mistake_is_named_with_its_place(text, expected):
    assert expected in message(text)


def test_all_mistakes_are_told_at_once_in_order():
    lines = message("find:\n  count: x\n  kindd: a\nfit:\n  robust: 7\n").splitlines()
    assert [line.split(": ")[:2] for line in lines] == [
        ["pipeline.yaml:2:3", "find.count"], ["pipeline.yaml:3:3", "find.kindd"], ["pipeline.yaml:5:3", "fit.robust"],
    ]  # fmt: skip


def test_file_that_cannot_be_read(tmp_path):
    with pytest.raises(ConfigError, match=r"none\.yaml: cannot be read .*--config"):
        config.load(tmp_path / "none.yaml", STAGES)
    (tmp_path / "picture.yaml").write_bytes(b"\x89PNG\xff\xfe")
    with pytest.raises(ConfigError, match=r"picture\.yaml: is not a text file"):
        config.load(tmp_path / "picture.yaml", STAGES)


def test_written_configuration_is_complete_and_reads_back():
    params = {"load": Nothing(), "find": Find(tolerance=1e-7, count=5, kind="b"), "fit": Fit(weights=(1.0, 3e-12))}
    text = config.to_yaml(params, STAGES)
    assert config.parse(text, STAGES) == params
    assert "  # smallest step (0 < value ≤ 1)\n  tolerance: 1.0e-07\n" in text
    assert "  # how many; null: as many as there are (1 ≤ value)\n  count: 5\n" in text
    assert "load: {}" in text
