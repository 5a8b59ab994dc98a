"""Photographs in: the only function that loads an image, the `image` stage, and the search for images and masks.

OpenImageIO decodes; a file's content decides what it is, not its ending. What comes out is linear light in float32,
turned upright by its EXIF orientation, with a mask of the pixels that can carry a surface.
"""

from __future__ import annotations

import glob
import itertools
import re
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import OpenImageIO as oiio
from pydantic import Field

from .engine.stage import Arrays, Stage, StageParams
from .errors import InputError

# A header may claim any size, and some decoders allocate when the file is opened, before its size can be looked at.
oiio.attribute("limits:imagesize_MB", 16384)

#: Rendered pictures have dozens; with more, a picture within the size limit could still fill the memory.
_MOST_CHANNELS = 64

ColorSpace = Literal["auto", "srgb", "linear"]

_FULL_FRAME_DIAGONAL = float(np.hypot(36.0, 24.0))  # mm

#: Endings that OpenImageIO knows but that are no photographs.
_NOT_PHOTOGRAPHS = {"null", "nul", "term", "z", "zfile", "env", "sm", "vsm"}
#: Photographs that cannot be decoded here. Raw files are TIFF in disguise: only their thumbnail would be read.
_UNDECODABLE = set("heic heif hif avif cr2 cr3 crw nef nrw arw srf sr2 dng raf orf rw2 pef srw x3f 3fr iiq raw".split())


class Params(StageParams):
    """Parameters of the `image` stage."""

    max_megapixels: float = Field(50.0, gt=0, le=1000, description="larger images are refused, not shrunk silently")
    color_space: ColorSpace = Field(
        "auto",
        description="auto: as the file declares, else sRGB for integers, linear for floats; or srgb, linear",
    )


@dataclass(frozen=True)
class ImageItem:
    """One image to reconstruct: the name of its output folder (unique in a run), its file, its mask's file."""

    name: str
    path: Path
    mask: Path | None


# ---------------------------------------------------------------------------------------------------- loading


def load_image(
    path: Path, max_megapixels: float = 50.0, color_space: ColorSpace = "auto"
) -> tuple[np.ndarray, np.ndarray]:
    """Load any image as linear light, upright.

    Returns rgb (H, W, 3) float32, linear, 1 = the encoding's white, grey replicated, and mask (H, W) bool, False where
    the image is transparent (alpha under one half) or not finite; rgb is 0 where it is not finite.
    The first picture of a file with several is taken. Raises InputError.
    """
    pixels, spec = _read(path, max_megapixels)
    names = [str(n) for n in spec.channelnames]
    color = _pick(names, "RGB") or _pick(names, "Y") or ([0] if len(names) == 1 else None)
    if color is None:
        raise InputError(f"{path}: has no R, G, B or grey channel (it has {', '.join(names)}); save it as RGB")
    alpha = _pick(names, "A")
    values = pixels[..., color]
    mask = np.ones(values.shape[:2], bool)
    if alpha is not None:
        a = _unit(pixels[..., alpha[0]])
        mask = a >= 0.5
        if not spec.get_int_attribute("oiio:UnassociatedAlpha", 0) and not (a == 1).all():
            values = _unit(values) / np.where(mask, a, 1)[..., None]  # colour was stored multiplied by alpha
    rgb = _linear(values, _curve(spec, color_space, path))
    finite = np.isfinite(rgb).all(axis=2)
    if not finite.all():
        rgb[~finite] = 0
        mask &= finite
    return np.ascontiguousarray(np.broadcast_to(rgb, (*mask.shape, 3))), mask


def load_mask(path: Path, max_megapixels: float = 50.0) -> np.ndarray:
    """Load a mask, (H, W) bool: True where opaque and brighter than half its maximum (0/1 and 0/255 both work)."""
    rgb, opaque = load_image(path, max_megapixels, "linear")  # the threshold is meant for values as they are stored
    grey = rgb.mean(axis=2) * opaque
    if not (grey > 0).any():
        raise InputError(f"{path}: the mask is black all over; paint white where the surface is, or remove the file")
    return grey > 0.5 * grey.max()


