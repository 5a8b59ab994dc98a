"""Disks that fail: every call in turn, a full disk, a store that may only be read, a file system without locks."""

import builtins
import errno
import fcntl
import io
import json
import os
import resource
import signal
import subprocess

import pytest
import toy_pipeline as toy
from faults import LONG, check, launch, results, said

from sftex_stages.engine import runs, worker
from sftex_stages.errors import SftexError

OPERATIONS = ["open", "write", "fsync", "rename", "mkdir"]


class Faulty:
    """Counts calls of one operation below a folder; the k-th of them fails (and all after it, if `lasting`)."""

    def __init__(self, monkeypatch, folder, operation, code):
        self.folder, self.operation, self.code = str(folder), operation, code
        self.calls, self.k, self.lasting = 0, 0, False
        real_open, real_fsync, real_replace, real_mkdir = builtins.open, os.fsync, os.replace, os.mkdir

        def opening(file, mode="r", *args, **options):
            if self.mine(file):
                self.count("open", file)
            stream = real_open(file, mode, *args, **options)
            return self.writing(stream, file) if self.mine(file) and set(mode) & set("wxa") else stream

        def fsync(number):
            self.count("fsync", None)
            real_fsync(number)

        def replace(source, target):
            self.count("rename", target)
            real_replace(source, target)

        def mkdir(path, *args, **options):
            if self.mine(path):
                self.count("mkdir", path)
            real_mkdir(path, *args, **options)

        monkeypatch.setattr(builtins, "open", opening)
        monkeypatch.setattr(io, "open", opening)
        monkeypatch.setattr(os, "fsync", fsync)
        monkeypatch.setattr(os, "replace", replace)
        monkeypatch.setattr(os, "mkdir", mkdir)

    def mine(self, file):
        return isinstance(file, str | os.PathLike) and str(file).startswith(self.folder)

    def count(self, operation, path):
        if operation == self.operation:
            self.calls += 1
            if self.k and (self.calls == self.k or (self.lasting and self.calls > self.k)):
                raise OSError(self.code, os.strerror(self.code), None if path is None else str(path))

    def writing(self, stream, path):
        faulty = self

        class Stream:
            def __getattr__(self, name):
                return getattr(stream, name)

            def __enter__(self):
                return self

            def __exit__(self, *exc):
                stream.close()

            def write(self, data):
                try:
                    faulty.count("write", None)
                except OSError:
                    stream.write(data[: len(data) // 2])  # a failing write leaves a part behind
                    raise
                return stream.write(data)

        return Stream()


@pytest.mark.parametrize("operation", OPERATIONS)
@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EIO] if LONG else [errno.EIO], ids=errno.errorcode.get)
def test_every_call_fails_once(folder, serial, monkeypatch, measured, operation, code):
    toy.run(folder / "clean", folder / "a.txt", folder / "b.txt")
    expected = results(folder / "clean")
    worker._cache.clear()
    with monkeypatch.context() as patch:
        faulty = Faulty(patch, folder / "count", operation, code)
        attempt(folder, folder / "count")
        total = faulty.calls
    assert total > 3
    step = 1 if LONG else max(1, total // 4)
    cases = loud = 0
    for lasting in (False, True):
        for k in range(1, total + 1, step):
            out = folder / f"out{k}{lasting}"
            with monkeypatch.context() as patch:
                faulty = Faulty(patch, out, operation, code)
                faulty.k, faulty.lasting = k, lasting
                errors = attempt(folder, out)
                assert faulty.calls >= k
            assert all("unexpected" not in words and os.strerror(code) in words for words in errors), errors
            if not errors:
                assert results(out) == expected  # silent only if nothing came of it
            loud += bool(errors)
            check(folder, out, expected)
            cases += 1
    name = f"call k of {operation} fails with {errno.errorcode[code]}, once or from then on, for every k"
    measured(name, cases, f"{loud} reported, {cases - loud} without effect; rerun equals a clean run")


def attempt(folder, out):
    """Run and record; the errors, in words. Anything but a SftexError goes through."""
    worker._cache.clear()
    try:
        found, planner = toy.run(out, folder / "a.txt", folder / "b.txt")
        runs.record(planner.store.root, "", [result.plan for result in found.values() if result.plan])
    except SftexError as error:
        return [str(error)]
    return [result.error for result in found.values() if result.error]


@pytest.mark.parametrize("limit", [300, 1500] if LONG else [1500])
def test_files_cannot_grow(folder, measured, limit):
    """RLIMIT_FSIZE, as on a disk that is full after so many bytes of a file."""
    toy.run(folder / "clean", folder / "a.txt", folder / "b.txt")

    def limited():
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))

    process = launch(folder, folder / "out", preexec=limited)
    answer, errors = said(process)
    assert process.returncode in (0, 2), errors
    words = [error for error in json.loads(answer).values() if error]
    assert words and all("cannot be written (File too large)" in error for error in words), words
    assert not list((folder / "out" / ".store").glob("tmp/*"))
    check(folder, folder / "out", results(folder / "clean"))
    measured(f"RLIMIT_FSIZE of {limit} bytes", 1, "reported with the file's name; no crash; rerun equals a clean run")


