"""Surface stage: from instances with two-fold ambiguous normals to one smooth surface (section 4 of the paper)."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.spatial import cKDTree

from sftex_stages.engine.stage import Arrays, Stage, StageParams
from sftex_stages.errors import StageError
from sftex_stages.frontal import template_of
from sftex_stages.geometry import (
    blocks,
    calibration,
    confidence,
    curvature,
    direct,
    gaussian,
    imaging,
    mirror,
    perspective,
    pooling,
    pyramid,
    refine,
    shading,
    sign_regions,
    sign_search,
    spline,
    support,
    tensors,
    verdict,
)
from sftex_stages.geometry import field as irradiance_field
from sftex_stages.geometry.camera import Camera

Float = NDArray[np.floating]


class Pinhole(StageParams):
    """A known pinhole camera; its axis meets the centre of the image."""

    focal_px: float = Field(gt=0, description="Focal length, in pixels of this image")


Point = tuple[float, float]
Disc = tuple[float, float, Annotated[float, Field(gt=0)]]


class HintParams(StageParams):
    """What is known of a surface beforehand; it decides between a surface and its mirror image, piece by piece."""

    near: tuple[Point, ...] = Field((), description="Points [x, y] px that stand out toward the camera")
    far: tuple[Point, ...] = Field((), description="Points [x, y] px that lie back")
    convex: tuple[Disc, ...] = Field((), description="Discs [x, y, radius] px that bulge toward the camera")
    convex_mask: bool = Field(False, description="All within the mask (without one: everything) bulges toward the camera")
    light: float | None = Field(
        None, ge=-360, le=360, description="Where the light comes from, degrees: 0 right, 90 above, 180 left, 270 below"
    )


class Params(StageParams):
    """Parameters of the surface stage."""

    method: Literal["collapsed", "em"] = Field(
        "collapsed", description="Signs by the search with the surface integrated out, or by the paper's EM"
    )
    camera: Literal["auto", "orthographic"] | Pinhole = Field(
        "auto",
        description="`auto` takes the focal length from the photograph's EXIF data, or else believes in perspective where "
        "element sizes prove it; `{focal_px: 2200}` if it is known",
    )
    start: Literal["auto", "cylinder", "sphere", "plane"] = Field(
        "auto", description="Shape that the sign search starts from; `auto` starts from all of them and from light and spectra"
    )
    hints: HintParams = Field(
        default_factory=HintParams.model_construct,
        description="What is known beforehand: near, far: [[x, y], …]; convex: [[x, y, radius], …]; convex_mask: whether all "
        "within the mask is convex; light: degrees",
    )
    min_inlier: float = Field(
        0.8, ge=0, le=1, description="Posterior above which an instance is used (the paper's 0.8)"
    )
    model_error: float = Field(0.03, gt=0, le=0.5, description="Error of pooled tensors that no averaging removes")
    nodes: int = Field(1500, ge=50, le=20000, description="Most nodes that the sign search pools the instances in")
    detail: float = Field(0.56, gt=0.2, le=4, description="Spacing of the surface's grid, in mean spacings of nodes")
    shading: bool = Field(True, description="Use irradiance against normals as a cue for signs")
    direct: int = Field(
        0, ge=0, le=5, description="Rounds of the direct method: instances registered again as the surface shows them"
    )
    finalists: int = Field(
        4, ge=1, le=50, description="Sign patterns compared by their full evidence; up to four times as many if nodes are few"
    )


TURN = 0.5  # of what a node knows: a cell in which the surface turns by more is quartered
ROUNDS, CURVED_ROUNDS = 3, 4  # of a refinement that chooses smoothness and noise; of one whose prior follows the surface
STEEP = 3.5  # slope (74 degrees) beyond which instances are not registered again any steeper: nothing is left of them


@dataclass(frozen=True)
class Instances:
    """Members of all usable textons: `table` as delivered, and what is worked with, (N, …) float64."""

    table: Arrays
    xy: Float
    transform: Float  # (N, 2, 2), as the rays of the camera see it
    trust: Float  # 0 below the threshold
    texton: NDArray[np.integer]  # 0 … K − 1, used textons only
    calibration: calibration.Calibration
    covariance: Float  # of w, (N, 2, 2)
    log_scale: Float  # (N,) of the calibrated transforms, up to a constant a texton
    cell: Float  # (N,) px of the cells that they are pooled in


@dataclass(frozen=True)
class Fit:
    """A refined surface; the instances and nodes it was refined from, as `camera` sees them; and nats by which the prior of
    curvature beat that of heights."""

    instances: Instances
    nodes: pooling.Nodes
    solution: refine.Solution
    camera: Camera
    gain: float


def collect(frontal: list[Arrays], min_inlier: float, found: Arrays | None = None) -> Arrays:
    """Members of all usable textons and what the search `found` of them, one row each; `texton` is the part's number.

    `searched` says which were found by search.

    Raises
    ------
    StageError
        without a usable texton, or with fewer than three instances to believe in.
    """
    names = ["xy", "transform", "tensor", "tensor_cov", "normal", "inlier", "irradiance", "irradiance_sigma"]
    names += ["irradiance_rgb", "log_scale_sigma"]
    parts = [(k, f) for k, f in enumerate(frontal) if bool(f["usable"]) and len(f["xy"])]
    if not parts:
        raise StageError(
            f"none of the {len(frontal)} texture elements is usable, so there is nothing to reconstruct from. "
            "Use a larger or sharper photograph of a repeating pattern, or a mask that leaves only the patterned "
            "surface; the textons' `reason` in the frontal results says what is wrong with each."
        )
    rows = {name: np.concatenate([np.asarray(f[name]) for _, f in parts]) for name in names}
    rows["texton"] = np.concatenate([np.full(len(f["xy"]), k, np.int32) for k, f in parts])
    detected = len(rows["xy"])
    if found is not None:
        rows = {name: np.concatenate([array, found[name]]) for name, array in rows.items()}
    rows["searched"] = np.arange(len(rows["xy"])) >= detected
    good = int((rows["inlier"] > min_inlier).sum())
    if good < 3:
        raise StageError(
            f"only {good} of {len(rows['xy'])} instances have a posterior above surface.min_inlier = {min_inlier:g}; "
            "at least 3 are needed. Lower surface.min_inlier, or use a photograph with more repetitions."
        )
    return rows


def prepare(rows: Arrays, params: Params, camera: Camera | None = None) -> Instances:
    """Calibrate the textons against one another (`calibration.py`), as the rays of `camera` see them."""
    xy = rows["xy"].astype(float)
    trust = np.where(rows["inlier"] > params.min_inlier, rows["inlier"], 0.0).astype(float)
    _, texton = np.unique(rows["texton"], return_inverse=True)
    _, covariance = tensors.deviator(rows["tensor"].astype(float), rows["tensor_cov"].astype(float))
    transform = rows["transform"].astype(float)
    if camera is not None:
        transform = camera.flatten(xy) @ transform
    result = calibration.calibrate(xy, transform, covariance, texton, np.maximum(trust, 1e-6), params.model_error)
    spread = covariance * result.noise[texton][:, None, None] + (params.model_error**2 / 2) * np.eye(2)
    log_scale = np.log(calibration.scales(transform, result.e[texton]))
    cell = np.full(len(xy), spacing_of(xy[trust > 0], params.nodes))
    return Instances(rows, xy, transform, trust, texton.astype(np.int64), result, spread, log_scale, cell)


def spacing_of(xy: Float, most: int) -> float:
    """Side in px of square cells, at most about `most` of them, that points `xy` (N, 2) are pooled in."""
    area = float(np.prod(np.maximum(np.ptp(xy, axis=0), 1.0)))
    return float(np.sqrt(area / min(len(xy), most)))


def run(inputs: Mapping[str, Any], params: Params) -> Arrays:
    """Height, normals, their support and uncertainty, and instances with their sign resolved.

    Inputs `image`, `frontal` and, where there was a search, `enrich`.

    Returns
    -------
    height (H, W) px toward the camera, mean 0 (perspective: px as they are at the distance f); normals (H, W, 3) in the
    camera's frame; valid (H, W) bool; normal_sigma (H, W) degrees, the root mean square angle expected; NaN where not valid.
    piece (H, W) int32, connected pieces of `valid` from 1, 0 elsewhere: their heights relative to one another are guessed.
    instance/… (N, …), members of usable textons: xy, transform, inlier, irradiance (and _rgb, _sigma) as delivered; normal
    calibrated, its sign resolved; normal_sigma, what it is off the surface and the surface off the truth; texton; state,
    posteriors of {as delivered, the other sign, not from the surface}; sign_margin, nats by which the best rival pattern
    is worse that differs there (NaN: not used).
    camera "orthographic" or "perspective", with focal_px (inf if orthographic), its standard deviation focal_sigma px (0 if it
    was given, or if orthographic) and principal_point (x, y).
    Of the pieces, (P,) each: vote/…, nats by which cues prefer the sign taken to the other (`mirror.py`): scale, light,
    bulge, hint, smoothness (the other pieces), and shading, by which a piece is tied to the light; mirror_margin, nats by
    which the sign taken beats the other; region_margin, nats by which the best rival pattern is worse that turns
    a tenth of the piece or more (inf: there is none).
    texton/… (K, …) of the textons used: part, their number; shear, (e1, e2) of the correction I + ((e1, e2), (e2, −e1)) of the
    frontal frame; slant_bias, degrees, the median of how much steeper it was delivered than the surface is; noise, factor on
    its variance; reason, in words, if it disagrees with the others, else "".
    energy, −log evidence of the surface; curvature_gain, nats by which the prior that charges for the surface's curvature is
    likelier than that which charges for the height map's derivatives (negative: this one was taken); candidate/… and light: see
    `record`.

    Raises
    ------
    StageError
        without a usable texton, with fewer than three instances to believe in, or with a hint outside of the image.
    """
    mask = np.asarray(inputs["image"]["mask"], bool)
    hints = read_hints(params.hints, mask.shape)
    rows = collect(inputs["frontal"], params.min_inlier, inputs.get("enrich"))
    instances = prepare(rows, params)
    used = instances.trust > 0
    box = instances.xy[used].min(0), instances.xy[used].max(0)
    spacing = float(instances.cell[0])  # the same for all, so far
    nodes = pool(instances, params)
    low, high = box[0] - 2 * spacing, box[1] + 2 * spacing
    coarse = gaussian.make_field(spline.cover(low, high, spacing), nodes.xy)
    sizes = None if params.camera == "orthographic" else element_sizes(instances, nodes, spacing)
    data = search_data(instances, nodes, spacing, params)
    if sizes is not None:
        data = replace(data, views=views(data, nodes, coarse.grid, sizes, inputs["image"], params))
    find = sign_search.search if params.method == "collapsed" else sign_search.by_em
    candidates = find(data, coarse, spacing, params.finalists, params.start)
    best = candidates[0]
    start = gaussian.gradients(coarse, best.a)
    coupled = sign_search.own_coupling(best)
    regions, rise = sign_search.rivals(data, coupled, best.s)
    margin = np.append(sign_regions.margins(regions, rise, len(best.s)), np.nan)[nodes.member]
    choice = choose_camera(nodes, coarse.grid, start, best, sizes, inputs["image"], params)
    found = verdict.decide(nodes, coarse, coupled, data, best, start, sizes, choice, hints, spacing)
    camera, before = choice.camera, nodes.xy
    start = found.sign[found.piece, None] * start
    if camera.bend:
        instances = prepare(rows, params, camera)
        nodes = pool(instances, params)
        start = start[cKDTree(before).query(nodes.xy)[1]]
    height = heights(instances, nodes, camera, spacing)
    fine = gaussian.make_field(coarse.grid, nodes.xy, camera.stretch(nodes.xy))
    solution = refine.refine(fine, nodes.w, nodes.covariance, nodes.weight, start, best.smooth, ROUNDS, height, best.noise)
    grid = spline.cover(low, high, params.detail * spacing)
    fitted = refit(instances, grid, solution, camera, spacing, params)
    for _ in range(params.direct):
        rows = look_again(inputs, rows, grid, fitted.solution.a, camera, params)
        fitted = refit(prepare(rows, params, camera), grid, fitted.solution, camera, spacing, params)
    other = doubted(rows, fitted, choice, spacing, params) if choice.doubt else None
    results = outputs(mask, fitted, spacing, other)
    results["instance/sign_margin"] = margin.astype(np.float32)
    results["focal_sigma"] = np.array(choice.doubt / camera.bend if choice.doubt else 0.0)
    results |= verdict.by_piece(results["piece"], before, found, regions, rise)
    return results | record(candidates, found.mirrored)


def look_again(
    inputs: Mapping[str, Any], rows: Arrays, grid: spline.Grid, a: Float, camera: Camera, params: Params
) -> Arrays:
    """The instances `rows` registered again as the surface of coefficients `a` (M,) shows them (`direct.py`)."""
    xy = rows["xy"].astype(float)
    slope = tensors.limit(camera.slopes_of(grid, a, xy), STEEP)
    p = direct.foreshortening(slope, camera, xy)
    rgb = inputs["image"]["rgb"]
    rows = {name: value.copy() for name, value in rows.items()}
    for k in np.unique(rows["texton"]):
        part = inputs["frontal"][k]
        level = int(part["level"])
        at = np.flatnonzero(rows["texton"] == k)
        transform, inlier = rows["transform"][at].astype(float), rows["inlier"][at].astype(float)
        image, template = pyramid.level_image(rgb, level), template_of(part)
        seen = direct.look_again(image, 2.0**-level, template, xy[at], transform, inlier, p[at], params.min_inlier)
        if seen is None:
            continue
        rows["inlier"][at] = seen.inlier
        new = at[seen.moved]
        rows["xy"][new], rows["transform"][new] = seen.xy[seen.moved], seen.transform[seen.moved]
        s = seen.transform[seen.moved]
        tensor = imaging.tensor_of(s, np.linalg.svd(s, compute_uv=False)[:, 0]) if len(new) else np.zeros((0, 3))
        rows["tensor"][new] = tensor
        rows["normal"][new] = imaging.normal_of_tensor(tensor)
    return rows


def refit(
    instances: Instances, grid: spline.Grid, before: refine.Solution, camera: Camera, spacing: float, params: Params
) -> Fit:
    """The surface `before` refined on `grid` from `instances` pooled anew, more finely where it turns.

    The prior charges for the height map's roughness or for the surface's curvature: whichever has the greater evidence.
    """
    nodes = pool(instances, params)
    instances = quartered(instances, nodes, before.field.grid, before.a, camera)
    nodes = pool(instances, params)
    stretch = camera.stretch(nodes.xy)
    start = gaussian.gradients(gaussian.make_field(before.field.grid, nodes.xy, stretch), before.a)
    height = heights(instances, nodes, camera, spacing)
    field, data = gaussian.make_field(grid, nodes.xy, stretch), (nodes.w, nodes.covariance, nodes.weight)
    flat = refine.refine(field, *data, start, before.smooth, ROUNDS, height, before.noise)
    field, settings = curvature.follow(field, flat.a, camera), (flat.height, flat.noise, flat.height_noise)
    curved = refine.refine(field, *data, flat.gradient, flat.smooth, CURVED_ROUNDS, *settings, camera=camera)
    solution = max((flat, curved), key=lambda x: x.evidence)
    return recalibrated(Fit(instances, nodes, solution, camera, curved.evidence - flat.evidence), params)


def recalibrated(fit: Fit, params: Params) -> Fit:
    """Textons corrected by the surface, and the surface refined from them: one round of the alternation. Then the prior learns
    where the surface is rough."""
    instances, nodes, solution, camera = fit.instances, fit.nodes, fit.solution, fit.camera
    grid, curved = solution.field.grid, solution.field.cells is not None
    seen, _ = tensors.predict(camera.slopes_of(grid, solution.a, instances.xy))
    found = calibration.against_surface(
        instances.calibration, instances.transform, instances.covariance, instances.texton, instances.trust, seen
    )
    if not np.array_equal(found.e, instances.calibration.e):
        instances = replace(instances, calibration=found)
        nodes = pool(instances, params)
        field = gaussian.make_field(grid, nodes.xy, camera.stretch(nodes.xy))
        start = gaussian.gradients(field, solution.a)
        field = curvature.follow(field, solution.a, camera) if curved else field
        data = nodes.w, nodes.covariance, nodes.weight
        settings = solution.height, solution.noise, solution.height_noise
        solution = refine.refine(field, *data, start, solution.smooth, 1, *settings)
    data = nodes.w, nodes.covariance, nodes.weight
    solution = refine.refine_locally(*data, solution, camera if curved else None)
    return replace(fit, instances=instances, nodes=nodes, solution=solution)


def doubted(rows: Arrays, fit: Fit, choice: perspective.Choice, spacing: float, params: Params) -> confidence.Other:
    """The same surface as a camera shows it whose 1/f is off by as much as must be expected."""
    camera, known = replace(choice.camera, bend=choice.camera.bend * np.exp(choice.doubt)), fit.solution
    instances = replace(prepare(rows, params, camera), cell=fit.instances.cell)
    nodes = pool(instances, params)
    height = heights(instances, nodes, camera, spacing)
    field = gaussian.make_field(known.field.grid, nodes.xy, camera.stretch(nodes.xy))
    field = replace(field, energies=known.field.energies)
    start = gaussian.gradients(field, known.a)
    data, settings = (nodes.w, nodes.covariance, nodes.weight), (height, known.noise, known.height_noise)
    found = refine.refine(field, *data, start, known.smooth, 3, *settings, tune=False)
    return confidence.Other(camera, found.a)


def heights(
    instances: Instances, nodes: pooling.Nodes, camera: Camera, spacing: float
) -> gaussian.Heights | None:
    """What element sizes say of heights at the nodes; None under orthography, or with too few of them."""
    sizes = element_sizes(instances, nodes, spacing) if camera.bend else None
    return sizes.heights(camera, nodes.xy, nodes.w, np.log(camera.rays(nodes.xy)[1])) if sizes else None


def pool(instances: Instances, params: Params) -> pooling.Nodes:
    """Nodes of the instances' cells."""
    robust = instances.trust * np.minimum(instances.calibration.weight, 1)
    return pooling.pool(
        instances.xy, instances.calibration.w, instances.covariance, robust, instances.cell, params.model_error
    )


