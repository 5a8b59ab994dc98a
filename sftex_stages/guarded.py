"""Files from others, read where a crash, a hang or a bomb does no harm: in a child process.

HDF5 is opened without locks by a child that may not write any file. It takes nothing but plain datasets of this one
file: soft and external links, external storage and virtual datasets are refused, and so is, before any of it is read,
more data than allowed or than the file's bytes can hold. A server that ends with its parent has the libraries loaded
and forks a child for every file, so that no file meets what another one left behind.
"""

from __future__ import annotations

import atexit
import contextlib
import importlib
import json
import multiprocessing
import os
import selectors
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import IO, Any, NamedTuple, TypeVar

import numpy as np

from .errors import InputError

PATIENCE = 6.0  # seconds without a byte from the child
_MOST_SECONDS = 600  # of work on one file, should nobody be left to lose patience
_SLAB = 16 << 20  # bytes sent at a time
_MOST_HEADER = 64 << 20
_DEEPEST = 8  # groups in groups
_FAILED = (1 << 64) - 1  # in place of a slab's length


class Declared(NamedTuple):
    """What a file says of one dataset. dtype "U" for text."""

    dtype: str
    shape: tuple[int, ...]


class Refused(Exception):
    """What this reader does not read, in words (in the child)."""


class DamagedFileError(Exception):
    """What is wrong with a file, in words (in the parent)."""


_T = TypeVar("_T")
Check = Callable[[Mapping[str, Any], Mapping[str, Declared]], None]


