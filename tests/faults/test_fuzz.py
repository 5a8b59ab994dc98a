"""Files from others, mutated: no crash, no hang, nothing outside. The process that matters is the one of the tests."""

import os
import resource
import signal
import struct
import time
import zlib
from collections import defaultdict
from pathlib import Path

import h5py
import numpy as np
import OpenImageIO as oiio
import pytest
from faults import HANG, LONG, wait_until

from sftex_stages import cli, evaluate, guarded, images, pipeline
from sftex_stages.engine.execute import execute
from sftex_stages.errors import InputError
from sftex_stages.results import archive


def mutations(content, rng, times):
    """Random bytes, blocks, extreme numbers, cuts and splices."""
    size = len(content)
    for number in range(times):
        data = bytearray(content)
        kind = number % 6
        where = rng.randrange(size if number % 2 else min(size, 3000))  # headers more often than data
        if kind == 0:
            for _ in range(rng.choice([1, 3, 10, 50])):
                data[rng.randrange(size)] ^= 1 << rng.randrange(8)
        elif kind == 1:
            data[where : where + 8] = rng.choice([b"\xff" * 8, b"\0" * 8, b"\x7f" + b"\xff" * 7, b"\0" * 7 + b"\x80"])
        elif kind == 2:
            data[where : where + 64] = rng.randbytes(64)
        elif kind == 3:
            data = data[: rng.randrange(size)]
        elif kind == 4:
            other = rng.randrange(size)
            data[where : where + 200] = data[other : other + 200]
        else:
            for _ in range(5):
                at = rng.randrange(min(size, 2000))
                data[at : at + 2] = rng.randbytes(2)
        yield bytes(data)


def result_files(folder):
    """A result as sftex writes it, and one as plain h5py does (whose metadata have no checksums)."""
    rng = np.random.default_rng(0)
    data, sizes = {}, defaultdict(lambda: 3, {"H": 40, "W": 50, "N": 9, "K": 2, "n": 6})
    for name, entry in archive.SCHEMA.items():
        shape = tuple(int(a) if a.isdigit() else sizes[a] for a in entry.axes.split())
        data[name] = np.full(shape, "word", "S8") if entry.dtype == "U" else rng.random(shape).astype(entry.dtype)
    for kind, options in {"sealed.h5": {"libver": ("v110", "v110")}, "plain.h5": {}}.items():
        with h5py.File(folder / kind, "w", **options) as file:
            file.attrs.update({"schema": archive.SCHEMA_NAME, "schema_version": 1, "camera": "orthographic"})
            file.attrs.update({"keys": "{}", "versions": "{}"})
            for name, array in data.items():
                text = array.astype(h5py.string_dtype("utf-8", 8)) if array.dtype.kind == "S" else array
                whole = {"compression": "gzip", "chunks": True, "fletcher32": True} if array.nbytes > 4000 else {}
                file.create_dataset(name, data=text, **whole)
        assert archive.open_result(folder / kind).height.shape == (40, 50)
    return [(folder / kind).read_bytes() for kind in ("sealed.h5", "plain.h5")]


def listing(*folders):
    return {
        p: p.stat().st_mtime_ns for folder in folders for p in folder.rglob("*") if not p.name.startswith("fuzzed.")
    }


def test_fuzzed_results(tmp_path, monkeypatch, rng, measured):
    (tmp_path / "cwd").mkdir()
    monkeypatch.chdir(tmp_path / "cwd")
    seeds = result_files(tmp_path)
    times = 250 if LONG else 20
    before = listing(tmp_path)
    path, counts, longest = tmp_path / "fuzzed.h5", {"read": 0, "refused": 0, "crashed": 0}, 0.0
    for seed in seeds:
        for number, data in enumerate(mutations(seed, rng, times)):
            path.write_bytes(data)
            started = time.monotonic()
            try:
                archive.open_result(path) if number % 3 else evaluate.evaluate(tmp_path / "sealed.h5", path)
                counts["read"] += 1
                if number % 3:
                    shown = tmp_path / f"fuzzed.{'png' if number % 2 else 'exr'}"
                    assert cli.main(["render", str(path), "--light", "1,-1,2", "-o", str(shown)]) in (cli.OK, cli.USAGE)
            except InputError as error:
                assert str(path) in str(error) or "sealed.h5" in str(error)
                counts["crashed" if "reading it crashed" in str(error) else "refused"] += 1
            longest = max(longest, time.monotonic() - started)
    assert longest < HANG and listing(tmp_path) == before
    words = f"{counts['refused']} refused, {counts['read']} read (damage in numbers without checksum), "
    words += f"{counts['crashed']} ended the reading child; longest {longest:.1f} s; nothing written"
    measured("fuzzed result and truth files", 2 * times, words)


