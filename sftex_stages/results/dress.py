"""The photograph dressed anew: another print, another light, another direction of view.

What measurements support has holes and a ragged border. A picture of another cloth has neither: the surface is continued,
smoothly, over holes and to the border of what looks like the same cloth (`cloth.py`). Nothing else uses the continuation.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import distance_transform_edt

from ..errors import InputError
from ..geometry import fill
from ..geometry.chart import Pinhole
from . import cloth, light, retexture
from .archive import Result

SMALL = 1e4  # what a logarithm of irradiance or a height, in px, may be at most: beyond, a file says nonsense


@dataclass(frozen=True)
class Cloth:
    """The surface continued to the cloth's border, (H, W, …): `image` linear; `there` bool; `chart` px, `irradiance`, `normals`
    and `height` NaN off it; `white`, the brightness of white print; `camera`."""

    image: np.ndarray
    there: np.ndarray
    chart: np.ndarray
    irradiance: np.ndarray
    normals: np.ndarray
    height: np.ndarray
    white: float
    camera: Pinhole

    @property
    def albedo(self) -> np.ndarray:
        """(H, W, 3) linear, NaN off the cloth."""
        return light.albedo(self.image, self.irradiance, self.there)


def continued(result: Result) -> Cloth:
    """A result's surface, continued. InputError if it has no pixel that can be used."""
    image = np.where(np.isfinite(result.image), np.clip(result.image, 0, 1e6), 0).astype(np.float32)
    y, x = np.indices(result.valid.shape, dtype=np.float32)
    with np.errstate(invalid="ignore", divide="ignore"):
        log = np.log(result.irradiance)
        known = result.valid & result.mask & (np.abs(log) < SMALL) & (np.abs(result.height) < SMALL)
        known &= (np.abs(result.chart) < retexture.FARTHEST).all(2) & (result.normals[..., 2] > 0)
        known &= (np.abs(result.normals) <= 1.01).all(2) & (result.piece > 0)
    if not known.any():
        raise InputError(f"{result.path}: no pixel of it has a surface, a chart and a light; there is nothing to dress")
    there = cloth.outline(image, known, result.mask)
    # Displacements, not places: far from all data they turn level, and the chart then goes on as the image does.
    maps = np.dstack([result.chart[..., 0] - x, result.chart[..., 1] - y, log, result.normals[..., :2], result.height])
    label = np.where(known, result.piece, 0)
    row, column = distance_transform_edt(label == 0, return_distances=False, return_indices=True)
    nearest = label[row, column]
    whole = np.full(maps.shape, np.nan, np.float32)
    free = np.array([np.inf, np.inf, 0, 0, 0, np.inf])
    for k in np.unique(label[known]):
        part = fill.fill(maps, label == k, there & (nearest == k))
        inside = np.isfinite(part[..., 0])
        low, high = part[label == k].min(0), part[label == k].max(0)
        whole[inside] = np.clip(part[inside], low - free, high + free)  # light and normals as extreme as any seen
    there &= np.isfinite(whole[..., 0])
    lean = np.minimum(1.0, 0.99 / np.maximum(np.linalg.norm(whole[..., 3:5], axis=2), 1e-9))[..., None]
    lean = whole[..., 3:5] * lean
    normals = np.dstack([lean, np.sqrt(1 - (lean**2).sum(2))])
    chart = np.dstack([whole[..., 0] + x, whole[..., 1] + y])
    bare = light.albedo(image, result.irradiance, known)
    return Cloth(image, there, chart, np.exp(whole[..., 2]), normals, whole[..., 5], light.white(bare), _camera(result))


def _camera(result: Result) -> Pinhole:
    if result.focal_px is None or result.principal_point is None or not 1 < result.focal_px < SMALL**2:
        return Pinhole()
    return Pinhole(result.focal_px, result.principal_point)


def printed(
    on: Cloth, picture: np.ndarray, opaque: np.ndarray, tile_px: float | None, turn: float, shift: tuple[float, float]
) -> np.ndarray:
    """Albedo (H, W, 3) of the cloth with another print: `picture` (h, w, 3) linear, its white as white as the cloth's own.

    Where `opaque` (h, w) is False the old print shows. The rest: see `retexture.print_on`.
    """
    if opaque.all():
        return retexture.print_on(on.chart, on.there, picture, tile_px, turn, shift) * np.float32(on.white)
    layers = np.dstack([picture * opaque[..., None], opaque]).astype(np.float32)
    layers = retexture.print_on(on.chart, on.there, layers, tile_px, turn, shift)
    return layers[..., :3] * np.float32(on.white) + (1 - np.minimum(layers[..., 3:], 1)) * on.albedo


def lit(on: Cloth, toward: np.ndarray, ambient: float) -> np.ndarray:
    """Irradiance (H, W) under another light (`light.shine`), its mean over the cloth as it was: the same exposure.

    InputError if no light falls on the cloth.
    """
    shine = light.shine(on.normals, toward, ambient)
    mean = float(shine[on.there].mean())
    if mean < 1e-3:
        raise InputError(
            f"the light from {', '.join(f'{v:g}' for v in toward)} falls on no part of the surface that is seen; "
            "z points toward the camera: give it a positive one, or add --ambient 0.2"
        )
    return shine * np.float32(on.irradiance[on.there].mean() / mean)


def composed(on: Cloth, albedo: np.ndarray, irradiance: np.ndarray) -> np.ndarray:
    """The photograph (H, W, 3), linear, with the cloth of this albedo (H, W, 3) in this irradiance (H, W)."""
    return light.blend(on.image, albedo * irradiance[..., None], on.there)
