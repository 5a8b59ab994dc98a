"""The guard of the versions: what each stage's source was when its version was last stated.

A stage's key holds its version, not its source. So whoever changes the source says, before it is committed, whether
results change::

    python tests/fingerprints.py changed frontal surface        raises their versions in the source, and records them
    python tests/fingerprints.py unchanged frontal -m "renamed a variable"     states that results are the same
    python tests/fingerprints.py                                 shows what is not stated yet

Recorded is a hash of the syntax tree (comments, docstrings and layout do not count) of every module that the stage's
module imports from sftex_stages, but for the engine, the errors, the configuration and the reading of files (these do
not decide what a result is).
"""

from __future__ import annotations

import argparse
import ast
import functools
import hashlib
import json
import re
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
FILE = ROOT / "tests" / "stage_fingerprints.json"
PACKAGE = "sftex_stages"
_NOT_RESULTS = ("engine", "errors", "config", "guarded")


def current() -> dict[str, dict]:
    """{stage: {"version", "modules": {path: hash}}} of the source as it is."""
    sys.path.insert(0, str(ROOT))
    from sftex_stages import pipeline
    from sftex_stages.results import VERSION

    versions = {stage.name: stage.version for stage in pipeline.PIPELINE} | {"outputs": VERSION}
    return {
        stage: {"version": v, "modules": {str(p.relative_to(ROOT)): _module_hash(p) for p in reached(source(stage))}}
        for stage, v in versions.items()
    }


def source(stage: str) -> Path:
    """The module that holds a stage's record."""
    names = {"image": "images.py", "outputs": "results/__init__.py"}
    return ROOT / PACKAGE / names.get(stage, f"{stage}.py")


def reached(start: Path) -> list[Path]:
    """The module and all that it imports, directly or not, from the package, sorted."""
    found: set[Path] = set()
    todo = [start.resolve()]
    while todo:
        path = todo.pop()
        if path not in found:
            found.add(path)
            todo += imported(path)
    return sorted(found)


@functools.cache
def imported(path: Path) -> list[Path]:
    """Modules of the package that a file imports, at its top or in a function."""
    here = path.parent.relative_to(ROOT).parts
    names: list[tuple[str, ...]] = []
    for node in ast.walk(ast.parse(path.read_bytes())):
        if isinstance(node, ast.Import):
            names += [tuple(alias.name.split(".")) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = here[: len(here) - node.level + 1] if node.level else ()
            base = (*base, *(node.module.split(".") if node.module else ()))
            names += [(*base, alias.name) for alias in node.names]  # the name may be a module, or something in one
            names.append(base)
    modules = []
    for name in names:
        if name[:1] == (PACKAGE,) and len(name) > 1 and name[1] not in _NOT_RESULTS:
            stem = ROOT.joinpath(*name)
            modules += [p for p in (stem.with_suffix(".py"), stem / "__init__.py") if p.is_file()]
    return modules


@functools.cache
def _module_hash(path: Path) -> str:
    return tree_hash(path)


def tree_hash(path: Path) -> str:
    """Hash of a module's syntax tree without docstrings and without the version that guards it."""
    tree = ast.parse(path.read_bytes())
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and ast.get_docstring(node, clean=False):
            node.body = node.body[1:]
        if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "Stage":
            node.keywords = [k for k in node.keywords if k.arg != "version"]
            node.args = [a for i, a in enumerate(node.args) if i != 1]
        if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "Field":
            node.args, node.keywords = [], []  # defaults, bounds, words: a parameter's value is part of the key
        if isinstance(node, ast.Assign) and [getattr(t, "id", "") for t in node.targets] == ["VERSION"]:
            node.value = ast.Constant(0)
    return hashlib.sha256(ast.dump(tree).encode()).hexdigest()[:16]


def open_questions(recorded: dict[str, dict], now: dict[str, dict]) -> dict[str, list[str]]:
    """{stage: its modules that differ from what was recorded with its version}; empty if all is stated."""
    questions = {}
    for stage, entry in now.items():
        old = recorded.get(stage, {"version": None, "modules": {}})
        names = sorted(old["modules"].keys() | entry["modules"].keys())
        changed = [n for n in names if old["modules"].get(n) != entry["modules"].get(n)]
        if changed or old["version"] != entry["version"]:
            questions[stage] = changed
    return questions


def message(questions: dict[str, list[str]], recorded: dict[str, dict], now: dict[str, dict]) -> str:
    """What to do about open questions."""
    lines = ["the source of stages changed, and nothing says whether their results did:"]
    for stage, modules in questions.items():
        old, new = recorded.get(stage, {}).get("version"), now[stage]["version"]
        raised = f" (version {old} → {new}: only to be recorded)" if old != new else ""
        lines.append(f"  {stage}: {', '.join(modules) or 'its version'}{raised}")
    stages = " ".join(questions)
    return "\n".join([
        *lines,
        "if results change:        python tests/fingerprints.py changed " + stages,
        f'if they stay the same:    python tests/fingerprints.py unchanged {stages} -m "why"',
        "(name the stages apart where one changes and another does not)",
    ])  # fmt: skip


def load() -> dict[str, dict]:
    """What is recorded."""
    recorded: dict[str, dict] = json.loads(FILE.read_text(encoding="utf-8")) if FILE.exists() else {}
    return recorded


def raise_version(stage: str, module: Path, version: int) -> None:
    """Write the next version into the stage's record in the source (`VERSION` for the outputs)."""
    text = module.read_text(encoding="utf-8")
    if stage == "outputs":
        new, count = re.subn(rf"^VERSION = {version}$", f"VERSION = {version + 1}", text, flags=re.MULTILINE)
    else:
        pattern = rf'(Stage\(\s*(?:name=)?"{stage}",\s*(?:version=)?){version}\b'
        new, count = re.subn(pattern, rf"\g<1>{version + 1}", text)
    if count != 1:
        sys.exit(f"{module}: version {version} of {stage} not found there; raise it by hand, then run this again")
    module.write_text(new, encoding="utf-8")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", nargs="?", choices=["changed", "unchanged"])
    parser.add_argument("stages", nargs="*")
    parser.add_argument("-m", "--message", help="why the results are unchanged")
    args = parser.parse_args()
    recorded, now = load(), current()
    questions = open_questions(recorded, now)
    if not args.what:
        print(message(questions, recorded, now) if questions else "every stage's source is that of its stated version")
        sys.exit(bool(questions))
    if unknown := set(args.stages) - now.keys():
        sys.exit(f"no stage {', '.join(unknown)}; there are {', '.join(now)}")
    if not args.stages or (args.what == "unchanged" and not args.message):
        sys.exit("name the stages" + (', and say why: -m "…"' if args.what == "unchanged" else ""))
    for stage in args.stages:
        entry = now[stage]
        old = recorded.get(stage, {}).get("version")
        if args.what == "unchanged":
            recorded[stage] = {**entry, "unchanged": args.message}
        else:
            if old == entry["version"]:  # not raised by hand already
                raise_version(stage, source(stage), old)
                entry = {**entry, "version": old + 1}
            recorded[stage] = entry
        print(f"{stage}: version {entry['version']} recorded")
    recorded = {stage: recorded[stage] for stage in now if stage in recorded}
    FILE.write_text(json.dumps(recorded, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