def mounted(path, kind, *options):
    """Mount for one test, if that is permitted here; a function that undoes it."""
    path.mkdir(exist_ok=True)
    if os.geteuid() or call("mount", *options, *kind, path, check=False):
        pytest.skip("mounting is not permitted here")
    return lambda: call("umount", "-l", path)


def call(*words, check=True):
    return subprocess.run([str(word) for word in words], check=check, capture_output=True, timeout=60).returncode


@pytest.mark.skipif(not LONG, reason="long set: make faults")
def test_full_disk(folder, measured):
    """A small tmpfs with less and less room."""
    toy.run(folder / "clean", folder / "a.txt", folder / "b.txt")
    expected = results(folder / "clean")
    cases = loud = 0
    for kilobytes in range(8, 240, 8):
        out = folder / "disk"
        undo = mounted(out, ["tmpfs"], "-t", "tmpfs", "-o", f"size={kilobytes}k")
        try:
            process = launch(folder, out)
            answer, errors = said(process)
            assert process.returncode in (0, 2), errors
            words = [error for error in json.loads(answer).values() if error]
            assert all("No space left on device" in error for error in words), words
            loud += bool(words)
            call("mount", "-o", "remount,size=10m", out)
            check(folder, out, expected)
            cases += 1
        finally:
            undo()
    assert loud
    measured("a full disk (tmpfs of 8 to 232 kB)", cases, f"{loud} reported, no crash; with room, equal to a clean run")


def test_store_that_may_only_be_read(folder, serial, monkeypatch, measured):
    """What is cached is found; what has to be computed is an error that names the store; nothing changes."""
    toy.run(folder / "out", folder / "a.txt")
    before = {p: p.read_bytes() for p in (folder / "out").rglob("*") if p.is_file()}
    with monkeypatch.context() as patch:
        for operation in OPERATIONS[1:]:
            faulty = Faulty(patch, folder / "out", operation, errno.EROFS)
            faulty.k, faulty.lasting = 1, True
        real = os.open

        def refusing(path, flags, *args, **options):
            if str(path).startswith(str(folder / "out")) and flags & (os.O_WRONLY | os.O_RDWR):
                raise OSError(errno.EROFS, os.strerror(errno.EROFS), str(path))
            return real(path, flags, *args, **options)

        patch.setattr(os, "open", refusing)
        found, _ = run(folder, "a.txt")
        assert not found["a"].error and not any(state.computed for state in found["a"].stages.values())
        with pytest.raises(SftexError, match=r"out: cannot be written \(Read-only file system\)"):
            run(folder, "a.txt", "b.txt")
    assert {p: p.read_bytes() for p in (folder / "out").rglob("*") if p.is_file()} == before
    measured("a store that may only be read", 2, "cached results are found; new ones are refused, naming the store")


def run(folder, *names):
    """Without preparing the store first: as the command line does."""
    planner = toy.planner(folder / "out")
    found = toy.execute(planner, [toy.item(folder / name) for name in names], 1, toy.Quiet())
    return {result.item.name: result for result in found}, planner


@pytest.mark.skipif(not LONG, reason="long set: make faults")
def test_mounted_read_only(folder, measured):
    toy.run(folder / "out", folder / "a.txt")
    before = results(folder / "out")
    undo = mounted(folder / "out", [str(folder / "out")], "--bind")
    try:
        call("mount", "-o", "remount,ro,bind", folder / "out")
        found, _ = run(folder, "a.txt")
        assert not found["a"].error
        with pytest.raises(SftexError, match="Read-only file system"):
            run(folder, "b.txt")
    finally:
        undo()
    assert results(folder / "out") == before
    measured("the same on a read-only mount", 2, "the same")


def test_file_system_without_locks(folder, serial, monkeypatch, measured):
    """NFS without a lock daemon: every lock fails with ENOLCK. The store needs none."""

    def refuse(*args):
        raise OSError(errno.ENOLCK, "No locks available")

    for name in ("flock", "lockf", "fcntl"):
        monkeypatch.setattr(fcntl, name, refuse)
    found, _ = toy.run(folder / "out", folder / "a.txt", folder / "b.txt")
    assert not any(result.error for result in found.values())
    check(folder, folder / "out", results(folder / "out"))
    measured("a file system without locks", 1, "no effect: nothing is locked")
