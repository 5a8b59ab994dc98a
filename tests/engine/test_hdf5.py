import hashlib
import json
import subprocess
import sys

import h5py
import numpy as np
import pytest

from sftex_stages.engine import keys
from sftex_stages.engine.hdf5 import decode, encode


def arrays():
    rng = np.random.default_rng(0)
    return {
        "image/rgb": rng.random((90, 70, 3)).astype(np.float32),
        "mask": rng.random((300, 300)) > 0.5,
        "transposed": rng.random((40, 50)).T,
        "large": np.arange(700_000, dtype=np.float64).reshape(7, 100, 1000),
        "empty": np.zeros((0, 2), np.float32),
        "nan": np.array([np.nan, np.inf, -0.0]),
        "count": np.array(3),
        "flag": np.array(True),
        "reason": np.array("zu wenig – α"),
        "nothing": np.array(""),
        "words": np.array(["a", "", "größer"]),
        "no words": np.array([], dtype="<U5"),
        "bytes": np.arange(256, dtype=np.uint8),
    }


def test_round_trip_is_exact():
    original = arrays()
    back = decode(encode(original))
    assert back.keys() == original.keys()
    for name, array in original.items():
        assert back[name].shape == array.shape and back[name].dtype.kind == array.dtype.kind, name
        if array.dtype.kind == "U":
            assert (back[name] == array).all()
        else:
            assert back[name].dtype == array.dtype and back[name].tobytes() == array.tobytes(order="C"), name
        assert not back[name].flags.writeable


def test_bytes_depend_on_the_content_alone():
    """Not on the order of names, the width of text, the memory layout; nor on the process."""
    original = arrays()
    other = {name: original[name] for name in reversed(original)}
    other["words"] = other["words"].astype("<U40")
    other["transposed"] = np.ascontiguousarray(other["transposed"])
    image = encode(original)
    assert encode(other) == image
    code = "import test_hdf5 as t, hashlib; print(hashlib.sha256(t.encode(t.arrays())).hexdigest())"
    paths = json.dumps([*sys.path, __file__.rsplit("/", 1)[0]])
    code = f"import sys; sys.path[:] = {paths}; {code}"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, timeout=120)
    assert done.stdout.decode().strip() == hashlib.sha256(image).hexdigest(), done.stderr.decode()


def test_what_cannot_be_stored_is_refused():
    with pytest.raises(TypeError, match="'x' has dtype object"):
        encode({"x": np.array([{}, None])})


def test_canonical_json():
    assert keys.canonical({"b": 1e-6, "a": [True, None, "ä"]}) == '{"a":[true,null,"ä"],"b":1e-06}'.encode()
    assert keys.digest({"a": 1, "b": 2}) == keys.digest({"b": 2, "a": 1})
    assert keys.digest({"a": 0.1 + 0.2}) != keys.digest({"a": 0.3})
    with pytest.raises(ValueError):
        keys.canonical(float("nan"))


def test_what_points_elsewhere_or_claims_too_much_is_not_decoded(tmp_path):
    """As a restored artefact might: its hash is right, its content is not what `encode` writes."""
    (tmp_path / "secret").write_bytes(bytes(8000))

    def external(file):
        file.create_dataset("x", (1000,), "f8", external=[(str(tmp_path / "secret"), 0, 8000)])

    def huge(file):
        file.create_dataset("x", (10**6, 10**6), "f8", chunks=(1000, 1000))

    def virtual(file):
        layout = h5py.VirtualLayout((1000,), "f8")
        layout[:] = h5py.VirtualSource(str(tmp_path / "other.h5"), "x", (1000,))
        file.create_virtual_dataset("x", layout)

    for make, words in {external: "another file", virtual: "another file", huge: "declares .* GiB"}.items():
        with h5py.File(tmp_path / "a.h5", "w") as file:
            make(file)
        with pytest.raises(ValueError, match=words):
            decode((tmp_path / "a.h5").read_bytes())
