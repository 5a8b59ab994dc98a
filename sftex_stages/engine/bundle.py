"""A run in one file or folder: taken out of a store, and put into another one, on another machine.

::

    SHA256SUMS                           of every other file (``sha256sum -c`` reads it)
    run.json  config.yaml                the run's record; its configuration
    store/<stage>/<key[:2]>/<key>.h5     artefacts, with their receipts (.json)
    results/<item>/<file>                what was delivered

Restoring takes nothing on trust: only plain files of exactly these names, each listed and right by its hash, each
receipt in agreement with its own key, each artefact plain HDF5 that holds what its receipt says. What is refused leaves
no trace, and nothing replaces results of another run.
"""

from __future__ import annotations

import hashlib
import io
import os
import re
import shutil
import tarfile
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

from ..errors import InputError, StoreError
from . import foreign, keys, ledger, runs
from .store import RESERVED, Store, read_receipt

_SUMS = "SHA256SUMS"
_STORE = re.compile(r"store/([a-z][a-z0-9_]{0,40})/([0-9a-f]{2})/(\2[0-9a-f]{62})\.(h5|json)")
_RESULT = re.compile(r"results/([^/\\\0]{1,200})/([A-Za-z0-9_][\w.-]{0,100})", re.ASCII)
_MOST_TEXT = 256 << 20  # bytes of SHA256SUMS, run.json and receipts


def archive(store: Store, out: Path, run: runs.Run, target: Path) -> int:
    """Write a run to a new file (*.tar) or folder; the number of files. InputError if anything of it is not intact."""
    entries = dict(_entries(store, out, run))
    sums = "".join(f"{digest}  {name}\n" for name, (_, digest) in sorted(entries.items()))
    if target.exists():
        raise InputError(f"{target}: exists already; choose another name")
    part = target.with_name(f".{target.name}.{uuid.uuid4().hex[:8]}.part")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        with _sink(part, target.suffix == ".tar") as add:
            add(_SUMS, sums.encode(), "")
            for name, (source, digest) in sorted(entries.items()):
                add(name, source, digest)
        os.rename(part, target)
    except OSError as error:
        raise StoreError(f"{target}: cannot be written ({error.strerror or error}); free space?") from error
    finally:
        shutil.rmtree(part, ignore_errors=True) if part.is_dir() else part.unlink(missing_ok=True)
    return len(entries) + 1


def _entries(store: Store, out: Path, run: runs.Run) -> Iterator[tuple[str, tuple[Path | bytes, str]]]:
    """Name, then content or its path, and SHA-256 of every file of a run."""
    record = ledger.seal({"config": run.config, "items": run.items})
    for name, content in (("run.json", record), ("config.yaml", run.config.encode())):
        yield name, (content, hashlib.sha256(content).hexdigest())
    for label, item in run.items.items():
        for stage, many in item["keys"].items():
            for key in many:
                receipt, problem = store.find(stage, key)
                if receipt is None:
                    raise InputError(f"{label}: {stage} {key[:12]} is not there ({problem or 'removed'}); run it again")
                for suffix in (".json", ".h5") if receipt["artefact"] else (".json",):
                    path = store.path(stage, key, suffix)
                    yield f"store/{stage}/{key[:2]}/{key}{suffix}", (path, keys.file_sha256(path))
                for name, sha256 in receipt.get("files", {}).items():
                    path = out / label / name
                    if not path.is_file() or keys.file_sha256(path) != sha256:
                        raise InputError(f"{path}: missing or changed since the run; run sftex again, then archive")
                    yield f"results/{label}/{name}", (path, sha256)


