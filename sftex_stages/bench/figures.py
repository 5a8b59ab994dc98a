"""The numbers of one image that the benchmark reports, and the values that they should reach.

`headline` flattens what `evaluate` and the receipts say into the figures of `FIGURES`. A target has a goal and,
sometimes, a floor: a value that must hold already, while the goal is still being worked at.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from ..measures import value_at

Numbers = dict[str, float | None]


@dataclass(frozen=True)
class Figure:
    """How a number is shown: its heading, its unit ("%": a share 0…1) and whether more is better (None: neither)."""

    title: str
    unit: str
    more: bool | None = False

    def text(self, value: float | None) -> str:
        """The value with as many digits as are worth reading."""
        if value is None:
            return "–"
        if self.unit == "%":
            return f"{100 * value:.1f}"
        if self.unit == "°" or abs(value) < 10:
            return f"{value:.3g}" if self.unit == "" else f"{value:.2f}"
        return f"{value:.0f}"

    @property
    def heading(self) -> str:
        """Title and unit."""
        return f"{self.title} {self.unit}".rstrip()


FIGURES = {
    "accepted": Figure("accepted", "", True),
    "usable_textons": Figure("usable textons", "", True),
    "textons": Figure("textons", "", None),
    "instance_median": Figure("instances, median", "°"),
    "instance_p90": Figure("instances, p90", "°"),
    "instance_signs": Figure("instance signs", "%", True),
    "instance_signs_given": Figure("instance signs as given", "%", True),
    "recall": Figure("recall", "%", True),
    "instance_light": Figure("log L std, worst texton", "%"),
    "instance_light_pooled": Figure("log L std, pooled", "%"),
    "instance_ratio": Figure("instance error/σ", "", None),
    "instance_beyond_3": Figure("instances over 3 σ", "%"),
    "coverage": Figure("coverage", "%", True),
    "signs": Figure("signs", "%", True),
    "signs_given": Figure("signs as given", "%", True),
    "dense_median": Figure("surface, median", "°"),
    "dense_median_given": Figure("median as given", "°"),
    "dense_median_better": Figure("median, better sign", "°"),
    "dense_mean": Figure("mean", "°"),
    "dense_p90": Figure("surface, p90", "°"),
    "dense_5": Figure("under 5°", "%", True),
    "dense_11": Figure("under 11.25°", "%", True),
    "dense_22": Figure("under 22.5°", "%", True),
    "dense_30": Figure("under 30°", "%", True),
    "dense_all_11": Figure("under 11.25° of all", "%", True),
    "pixel_ratio": Figure("surface error/σ", "", None),
    "pixel_beyond_3": Figure("surface over 3 σ", "%"),
    "pixel_factor": Figure("σ, worst decile's factor", ""),
    "height": Figure("height RMS/range", "%"),
    "height_scaled": Figure("height, scale removed", "%"),
    "light": Figure("irradiance", "%"),
    "light_correlation": Figure("correlation of logs", "", True),
    "light_constant": Figure("baseline: flat light", "%", None),
    "light_blurred": Figure("baseline: blurred image", "%", None),
    "light_gain": Figure("blurred / ours", "", True),
    "frontal_baseline": Figure("baseline: frontal", "°", None),
    "constant_baseline": Figure("baseline: constant", "°", None),
    "keypoints": Figure("keypoints", "", None),
    "seconds": Figure("cold run", "s"),
    "cached_seconds": Figure("cached run", "s"),
    "frontal_ms": Figure("frontal per keypoint", "ms"),
    "peak_memory": Figure("peak of all jobs", "MB"),
    "frontal_memory": Figure("frontal job's peak", "MB"),
    "irradiance_seconds": Figure("irradiance stage", "s"),
    "light_ratio": Figure("light error/σ", "", None),
    "chart_angle": Figure("chart, angles", "°"),
    "chart_angle_95": Figure("angles, p95", "°"),
    "chart_area": Figure("chart, areas", "%"),
    "chart_area_95": Figure("areas, p95", "%"),
    "retexture": Figure("own print put back", "%"),
    "render_seconds": Figure("sftex render", "s"),
}

_EVALUATED = {
    "accepted": "instances.accepted",
    "instance_median": "instances.error.median",
    "instance_p90": "instances.error.p90",
    "instance_signs": "instances.signs_right_best",
    "instance_signs_given": "instances.signs_right",
    "recall": "instances.recall.recall",
    "instance_light": "instances.irradiance.worst",
    "instance_light_pooled": "instances.irradiance.pooled",
    "instance_ratio": "instances.calibration.median_ratio",
    "instance_beyond_3": "instances.calibration.beyond_3",
    "coverage": "coverage",
    "signs_given": "normals.signs_right",
    "dense_median_given": "normals.given.median",
    "pixel_ratio": "normals.calibration.median_ratio",
    "pixel_beyond_3": "normals.calibration.beyond_3",
    "pixel_factor": "normals.calibration.worst_factor",
    "height": "height.rms_over_range",
    "height_scaled": "height.rms_over_range_scaled",
    "light": "irradiance.error",
    "light_correlation": "irradiance.correlation",
    "light_constant": "irradiance.constant.error",
    "light_blurred": "irradiance.blurred.error",
    "light_ratio": "irradiance.calibration.median_ratio",
    "chart_angle": "chart.angle.median",
    "chart_angle_95": "chart.angle.p95",
    "chart_area": "chart.area.median",
    "chart_area_95": "chart.area.p95",
    "frontal_baseline": "baselines.frontal.median",
    "constant_baseline": "baselines.constant.median",
}


def headline(figures: Mapping[str, Any] | None, costs: Mapping[str, Any]) -> Numbers:
    """All of `FIGURES` for one image, from `evaluate` (None without a truth) and from `run.costs`.

    Under an orthographic true camera, signs and dense normals count up to one global flip, under a perspective one as
    given.
    """
    out: Numbers = dict.fromkeys(FIGURES)
    for name in FIGURES:
        if name in costs:
            out[name] = costs[name]
    if figures is None:
        return out
    out |= {name: value_at(figures, path) for name, path in _EVALUATED.items()}
    normals = figures["normals"]
    free = figures["frame"]["truth"] == "orthographic"
    sign = normals["best"] if free else "given"
    shares = [normals["signs_right"], normals["signs_right_flipped"] if free else None]
    out["signs"] = max((s for s in shares if s is not None), default=None)
    out |= {f"dense_{name}": normals[sign][name] for name in ("median", "mean", "p90")}
    out["dense_median_better"] = normals[normals["best"]]["median"]
    for name in ("5", "11.25", "22.5", "30"):
        out[f"dense_{name.partition('.')[0]}"] = normals[sign][f"under_{name}"]
    out["dense_all_11"] = normals[f"{sign}_all"]["under_11.25"]
    if out["light_correlation"] is not None and out["light"] and out["light_blurred"] is not None:
        out["light_gain"] = out["light_blurred"] / out["light"]  # only where the light varies
    return out


# ---------------------------------------------------------------------------------------------------------- targets


@dataclass(frozen=True)
class Target:
    """At most (`more`: at least) `goal`; `floor` if there is one that must hold now; the value that was reached."""

    figure: str
    more: bool
    goal: float | None
    floor: float | None
    value: float | None

    @property
    def state(self) -> str:
        """"pass", "floor" (the floor holds, the goal does not), "miss", or "none" without a value."""
        if self.value is None:
            return "none"
        if self.goal is not None and self._holds(self.goal):
            return "pass"
        if self.floor is not None and self._holds(self.floor):
            return "floor" if self.goal is not None else "pass"
        return "miss"

    def _holds(self, limit: float) -> bool:
        assert self.value is not None
        return self.value >= limit if self.more else self.value <= limit


_EASY = ("sphere_stars_const", "spherecap_glyphs_side", "bumps_leaves_sun")
_SHEETS = ("cylinder_flowers_sun", "wave_paisley_side", "cloth_push_brick_sun")
_RENDERED = (
    *_EASY, *_SHEETS, "plane_stars_tilt", "sphere_dots_sun", "cloth_hang_floral_side", "bumps_paisley_persp",
)  # fmt: skip
_VARIED = tuple(name for name in _RENDERED if name not in ("sphere_stars_const", "plane_stars_tilt"))  # in irradiance
_ALL = (*_RENDERED, "golf", "cloth1")

# (images, figure, goal, floor)
_Row = tuple[tuple[str, ...], str, float | None, float | None]


def _instances(images: tuple[str, ...], median: float, p90: float, recall: float | None) -> list[_Row]:
    rows: list[_Row] = [(images, "instance_median", median, None), (images, "instance_p90", p90, None)]
    return rows if recall is None else [*rows, (images, "recall", recall, None)]


def _surface(images: tuple[str, ...], signs: float, median: float, under_11: float, coverage: float) -> list[_Row]:
    wanted = {"signs": signs, "dense_median": median, "dense_11": under_11, "coverage": coverage}
    return [(images, figure, goal, None) for figure, goal in wanted.items()]


_ROWS: list[_Row] = [
    *_instances((*_EASY, "plane_stars_tilt"), 1.2, 4, 0.9),
    *_instances(("sphere_dots_sun",), 1.5, 4, 0.9),
    *_instances(_SHEETS, 2, 7, 0.8),
    *_instances(("cloth_hang_floral_side",), 4, 15, 0.6),
    *_instances(("bumps_paisley_persp",), 2, 6, 0.9),
    *_instances(("golf",), 5, 12, None),
    *_instances(("cloth1",), 7, 20, None),
    (("cloth1",), "accepted", 2000, None),
    (_EASY, "instance_median", None, 3),
    (("cloth1",), "instance_median", None, 15),
    (_RENDERED, "instance_light", 0.02, None),
    (_ALL, "instance_beyond_3", 0.05, None),
    *_surface((*_EASY, "sphere_dots_sun"), 0.99, 2, 0.93, 0.85),
    *_surface((*_SHEETS, "plane_stars_tilt"), 0.98, 2.5, 0.9, 0.85),
    *_surface(("cloth_hang_floral_side",), 0.92, 6, 0.65, 0.7),
    *_surface(("bumps_paisley_persp",), 0.99, 2, 0.93, 0.85),
    *_surface(("golf",), 0.99, 5, 0.85, 0.8),
    *_surface(("cloth1",), 0.95, 7, 0.65, 0.85),
    ((*_EASY, "sphere_dots_sun", *_SHEETS, "plane_stars_tilt"), "height", 0.03, None),
    (_ALL, "pixel_factor", 1.5, None),
    (_EASY, "dense_median_better", None, 4),
    (("cloth1",), "dense_median_better", None, 18),
    (("golf",), "dense_median_better", None, 15),
    (("spherecap_glyphs_side", "bumps_leaves_sun"), "light", 0.02, 0.04),
    (("cylinder_flowers_sun", "sphere_dots_sun"), "light", 0.02, None),
    (("wave_paisley_side", "sphere_stars_const"), "light", 0.03, None),
    (("cloth_hang_floral_side", "cloth_push_brick_sun"), "light", 0.06, None),
    (_VARIED, "light_correlation", 0.97, None),
    (_VARIED, "light_gain", 3, None),
    (_ALL, "seconds", 8, 60),
    (_ALL, "cached_seconds", 1, 3),
    (_ALL, "frontal_ms", 1, None),
    (_ALL, "frontal_memory", 300, None),
    (_ALL, "irradiance_seconds", 3, None),
    (_ALL, "render_seconds", 5, None),
    (("cylinder_flowers_sun", "wave_paisley_side"), "chart_angle", 3, None),
    (("cylinder_flowers_sun", "wave_paisley_side"), "chart_area", 0.05, None),
    (("cylinder_flowers_sun",), "retexture", 0.05, None),
]
_RATIO = (0.5, 1.5)  # wanted range of the median instance error in units of sigma
VARIANTS = ("_noise_q70", "_noise")  # endings of degraded copies of a scene, which share its truth
_VARIANT_ROWS = [("instance_median", 1.5), ("recall", 0.8)]  # figure, limit as a multiple of the clean image's


def original(name: str) -> str:
    """The scene of which `name` is a degraded copy; else `name` itself."""
    for ending in VARIANTS:
        if name.endswith(ending):
            return name.removesuffix(ending)
    return name


def targets(name: str, numbers: Numbers, clean: Numbers | None) -> list[Target]:
    """What is wanted of image `name`; `clean`: numbers of the image of which it is a degraded copy, if it is one."""
    merged: dict[str, list[float | None]] = {}
    for images, figure, goal, floor in _ROWS:
        if name in images:
            row = merged.setdefault(figure, [None, None])
            row[:] = [row[0] if goal is None else goal, row[1] if floor is None else floor]
    out = [Target(f, bool(FIGURES[f].more), goal, floor, numbers[f]) for f, (goal, floor) in merged.items()]
    if name in _ALL:
        out.append(Target("instance_ratio", False, _RATIO[1], None, numbers["instance_ratio"]))
        out.append(Target("instance_ratio", True, _RATIO[0], None, numbers["instance_ratio"]))
    for figure, factor in _VARIANT_ROWS if clean else []:
        reference = clean[figure] if clean else None
        goal = None if reference is None else factor * reference
        out.append(Target(figure, bool(FIGURES[figure].more), goal, None, numbers[figure]))
    return out