def quartered(
    instances: Instances, nodes: pooling.Nodes, grid: spline.Grid, a: Float, camera: Camera
) -> Instances:
    """The instances with the cells of those `nodes` quartered in which the surface of coefficients `a` (M,) turns by more than
    `TURN` of what the node knows."""
    seen, _ = tensors.predict(camera.slopes_of(grid, a, instances.xy))
    used = nodes.member >= 0
    node, count = nodes.member[used], len(nodes.xy)
    number = np.bincount(node, minlength=count)
    mean = np.stack([np.bincount(node, seen[used, k], count) / number for k in range(2)], 1)
    spread = np.bincount(node, ((seen[used] - mean[node]) ** 2).sum(1), count) / number
    wide = spread > TURN**2 * np.trace(nodes.covariance, axis1=1, axis2=2)
    cell = instances.cell.copy()
    cell[used] = np.where(wide[node], 0.5, 1.0) * cell[used]
    return replace(instances, cell=cell)


def choose_camera(
    nodes: pooling.Nodes,
    grid: spline.Grid,
    start: Float,
    best: sign_search.Candidate,
    sizes: perspective.Sizes | None,
    image: Arrays,
    params: Params,
) -> perspective.Choice:
    """The camera that is asked for, or the photograph's own, or told by element `sizes`; and what these say about the sign of
    `start` (M, 2)."""
    centre, size, bend = frame(image, params)
    if params.camera == "orthographic" or sizes is None:
        return perspective.Choice(Camera(centre, bend or 0.0), 0.0, 0.0)
    w, covariance = nodes.w, nodes.covariance
    return perspective.choose(grid, nodes.xy, w, covariance, sizes, start, best.smooth, best.noise, centre, size, bend)