def focal_length(path: Path) -> float | None:
    """Focal length in px of the image as it is, from its EXIF data; None if these do not tell.

    From the 35 mm equivalent, which is by the diagonal (CIPA DCG-001), or from the length in mm and the sensor's pixel
    pitch. A photograph that was cropped without correcting these data has a longer one.
    """
    source = oiio.ImageInput.open(str(path))
    if source is None:
        return None
    spec = source.spec()
    source.close()
    equivalent = spec.get_float_attribute("Exif:FocalLengthIn35mmFilm")
    if equivalent > 0:
        return equivalent * float(np.hypot(spec.width, spec.height)) / _FULL_FRAME_DIAGONAL
    length, pitch = (spec.get_float_attribute(f"Exif:{n}") for n in ("FocalLength", "FocalPlaneXResolution"))
    unit = {2: 25.4, 3: 10.0, 4: 1.0}.get(spec.get_int_attribute("Exif:FocalPlaneResolutionUnit", 2))  # mm
    if not (length > 0 and pitch > 0 and unit):
        return None
    taken = spec.get_int_attribute("Exif:PixelXDimension", 0)
    return length * pitch / unit * (spec.width / taken if taken > 0 else 1.0)


def run(inputs: Mapping[str, Any], params: Params) -> Arrays:
    """The `image` stage. inputs: "image" Path, "mask" Path or None.

    Returns rgb (H, W, 3) float32 linear light, mask (H, W) bool (True = a surface may be here), and where the file tells it
    focal_px (), its focal length in px. Raises InputError.
    """
    path, mask_path = inputs["image"], inputs["mask"]
    rgb, mask = load_image(path, params.max_megapixels, params.color_space)
    if mask_path is not None:
        given = load_mask(mask_path, params.max_megapixels)
        if given.shape != mask.shape:
            (h, w), (mh, mw) = mask.shape, given.shape
            sizes = f"the mask is {mw} × {mh} pixels but {path} is {w} × {h}"
            raise InputError(f"{mask_path}: {sizes}; make them the same size")
        mask &= given
    if not mask.any():
        raise InputError(f"{path}: no pixel is left (transparent, not finite, or outside of the mask)")
    focal = focal_length(path)
    return {"rgb": rgb, "mask": mask} | ({} if focal is None else {"focal_px": np.array(focal)})


STAGE = Stage(name="image", version=2, params=Params, run=run, files=("image", "mask"))


def _read(path: Path, max_megapixels: float) -> tuple[np.ndarray, oiio.ImageSpec]:
    """Decode a file: pixels (H, W, C) as uint8, uint16 or float32, upright, and the specification as stored."""
    advice = "convert it to PNG, JPEG, TIFF or EXR"
    try:
        with open(path, "rb") as f:
            head = f.read(64)
    except OSError as e:
        raise InputError(f"{path}: cannot be read ({e.strerror or e}); check the name and the permissions") from e
    if not head:
        raise InputError(f"{path}: the file is empty (0 bytes); copy or export it again")
    if path.suffix[1:].lower() in _UNDECODABLE or head[4:12] in (b"ftypheic", b"ftypheix", b"ftypmif1", b"ftypavif"):
        raise InputError(f"{path}: raw, HEIC and AVIF photographs are not decoded here; {advice} (16 bit if you can)")
    hints = oiio.ImageSpec()
    hints.attribute("oiio:UnassociatedAlpha", 1)  # leave the colours as they are stored, do not multiply by alpha
    source = oiio.ImageInput.open(str(path), hints)
    if source is None:
        raise InputError(f"{path}: not an image that can be read{_what(head)} ({_tidy(oiio.geterror())}); {advice}")
    spec = source.spec()
    megapixels = spec.width * spec.height * spec.depth / 1e6
    if megapixels == 0 or spec.nchannels == 0:
        raise InputError(f"{path}: the image has no pixels ({spec.width} × {spec.height})")
    if spec.nchannels > _MOST_CHANNELS:
        raise InputError(f"{path}: has {spec.nchannels} channels, over the limit of {_MOST_CHANNELS}; save it as RGB")
    if spec.depth > 1:
        raise InputError(f"{path}: a volume of {spec.depth} layers, not a photograph")
    if megapixels > max_megapixels:
        raise InputError(
            f"{path}: {spec.width} × {spec.height} = {megapixels:.1f} megapixels, over the limit of "
            f"{max_megapixels:g}; make the image smaller or raise image.max_megapixels"
        )
    native = str(spec.format) in ("uint8", "uint16")
    pixels = source.read_image(oiio.UNKNOWN if native else oiio.FLOAT)
    problem = source.geterror() if source.has_error else ""
    source.close()
    # Some cameras put stray bytes between JPEG segments; the picture is whole. Any other complaint means lost pixels.
    if pixels is None or (problem and "extraneous bytes" not in problem):
        raise InputError(f"{path}: the file is damaged or cut short ({_tidy(problem)}); copy or export it again")
    return _upright(pixels, spec.get_int_attribute("Orientation", 1)), spec