def image_seeds(folder):
    pixels = np.random.default_rng(1).integers(0, 256, (40, 60, 4), np.uint8)
    for ending, channels in {"png": 4, "jpg": 3, "tif": 3, "exr": 4, "bmp": 3, "webp": 3}.items():
        path = folder / f"seed.{ending}"
        spec = oiio.ImageSpec(60, 40, channels, "half" if ending == "exr" else "uint8")
        file = oiio.ImageOutput.create(str(path))
        assert file.open(str(path), spec) and file.write_image(np.ascontiguousarray(pixels[..., :channels]))
        file.close()
        yield ending, path.read_bytes()
        path.unlink()


def test_fuzzed_images(tmp_path, monkeypatch, rng, measured):
    """Through the engine, as a user's files go: a decoder that crashes takes its worker, not the run."""
    folder = tmp_path / "in"
    folder.mkdir()
    monkeypatch.chdir(tmp_path)
    seeds = list(image_seeds(tmp_path))
    times = 204 if LONG else 12
    for ending, seed in seeds:
        for number, data in enumerate(mutations(seed, rng, times // len(seeds))):
            (folder / f"{ending}{number}.{ending}").write_bytes(data)
    items = pipeline.items(images.discover(folder))
    assert len(items) == times

    class Clock:
        last, longest = 0.0, 0.0

        def progress(self, result, stage, done, jobs):
            self.finished(result)

        def finished(self, result):
            now = time.monotonic()
            self.longest, self.last = max(self.longest, now - (self.last or now)), now  # not the start of workers

    clock = Clock()
    params = {stage.name: stage.params() for stage in pipeline.PIPELINE}
    planner = pipeline.planner(tmp_path / "out", params, until="image")
    results = execute(planner, items, 2, clock)
    failed = [result.error for result in results if result.error]
    crashed = sum("died" in error for error in failed)
    assert not any("unexpected" in error for error in failed), [e for e in failed if "unexpected" in e]
    assert all(
        str(result.item.files["image"]) in result.error or "died" in result.error for result in results if result.error
    )
    assert clock.longest < HANG
    assert {p.name for p in tmp_path.iterdir()} == {"in", "out"} and len(os.listdir(folder)) == times
    words = (
        f"{len(failed) - crashed} refused with a reason, {times - len(failed)} decoded, {crashed} ended their worker; "
    )
    measured("fuzzed images (PNG, JPEG, TIFF, EXR, BMP, WebP)", times, words + f"longest wait {clock.longest:.1f} s")


def bombs():
    """Small files that claim, or unpack to, far more than they hold."""

    def chunk(kind, body):
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    def png(width, height, extra, body):
        header = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0))
        return b"\x89PNG\r\n\x1a\n" + header + extra + chunk(b"IDAT", body) + chunk(b"IEND", b"")

    def tiff(**more):
        tags = {256: 64, 257: 64, 258: 8, 259: 1, 262: 1, 273: 8, 277: 1, 278: 64, 279: 64} | {
            int(k[1:]): v for k, v in more.items()
        }
        body = b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in sorted(tags.items()))
        return b"II*\0" + struct.pack("<I", 72) + bytes(64) + struct.pack("<H", len(tags)) + body + bytes(4)

    packed, rows = zlib.compress(bytes(100_000_000), 9), zlib.compress((b"\0" + bytes(8)) * 8)
    yield "comment.png", png(8, 8, chunk(b"zTXt", b"Comment\0\0" + packed), rows)
    yield "profile.png", png(8, 8, chunk(b"iCCP", b"x\0\0" + packed), rows)
    yield "rows.png", png(8, 8, b"", packed)
    yield "size.png", png(2**31 - 1, 2**31 - 1, b"", rows)
    yield "size.tif", tiff(t256=2**31, t257=2**31)
    yield "tile.tif", tiff(t322=2**26, t323=2**26, t324=8, t325=64)
    yield "channels.tif", tiff(t277=1000)
    yield (
        "size.bmp",
        b"BM" + struct.pack("<IHHIIiiHHIIiiII", 54, 0, 0, 54, 40, 60000, 60000, 1, 24, *[0] * 6) + bytes(99),
    )
    yield (
        "size.jpg",
        bytes.fromhex("ffd8ffc0001108ffffffff03011100021100031100ffda000c03010002110311003f00") + bytes(50),
    )
    yield "size.webp", b"RIFF" + struct.pack("<I", 30) + b"WEBPVP8X" + struct.pack("<I", 10) + bytes(4) + b"\xff" * 6
    yield "size.hdr", b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 100000 +X 100000\n" + b"\2\2\0\0" * 10


