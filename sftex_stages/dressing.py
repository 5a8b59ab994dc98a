"""The command ``sftex render``: a result's photograph with another print, in another light, or from another side."""

from __future__ import annotations

import argparse
import re
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from .errors import ConfigError, StoreError

if TYPE_CHECKING:
    from .results.dress import Cloth

ENDINGS = (".png", ".jpg", ".jpeg", ".exr")


def render(args: argparse.Namespace) -> int:
    """Make the picture; returns the exit code."""
    if args.texture is None and args.light is None and args.view is None:
        raise ConfigError("nothing to do: give --texture, --light or --view (sftex render --help)")
    for option, needs in (("tile_px", "texture"), ("turn", "texture"), ("shift", "texture"), ("ambient", "light")):
        if getattr(args, option) is not None and getattr(args, needs) is None:
            raise ConfigError(f"--{option.replace('_', '-')} means nothing without --{needs}")
    if args.view and args.output.suffix.lower() == ".exr":
        raise ConfigError(f"{args.output}: views are made for the screen; write a .png or .jpg, or leave out --view")
    if not args.output.parent.is_dir():
        raise StoreError(f"{args.output.parent}: no such folder; make it first")
    from . import images  # only now: the command line as a whole stays quick
    from .guarded import apart
    from .results import dress, exports
    from .results.archive import open_result

    path = args.result / "result.h5" if args.result.is_dir() else args.result
    result = open_result(path)
    picture = apart(images.load_image, args.texture) if args.texture else None
    on = dress.continued(result)
    turn, shift = args.turn or 0.0, args.shift or (0.0, 0.0)
    albedo = dress.printed(on, *picture, args.tile_px, turn, shift) if picture else on.albedo
    irradiance = dress.lit(on, np.array(args.light), args.ambient or 0.0) if args.light else on.irradiance
    new = dress.composed(on, albedo, irradiance)
    exposure = exports.usual_exposure(on.image)
    with tempfile.TemporaryDirectory() as scratch:
        if args.output.suffix.lower() == ".exr":
            content = exports.exr(new, ("R", "G", "B"), "linear light (sftex render)", Path(scratch))
        else:
            shown = exports.to_display(new, exposure)
            if args.view is not None:
                shown = _seen(on, shown, args.view)
            content = exports.encode(shown, args.output.suffix.lower())
    _write(args.output, content)
    print(f"sftex: {args.output} written", file=sys.stderr)
    return 0


def _seen(on: Cloth, picture: np.ndarray, view: tuple[float, float]) -> np.ndarray:
    """The cloth, dressed in the picture (H, W, 3) uint8, from azimuth and elevation in degrees."""
    from .results.render import render as oblique

    return oblique(on.height, on.normals, on.there, (picture,), *view, size=max(picture.shape[:2]), camera=on.camera)[0]


def _write(path: Path, content: bytes) -> None:
    from .engine.store import write_atomically

    try:
        write_atomically(path, content, path.parent)
    except OSError as error:
        raise StoreError(f"{path}: cannot be written ({error.strerror or error}); choose another place") from error


# --------------------------------------------------------------------------------------------------- parsing


def numbers(count: int, example: str) -> Callable[[str], tuple[float, ...]]:
    """A parser of `count` finite numbers between commas."""

    def parse(text: str) -> tuple[float, ...]:
        try:
            values = tuple(float(part) for part in text.split(","))
        except ValueError:
            values = ()
        if len(values) != count or not np.isfinite(values).all():
            raise argparse.ArgumentTypeError(f"{text!r} is not {count} numbers, like {example}")
        return values

    return parse


def direction(text: str) -> tuple[float, ...]:
    """``x,y,z``, not all 0."""
    values = numbers(3, "1,-1,2")(text)
    if not any(values):
        raise argparse.ArgumentTypeError("0,0,0 is no direction")
    return values


def angles(text: str) -> tuple[float, ...]:
    """``azimuth,elevation`` in degrees, each within ±80."""
    values = numbers(2, "-35,20")(text)
    if max(map(abs, values)) >= 80:
        raise argparse.ArgumentTypeError(f"{text!r}: azimuth and elevation must lie within ±80 degrees")
    return values


def within(low: float, high: float, what: str) -> Callable[[str], float]:
    """A parser of one number from `low` to `high`."""

    def parse(text: str) -> float:
        (value,) = numbers(1, f"{low:g}")(text)
        if not low <= value <= high:
            raise argparse.ArgumentTypeError(f"{text} is not {what} ({low:g} to {high:g})")
        return value

    return parse


def picture_file(text: str) -> Path:
    """A path whose ending says what to write."""
    path = Path(text)
    if path.suffix.lower() not in ENDINGS:
        raise argparse.ArgumentTypeError(f"{text!r} must end in one of {', '.join(ENDINGS)}")
    return path


def add_parser(command: Callable[..., argparse.ArgumentParser]) -> None:
    """Its command line; `command(name, function, about)` makes a parser."""
    parser = command("render", render, "dress a result's photograph anew: another print, another light, another view")
    # A value such as -1,2,3 is a number to us, and would be an unknown option to argparse.
    parser._negative_number_matcher = re.compile(r"^-\.?\d")
    parser.add_argument("result", type=Path, metavar="RESULT", help="result.h5, or the folder that holds it")
    parser.add_argument("--texture", type=Path, metavar="FILE", help="the new print, repeated; transparent parts leave the old")
    parser.add_argument(
        "--tile-px", type=within(1, 1e6, "a width in px"), metavar="N",
        help="width of a repetition, in px of the surface seen straight on (default: that of the file)",
    )  # fmt: skip
    parser.add_argument("--turn", type=within(-360, 360, "an angle"), metavar="DEG", help="turn the print clockwise")
    parser.add_argument("--shift", type=numbers(2, "10,-5"), metavar="U,V", help="move the print right and down, in px")
    parser.add_argument(
        "--light", type=direction, metavar="X,Y,Z",
        help="one far light from there (x right, y down, z toward the camera) instead of the recovered one",
    )  # fmt: skip
    parser.add_argument(
        "--ambient", type=within(0, 1, "a share"), metavar="A", help="share of light from everywhere (default: 0)"
    )
    parser.add_argument(
        "--view", type=angles, metavar="AZ,EL", help="from that many degrees to the right and above, the cloth alone"
    )
    parser.add_argument(
        "-o", "--output", type=picture_file, required=True, metavar="PICTURE", help="the .png, .jpg or .exr to write"
    )