@contextmanager
def _sink(part: Path, as_tar: bool) -> Iterator[Any]:
    """A function that adds a file (name, path or bytes, expected SHA-256); equal content makes equal archives."""

    def checked(source: Path | bytes, digest: str) -> tuple[IO[bytes], int]:
        content = source if isinstance(source, bytes) else source.read_bytes()
        if digest and hashlib.sha256(content).hexdigest() != digest:
            raise InputError(f"{source!s}: changed while it was being archived; try again")
        return io.BytesIO(content), len(content)

    if as_tar:
        with open(part, "xb") as file, tarfile.open(fileobj=file, mode="w", format=tarfile.PAX_FORMAT) as tar:

            def add(name: str, source: Path | bytes, digest: str) -> None:
                info = tarfile.TarInfo(name)
                stream, info.size = checked(source, digest)
                tar.addfile(info, stream)

            yield add
            tar.close()
            file.flush()
            os.fsync(file.fileno())
        return

    def put(name: str, source: Path | bytes, digest: str) -> None:
        (part / name).parent.mkdir(parents=True, exist_ok=True)
        stream, _ = checked(source, digest)
        with open(part / name, "xb") as file:
            shutil.copyfileobj(stream, file)

    yield put


# ------------------------------------------------------------------------------------------------- restoring


def restore(store: Store, out: Path, source: Path) -> tuple[str, int]:
    """Put an archived run into a store, its results into ``out/<item>``: the run's id, number of files that were new.

    InputError (before anything is put in place) if the archive is not exactly what it should be.
    """
    store.prepare()
    staging = store.root / "tmp" / f"restore-{uuid.uuid4().hex}"
    try:
        staging.mkdir()
        staged = _stage(source, staging)
        run = _check(source, staged, out)
        return run, _place(store, out, staged, run)
    except (tarfile.TarError, EOFError, UnicodeError) as error:
        raise InputError(f"{source}: not a whole archive of a run ({error}); copy it again") from error
    except OSError as error:
        raise StoreError(f"{source}: cannot be restored ({error.filename or ''} {error.strerror or error})") from error
    finally:
        shutil.rmtree(staging, ignore_errors=True)


def _members(source: Path) -> Iterator[tuple[str, int, IO[bytes]]]:
    """Name, size and stream of every file, SHA256SUMS first; InputError for anything but plain files."""
    if source.is_dir():
        paths = [p for p in sorted(source.rglob("*")) if p.is_symlink() or not p.is_dir()]
        for path in sorted(paths, key=lambda p: p.name != _SUMS or p.parent != source):
            if path.is_symlink() or not path.is_file():
                raise InputError(f"{source}: {path.name} is not a plain file; such archives are not restored")
            with open(path, "rb") as file:
                yield path.relative_to(source).as_posix(), path.stat().st_size, file
        return
    with open(source, "rb") as raw, tarfile.open(fileobj=raw, mode="r:") as tar:
        for info in tar:
            stream = tar.extractfile(info) if info.isreg() and not info.issparse() else None
            if stream is None:
                raise InputError(f"{source}: {info.name!r} is not a plain file; such archives are not restored")
            yield info.name, info.size, stream


def _stage(source: Path, staging: Path) -> dict[str, tuple[Path, str]]:
    """Copy every file under a number into `staging`: name -> (copy, SHA-256). Names and hashes are checked."""
    if not source.exists():
        raise InputError(f"{source}: no such archive")
    sums: dict[str, str] | None = None
    staged: dict[str, tuple[Path, str]] = {}
    for name, size, stream in _members(source):
        if name == _SUMS and sums is None:
            sums = _parse_sums(source, _read(source, name, size, stream))
            continue
        if sums is None or name not in sums or name in staged:
            raise InputError(f"{source}: {name!r} is not listed in {_SUMS}, or comes twice; not an archive of a run")
        if not name.endswith(".h5") and not name.startswith("results/") and size > _MOST_TEXT:
            raise InputError(f"{source}: {name} has {size} bytes, over the limit")
        copy = staging / str(len(staged))
        digest = hashlib.sha256()
        with open(copy, "xb") as file:
            while block := stream.read(1 << 20):
                digest.update(block)
                file.write(block)
            file.flush()
            os.fsync(file.fileno())
        if digest.hexdigest() != sums[name]:
            raise InputError(f"{source}: {name} is damaged (wrong SHA-256); copy the archive again")
        staged[name] = copy, sums[name]
    if sums is None or staged.keys() != sums.keys():
        missing = sorted((sums or {_SUMS: ""}).keys() - staged.keys())
        raise InputError(f"{source}: {missing[0]} is missing ({len(missing)} in all); copy the archive again")
    return staged