def test_bombs(tmp_path, measured):
    """Refused, or read for what they are, in little time and memory."""
    sizes = []
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for name, content in bombs():
        (tmp_path / name).write_bytes(content)
        started = time.monotonic()
        try:
            assert images.load_image(tmp_path / name)[0].shape == (8, 8, 3)
        except InputError as error:
            assert str(tmp_path / name) in str(error)
        assert time.monotonic() - started < HANG
        sizes.append(len(content))
    grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) // 1024
    assert grown < 500
    measured("decompression bombs and absurd sizes", len(sizes), f"refused or harmless; {grown} MB more memory at most")


def die(path):
    os.kill(os.getpid(), signal.SIGSEGV)


def test_a_texture_that_crashes_its_decoder_is_an_error(tmp_path, monkeypatch, capfd):
    result_files(tmp_path)
    monkeypatch.setattr(images, "load_image", die)
    arguments = [
        "render",
        str(tmp_path / "plain.h5"),
        "--texture",
        str(tmp_path / "x.png"),
        "-o",
        str(tmp_path / "o.png"),
    ]
    assert cli.main(arguments) == cli.USAGE and not (tmp_path / "o.png").exists()
    assert "x.png: the process that read it died" in capfd.readouterr().err


def reader():
    """The process that reads the present file: the only child of the server."""
    server = guarded._server.process.pid
    (child,) = Path(f"/proc/{server}/task/{server}/children").read_text().split()
    return int(child)


@pytest.mark.parametrize("fault", [signal.SIGSEGV, signal.SIGKILL])
def test_a_reader_that_crashes_is_an_error_and_the_next_file_is_read(tmp_path, fault):
    result_files(tmp_path)
    with pytest.raises(InputError, match=rf"plain\.h5: .*crashed, {fault.name}"):
        guarded.read_hdf5(tmp_path / "plain.h5", ["surface/height"], check=lambda *declared: os.kill(reader(), fault))
    assert archive.open_result(tmp_path / "plain.h5").valid.shape == (40, 50)


def test_a_reader_that_hangs_is_stopped(tmp_path, monkeypatch):
    result_files(tmp_path)
    stopped = []

    def stop(*declared):
        monkeypatch.setattr(guarded, "PATIENCE", 0.3)
        stopped.append(reader())
        os.kill(stopped[0], signal.SIGSTOP)

    with pytest.raises(InputError, match=r"no answer within 0 s"):
        guarded.read_hdf5(tmp_path / "plain.h5", ["surface/height"], check=stop)
    assert wait_until(lambda: not Path(f"/proc/{stopped[0]}/cmdline").exists())


def test_refused_and_damaged_files_leave_the_server_ready(tmp_path):
    """Whatever is wrong, and whenever it is found, the next file is answered from its beginning, by the same server."""
    content, _ = result_files(tmp_path)
    whole = archive.open_result(tmp_path / "sealed.h5").height
    server = guarded._server.process.pid
    with h5py.File(tmp_path / "sealed.h5") as file:
        chunk = file["surface/height"].id.get_chunk_info(0)
    rotten = bytearray(content)
    rotten[chunk.byte_offset + 9] ^= 4
    with h5py.File(tmp_path / "less.h5", "w") as file:
        file["another"] = 1
    less = (tmp_path / "less.h5").read_bytes()
    for name, bad in {"cut": content[:500], "text": b"text", "rotten": bytes(rotten), "less": less}.items():
        (tmp_path / "bad.h5").write_bytes(bad)
        with pytest.raises(InputError, match=r"bad\.h5"):
            archive.open_result(tmp_path / "bad.h5")
        np.testing.assert_array_equal(archive.open_result(tmp_path / "sealed.h5").height, whole)
        assert guarded._server.process.pid == server, name
