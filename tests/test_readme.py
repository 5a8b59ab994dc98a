"""README.md says what the program does: its names exist, the program's names are in it, its examples run."""

from __future__ import annotations

import importlib.util
import json
import re
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from sftex_stages import cli
from sftex_stages.bench.figures import FIGURES
from sftex_stages.pipeline import PIPELINE
from sftex_stages.results import FILES
from sftex_stages.results.archive import SCHEMA, encode

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
REMEDY = "README.md is not what the program says; write it anew with: .venv/bin/python docs/readme.py"


def load(path: str) -> ModuleType:
    """A Python file that belongs to no package."""
    spec = importlib.util.spec_from_file_location(Path(path).stem + "_loaded", ROOT / path)
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


readme = load("docs/readme.py")


def table(name: str) -> list[list[str]]:
    """Cells of the rows of a part's tables, without their heads."""
    part = re.search(rf"<!-- {name}:begin -->\n(.*?)<!-- {name}:end -->", README, re.DOTALL)
    assert part, name
    rows = re.findall(r"^\| (`.*) \|$", part[1], re.MULTILINE)
    return [re.split(r"(?<!\\) \| ", row) for row in rows]


def test_the_generated_parts_are_current() -> None:
    assert readme.filled(README) == README, REMEDY


def test_every_parameter_and_its_default() -> None:
    said = {name.strip("`"): json.loads(default.strip("`")) for name, default, *_ in table("parameters")}
    real = {
        f"{stage.name}.{key}": value
        for stage in PIPELINE
        for key, value in stage.params().model_dump(mode="json").items()
    }
    assert said == real, REMEDY


def test_every_output_file_and_every_dataset() -> None:
    assert [row[0].strip("`") for row in table("outputs")] == list(FILES), REMEDY
    assert [row[0].strip("`") for row in table("archive")] == list(SCHEMA), REMEDY


def test_every_exit_code() -> None:
    said = [int(code) for code in re.findall(r"^\| (\d+) \| ", README, re.MULTILINE)]
    real = [value for name, value in vars(cli).items() if name.isupper() and type(value) is int]
    assert said == sorted(real)


def test_every_command_is_understood(capsys: pytest.CaptureFixture[str]) -> None:
    commands = {row[0].strip("`").split()[1] for row in table("commands") if row[0].startswith("`sftex ")}
    assert commands >= {"run", "status", "evaluate", "config"}
    for command in commands:
        with pytest.raises(SystemExit) as leaving:
            cli.main([command, "--help"])
        assert leaving.value.code == 0
    assert set(re.findall(r"\bsftex (run|status|evaluate|config)\b", README)) <= commands
    capsys.readouterr()


def test_names_in_the_prose_exist() -> None:
    stages = [stage.name for stage in PIPELINE]
    known = {f"{stage.name}.{key}" for stage in PIPELINE for key in stage.params.model_fields} | set(FILES)
    for name in re.findall(rf"`((?:{'|'.join(stages)})\.\w+)`", README):
        assert name in known, name
    known_files = set(FILES)
    for name in re.findall(r"`(\w+\.(?:png|h5|exr|ply|glb|jpg))`", README):
        assert name in known_files, name
    targets = re.findall(r"^(\w+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
    for target in re.findall(r"\bmake (reconstruct|test|bench|help|lint|\w+)\b(?=[ `]|$)", README):
        assert target in targets, target


@pytest.mark.parametrize("page", ["README.md", "docs/method.md", "docs/benchmarks.md"])
def test_links_lead_somewhere_and_pages_stand_alone(page: str) -> None:
    text = (ROOT / page).read_text(encoding="utf-8")
    for link in re.findall(r"\]\(([^)#]+)", text):
        if not link.startswith("https://"):
            assert ((ROOT / page).parent / link).exists(), link
    # files that the text speaks of by their path from the root, or under geometry/
    for path in re.findall(r"`((?:sftex_stages|docs|data|tests|geometry)/[\w/.]+)`", text):
        assert (ROOT / path).exists() or (ROOT / "sftex_stages" / path).exists(), path
    assert not re.search(r"/work\b|\.library|issue \d|/tmp", text)


def test_the_picture_is_there_and_small() -> None:
    assert 50_000 < (ROOT / "docs/images/overview.png").stat().st_size < 700_000


def test_the_python_examples_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
    examples = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    assert len(examples) == 2
    scene = load("tests/results/conftest.py")
    arrays = scene.stage_arrays()
    meta = {"image_name": "the photograph", "image_sha256": "ab" * 32, "config_yaml": "", "keys": {}, "versions": {}}
    path = tmp_path / "outputs/spherecap_glyphs_side/result.h5"
    path.parent.mkdir(parents=True)
    path.write_bytes(encode(arrays, meta))
    monkeypatch.chdir(tmp_path)
    for example in examples:
        exec(compile(example, "README.md", "exec"), {})
    shown = capsys.readouterr().out
    assert "the photograph | x right, y down" in shown
    assert f"{arrays['surface']['valid'].mean():.0%} of the picture" in shown
    assert "(90, 130) (90, 130, 3)" in shown


def test_the_measured_tables_are_filled_from_a_benchmark() -> None:
    none = dict.fromkeys(FIGURES)
    images = {
        "ball": {"failed": None, "numbers": none | {"dense_median": 1.254, "seconds": 12.0, "keypoints": 9876}},
        "unmeasured": {"failed": None, "numbers": none | {"seconds": 34.0}},
        "broken": {"failed": "no texture", "numbers": none},
    }
    report = {"sftex": "9", "date": "2030-01-02 03:04", "machine": "a machine", "jobs": None, "images": images}
    content = readme.bench(report)
    accuracy, cost = (part.splitlines() for part in re.findall(r"(?:^\|.*\n?)+", content, re.MULTILINE))
    assert [row.split()[1] for row in accuracy[2:]] == ["ball"]
    assert [row.split()[1] for row in cost[2:]] == ["ball", "unmeasured"]
    column = accuracy[0].split("|").index(next(h for h in accuracy[0].split("|") if h.strip() == "surface, median °"))
    assert accuracy[2].split("|")[column].strip() == "1.25"
    assert "9876" in cost[2] and "34" in cost[3]
    assert "- `broken` failed: no texture" in content
    text = readme.put(README, "bench", content)
    assert content in text and readme.put(text, "bench", "old") == readme.put(README, "bench", "old")
    with pytest.raises(ValueError, match="nowhere"):
        readme.put(README, "nowhere", "")