def frame(image: Arrays, params: Params) -> tuple[Point, float, float | None]:
    """Principal point (x, y) and longer side of the image, px, and 1/f, 1/px, if it is known."""
    shape = image["mask"].shape
    bend = 1 / params.camera.focal_px if isinstance(params.camera, Pinhole) else None
    if params.camera == "auto" and "focal_px" in image:
        bend = 1 / float(image["focal_px"])
    return ((shape[1] - 1) / 2, (shape[0] - 1) / 2), float(max(shape)), bend


def views(
    data: sign_search.Data,
    nodes: pooling.Nodes,
    grid: spline.Grid,
    sizes: perspective.Sizes,
    image: Arrays,
    params: Params,
) -> tuple[sign_search.View, ...]:
    """What the camera that is known would show, or those do that may have been there."""
    seen = perspective.views(nodes.xy, nodes.w, nodes.covariance, sizes, *frame(image, params))
    return tuple(sign_search.seen_by(data, grid, view) for view in seen)


def read_hints(params: HintParams, shape: tuple[int, int]) -> mirror.Hints:
    """The hints as arrays.

    Raises
    ------
    StageError
        if a point lies outside of an image of `shape` (H, W).
    """
    lists = {"near": params.near, "far": params.far, "convex": params.convex}
    for name, rows in lists.items():
        for row in rows:
            if not (-0.5 <= row[0] <= shape[1] - 0.5 and -0.5 <= row[1] <= shape[0] - 0.5):
                raise StageError(
                    f"surface.hints.{name}: the point [{row[0]:g}, {row[1]:g}] lies outside of the image, which is "
                    f"{shape[1]} x {shape[0]} pixels; give x from the left and y from the top, in pixels"
                )
    turn = None if params.light is None else np.radians(params.light)
    light = None if turn is None else np.array([np.cos(turn), -np.sin(turn)])
    near, far, convex = (np.array(v, float).reshape(-1, k) for v, k in zip(lists.values(), (2, 2, 3), strict=True))
    return mirror.Hints(near, far, convex, light, params.convex_mask)


