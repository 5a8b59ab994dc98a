"""Round trip of a new print: the scene's own flat albedo, laid on the recovered surface in the recovered light.

The flat albedo is made from the truth alone: the photograph over the true irradiance, laid flat on a chart of the true surface
(`geometry/chart.py`). Two charts of one surface differ by a rigid motion, which is fitted; irradiance by one scale, which is
removed as everywhere. What is left of the difference from the photograph is the error of shape, chart, light and resampling.
"""

import subprocess
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.ndimage import label

from ..errors import SftexError
from ..geometry.chart import Pinhole, make_chart
from ..guarded import read_hdf5
from ..results.archive import Result
from ..results.light import albedo
from ..results.mesh import bake, mesh
from ..results.retexture import print_on

_NAMES = ("surface/valid", "surface/normals", "surface/height", "irradiance/map")
_VERTICES, _TURNS = 20000, 100


def round_trip(result: Result, truth_path: Path) -> float | None:
    """Median |log(picture / photograph)| over the pixels that both surfaces have; None where the truth lacks something."""
    attributes, truth = read_hdf5(truth_path, _NAMES, what="truth")
    if len(truth) < len(_NAMES):
        return None
    valid = truth["surface/valid"].astype(bool) & (truth["surface/normals"][..., 2] > 0.1)
    pieces, _ = label(valid & (truth["irradiance/map"] > 0))
    whole = np.where(pieces == np.bincount(pieces[valid]).argmax(), 1, 0)  # the largest
    camera = _camera(attributes)
    height, normals = (truth[f"surface/{n}"].astype(float) for n in ("height", "normals"))
    flat = make_chart(height, normals, whole, camera, _VERTICES, _TURNS).uv
    sheet = mesh(height, normals, whole, flat, camera)
    print_ = bake(sheet, albedo(result.image, truth["irradiance/map"], whole > 0))
    both = (whole > 0) & result.valid & np.isfinite(result.chart).all(2) & (result.irradiance > 0)
    if both.sum() < 100:
        return None
    # From the true chart to px of the print: an affine map, read off the mesh.
    on_print = sheet.uv * np.array(sheet.size[::-1]) - 0.5
    there = flat[sheet.pixel[:, 1], sheet.pixel[:, 0]]
    turn, shift = _rigid(result.chart[both].astype(float), flat[both])
    scale, offset = np.polyfit(there[:, 0], on_print[:, 0], 1), np.polyfit(there[:, 1], on_print[:, 1], 1)
    moved = (result.chart.astype(float) @ turn + shift) * [scale[0], offset[0]] + [scale[1], offset[1]]
    picture = print_on(moved, both, print_)
    shown = (picture * result.irradiance[..., None]).mean(2)[both]
    seen = result.image.mean(2)[both]
    good = (shown > 0) & (seen > 0)
    ratio = np.log(shown[good] / seen[good])
    return float(np.median(np.abs(ratio - np.median(ratio))))


def _camera(attributes: dict[str, Any]) -> Pinhole:
    if attributes.get("camera") != "perspective":
        return Pinhole()
    x, y = attributes["principal_point"]
    return Pinhole(float(attributes["focal_px"]), (float(x), float(y)))


def _rigid(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotation (2, 2) and shift (2,) with a @ rotation + shift nearest to b, (N, 2) each, by the median of the residuals."""
    weight = np.ones(len(a))
    for _ in range(5):
        middle = [np.average(x, axis=0, weights=weight) for x in (a, b)]
        u, _, v = np.linalg.svd(((a - middle[0]) * weight[:, None]).T @ (b - middle[1]))
        turn = u @ np.diag([1, np.linalg.det(u @ v)]) @ v
        shift = middle[1] - middle[0] @ turn
        away = np.linalg.norm(a @ turn + shift - b, axis=1)
        weight = 1 / (1 + (away / max(float(np.median(away)), 0.05)) ** 2)
    return turn, shift


def render_seconds(command: list[str], result: Path, scratch: Path) -> float:
    """Seconds that ``sftex render`` takes to put a checked print on a result. SftexError with its last words if it fails."""
    y, x = np.mgrid[:256, :256]
    checks = np.where((x // 64 + y // 64) % 2, 230, 60).astype(np.uint8)
    cv2.imwrite(str(scratch / "checks.png"), np.dstack([checks] * 3))
    words = ["render", str(result), "--texture", str(scratch / "checks.png"), "-o", str(scratch / "dressed.png")]
    started = time.perf_counter()
    done = subprocess.run([*command, *words], capture_output=True, text=True, check=False)
    if done.returncode:
        raise SftexError(f"sftex render: {done.stderr.strip().splitlines()[-1:]}")
    return time.perf_counter() - started
