"""The ledger of an item: what its last run found, so that planning it again reads one small file instead of hundreds.

::

    <root>/items/<hash of the item's label>.json    per stage: what was hashed into the keys, and the finished jobs

It is a memo, never the truth. A stage's entry counts only if the identity is the present one, and a job in it only as
long as the file system says of both its files (size, times, inode) what it said when their bytes were last hashed;
everything else is looked up and hashed again. It also tells what a plan is compared with when it says why.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from .store import Receipt, write_atomically

Steps = dict[str, dict[str, Any]]  # stage -> {"identity", "jobs": [[part, short receipt], ...], "files": {name: stamp}}


def path_of(root: Path, label: str) -> Path:
    """Where an item's ledger lives."""
    return root / "items" / f"{hashlib.sha256(label.encode()).hexdigest()[:32]}.json"


def read(root: Path, label: str) -> Steps:
    """The item's ledger; empty if there is none or it is damaged (then everything is looked up)."""
    try:
        document = unseal(path_of(root, label).read_bytes())
    except (OSError, ValueError):
        return {}
    return _expand(document) if document.get("label") == label else {}


def write(root: Path, label: str, steps: Steps) -> None:
    """Replace the item's ledger. OSError where nothing can be written."""
    software: list[dict[str, str]] = []  # of all jobs together few different ones
    brief: Steps = {}
    for stage, entry in steps.items():
        jobs = []
        for part, receipt in entry["jobs"]:
            if receipt["software"] not in software:
                software.append(receipt["software"])
            jobs.append([part, {**receipt, "software": software.index(receipt["software"])}])
        brief[stage] = {**entry, "jobs": jobs}
    content = seal({"label": label, "software": software, "steps": brief})
    write_atomically(path_of(root, label), content, root / "tmp", durable=False)


def read_all(root: Path) -> Iterator[tuple[Path, str, Steps]]:
    """(file, label, steps) of all items; label "" for a damaged ledger."""
    for path in sorted((root / "items").glob("*.json")):
        try:
            document = unseal(path.read_bytes())
            yield path, document["label"], _expand(document)
        except (OSError, ValueError, KeyError):
            yield path, "", {}


def _expand(document: dict[str, Any]) -> Steps:
    steps: Steps = document["steps"]
    for entry in steps.values():
        for _, receipt in entry["jobs"]:
            receipt["software"] = document["software"][receipt["software"]]
    return steps


def entry(identity: dict[str, Any], done: dict[int | None, Receipt], delivered: dict[str, str]) -> dict[str, Any]:
    """The ledger's entry of a complete stage; `delivered`: files of a delivery, with their stamps."""
    jobs = [[part, receipt] for part, receipt in done.items()]
    return {"identity": identity, "jobs": jobs} | ({"files": delivered} if delivered else {})


def seal(document: Any) -> bytes:
    """JSON under a line with its SHA-256."""
    text = json.dumps(document, separators=(",", ":"), ensure_ascii=False).encode()
    return hashlib.sha256(text).hexdigest().encode() + b"\n" + text + b"\n"


def unseal(content: bytes) -> Any:
    """The document of `seal`; ValueError if any byte is not as it was written."""
    checksum, _, rest = content.partition(b"\n")
    text = rest[:-1]
    if rest[-1:] != b"\n" or hashlib.sha256(text).hexdigest().encode() != checksum:
        raise ValueError("wrong checksum")
    return json.loads(text)
