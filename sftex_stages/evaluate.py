"""Compare a result with a known surface: `evaluate(result, truth)` gives the figures, `format_text` a readable page.

A truth file (HDF5) holds attribute `camera` ("orthographic", or "perspective" with `focal_px` and `principal_point`),
`surface/{height (H,W), normals (H,W,3), valid (H,W)}` and, where known, `irradiance/map (H,W)` (linear, up to one
scale) and `instances/{xy (M,2), normal (M,3), texton (M,), radius_px (M,)}` (texton -1: a spurious element, not
counted).

**Frames.** Everything is compared in the result's frame. Where the truth is perspective and the result orthographic,
the result's normals are relative to the viewing direction at each pixel: the true normals are turned by the smallest
rotation that takes the ray at their pixel to the z axis, true slants are taken from these, and the true height is -f
log(range / f), whose image gradient is that of the surface relative to the ray (heights are taken to be in px at the
distance f, so that range = (f - z) sqrt(1 + |x - c|²/f²)). Otherwise normals and heights are compared as they stand.

**Pixels.** Those that are valid, with finite normals, in both files; `coverage` is their share of the truth's valid
pixels.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from . import measures
from .errors import InputError
from .guarded import read_hdf5
from .measures import angle, relative_to_ray, spread, unit

ACCEPTED = 0.8  # posterior of an instance above which it counts (the paper, section 4)
MAX_SLANT = 60.0  # degrees: true instances beyond are not asked for (interest points fade there, section 1.3)


_NAMES = {
    "truth": (
        "surface/valid", "surface/normals", "surface/height", "irradiance/map",
        "instances/xy", "instances/texton", "instances/normal", "instances/radius_px",
    ),
    "result": (
        "surface/valid", "surface/normals", "surface/height", "surface/normal_sigma", "surface/piece",
        "irradiance/map", "irradiance/sigma", "image/rgb", "chart/uv", "instances/xy", "instances/normal",
        "instances/normal_sigma", "instances/inlier", "instances/irradiance", "instances/texton",
    ),
}  # fmt: skip


class _File:
    """A result or truth file, with errors that name the file and the dataset. Read in a guarded way."""

    def __init__(self, path: Path, what: str):
        self.path, self.what = path, what
        self.attrs, self.arrays = read_hdf5(path, _NAMES[what], what=what)

    def has(self, name: str) -> bool:
        """Whether there is a dataset `name`, or any in a group of that name."""
        return any(known == name or known.startswith(f"{name}/") for known in self.arrays)

    def array(self, name: str, shape: tuple[int | None, ...]) -> np.ndarray:
        """Dataset `name` of this shape (None: any length)."""
        array = self.arrays.get(name)
        if array is None or array.dtype.kind not in "biuf":
            raise InputError(f"{self.path}: dataset {name} is missing; is this a {self.what} file of sftex?")
        if array.ndim != len(shape) or any(b is not None and a != b for a, b in zip(array.shape, shape, strict=True)):
            wanted = " × ".join("any" if n is None else str(n) for n in shape)
            raise InputError(
                f"{self.path}: {name} has the shape {' × '.join(map(str, array.shape))}, expected {wanted}"
            )
        return array

    def camera(self) -> tuple[float, np.ndarray] | None:
        """(focal length, principal point), px, or None for an orthographic camera."""
        attrs = self.attrs
        kind = str(attrs.get("camera", "orthographic"))
        if kind == "orthographic":
            return None
        if kind != "perspective":
            raise InputError(f"{self.path}: camera is {kind!r}, expected 'orthographic' or 'perspective'")
        if "focal_px" not in attrs or "principal_point" not in attrs:
            raise InputError(f"{self.path}: a perspective camera needs the attributes focal_px and principal_point")
        try:
            return float(attrs["focal_px"]), np.asarray(attrs["principal_point"], float).reshape(2)
        except (TypeError, ValueError) as e:
            raise InputError(f"{self.path}: focal_px and principal_point are not numbers (1 and 2)") from e


def evaluate(result_path: Path | str, truth_path: Path | str) -> dict[str, Any]:
    """Every figure of accuracy of a result, as nested dicts of numbers, None where a figure does not exist.

    result_path: a `result.h5` or its folder; truth_path: see the module. Angles in degrees, shares 0…1. Raises InputError if a
    file cannot be used or the two do not belong together. `measures` defines each figure.
    """
    truth = _File(Path(truth_path), "truth")
    size = truth.array("surface/valid", (None, None)).shape
    surface = {
        "valid": truth.array("surface/valid", size).astype(bool),
        "normals": unit(truth.array("surface/normals", (*size, 3))),
        "height": truth.array("surface/height", size).astype(float),
    }
    light = truth.array("irradiance/map", size).astype(float) if truth.has("irradiance/map") else None
    elements = _true_instances(truth) if truth.has("instances") else None
    true_camera = truth.camera()
    result_path = Path(result_path)
    if result_path.is_dir():
        result_path /= "result.h5"
    result = _File(result_path, "result")
    own = result.array("surface/valid", (None, None)).shape
    if own != size:
        raise InputError(
            f"{result_path} is {own[1]} × {own[0]} pixels, {truth_path} is {size[1]} × {size[0]}: "
            "they do not belong to the same image"
        )
    valid = result.array("surface/valid", size).astype(bool)
    normals = unit(result.array("surface/normals", (*size, 3)))
    height = result.array("surface/height", size).astype(float)
    estimate = result.array("irradiance/map", size).astype(float)
    sigma = result.array("surface/normal_sigma", size).astype(float)
    piece = result.array("surface/piece", size) if result.has("surface/piece") else np.zeros(size, np.int32)
    instances = _accepted_instances(result)
    camera = result.camera()
    photograph = result.array("image/rgb", (*size, 3)) if result.has("image/rgb") else None
    spread_of_light = result.array("irradiance/sigma", size).astype(float) if result.has("irradiance/sigma") else None
    chart = _chart(result, surface, valid, true_camera)

    turned = true_camera is not None and camera is None
    if turned:
        _turn_to_rays(surface, elements, *true_camera)  # type: ignore[misc]
    known = surface["valid"] & np.isfinite(surface["normals"]).all(axis=2)
    both = known & valid & np.isfinite(normals).all(axis=2)
    true_normals = surface["normals"][both]
    dense = measures.compare_normals(normals[both], true_normals, int(known.sum() - both.sum()))
    errors = angle(normals[both] * (measures.FLIP if dense["best"] == "flipped" else 1.0), true_normals)
    level = both & np.isfinite(height) & np.isfinite(surface["height"])
    true_range = float(np.ptp(surface["height"][known])) if known.any() else 0.0
    return {
        "frame": {
            "truth": "perspective" if true_camera else "orthographic",
            "result": "perspective" if camera else "orthographic",
            "compared": "viewing ray" if turned else "camera",
        },
        "coverage": float(both.sum() / known.sum()) if known.any() else None,
        "normals": dense | {"calibration": measures.calibration(errors, sigma[both], deciles=True)},
        "height": measures.compare_heights(
            height[level], surface["height"][level], true_range, piece[level], both_signs=true_camera is None
        ),
        "irradiance": _irradiance(estimate, spread_of_light, light, known & valid, known, photograph),
        "chart": chart,
        "instances": _instances(instances, surface["normals"], known, light, elements),
        "baselines": _baselines(surface["normals"][known]),
    }


def _true_instances(truth: _File) -> dict[str, np.ndarray]:
    """xy (M, 2), normal (M, 3), radius (M,) of the genuine elements."""
    xy = truth.array("instances/xy", (None, 2)).astype(float)
    n = len(xy)
    genuine = truth.array("instances/texton", (n,)) >= 0
    normal = unit(truth.array("instances/normal", (n, 3)))
    radius = truth.array("instances/radius_px", (n,)).astype(float)
    return {"xy": xy[genuine], "normal": normal[genuine], "radius": radius[genuine]}


def _accepted_instances(result: _File) -> dict[str, np.ndarray]:
    """xy, normal, sigma, irradiance, texton of the accepted instances (the archive holds usable textons only)."""
    posterior = result.array("instances/inlier", (None,))
    n, accepted = len(posterior), posterior > ACCEPTED
    return {
        "xy": result.array("instances/xy", (n, 2)).astype(float)[accepted],
        "normal": unit(result.array("instances/normal", (n, 3)))[accepted],
        "sigma": result.array("instances/normal_sigma", (n,)).astype(float)[accepted],
        "irradiance": result.array("instances/irradiance", (n,)).astype(float)[accepted],
        "texton": result.array("instances/texton", (n,))[accepted],
    }


def _turn_to_rays(
    surface: dict[str, np.ndarray], elements: dict[str, np.ndarray] | None, focal: float, centre: np.ndarray
) -> None:
    """Replace true normals and heights by those relative to the viewing ray (see the module)."""
    y, x = np.indices(surface["valid"].shape, dtype=float)
    xy = np.stack([x, y], axis=-1)
    surface["normals"] = relative_to_ray(surface["normals"], xy, focal, centre)
    slope = np.sqrt(1.0 + np.sum(((xy - centre) / focal) ** 2, axis=-1))
    depth = focal - surface["height"]
    depth[~surface["valid"] | ~(depth > 0)] = np.nan
    surface["height"] = -focal * np.log(depth * slope / focal)
    if elements is not None:
        elements["normal"] = relative_to_ray(elements["normal"], elements["xy"], focal, centre)


def _nearest(field: np.ndarray, xy: np.ndarray) -> np.ndarray:
    """Values (N, …) of field (H, W, …) at the pixels nearest to xy (N, 2); those beyond the border at the border."""
    column, row = np.rint(xy).astype(int).T if len(xy) else np.zeros((2, 0), int)
    h, w = field.shape[:2]
    return field[np.clip(row, 0, h - 1), np.clip(column, 0, w - 1)]


def _instances(
    found: dict[str, np.ndarray],
    normals: np.ndarray,
    known: np.ndarray,
    light: np.ndarray | None,
    elements: dict[str, np.ndarray] | None,
) -> dict[str, Any]:
    """Figures of the accepted instances; the truth at one is that of its nearest pixel, `off_surface` have none."""
    there = _nearest(known, found["xy"])
    xy, texton = found["xy"][there], found["texton"][there]
    out: dict[str, Any] = {
        "accepted": len(there),
        "textons": len(np.unique(found["texton"])),
        "off_surface": int((~there).sum()),
        **measures.compare_instances(found["normal"][there], found["sigma"][there], _nearest(normals, xy)),
        **measures.split_errors(found["normal"][there], _nearest(normals, xy), texton),
    }
    out["recall"] = {"recall": None, "true": None, "found": None}
    if elements is not None:
        asked = elements["normal"][:, 2] > np.cos(np.radians(MAX_SLANT))
        out["recall"] = measures.recall(found["xy"], elements["xy"][asked], elements["radius"][asked])
    out["irradiance"] = None
    if light is not None:
        true, own = _nearest(light, xy), found["irradiance"][there]
        lit = (true > 0) & (own > 0)  # also False for NaN
        out["irradiance"] = measures.irradiance_at_instances(own[lit], texton[lit], true[lit])
    return out


def _irradiance(
    estimate: np.ndarray,
    sigma: np.ndarray | None,
    light: np.ndarray | None,
    inside: np.ndarray,
    known: np.ndarray,
    photograph: np.ndarray | None,
) -> dict[str, Any] | None:
    """Figures of the irradiance map and of its baselines over the same pixels; None where the truth has no light."""
    if light is None:
        return None
    with np.errstate(invalid="ignore"):
        lit = inside & (light > 0) & (estimate > 0) & np.isfinite(light) & np.isfinite(estimate)
    out = measures.compare_irradiance(estimate[lit], light[lit])
    out["calibration"] = None
    if sigma is not None and lit.any():
        ratio = np.log(estimate[lit] / light[lit])
        out["calibration"] = measures.calibration(np.abs(ratio - np.median(ratio)), sigma[lit], deciles=True)
    # Where there is no estimate at all, the baselines are still worth knowing.
    over = lit if lit.any() else known & (light > 0)
    out["constant"] = measures.compare_irradiance(np.ones(int(over.sum())), light[over])
    out["blurred"] = None
    if photograph is not None:
        blurred = measures.blurred_brightness(np.nan_to_num(photograph), known)
        seen = over & (blurred > 0)
        out["blurred"] = measures.compare_irradiance(blurred[seen], light[seen])
    return out


def _chart(
    result: _File, surface: dict[str, np.ndarray], valid: np.ndarray, camera: tuple[float, np.ndarray] | None
) -> dict[str, Any] | None:
    """How far the chart is from isometry on the true surface; None without a chart."""
    if not result.has("chart/uv"):
        return None
    focal, centre = camera or (np.inf, np.zeros(2))
    inside = valid & surface["valid"]
    return measures.chart_distortion(
        result.array("chart/uv", (*valid.shape, 2)), surface["normals"], surface["height"], inside, focal, centre
    )


def _baselines(normals: np.ndarray) -> dict[str, Any]:
    """What one normal for the whole surface scores over all true pixels: the frontal one, and the best there is."""
    if len(normals) == 0:
        return {"frontal": spread(np.zeros(0)), "constant": spread(np.zeros(0))}
    frontal = np.array([0.0, 0.0, 1.0])
    best = measures.best_constant_normal(normals)
    return {
        "frontal": spread(angle(normals, frontal)),
        "constant": spread(angle(normals, best)) | {"normal": [float(v) for v in best]},
    }


# ------------------------------------------------------------------------------------------------------------- text


def format_text(figures: dict[str, Any]) -> str:
    """The figures of `evaluate` as an aligned page for people."""
    frame, normals, instances, height = (figures[k] for k in ("frame", "normals", "instances", "height"))
    base, light, asked = figures["baselines"], figures["irradiance"], instances["recall"]
    relative = ", compared relative to the viewing ray" if frame["compared"] == "viewing ray" else ""
    lines = [f"camera               truth {frame['truth']}, result {frame['result']}{relative}", ""]
    heads = ["median", "mean", "p90", *(f"< {s:g}°" for s in measures.SHARES)]
    lines.append(f"{'normal error':<39}" + "".join(f"{h:>9}" for h in heads))
    rows = [
        ("instances, two-fold ambiguity removed", instances["error"]),
        ("instances, sign as given", instances["error_given"]),
        ("surface, sign as given", normals["given"]),
        ("surface, flipped", normals["flipped"]),
        ("surface, as given, gaps count as 90°", normals["given_all"]),
        ("surface, flipped, gaps count as 90°", normals["flipped_all"]),
        ("baseline: fronto-parallel", base["frontal"]),
        ("baseline: best constant normal", base["constant"]),
    ]
    lines += [_spread_row(name, values) for name, values in rows]
    found = f" ({asked['found']} of {asked['true']} with slant < {MAX_SLANT:g}°)" if asked["recall"] is not None else ""
    lines += [
        "",
        f"instances            {instances['accepted']} accepted (posterior > {ACCEPTED:g}) "
        f"of {instances['textons']} textons, {instances['off_surface']} where the truth has no surface",
        f"  recall             {_percent(asked['recall'])}{found}",
        f"  signs right        {_percent(instances['signs_right'])} as given, "
        f"{_percent(instances['signs_right_best'])} with the better global flip",
        f"  |error| / sigma    {_calibration(instances['calibration'])}",
    ]
    bins = [b for b in instances["by_slant"] if b["count"]]
    lines.append("  error by slant     " + ", ".join(f"{b['from']}–{b['to']}° {b['median']:.1f}/{b['p90']:.1f}" for b in bins))
    bias = instances["slant_bias"]
    lines.append(
        f"  slant              textons are off by {_number(bias['textons'], '.2f', '°')}, their instances scatter by "
        f"{_number(bias['within'], '.2f', '°')} about that (medians)"
    )
    if instances["irradiance"]:
        i = instances["irradiance"]
        lines.append(
            f"  log(L / truth)     standard deviation per texton: median {_percent(i['median'])}, "
            f"worst {_percent(i['worst'])} ({i['textons']} textons)"
        )
    lines += [
        f"surface              {_percent(figures['coverage'])} of the true pixels",
        f"  signs right        {_percent(normals['signs_right'])} as given, "
        f"{_percent(normals['signs_right_flipped'])} flipped, "
        f"{_percent(normals['signs_right_steep'])} as given where the slant is over 10°",
        f"  |error| / sigma    {_calibration(normals['calibration'])}",
    ]
    if normals["calibration"]["decile_ratio"]:
        ratios = " ".join(f"{r:.2f}" for r in normals["calibration"]["decile_ratio"])
        lines.append(f"  … by sigma's decile {ratios}")
    flip = ", flipped" if height["sign"] == -1 else ""
    lines.append(
        f"  height             RMS {_percent(height['rms_over_range'])} of the range{flip}; "
        f"{_percent(height['rms_over_range_scaled'])} with one scale removed"
    )
    if light:
        lines.append(f"irradiance           {_light(light)}")
        lines.append(f"  constant           {_light(light['constant'])}")
        if light["blurred"]:
            lines.append(f"  blurred image      {_light(light['blurred'])}")
        if light["calibration"]:
            lines.append(f"  |error| / sigma    {_calibration(light['calibration'])}")
    if chart := figures["chart"]:
        angles, areas = _number(chart["angle"]["median"], ".2f", "°"), _percent(chart["area"]["median"])
        lines.append(f"chart                angles change by {angles}, areas by {areas} (medians on the true one)")
    return "\n".join(lines)


def _spread_row(name: str, values: dict[str, Any]) -> str:
    degrees = "".join(f"{_number(values[k], '.2f', '°'):>9}" for k in ("median", "mean", "p90"))
    return f"{name:<39}" + degrees + "".join(f"{_percent(values[f'under_{s:g}']):>9}" for s in measures.SHARES)


def _number(value: float | None, form: str, sign: str) -> str:
    return "–" if value is None else f"{value:{form}}{sign}"


def _percent(share: float | None) -> str:
    return "–" if share is None else f"{100 * share:.1f} %"


def _calibration(values: dict[str, Any]) -> str:
    return f"median {_number(values['median_ratio'], '.2f', '')}, over 3: {_percent(values['beyond_3'])}"


def _light(values: dict[str, Any]) -> str:
    return (
        f"median |log ratio| {_percent(values['error'])}, p90 {_percent(values['p90'])}, "
        f"correlation of logs {_number(values['correlation'], '.3f', '')}"
    )