def read_hdf5(
    path: Path, names: Sequence[str], max_bytes: int = 8 << 30, check: Check | None = None, what: str = "HDF5"
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """The root's attributes (plain Python) and those of the datasets `names` that are there.

    `what`: kind of file, for messages. `check(attributes, declared)` is called before any data is read and may raise.
    Text comes as '<U…'. Raises InputError, which names the file, for everything that is wrong with it.
    """
    return _guarded(path, what, names, max_bytes, check)


def survey_hdf5(path: Path, max_bytes: int = 8 << 30, what: str = "HDF5") -> dict[str, Declared]:
    """What a file says of all its datasets; none is read. InputError if anything in it is not a plain dataset."""
    found: dict[str, Declared] = {}

    def note(attributes: Mapping[str, Any], declared: Mapping[str, Declared]) -> None:
        found.update(declared)
        raise _Enough

    with contextlib.suppress(_Enough):
        _guarded(path, what, None, max_bytes, note)
    return found


def apart(function: Callable[..., _T], path: Path, *more: Any) -> _T:
    """``function(path, *more)``, called in a process of its own. InputError if the file is the death of it."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        try:
            return pool.submit(function, path, *more).result()
        except BrokenProcessPool as error:
            raise InputError(
                f"{path}: the process that read it died; save the file anew with another program"
            ) from error


class _Enough(Exception):
    """Nothing more is wanted of this file."""


def _guarded(
    path: Path, what: str, names: Sequence[str] | None, max_bytes: int, check: Check | None
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    if not path.is_file():
        raise InputError(f"{path}: no such {what} file")
    with _lock:
        server = _running()
        try:
            return server.read(path, names, max_bytes, check)
        except DamagedFileError as error:
            raise InputError(f"{path}: not a whole {what} file in HDF5 ({error}); make or copy it anew") from error
        finally:
            if not server.idle:
                server.kill()  # whatever is left of this file goes with it


# ----------------------------------------------------------------------------------------------- the parent's side

_lock = threading.Lock()
_server: _Server | None = None


class _Server:
    """A running server. It is used again only while it is idle: all that was asked of it, it has answered."""

    def __init__(self) -> None:
        folder = str(Path(__file__).resolve().parents[1])
        known = os.environ.get("PYTHONPATH")
        env = {**os.environ, "PYTHONPATH": folder + (os.pathsep + known if known else ""), "OMP_NUM_THREADS": "1"}
        self.owner = os.getpid()
        self.process = subprocess.Popen(
            [sys.executable, "-P", "-m", __name__], env=env,
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, process_group=0,
        )  # fmt: skip
        assert self.process.stdin and self.process.stdout
        self.to: IO[bytes] = self.process.stdin
        self.idle, self.new = True, True
        self.out = self.process.stdout.fileno()
        self.selector = selectors.DefaultSelector()
        self.selector.register(self.out, selectors.EVENT_READ)

    def read(
        self, path: Path, names: Sequence[str] | None, max_bytes: int, check: Check | None
    ) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
        request = {"path": str(path.absolute()), "names": names and list(names), "max_bytes": max_bytes}
        self.idle = False
        try:
            self._say(json.dumps(request).encode() + b"\n")
            header = self._json(path)
            declared = {name: Declared(dtype, tuple(shape)) for name, dtype, shape in header["declared"]}
            if check:
                try:
                    check(header["attributes"], declared)
                except (InputError, _Enough):
                    self._say(b"-")
                    self._json(path)
                    raise
            self._say(b"+")
            arrays = {name: self._array(path, *entry) for name, entry in declared.items()}
            self._json(path)
        except (BrokenPipeError, EOFError) as error:
            raise DamagedFileError(f"reading it crashed, {self._ending()}") from error
        return header["attributes"], arrays

    def _say(self, words: bytes) -> None:
        self.to.write(words)
        self.to.flush()

    def _array(self, path: Path, dtype: str, shape: tuple[int, ...]) -> np.ndarray:
        if dtype == "U":
            return np.array(self._json(path)["text"], dtype=np.str_).reshape(shape)
        array = np.empty(shape, np.dtype(dtype))
        view = memoryview(array.reshape(-1).view(np.uint8).data)
        at = 0
        while at < len(view):
            length = int.from_bytes(self._bytes(8), "little")
            if length == _FAILED:
                self._json(path)
            view[at : at + length] = self._bytes(length)
            at += length
        return array

    def _json(self, path: Path) -> dict[str, Any]:
        length = int.from_bytes(self._bytes(8), "little")
        if length > _MOST_HEADER:
            raise DamagedFileError(f"{length} bytes of attributes or text")
        document: dict[str, Any] = json.loads(self._bytes(length))
        self.idle = not document.keys().isdisjoint({"refused", "damaged", "end"})  # these are its last words
        if "refused" in document:
            raise InputError(f"{path}: {document['refused']}")
        if "damaged" in document:
            raise DamagedFileError(document["damaged"])
        return document

    def _bytes(self, count: int) -> bytes:
        blocks = []
        patience = 5 * PATIENCE if self.new else PATIENCE  # the first answer waits for imports
        while count:
            if not self.selector.select(patience):
                raise DamagedFileError(f"no answer within {patience:.0f} s")
            block = os.read(self.out, min(count, 1 << 20))
            if not block:
                raise EOFError
            blocks.append(block)
            count -= len(block)
            self.new = False
        return b"".join(blocks)

    def _ending(self) -> str:
        code = self.process.wait(PATIENCE)
        return signal.Signals(-code).name if code < 0 else f"exit code {code}"

    def kill(self) -> None:
        """End it, and its child."""
        global _server
        _server = None
        self.selector.close()
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.process.pid, signal.SIGKILL)
        with contextlib.suppress(BrokenPipeError):
            self.process.communicate()


def _running() -> _Server:
    global _server
    if _server is None or _server.owner != os.getpid() or _server.process.poll() is not None:
        _server = _Server()
    return _server


@atexit.register
def _stop() -> None:
    if _server and _server.owner == os.getpid():
        _server.kill()


# ------------------------------------------------------------------------------------------------ the server's side


def _serve() -> None:
    """Answer requests, each in a child, until the parent is gone; die as a child dies."""
    import resource

    resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))  # a file that makes HDF5 write has no effect
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    out = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # nothing else may print into the answers
    importlib.import_module(".engine.hdf5", __package__)  # h5py and all it needs: loaded once, before the forks
    for line in sys.stdin.buffer:
        child = os.fork()
        if child == 0:
            try:
                _reply(json.loads(line), out)
                os._exit(0)
            finally:
                os._exit(1)
        code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        if code < 0:
            os.kill(os.getpid(), -code)
        if code:
            os._exit(max(code, 1))


def _reply(request: dict[str, Any], out: IO[bytes]) -> None:
    """The answer to one request, in the child."""
    import resource

    room = request["max_bytes"] + (2 << 30)
    resource.setrlimit(resource.RLIMIT_AS, (room, resource.getrlimit(resource.RLIMIT_AS)[1]))
    resource.setrlimit(resource.RLIMIT_CPU, (_MOST_SECONDS, _MOST_SECONDS))
    try:
        for block in _answer(request):
            out.write(block)
            out.flush()
    except Refused as error:
        _fail(out, "refused", str(error))
    except Exception as error:
        _fail(out, "damaged", " ".join(str(error).split())[:300] or type(error).__name__)
    out.flush()


def _fail(out: IO[bytes], how: str, words: str) -> None:
    out.write(_FAILED.to_bytes(8, "little") if _fail_as_slab[0] else b"")
    out.writelines(_framed({how: words}))


_fail_as_slab = [False]  # whether the parent expects a slab of an array next


def _framed(document: dict[str, Any]) -> list[bytes]:
    text = json.dumps(document).encode()
    return [len(text).to_bytes(8, "little"), text]


def _answer(request: dict[str, Any]) -> Iterator[bytes]:
    import h5py

    from .engine.hdf5 import plain

    _fail_as_slab[0] = False
    path = request["path"]
    with h5py.File(path, "r", locking=False) as file:
        found: dict[str, Any] = {}
        for name in _everything(file) if request["names"] is None else request["names"]:
            node = _dataset(file, name)
            if node is None:
                continue
            if problem := plain(node):
                raise Refused(f"{name} {problem}; such files are not read")
            found[name] = node
        total = sum(node.size * max(1, node.dtype.itemsize) for node in found.values())
        if total > request["max_bytes"]:
            limit = request["max_bytes"] / 2**30
            raise Refused(f"declares {total / 2**30:.1f} GiB of data, over the limit of {limit:.1f} GiB")
        declared = [[name, _dtype(name, node), list(node.shape)] for name, node in found.items()]
        attributes = {str(name): _plain_value(file.attrs, name) for name in file.attrs}
        yield from _framed({"attributes": attributes, "declared": declared})
        for name, node in found.items() if os.read(0, 1) == b"+" else ():
            if _dtype(name, node) == "U":
                _fail_as_slab[0] = False
                text = np.asarray(node.asstr()[()], dtype=np.str_)
                yield from _framed({"text": text.ravel().tolist()})
                continue
            _fail_as_slab[0] = True
            for slab in _slabs(node):
                data = np.ascontiguousarray(slab).tobytes()
                if data:
                    yield len(data).to_bytes(8, "little")
                    yield data
        _fail_as_slab[0] = False
    yield from _framed({"end": True})  # not before the file is closed, which may fail too


def _dataset(file: Any, name: str) -> Any:
    """The dataset `name`, None if there is none; Refused if it is reached by a link or is something else."""
    import h5py

    node: Any = file
    for part in name.split("/"):
        link = node.get(part, getlink=True) if isinstance(node, h5py.Group) else None
        if link is None:
            return None
        if not isinstance(link, h5py.HardLink):
            raise Refused(f"{name} is a link to elsewhere; such files are not read")
        node = node[part]
    if not isinstance(node, h5py.Dataset):
        raise Refused(f"{name} is not a dataset; such files are not read")
    return node


def _everything(group: Any, prefix: str = "", depth: int = 0) -> Iterator[str]:
    """Names of all that is no group, whatever it is."""
    import h5py

    if depth > _DEEPEST:  # a group may contain itself
        raise Refused(f"{prefix} lies too deep; such files are not read")
    for name in group:
        if isinstance(group.get(name, getlink=True), h5py.HardLink) and isinstance(group[name], h5py.Group):
            yield from _everything(group[name], f"{prefix}{name}/", depth + 1)
        else:
            yield prefix + name


def _dtype(name: str, node: Any) -> str:
    import h5py

    if h5py.check_string_dtype(node.dtype) is not None:
        return "U"
    if node.dtype.kind not in "biufc" or node.dtype.hasobject or node.dtype.subdtype or node.shape is None:
        raise Refused(f"{name} holds {node.dtype}, neither numbers nor text")
    return str(node.dtype.str)


def _slabs(node: Any) -> Iterator[Any]:
    """The dataset's rows, a slab at a time: a large one shows progress."""
    if node.ndim == 0 or node.size == 0:
        yield node[()]
        return
    rows = max(1, _SLAB // max(1, node.size // len(node) * node.dtype.itemsize))
    for start in range(0, len(node), rows):
        yield node[start : start + rows]


def _plain_value(attributes: Any, name: str) -> Any:
    """An attribute as JSON holds it; None for what it cannot hold."""
    value = attributes[name]
    if isinstance(value, bytes):
        return value.decode(errors="replace")
    if isinstance(value, np.generic | np.ndarray):
        value = value.tolist()
    if isinstance(value, str | bool | int | float):
        return value
    return value if isinstance(value, list) and all(isinstance(v, str | int | float) for v in value) else None


if __name__ == "__main__":
    _serve()