def element_sizes(instances: Instances, nodes: pooling.Nodes, spacing: float) -> perspective.Sizes | None:
    """Log scale of the elements on one scale for all textons; None with too few of them."""
    sigma = np.hypot(instances.table["log_scale_sigma"].astype(float), 0.01)
    used = (instances.trust > 0) & np.isfinite(sigma) & np.isfinite(instances.log_scale)
    if used.sum() <= 30:
        return None
    value, variance = on_one_scale(instances, nodes, instances.log_scale, sigma, used, spacing)
    return perspective.Sizes(value, variance, nodes.weight)


def on_one_scale(
    instances: Instances, nodes: pooling.Nodes, log: Float, sigma: Float, used: NDArray[np.bool_], spacing: float
) -> tuple[Float, Float]:
    """Means (M,) over the nodes of logarithms (N,) that every texton knows up to its own constant, and their variance."""
    trust = np.where(used, instances.trust, 0.0)
    present, texton = np.unique(instances.texton[used], return_inverse=True)
    found = irradiance_field.fit(instances.xy[used], log[used], sigma[used], texton, trust[used], spacing, 1.0)
    offset = np.zeros(instances.texton.max() + 1)
    offset[present] = found.offset
    return pooling.average(
        np.where(used, log, 0.0) - offset[instances.texton],
        np.where(used, sigma, 1.0) ** 2,
        nodes,
        np.maximum(trust, 1e-9),
        0.01,
    )


