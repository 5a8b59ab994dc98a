"""The artefact store: immutable files named by their key, each with a readable receipt written last.

::

    <root>/<stage>/<key[:2]>/<key>.h5     the arrays (HDF5)
    <root>/<stage>/<key[:2]>/<key>.json   the receipt: inputs, parameters, versions, duration, SHA-256 of the artefact
    <root>/<stage>/<key[:2]>/<key>.log    traceback of a failed attempt, until one succeeds
    <root>/items/                         what the last run of every item found (see `ledger`)
    <root>/runs/                          what runs reached, and which of them are pinned (see `runs`)
    <root>/crashes.log                    where processes died, if they could still tell
    <root>/damaged/                       what failed its checksum, set aside
    <root>/tmp/                           files being written

Every file is written under a temporary name, synced and renamed, so it is there whole or not at all; no receipt means
not done. No other state decides anything: nothing to get stuck, nothing to lock. Nothing is trusted that was not hashed:
the receipt carries its own checksum, the artefact's SHA-256 is compared at every read.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import json
import os
import shutil
import tempfile
import time
import uuid
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ..errors import StoreError
from . import keys

Receipt = dict[str, Any]
RESERVED = {"tmp", "damaged", "items", "runs"}  # folders of the store that are no stages
_SMALL = 1 << 20  # bytes
_STALE_TEMPORARY = 24 * 3600  # seconds; younger ones may belong to another run


class DamagedError(Exception):
    """An artefact that was verified a moment ago is not what its receipt says. Mended by computing it again."""

    def __init__(self, stage: str, key: str, problem: str) -> None:
        super().__init__(stage, key, problem)
        self.stage, self.key, self.problem = stage, key, problem


@dataclass
class Store:
    """A folder of artefacts. Cheap to create; keeps what it has verified for its own lifetime (one run)."""

    root: Path
    notices: list[str] = field(default_factory=list)  # what was set aside, in words
    fresh: set[tuple[str, str]] = field(default_factory=set)  # (stage, key) published by this run
    _verified: dict[tuple[str, str], Receipt] = field(default_factory=dict)

    def path(self, stage: str, key: str, suffix: str = ".h5") -> Path:
        """Where a file of the job `key` of `stage` lives."""
        return Path(self._file(stage, key, suffix))

    def _file(self, stage: str, key: str, suffix: str) -> str:
        return f"{self.root}/{stage}/{key[:2]}/{key}{suffix}"  # a Path costs as much as reading a receipt

    def prepare(self) -> None:
        """Create the store and prove that it can be written; StoreError (with what to do) otherwise."""
        try:
            (self.root / "tmp").mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=self.root / "tmp") as probe:
                probe.write(b"probe")
                probe.flush()
                os.fsync(probe.fileno())
            for left_over in (self.root / "tmp").iterdir():  # of runs that were killed
                with contextlib.suppress(FileNotFoundError):  # another run may clear up too
                    if time.time() - left_over.stat().st_mtime > _STALE_TEMPORARY:
                        shutil.rmtree(left_over) if left_over.is_dir() else left_over.unlink()
        except OSError as error:
            raise StoreError(
                f"{self.root.parent}: cannot be written ({error.strerror}); choose another output folder with --out"
            ) from error

    def find(self, stage: str, key: str, repair: bool = True) -> tuple[Receipt | None, str]:
        """The verified receipt of a finished job, or None and the reason in words ("" if it simply was never done).

        Of the receipt comes what plans need (key, artefact, files, software, and of the scalars counts and yes or no),
        and "stamps", of its file and the artefact's when their bytes were hashed. Damaged files are set aside (unless
        not `repair`), so that the job can be done again.
        """
        if (stage, key) in self._verified:
            return self._verified[stage, key], ""
        try:
            receipt, own = read_receipt(self._file(stage, key, ".json"))
            if receipt["key"] != key:
                raise ValueError("of another job")
        except (FileNotFoundError, NotADirectoryError):
            return None, ""
        except (OSError, ValueError, KeyError) as error:
            return None, self._damaged(stage, key, f"damaged receipt ({_mendable(error)})", repair)
        try:
            stamps = [own, self._check_artefact(stage, key, receipt)]
        except FileNotFoundError:
            return None, "artefact removed"
        except (OSError, ValueError) as error:
            return None, self._damaged(stage, key, f"damaged artefact ({_mendable(error)})", repair)
        found: Receipt = {name: receipt[name] for name in ("key", "artefact", "files", "software") if name in receipt}
        scalars = {name: value for name, value in receipt.get("scalars", {}).items() if isinstance(value, int)}
        self._verified[stage, key] = {**found, "scalars": scalars, "stamps": stamps}
        return self._verified[stage, key], ""

    def trust(self, stage: str, receipt: Receipt) -> bool:
        """Accept a receipt that a ledger remembers, if its files are, for the file system, those that were hashed."""
        place = stage, receipt["key"]
        if place not in self._verified:
            base = self._file(stage, receipt["key"], "")
            own, artefact = receipt["stamps"]
            try:
                if stamp(os.stat(base + ".json")) != own or (artefact and stamp(os.stat(base + ".h5")) != artefact):
                    return False
            except OSError:
                return False
            self._verified[place] = receipt
        return True

    def _check_artefact(self, stage: str, key: str, receipt: Receipt) -> str | None:
        """The artefact's stamp, taken before its bytes are hashed; None for a job that left files elsewhere."""
        expected = receipt["artefact"]
        if expected is None:
            return None
        with open(self._file(stage, key, ".h5"), "rb") as file:
            status = os.fstat(file.fileno())
            if status.st_size != expected["bytes"]:
                raise ValueError(f"{status.st_size} bytes instead of {expected['bytes']}")
            small = status.st_size < _SMALL  # most artefacts are; one read costs least
            digest = hashlib.sha256(file.read()) if small else hashlib.file_digest(file, "sha256")
            if digest.hexdigest() != expected["sha256"]:
                raise ValueError("wrong SHA-256")
        return stamp(status)

    def read_artefact(self, stage: str, key: str, sha256: str) -> bytes:
        """The artefact's bytes, verified. DamagedError if they are not those of the receipt."""
        try:
            image = self.path(stage, key).read_bytes()  # hashed and decoded from one read: no change in between
        except OSError as error:
            raise DamagedError(stage, key, f"cannot be read ({error.strerror})") from error
        if hashlib.sha256(image).hexdigest() != sha256:
            raise DamagedError(stage, key, "wrong SHA-256")
        return image

    def publish(self, stage: str, key: str, image: bytes | None, receipt: Receipt) -> Receipt:
        """Write artefact, then receipt (with the artefact's hash and its own checksum). StoreError if impossible."""
        artefact = None
        if image is not None:
            artefact = {"sha256": hashlib.sha256(image).hexdigest(), "bytes": len(image)}
        receipt = {**receipt, "artefact": artefact}
        receipt["checksum"] = keys.digest(receipt)
        if image is not None:
            self._write(self.path(stage, key), image)
        self._write(self.path(stage, key, ".json"), json.dumps(receipt, indent=1, ensure_ascii=False).encode())
        with contextlib.suppress(OSError):
            self.path(stage, key, ".log").unlink()
        return receipt

    def write_log(self, stage: str, key: str, text: str) -> Path:
        """Keep the traceback of a failed job beside its receipt."""
        path = self.path(stage, key, ".log")
        self._write(path, text.encode())
        return path

    def accept(self, stage: str, key: str) -> None:
        """This run has just published this: to be verified when it is next looked for, even if it was there before."""
        self.fresh.add((stage, key))
        self._verified.pop((stage, key), None)

    def reject(self, damage: DamagedError) -> None:
        """Set aside what a worker found damaged."""
        self._damaged(damage.stage, damage.key, f"damaged artefact ({damage.problem})", repair=True)

    def receipts(self) -> Iterator[tuple[str, str]]:
        """(stage, key) of all receipts, sorted."""
        for stage in sorted(set(_names(self.root)) - RESERVED):
            for folder in sorted(_names(f"{self.root}/{stage}")):
                names = sorted(_names(f"{self.root}/{stage}/{folder}")) if len(folder) == 2 else ()
                yield from ((stage, name[:-5]) for name in names if name.endswith(".json"))

    def _damaged(self, stage: str, key: str, problem: str, repair: bool) -> str:
        self._verified.pop((stage, key), None)
        if not repair:
            return problem
        folder = self.root / "damaged"
        try:
            folder.mkdir(exist_ok=True)
            for suffix in (".json", ".h5"):
                with contextlib.suppress(FileNotFoundError):  # another run may have been quicker
                    os.replace(self.path(stage, key, suffix), folder / f"{stage}-{key[:16]}-{time.time_ns()}{suffix}")
        except OSError as error:
            raise StoreError(f"{folder}: a damaged artefact cannot be set aside ({error.strerror})") from error
        self.notices.append(f"{stage} {key[:12]}: {problem}; set aside in {folder}, computed again")
        return problem

    def _write(self, path: Path, content: bytes) -> None:
        try:
            write_atomically(path, content, self.root / "tmp")
        except OSError as error:
            raise StoreError(
                f"{path}: cannot be written ({error.strerror}); free space or choose another --out"
            ) from error


