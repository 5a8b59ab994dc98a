"""Arrays to HDF5 bytes and back.

The file is built in memory and written by the store with ordinary writes: HDF5 itself crashes the interpreter on a full
disk. The bytes depend on the arrays alone (no timestamps, sorted names, fixed chunking), so that the SHA-256 of a file
is the hash of its content. Checksums (fletcher32) guard the chunks for readers that do not know that SHA-256.
"""

from __future__ import annotations

import h5py
import numpy as np

from .stage import Arrays

_CHUNKED_FROM = 4096  # bytes; below, a compressed chunk costs more than it saves
_CHUNK_BYTES = 1 << 20
_MOST_RATIO = 1100  # of numbers to stored bytes: deflate cannot do better than 1032


def encode(arrays: Arrays) -> bytes:
    """HDF5 file image of flat named arrays ('/' in a name makes a group). TypeError for what cannot be held exactly."""
    with h5py.File.in_memory(libver=("v110", "v110")) as file:
        for name in sorted(arrays):
            array = np.asarray(arrays[name], order="C")
            if array.dtype.kind == "U":
                file.create_dataset(name, data=_utf8(array))
            elif array.dtype.kind in "biufc":
                file.create_dataset(name, data=array, **_layout(array))
            else:
                raise TypeError(f"array {name!r} has dtype {array.dtype}; only numbers, bool and text can be stored")
        file.flush()
        image: bytes = file.id.get_file_image()
    return image


def decode(image: bytes) -> Arrays:
    """The arrays of `encode`, read-only. Text comes back as '<U…', scalars as 0-d arrays.

    ValueError for what `encode` does not write: data outside of the file, or more of it than the bytes can hold.
    """
    arrays: Arrays = {}

    def visit(name: str, node: object) -> None:
        if isinstance(node, h5py.Dataset):
            if problem := plain(node):
                raise ValueError(f"{name} {problem}")
            text = h5py.check_string_dtype(node.dtype) is not None
            array = np.asarray(node.asstr()[()], dtype=np.str_) if text else np.asarray(node[()])
            array.flags.writeable = False  # shared between the jobs of a worker: no stage may change its inputs
            arrays[name] = array

    with h5py.File.in_memory(file_image=image) as file:
        file.visititems(visit)
    return arrays


def plain(dataset: h5py.Dataset) -> str:
    """What makes a dataset other than plain numbers or text in its own file, in words; "" if nothing does."""
    if dataset.is_virtual or dataset.external:
        return "is not an ordinary dataset: its numbers are in another file"
    declared = (dataset.size or 0) * dataset.dtype.itemsize
    stored = dataset.id.get_storage_size()
    if declared > _CHUNKED_FROM and declared > _MOST_RATIO * stored:
        return f"declares {declared / 2**30:.1f} GiB of data in {stored} bytes"
    return ""


def _utf8(array: np.ndarray) -> np.ndarray:
    """Fixed-length UTF-8 (variable-length strings live in a heap outside of the checksums)."""
    encoded = np.char.encode(array, "utf-8")
    length = max(1, encoded.dtype.itemsize)
    return encoded.astype(h5py.string_dtype("utf-8", length))


def _layout(array: np.ndarray) -> dict:
    if array.nbytes < _CHUNKED_FROM:
        return {}
    chunks = list(array.shape)
    axis = 0
    while np.prod(chunks) * array.itemsize > _CHUNK_BYTES:  # halve the slowest axis first: rows stay whole
        if chunks[axis] == 1:
            axis += 1
        else:
            chunks[axis] = -(-chunks[axis] // 2)
    return {
        "chunks": tuple(chunks), "compression": "gzip", "compression_opts": 1, "shuffle": True, "fletcher32": True,
    }  # fmt: skip