def search_data(instances: Instances, nodes: pooling.Nodes, spacing: float, params: Params) -> sign_search.Data:
    """What the sign search is given: gradients up to sign, and irradiance on one scale."""
    d, covariance = tensors.gradient(nodes.w, nodes.covariance)
    log_outlier = -np.log(np.pi) + 0.5 * (np.linalg.slogdet(nodes.covariance)[1] - np.linalg.slogdet(covariance)[1])
    light = instances.table["irradiance"].astype(float)
    lit = (instances.trust > 0) & (light > 0) & np.isfinite(light)
    cue = None
    if params.shading and lit.sum() > 30:
        sigma = np.hypot(instances.table["irradiance_sigma"].astype(float), 0.01)
        value, variance = on_one_scale(instances, nodes, np.log(np.where(lit, light, 1.0)), sigma, lit, spacing)
        e = np.exp(value)
        e, variance = e / e.mean(), variance * (e / e.mean()) ** 2
        cue = shading.make_shading(nodes.xy, e, variance, tensors.normals(d))
    return sign_search.Data(nodes.xy, d, covariance, nodes.weight, log_outlier, cue)


def outputs(
    mask: NDArray[np.bool_],
    fit: Fit,
    spacing: float,
    other: confidence.Other | None,
) -> Arrays:
    """Dense maps and instances."""
    instances, solution, camera = fit.instances, fit.solution, fit.camera
    table, grid = instances.table, solution.field.grid
    g = camera.slopes_of(grid, solution.a, instances.xy)
    k, found = instances.trust > 0, instances.calibration
    residual, chi2 = confidence.residuals(found.w, instances.covariance, g)
    shear = found.common * calibration.shear_effect(instances.transform)[1]
    moved = confidence.influence(solution, fit.nodes, residual, instances.texton, shear, instances.xy)
    inverse = blocks.selected_inverse(solution.factor)
    errors = confidence.Errors(
        instances.xy[k], chi2[k], moved, grid, inverse, solution.smooth.reach / spacing, camera, other
    )
    spread = confidence.spread(errors, instances.xy)
    sigma = confidence.angle(errors, instances.xy, g, spread)
    normal = resolve(instances, g)
    off = np.linalg.norm(normal - tensors.normals(g), axis=1)  # in radians, but for a third order
    state = posterior_states(instances, g, spread)
    heard = found.noise[instances.texton] <= calibration.DISAGREES
    inlier = table["inlier"] * (1 - state[:, 2]) * heard
    seen = (instances.trust > 0) & (state[:, 2] < 0.8)
    # what a search finds fills holes; how far a measurement speaks is told by those that were there before
    reach = support.reach(instances.xy[seen & ~table["searched"]], spacing)
    maps = support.dense(grid, solution.a, mask.shape, instances.xy[seen], spacing, errors, reach)
    piece = support.pieces(support.close_holes(maps["supported"] & mask, maps["closable"] & mask), spacing**2)
    valid = piece > 0
    nan = np.float32(np.nan)
    mean = maps["height"][valid].mean() if valid.any() else 0.0
    height = (maps["height"] - mean) / (1 - mean * camera.bend)  # under perspective a change of the unit, as it must be
    return texton_table(instances, g) | {
        "height": np.where(valid, height, nan).astype(np.float32),
        "normals": np.where(valid[..., None], maps["normals"], nan).astype(np.float32),
        "valid": valid,
        "piece": piece,
        "normal_sigma": np.where(valid, maps["sigma"], nan).astype(np.float32),
        "instance/xy": table["xy"].astype(np.float32),
        "instance/transform": table["transform"].astype(np.float32),
        "instance/normal": camera.turn(instances.xy, normal).astype(np.float32),
        "instance/normal_sigma": np.degrees(np.hypot(sigma, off)).astype(np.float32),
        "instance/inlier": inlier.astype(np.float32),
        "instance/irradiance": table["irradiance"].astype(np.float32),
        "instance/irradiance_rgb": table["irradiance_rgb"].astype(np.float32),
        "instance/irradiance_sigma": table["irradiance_sigma"].astype(np.float32),
        "instance/texton": table["texton"],
        "instance/state": state.astype(np.float32),
        "camera": np.array("perspective" if camera.bend else "orthographic"),
        "focal_px": np.array(1 / camera.bend if camera.bend else np.inf),
        "principal_point": np.array(camera.centre),
        "energy": np.array(-solution.evidence),
        "curvature_gain": np.array(fit.gain),
    }


