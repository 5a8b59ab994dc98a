"""The configuration: pipeline.yaml -> validated parameters of every stage, and back to YAML.

One section per stage, one key per parameter; what is missing has its default. Mistakes are reported all at once, each
with file, line, column, key and the nearest right name: ``pipeline.yaml:3:3: frontal.toll: unknown key; did you mean
"tol"?``
"""

from __future__ import annotations

import difflib
import json
from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from textwrap import wrap
from typing import Any

from pydantic import ValidationError
from ruamel.yaml import YAML
from ruamel.yaml.error import MarkedYAMLError, YAMLError
from ruamel.yaml.nodes import MappingNode, Node, ScalarNode

from .engine.stage import Stage, StageParams
from .errors import ConfigError

Params = dict[str, StageParams]  # stage name -> parameters
Loc = tuple[str | int, ...]  # ("frontal", "tol")


def load(path: Path | None, stages: Sequence[Stage]) -> Params:
    """Parameters of all stages from a YAML file (None: all defaults). ConfigError lists every mistake."""
    if path is None:
        return {stage.name: stage.params() for stage in stages}
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror}); check the name given to --config") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: is not a text file in UTF-8; is it a configuration?") from error
    return parse(text, stages, str(path))


def parse(text: str, stages: Sequence[Stage], name: str = "pipeline.yaml") -> Params:
    """Parameters of all stages from YAML text; `name` is what messages call it."""
    root = _compose(text, name)
    problems: list[tuple[int, int, str]] = []  # line, column, words
    marks: dict[Loc, Node] = {}
    sections = _plain(root, (), marks, problems) if root is not None else None
    sections = {} if sections is None else sections
    if not isinstance(sections, dict):
        problems.append((*_position(root), "expected sections such as 'frontal:' with keys indented below them"))
        sections = {}
    by_name = {stage.name: stage for stage in stages}
    params: Params = {}
    for section in sections:
        if section not in by_name:
            problems.append((*_position(marks[(section,)]), f"{section}: {_unknown_section(section, stages)}"))
    for stage in stages:
        values = sections.get(stage.name)
        found = _validate(stage, {} if values is None else values, stages)
        if isinstance(found, StageParams):
            params[stage.name] = found
        else:
            problems += [(*_nearest_mark(loc, marks), f"{_dotted(loc)}: {message}") for loc, message in found]
    if problems:
        raise ConfigError("\n".join(f"{name}:{line}:{column}: {words}" for line, column, words in sorted(problems)))
    return params


def to_yaml(params: Params, stages: Sequence[Stage]) -> str:
    """The complete configuration as commented YAML; `parse` gives the same parameters back."""
    lines = []
    for stage in stages:
        values = json.loads(params[stage.name].model_dump_json())
        schema = stage.params.model_json_schema()["properties"] if stage.params.model_fields else {}
        lines += ["", f"{stage.name}:" + ("" if values else " {}")]
        for key, value in values.items():
            comment = stage.params.model_fields[key].description or ""
            lines += wrap(comment + _bounds(schema[key]), 116, initial_indent="  # ", subsequent_indent="  # ")
            lines.append(f"  {key}: {_scalar(value)}")
    return "\n".join(lines[1:]) + "\n"


_HEAD = """\
# The default configuration of sftex: every stage, every parameter. A copy need only hold what differs from it.
# A stage is computed again when one of its own parameters, or the outcome of a stage before it, changes.
"""


def default_yaml(stages: Sequence[Stage]) -> str:
    """The text of the pipeline.yaml that sftex ships."""
    return f"{_HEAD}\n{to_yaml(load(None, stages), stages)}"


# ------------------------------------------------------------------------------------------------ reading


def _compose(text: str, name: str) -> Node | None:
    """YAML 1.2 syntax tree with positions: 1e-6 is a number, `off` a word, equal keys are found."""
    try:
        return _yaml().compose(text)
    except MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        where = f"{name}:{mark.line + 1}:{mark.column + 1}" if mark else name
        words = "; ".join(part for part in (error.context, error.problem) if part)
        raise ConfigError(f"{where}: not valid YAML: {words}") from error
    except YAMLError as error:  # characters that YAML does not allow
        raise ConfigError(f"{name}: not valid YAML: {' '.join(str(error).split())}") from error


