"""Stage `frontal`: one texton's frontal appearance and its instances' transforms, one job per cluster (section 3.1)."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from .engine.stage import Arrays, Stage, StageParams
from .geometry.pyramid import level_image, sampling_spread
from .geometry.registration import Template, make_template, patch_grid, register, sample
from .geometry.texton import (
    Estimate,
    Settings,
    estimate_texton,
    independent_samples,
    posterior,
    strain_error,
    weighted_contrast,
    weighted_mean,
)
from .geometry.views import Views, calibrate, measure, unique

Array = NDArray[np.floating]
Indices = NDArray[np.integer]


class Params(StageParams):
    """Parameters of `frontal`."""

    radius: float = Field(4.5, gt=1, le=20, description="radius of the first domain, in sizes (σ) of the interest point")
    region_radius: float = Field(2.0, gt=1, le=5, description="radius of the first domain, in radii of the region")
    min_radius: float = Field(6.0, ge=0, le=50, description="least radius of the first domain, px of the image")
    max_growth: float = Field(2.2, ge=1, le=5, description="the domain may grow to this multiple of the first radius")
    iterations: int = Field(20, ge=5, le=100, description="EM iterations")
    affine_iterations: int = Field(6, ge=1, le=50, description="of which with free affine frames")
    subset: int = Field(100, ge=3, description="copies that a texton is estimated from; the others are registered to it")
    adopt: float = Field(
        0.95, ge=0, le=1, description="other points are tried whose descriptor is as near as this share of the own"
    )
    agreement: float = Field(0.3, gt=0, lt=1, description="share of unrelated variance below which a pixel is the element's")
    noise_floor: float = Field(0.01, gt=0, lt=1, description="texton noise that no agreement undercuts, in units of contrast")
    blur: float = Field(0.5, ge=0, le=5, description="standard deviation of the image's point spread, px")
    fit_blur: bool = Field(True, description="whether each texton finds the point spread itself, starting from `blur`")
    trend_order: int = Field(1, ge=0, le=2, description="order of the polynomial trend of log scale (perspective)")
    max_metric_residual: float = Field(0.03, gt=0, description="a texton above is unusable")
    min_share: float = Field(0.3, ge=0, le=1, description="share of the members (or 20 of them) that must agree with a texton")
    max_strain_error: float = Field(0.12, gt=0, description="a texton that some strain of it changes too little is unusable")
    max_metric_error: float = Field(0.07, gt=0, description="a texton whose stretch is known less well is unusable")
    max_sigma: float = Field(8.0, gt=0, description="a texton whose typical normal error is larger (degrees) is unusable")


_ENOUGH = 20  # instances that chance does not bring together, however large their cluster
_CIRCLE_SLACK = 4.0  # one size is all that a circle's upgrade fits, so that scattered sizes say less against it
# of the descriptors in hand, shared by the jobs that one worker runs: squared lengths, and log sizes of their frames
_SIZES: dict[str, Any] = {}


def empty(reason: str) -> Arrays:
    """The artefact of a texton that could not be estimated."""
    return {
        "usable": np.array(False),
        "reason": np.array(reason),
        "appearance": np.zeros((0, 0, 3), np.float32),
        "domain": np.zeros((0, 0), np.float32),
        "spacing": np.array(0, np.float32),
        "progress": np.zeros((0, 0, 0, 3), np.float32),
        "progress_iterations": np.zeros(0, np.int32),
        "metric_residual": np.array(np.nan, np.float32),
        "information": np.array(0, np.float32),
        "strain_error": np.array(np.nan, np.float32),
        "circular": np.array(False),
        "blur": np.array(np.nan, np.float32),
        "level": np.array(0, np.int32),
        "noise": np.array(np.nan),
        "prior": np.array(np.nan),
        "spread": np.array(np.nan),
        "mean_blur": np.zeros(3),
        "ridge": np.zeros(8),
        "gram": np.eye(2),
        "trend": np.zeros(5),
        "order": np.array(0, np.int32),
        "inflation": np.array(np.nan),
        "scale_variance": np.array(np.nan),
        "relief": np.array(0.0),
        "gauge_cov": np.zeros((8, 8)),
    } | no_rows()


def no_rows() -> Arrays:
    """The table of no instances."""
    none = np.zeros((0,), np.float32)
    return {
        "index": np.zeros(0, np.int32),
        "xy": np.zeros((0, 2), np.float32),
        "transform": np.zeros((0, 2, 2), np.float32),
        "scale": none,
        "tensor": np.zeros((0, 3), np.float32),
        "tensor_cov": np.zeros((0, 3, 3), np.float32),
        "log_scale_sigma": none,
        "normal": np.zeros((0, 3), np.float32),
        "normal_sigma": none,
        "inlier": none,
        "irradiance": none,
        "irradiance_rgb": np.zeros((0, 3), np.float32),
        "irradiance_sigma": none,
    }


def run(inputs: Mapping[str, Any], params: Params) -> Arrays:
    """Estimate the texton of one cluster. Inputs `image`, `detect`, `cluster`, `part`."""
    rgb, detect = inputs["image"]["rgb"], inputs["detect"]
    members = np.flatnonzero(inputs["cluster"]["label"] == int(inputs["part"]))
    if len(members) < 4:
        # three views leave a second metric frame as a rule, whose preserved directions differ; a fourth decides
        return empty(f"only {len(members)} instances; four are the least that fix one frontal view")
    xy0, frames0 = detect["xy"][members].astype(np.float64), detect["frame"][members].astype(np.float64)

    # one grid point is about one pixel of the pyramid level on which the first domain is 8 to 15 points in radius
    radius = params.region_radius if detect["kind"][members[0]] else params.radius
    unit = float(np.median(np.sqrt(np.abs(np.linalg.det(frames0)))))
    radius = max(radius, params.min_radius / unit)
    size = unit * radius
    level = int(np.clip(np.ceil(np.log2(size / 15.0)), -1, 5))
    image = level_image(rgb, level)
    factor = 2.0**-level
    half = int(np.clip(round(size * factor), 6, 15))
    xy = (xy0 + 0.5) * factor - 0.5
    frames = frames0 * (radius * factor / half)
    extent = np.array([rgb.shape[1], rgb.shape[0]], float)
    where0 = (2 * xy0 - extent) / extent.max()

    rng = np.random.default_rng(0)
    few = np.sort(rng.permutation(len(members))[: 2 * params.subset])  # not all of them will show to be copies
    settings = Settings(
        half=half,
        half_limit=round(half * params.max_growth),
        iterations=params.iterations,
        affine_iterations=min(params.affine_iterations, params.iterations),
        noise_floor=params.noise_floor,
        trend_order=params.trend_order,
        agreement=params.agreement,
        spread=(params.blur * factor) ** 2 + sampling_spread(factor),
        fit_spread=params.fit_blur,
        most=params.subset,
    )
    texton = estimate_texton(image, xy[few], frames[few], where0[few], settings)
    if texton is None:
        return empty("no three of its patches look alike")
    founders = few[texton.founders]
    found = founders[texton.inlier > 0.8]
    more = adopt(detect, members, found, params.adopt)
    if len(more):
        members = np.concatenate([members, more])
        xy0, frames0 = detect["xy"][members].astype(np.float64), detect["frame"][members].astype(np.float64)
        xy, frames = (xy0 + 0.5) * factor - 0.5, frames0 * (radius * factor / half)
        where0 = (2 * xy0 - extent) / extent.max()
    return finish(image, texton, xy, frames, where0, members, founders, factor, params)


def adopt(detect: Mapping[str, Any], members: Indices, found: Indices, reach: float) -> Indices:
    """Points of other clusters, or of none, that may show the same element: rows of `detect`.

    k-means cuts an element's instances where their looks change with slant and light. Tried are those whose descriptor is
    nearer to the mean of the instances `found` (rows of `members`) than the share `reach` of these, and of a like size; as
    many at most as there are members.
    """
    if reach == 0 or len(found) < 4:
        return np.zeros(0, members.dtype)
    descriptor, kind = detect["descriptor"], detect["kind"]
    if _SIZES.get("of") is not descriptor:
        size = np.log(np.abs(np.linalg.det(detect["frame"].astype(np.float64)))) / 2
        _SIZES.update({"of": descriptor, "size": size, "length": np.einsum("nk,nk->n", descriptor, descriptor)})
    size = _SIZES["size"]
    own = members[found]
    centre = descriptor[own].mean(0)
    distance = _SIZES["length"] - 2 * descriptor @ centre  # squared, but for a constant
    near = (distance < np.quantile(distance[own], reach)) & (kind == kind[members[0]])
    near &= np.abs(size - np.median(size[own])) < np.log(2.0)
    near[members] = False
    rows = np.flatnonzero(near)
    return np.sort(rows[np.argsort(distance[rows], kind="stable")[: len(members)]])


def finish(
    image: Array,
    texton: Estimate,
    xy: Array,
    frames: Array,
    where: Array,
    members: Indices,
    founders: Indices,
    factor: float,
    params: Params,
) -> Arrays:
    """Register all members to the finished texton and report them with their uncertainties."""
    template = texton.template
    start_xy, start_frames = xy.copy(), frames.copy()
    if len(founders) < len(members):
        # detector frames differ from the texton's by one common map: learn it from the founders
        good = texton.inlier > 0.8
        if good.sum() >= 3:
            relative = np.linalg.solve(frames[founders][good], texton.frames[good])
            common = np.median(relative, axis=0)
            shift = np.median(
                np.linalg.solve(frames[founders][good], (texton.xy[good] - xy[founders][good])[..., None])[..., 0], axis=0
            )
            start_frames = frames @ common
            start_xy = xy + np.einsum("mij,j->mi", frames, shift)
    start_xy[founders], start_frames[founders] = texton.xy, texton.frames
    got = register(image, template, start_xy, start_frames, steps=10)
    residual = got.residual
    contrast2 = weighted_contrast(template)
    samples = independent_samples(template)
    inlier = posterior(residual, texton.noise**2, contrast2, texton.prior, samples)
    if inlier.sum() < 2.5:
        return empty("its patches do not agree with their mean")
    order = params.trend_order if inlier.sum() >= 12 else 0
    gauge, metric_residual, circular = calibrate(template, got.frames, where, residual, inlier, order)
    views = measure(image, template, gauge, got, where)
    inlier = inlier * views.credit * unique(got.xy, residual, views.transform, template)
    good = inlier > 0.8
    metric_error = float(np.sqrt(np.linalg.eigvalsh(gauge.covariance[:3, :3])[-1]))
    least = max(float(np.median(residual[good])) if good.any() else 0.0, params.noise_floor**2 * contrast2)
    weakest = strain_error(template, least)
    reason = ""
    typical = float(np.median(views.normal_sigma[good])) if good.any() else np.inf
    if good.sum() < 4:
        reason = f"only {int(good.sum())} instances agree with it"
    elif good.sum() < min(_ENOUGH, params.min_share * len(members)):
        reason = f"only {int(good.sum())} of {len(members)} members agree with it, as few as chance brings together"
    elif metric_residual > params.max_metric_residual * (_CIRCLE_SLACK if circular else 1.0):
        reason = f"its instances are no views of one flat element (metric residual {metric_residual:.3f})"
    elif weakest > params.max_strain_error:
        reason = f"it is too plain along one direction, as an edge is, to fix slant and tilt (error {weakest:.2f})"
    elif metric_error > params.max_metric_error:
        reason = f"its instances keep one direction of the element and do not fix its stretch (error {metric_error:.2f})"
    elif typical > params.max_sigma:
        reason = f"it says too little about slant and tilt (expected error {typical:.1f} degrees)"
    return {
        "usable": np.array(reason == ""),
        "reason": np.array(reason),
        "appearance": texton.values.astype(np.float32),
        "domain": texton.weights.astype(np.float32),
        "spacing": np.array(texton.spacing / factor, np.float32),
        "progress": progress(image, texton),
        "progress_iterations": np.array([h[0] for h in texton.history], np.int32),
        "metric_residual": np.array(metric_residual, np.float32),
        "information": np.array(metric_error, np.float32),
        "strain_error": np.array(weakest, np.float32),
        "circular": np.array(circular),
        "blur": np.array(np.sqrt(max(template.spread - sampling_spread(factor), 0)) / factor, np.float32),
        "level": np.array(round(-np.log2(factor)), np.int32),
        "noise": np.array(texton.noise),
        "prior": np.array(texton.prior),
        "spread": np.array(template.spread),
        "mean_blur": template.mean_blur,
        "ridge": template.ridge,
        "gram": gauge.gram,
        "trend": gauge.trend,
        "order": np.array(gauge.order, np.int32),
        "inflation": np.array(gauge.inflation),
        "scale_variance": np.array(gauge.scale_variance),
        "relief": np.array(gauge.relief),
        "gauge_cov": gauge.covariance,
    } | rows(views, members, inlier, factor)


def template_of(table: Arrays) -> Template:
    """The texton of a `table` that this stage delivered, ready to register to; lengths in px of its pyramid level."""
    factor = 2.0 ** -int(table["level"])
    values, weights, spacing = table["appearance"].astype(float), table["domain"].astype(float), float(table["spacing"])
    return make_template(values, weights, spacing * factor, float(table["spread"]), table["mean_blur"], table["ridge"])


def rows(views: Views, index: Indices, inlier: Array, factor: float) -> Arrays:
    """A row for each view; `index` of its point in `detect`, −1 without one. `factor`: px of its pyramid level per px."""
    out = {
        "xy": (views.xy + 0.5) / factor - 0.5,
        "transform": views.transform,
        "scale": views.scale,
        "tensor": views.tensor,
        "tensor_cov": views.tensor_cov,
        "log_scale_sigma": views.log_scale_sigma,
        "normal": views.normal,
        "normal_sigma": views.normal_sigma,
        "inlier": inlier,
        "irradiance": views.light,
        "irradiance_rgb": views.light_rgb,
        "irradiance_sigma": views.light_sigma,
    }
    return {"index": index.astype(np.int32)} | {name: array.astype(np.float32) for name, array in out.items()}


def progress(image: Array, texton: Estimate) -> Array:
    """The frontal appearance after each iteration in the history, on the final grid and gauge: (k, n, n, 3)."""
    n = 2 * texton.half + 1
    points = patch_grid(texton.half, texton.spacing)
    pictures: list[Array] = []
    for k, (_, xy, frames, inlier) in enumerate(texton.history):
        if k and frames is texton.history[k - 1][2]:  # EM had settled
            pictures.append(pictures[-1])
            continue
        # the gauge of that iteration against the final one: a common map, by least squares over the founders
        weight = texton.inlier[:, None, None]
        a = np.einsum("mji,mjk->ik", frames * weight, frames)
        b = np.einsum("mji,mjk->ik", frames * weight, texton.frames)
        patches = sample(image, xy, frames @ np.linalg.solve(a, b), points)
        gain = np.maximum(patches.mean((1, 2)), 1e-6)
        mean, _ = weighted_mean(patches, gain / np.median(gain), inlier + 1e-9)
        pictures.append(mean.reshape(n, n, -1))
    return np.stack(pictures).astype(np.float32)


STAGE = Stage(name="frontal", version=5, params=Params, run=run, inputs=("image", "detect", "cluster"), fan_out="cluster")