def _upright(pixels: np.ndarray, orientation: int) -> np.ndarray:
    if orientation in (0, 1):
        return pixels
    buffer = oiio.ImageBuf(np.ascontiguousarray(pixels))
    buffer.specmod().attribute("Orientation", orientation)
    turned = oiio.ImageBufAlgo.reorient(buffer)
    return np.asarray(turned.get_pixels(turned.spec().format))


def _pick(names: list[str], wanted: str) -> list[int] | None:
    """Indices of the channels called `wanted` ("R" also matches "beauty.R"), None unless all are there."""
    short = [n.rsplit(".", 1)[-1].upper() for n in names]
    return [short.index(c) for c in wanted] if all(c in short for c in wanted) else None


def _curve(spec: oiio.ImageSpec, color_space: ColorSpace, path: Path) -> float | None:
    """How the file's values become linear light: 0 by the sRGB curve, g > 0 as a power g, None: they are linear."""
    if color_space != "auto":
        return 0.0 if color_space == "srgb" else None
    declared = spec.get_string_attribute("oiio:ColorSpace").lower()
    if not declared:
        return None if str(spec.format) in ("half", "float", "double") else 0.0
    if re.match(r"lin|scene_linear|acescg|aces2065", declared):
        return None
    if declared.startswith("srgb"):
        return 0.0  # Display P3 too: other primaries, the same curve
    if power := re.match(r"g(?:amma)?(\d)\.?(\d)", declared):
        return spec.get_float_attribute("oiio:Gamma", float(f"{power[1]}.{power[2]}"))
    raise InputError(
        f"{path}: its colour space “{declared}” is not supported; save it as sRGB or linear, or set image.color_space"
    )


def _unit(values: np.ndarray) -> np.ndarray:
    """Stored values as float32, integers scaled to 0…1."""
    if values.dtype == np.float32:
        return values
    return values.astype(np.float32) / np.float32(np.iinfo(values.dtype).max)


def _linear(values: np.ndarray, curve: float | None) -> np.ndarray:
    if values.dtype == np.float32:
        return np.array(values) if curve is None else _decode(values, curve)
    table = _unit(np.arange(np.iinfo(values.dtype).max + 1, dtype=values.dtype))
    return (table if curve is None else _decode(table, curve))[values]


def _decode(v: np.ndarray, power: float) -> np.ndarray:
    """Encoded to linear: IEC 61966-2-1 (piecewise) for power 0, else a plain power; odd, so negative values survive."""
    a = np.abs(v.astype(np.float64))
    linear = a**power if power else np.where(a <= 0.04045, a / 12.92, ((a + 0.055) / 1.055) ** 2.4)
    return np.asarray(np.copysign(linear, v), np.float32)


def _what(head: bytes) -> str:
    if all(b >= 32 or b in b"\t\r\n\f" for b in head):
        return ": it holds text"
    return ""


def _tidy(message: str) -> str:
    return " ".join(dict.fromkeys(line.strip() for line in message.splitlines() if line.strip())) or "no reason given"


# ---------------------------------------------------------------------------------------------------- discovery