def _plain(node: Node, loc: Loc, marks: dict[Loc, Node], problems: list[tuple[int, int, str]]) -> Any:
    """The node's value in plain Python; remembers where every key stands and notes equal keys."""
    tag = node.tag or ""
    if node.anchor or not tag.startswith("tag:yaml.org,2002:") or ":python/" in tag:
        problems.append(
            (*_position(node), f"{_dotted(loc)}: tags (!) and anchors (&, *) are not supported; write it out")
        )
        return None  # aliases could refer to themselves
    if isinstance(node, ScalarNode):
        return _yaml().constructor.construct_object(node, deep=True)
    if not isinstance(node, MappingNode):
        return [_plain(child, (*loc, i), marks, problems) for i, child in enumerate(node.value)]
    values: dict[str, Any] = {}
    for key_node, value_node in node.value:
        if not isinstance(key_node, ScalarNode):
            problems.append((*_position(key_node), "a key must be one word"))
            continue
        key = str(key_node.value)
        here = (*loc, key)
        if key in values:
            first = _position(marks[here])[0]
            problems.append((*_position(key_node), f"{_dotted(here)}: given twice, first in line {first}; keep one"))
            continue
        marks[here] = key_node
        values[key] = _plain(value_node, here, marks, problems)
    return values


@lru_cache
def _yaml() -> YAML:
    return YAML(typ="safe", pure=True)


def _position(node: Node | None) -> tuple[int, int]:
    """Line and column, from 1."""
    return (node.start_mark.line + 1, node.start_mark.column + 1) if node is not None else (1, 1)


def _nearest_mark(loc: Loc, marks: Mapping[Loc, Node]) -> tuple[int, int]:
    while loc and loc not in marks:
        loc = loc[:-1]
    return _position(marks.get(loc))


# --------------------------------------------------------------------------------------------- validating


def _validate(stage: Stage, values: Any, stages: Sequence[Stage]) -> StageParams | list[tuple[Loc, str]]:
    """The stage's parameters, or what is wrong with them: (where, words)."""
    if not isinstance(values, dict):
        return [((stage.name,), f"expected keys indented below it, not {json.dumps(values, default=str)}")]
    try:
        # strict JSON: no "3" for 3, no `yes` for true; but 1 for 1.0, and lists for tuples
        return stage.params.model_validate_json(json.dumps(values, default=str), strict=True)
    except ValidationError as error:
        return [_explain(stage, values, problem, stages) for problem in error.errors()]


def _explain(stage: Stage, values: dict[str, Any], problem: Any, stages: Sequence[Stage]) -> tuple[Loc, str]:
    loc = (stage.name, *problem["loc"])
    if problem["type"] == "extra_forbidden":
        return loc, _unknown_key(str(problem["loc"][-1]), stage, stages)
    words = problem["msg"].replace("Input should be", "should be").removeprefix("Value error, ")
    return loc, f"{words}, not {json.dumps(problem['input'], ensure_ascii=False, default=str)}"


def _unknown_key(key: str, stage: Stage, stages: Sequence[Stage]) -> str:
    near = difflib.get_close_matches(key, stage.params.model_fields, n=1)
    if near:
        return f'unknown key; did you mean "{near[0]}"?'
    others = [other.name for other in stages if key in other.params.model_fields]
    if others:
        return f'unknown key; it belongs in section "{others[0]}"'
    return f"unknown key; {stage.name} has {', '.join(stage.params.model_fields) or 'no parameters'}"


def _unknown_section(section: str, stages: Sequence[Stage]) -> str:
    owners = [stage.name for stage in stages if section in stage.params.model_fields]
    if owners:
        return f'not a section; the key belongs in section "{owners[0]}"'
    names = [stage.name for stage in stages]
    near = difflib.get_close_matches(section, names, n=1)
    return "unknown section; " + (f'did you mean "{near[0]}"?' if near else f"there are {', '.join(names)}")


def _dotted(loc: Loc) -> str:
    return ".".join(str(part) for part in loc)


# ------------------------------------------------------------------------------------------------ writing


def _bounds(schema: Mapping[str, Any]) -> str:
    """ " (0 < value ≤ 1)" from a JSON schema, "" if there are no bounds."""
    options = schema.get("anyOf", [schema])  # an optional number
    low = next((f"{o[k]:g} {sign} " for o in options for k, sign in _LOW.items() if k in o), "")
    high = next((f" {sign} {o[k]:g}" for o in options for k, sign in _HIGH.items() if k in o), "")
    return f" ({low}value{high})" if low or high else ""


_LOW = {"minimum": "≤", "exclusiveMinimum": "<"}
_HIGH = {"maximum": "≤", "exclusiveMaximum": "<"}


def _scalar(value: Any) -> str:
    """JSON, which is YAML; but 1.0e-06 rather than 1e-06, which YAML 1.1 readers take for text."""
    if isinstance(value, list):
        return f"[{', '.join(_scalar(v) for v in value)}]"
    if isinstance(value, dict):
        return f"{{{', '.join(f'{json.dumps(k)}: {_scalar(v)}' for k, v in value.items())}}}"
    text = json.dumps(value, ensure_ascii=False)
    if isinstance(value, float) and "e" in text and "." not in text:
        return text.replace("e", ".0e")
    return text