def _read(source: Path, name: str, size: int, stream: IO[bytes]) -> bytes:
    if size > _MOST_TEXT:
        raise InputError(f"{source}: {name} has {size} bytes, over the limit")
    return stream.read()


def _parse_sums(source: Path, content: bytes) -> dict[str, str]:
    sums = {}
    for line in content.decode().splitlines():
        digest, _, name = line.partition("  ")
        result = _RESULT.fullmatch(name)
        stage = _STORE.fullmatch(name)
        known = name in ("run.json", "config.yaml") or (stage and stage[1] not in RESERVED)
        known = known or (result and not result[1].startswith("."))
        if not re.fullmatch("[0-9a-f]{64}", digest) or not known or name in sums:
            raise InputError(f"{source}: {_SUMS} lists {name!r}, which has no place in a run; not restored")
        sums[name] = digest
    return sums


def _check(source: Path, staged: dict[str, tuple[Path, str]], out: Path) -> str:
    """The run's id; InputError if its parts do not belong together, are not plain, or would replace other results."""
    wanted = {"run.json", "config.yaml"}
    try:
        document = ledger.unseal(staged["run.json"][0].read_bytes())
        if hashlib.sha256(document["config"].encode()).hexdigest() != staged["config.yaml"][1]:
            raise ValueError("config.yaml is another one")
        for label, item in document["items"].items():
            for stage, many in item["keys"].items():
                for key in many:
                    base = f"store/{stage}/{key[:2]}/{key}"
                    receipt, _ = read_receipt(staged[f"{base}.json"][0])
                    if receipt["key"] != key or keys.digest(receipt["identity"]) != key:
                        raise ValueError(f"{base}.json belongs to another job")
                    foreign.check_receipt(receipt, stage)
                    files = {f"results/{label}/{name}": sha256 for name, sha256 in receipt.get("files", {}).items()}
                    if receipt["artefact"] is not None:
                        files[f"{base}.h5"] = receipt["artefact"]["sha256"]
                    if any(staged[name][1] != sha256 for name, sha256 in files.items()):
                        raise ValueError(f"{base}.json tells of other files")
                    for member in (member for member in files if member.endswith(".h5")):
                        foreign.check_hdf5(
                            staged[member][0], member, receipt["arrays"] if receipt["artefact"] else None
                        )
                    wanted |= {f"{base}.json", *files}
        name = keys.digest(document)[:12]
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise InputError(f"{source}: its parts do not belong together ({error}); not restored") from error
    except InputError as error:
        raise InputError(f"{source}: {error}") from error
    if extra := staged.keys() - wanted:
        raise InputError(f"{source}: {min(extra)} does not belong to the run; not restored")
    for result in (entry for entry in staged if entry.startswith("results/")):
        place = out / result.removeprefix("results/")
        if place.is_file() and keys.file_sha256(place) != staged[result][1]:
            raise InputError(f"{place}: differs from the archive's and would be lost; restore into another --out")
    return name


def _place(store: Store, out: Path, staged: dict[str, tuple[Path, str]], run: str) -> int:
    """Move what is not there yet into place; artefacts before receipts, the record last."""
    new = 0
    have: dict[tuple[str, str], bool] = {}  # intact in this store before
    for name in sorted(staged, key=lambda n: (n == "run.json", n.endswith(".json"), n)):
        copy, sha256 = staged[name]
        part = name.split("/")
        if part[0] == "config.yaml":
            continue
        if part[0] == "store":
            stage, file = part[1], Path(part[3])
            path = store.path(stage, file.stem, file.suffix)
            if have.setdefault((stage, file.stem), store.find(stage, file.stem)[0] is not None):
                continue
        elif name == "run.json":
            path = store.root / "runs" / f"{run}.json"
        else:
            path = out / part[1] / part[2]
        if path.is_file() and keys.file_sha256(path) == sha256:
            continue
        path.parent.mkdir(parents=True, exist_ok=True)
        os.replace(copy, path)
        new += 1
    return new