def discover(items: str | Path | Iterable[str | Path], masks: Path | None = None) -> list[ImageItem]:
    """Find the images to reconstruct, sorted by path, each file once.

    items: a folder (its images, not those of its subfolders), a file (whatever its ending), a glob, or several.
    masks: a folder with ``<stem>.png`` or ``<stem>.mask.png``; without it ``<stem>.mask.png`` beside the image is
    taken (upper or lower case). Images with one stem get the name ``<stem>_<ending>``, and the folder's name before it
    if even that is not enough. Raises InputError if an item matches nothing, or the masks folder no image.
    """
    paths: dict[Path, Path] = {}
    for item in [items] if isinstance(items, str | Path) else items:
        for path in _expand(str(item)):
            paths.setdefault(path.resolve(), path)
    if not paths:
        raise InputError("no images given; name a folder, a file or a glob")
    found = sorted(paths.values())
    if masks is not None and not masks.is_dir():
        raise InputError(f"{masks}: no such folder of masks")
    listings: dict[Path, dict[str, Path]] = {}
    result = [
        ImageItem(name, path, _mask_of(path, masks, listings)) for name, path in zip(_names(found), found, strict=True)
    ]
    if masks is not None and not any(item.mask for item in result):
        raise InputError(
            f"{masks}: no mask matches any of the {len(result)} image(s); call them like the image: {found[0].stem}.png"
        )
    return result


def summary(items: list[ImageItem]) -> str:
    """What was found, in words: ``12 images, 9 with a mask``."""
    masked = sum(item.mask is not None for item in items)
    return f"{len(items)} image{'s' * (len(items) != 1)}, {masked or 'none'} with a mask"


def _expand(item: str) -> list[Path]:
    path = Path(item).expanduser()
    if path.is_file():
        if _is_mask(path):
            raise InputError(f"{path}: this is a mask (its name ends in .mask.png); name the image that it belongs to")
        return [path]
    if path.is_dir():
        files = _photographs(_listing(path))
        if not files:
            raise InputError(f"{path}: no image in this folder (masks, hidden files and subfolders do not count)")
        return files
    if glob.has_magic(item):
        files = _photographs(Path(p) for p in glob.glob(str(path), recursive=True))
        if files:
            return files
        raise InputError(f"{item}: no image matches; check the pattern (in quotes the shell leaves it alone)")
    raise InputError(f"{path}: no such file or folder")


def _photographs(paths: Iterable[Path]) -> list[Path]:
    """The images among `paths`, by ending. One that cannot be decoded is kept (it will say so) unless a twin can be."""
    listed: str = oiio.get_string_attribute("extension_list")
    endings = {e for group in listed.split(";") for e in group.split(":")[-1].split(",")} - _NOT_PHOTOGRAPHS
    files = [p for p in paths if not p.name.startswith(".") and not _is_mask(p) and p.is_file()]
    readable = [p for p in files if p.suffix[1:].lower() in endings - _UNDECODABLE]
    twins = {p.with_suffix("") for p in readable}
    return readable + [p for p in files if p.suffix[1:].lower() in _UNDECODABLE and p.with_suffix("") not in twins]


def _listing(folder: Path) -> list[Path]:
    try:
        return sorted(folder.iterdir())
    except OSError as e:
        raise InputError(f"{folder}: the folder cannot be read ({e.strerror or e}); check its permissions") from e


def _is_mask(path: Path) -> bool:
    return path.name.lower().endswith(".mask.png")


def _mask_of(image: Path, masks: Path | None, listings: dict[Path, dict[str, Path]]) -> Path | None:
    """The image's mask; names compare without case, one that matches with its case goes first."""
    folder = masks if masks is not None else image.parent
    if folder not in listings:
        files = [p for p in _listing(folder) if p.suffix.lower() == ".png"]
        listings[folder] = {p.name.lower(): p for p in files} | {p.name: p for p in files}
    here = listings[folder]
    for name in [f"{image.stem}.mask.png"] + ([f"{image.stem}.png"] if masks is not None else []):
        mask = here.get(name) or here.get(name.lower())
        if mask is not None and not mask.samefile(image):
            return mask
    return None


def _names(paths: list[Path]) -> list[str]:
    """A unique name for the output folder of each path, unique also where file names have no case."""
    names = [p.stem.lstrip(".") or "image" for p in paths]
    for widen in (
        lambda p, n: f"{n}_{p.suffix[1:]}" if p.suffix else n,
        lambda p, n: f"{p.resolve().parent.name}_{n}",
    ):
        count = Counter(n.casefold() for n in names)
        names = [widen(p, n) if count[n.casefold()] > 1 else n for p, n in zip(paths, names, strict=True)]
    taken: set[str] = set()
    for i, name in enumerate(names):
        numbered = (f"{name}-{k}" for k in itertools.count(2))
        while names[i].casefold() in taken:
            names[i] = next(numbered)
        taken.add(names[i].casefold())
    return names