def record(candidates: list[sign_search.Candidate], mirror: bool) -> Arrays:
    """What was tried: evidences (C,) in nats of the candidate sign patterns, best first, and the light of the best one.

    candidate/shape, candidate/shading and candidate/sizes add up to the evidence that ranks the tuned ones (candidate/tuned);
    candidate/origin names the start. light (4,) = (a, b, c_x, c_y): irradiance a + b n_z + c·n_xy relative to its mean, NaN
    without shading.
    """
    light = np.full(4, np.nan) if candidates[0].light is None else candidates[0].light.direction
    return {
        "candidate/shape": np.array([c.shape for c in candidates]),
        "candidate/shading": np.array([c.shade for c in candidates]),
        "candidate/sizes": np.array([c.size for c in candidates]),
        "candidate/origin": np.array([c.origin for c in candidates]),
        "candidate/tuned": np.array([c.tuned for c in candidates]),
        "light": light * np.array([1, 1, -1, -1]) if mirror else light,
    }


def texton_table(instances: Instances, g: Float) -> Arrays:
    """What the surface of slopes `g` (N, 2) says of every texton used: see `run`."""
    found, trusted = instances.calibration, instances.trust > 0
    delivered, _ = tensors.deviator(instances.table["tensor"].astype(float), instances.table["tensor_cov"].astype(float))
    steep = np.arcsin(np.sqrt(np.clip(np.hypot(*delivered.T), 0, 1)))
    off = np.degrees(steep - np.arctan(np.hypot(*g.T)))
    count = len(found.e)
    bias, reason = np.full(count, np.nan), []
    for k in range(count):
        mine = off[(instances.texton == k) & trusted]
        bias[k] = np.median(mine) if len(mine) else np.nan
        times = np.sqrt(found.noise[k])
        words = f"disagrees with its neighbours: {times:.0f} times as far off as it states, and so has next to no say"
        reason.append(words if found.noise[k] > calibration.DISAGREES else "")
    return {
        "texton/part": np.unique(instances.table["texton"]).astype(np.int32),
        "texton/shear": (found.e / 2).astype(np.float32),
        "texton/slant_bias": bias.astype(np.float32),
        "texton/noise": found.noise.astype(np.float32),
        "texton/reason": np.array(reason),
    }


def posterior_states(instances: Instances, g: Float, spread: Float) -> Float:
    """Posteriors (N, 3) of {+, −, not from the surface} (section 4): + is the sign nearer to the delivered normal."""
    d, covariance = tensors.gradient(instances.calibration.w, instances.covariance)
    log_outlier = -np.log(np.pi) + 0.5 * (np.linalg.slogdet(instances.covariance)[1] - np.linalg.slogdet(covariance)[1])
    delivered = -instances.table["normal"][:, :2].astype(float)
    d *= np.where((d * delivered).sum(1) < 0, -1.0, 1.0)[:, None]
    data = sign_search.Data(instances.xy, d, covariance, instances.trust, log_outlier, None)
    return sign_search.states(data, g, spread, 1.0)


def resolve(instances: Instances, g: Float) -> Float:
    """Calibrated normals (N, 3) with the sign that is nearer to the surface's gradient `g` (N, 2)."""
    d, _ = tensors.gradient(instances.calibration.w, instances.covariance)
    return tensors.normals(d * np.where((d * g).sum(1) < 0, -1.0, 1.0)[:, None])


STAGE = Stage(name="surface", version=24, params=Params, run=run, inputs=("image", "frontal", "enrich"))