def write_atomically(path: Path, content: bytes, scratch: Path, durable: bool = True) -> None:
    """Write under a temporary name in `scratch` (same file system), sync if `durable`, rename: whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    scratch.mkdir(parents=True, exist_ok=True)
    temporary = scratch / uuid.uuid4().hex
    try:
        with open(temporary, "xb") as file:
            file.write(content)
            file.flush()
            if durable:
                os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def read_receipt(path: Path | str) -> tuple[Receipt, str]:
    """A receipt whose checksum is right, and its file's stamp; ValueError (in words) otherwise, OSError if unreadable."""
    with open(path, "rb") as file:
        status, content = os.fstat(file.fileno()), file.read()
    try:
        receipt = json.loads(content)
        checksum = receipt.pop("checksum")
    except (ValueError, AttributeError, KeyError, TypeError, RecursionError) as error:
        raise ValueError("not a receipt") from error
    if keys.digest(receipt) != checksum:
        raise ValueError("wrong checksum")
    return {**receipt, "checksum": checksum}, stamp(status)


def _names(folder: Path | str) -> list[str]:
    """What is in a folder; nothing if it is none."""
    try:
        return os.listdir(folder)
    except (FileNotFoundError, NotADirectoryError):
        return []


def stamp(status: os.stat_result) -> str:
    """What changes, in a file system, when a file is written, replaced or moved."""
    return f"{status.st_size} {status.st_mtime_ns} {status.st_ctime_ns} {status.st_ino}"


def _mendable(error: Exception) -> Exception:
    """Bad content and bad sectors can be computed again; a file that may not be read is another's mistake."""
    if isinstance(error, OSError) and error.errno not in (errno.EIO, errno.EISDIR):
        where = error.filename or "the store"
        raise StoreError(f"{where}: cannot be read ({error.strerror}); check its permissions") from error
    return error
