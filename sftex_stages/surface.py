"""Surface stage: from instances with two-fold ambiguous normals to one smooth surface (section 4 of the paper)."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from sftex_stages.engine.stage import Arrays, Stage, StageParams
from sftex_stages.errors import StageError
from sftex_stages.geometry import calibration, gaussian, pooling, refine, shading, sign_search, spline, support, tensors
from sftex_stages.geometry import field as irradiance_field

Float = NDArray[np.floating]


class Params(StageParams):
    """Parameters of the surface stage."""

    method: Literal["collapsed", "em"] = Field(
        "collapsed", description="Signs by the search with the surface integrated out, or by the paper's EM"
    )
    min_inlier: float = Field(
        0.8, ge=0, le=1, description="Posterior above which an instance is used (the paper's 0.8)"
    )
    model_error: float = Field(0.03, gt=0, le=0.5, description="Error of pooled tensors that no averaging removes")
    nodes: int = Field(1500, ge=50, le=20000, description="Most nodes that the sign search pools the instances in")
    detail: float = Field(0.8, gt=0.2, le=4, description="Spacing of the surface's grid, in mean spacings of nodes")
    shading: bool = Field(True, description="Use irradiance against normals as a cue for signs")
    finalists: int = Field(4, ge=1, le=50, description="Sign patterns that are compared by their full evidence")


@dataclass(frozen=True)
class Instances:
    """Members of all usable textons: `table` as delivered, and what is worked with, (N, …) float64."""

    table: Arrays
    xy: Float
    trust: Float  # 0 below the threshold
    texton: NDArray[np.integer]  # 0 … K − 1, used textons only
    calibration: calibration.Calibration
    covariance: Float  # of w, (N, 2, 2)


def collect(frontal: list[Arrays], min_inlier: float) -> Arrays:
    """Members of all usable textons, one row each; `texton` is the part's number.

    Raises
    ------
    StageError
        without a usable texton, or with fewer than three instances to believe in.
    """
    names = ["xy", "transform", "tensor", "tensor_cov", "normal", "inlier", "irradiance", "irradiance_sigma"]
    parts = [(k, f) for k, f in enumerate(frontal) if bool(f["usable"]) and len(f["xy"])]
    if not parts:
        raise StageError(
            f"none of the {len(frontal)} texture elements is usable, so there is nothing to reconstruct from. "
            "Use a larger or sharper photograph of a repeating pattern, or a mask that leaves only the patterned "
            "surface; the textons' `reason` in the frontal results says what is wrong with each."
        )
    rows = {name: np.concatenate([np.asarray(f[name]) for _, f in parts]) for name in names}
    rows["texton"] = np.concatenate([np.full(len(f["xy"]), k, np.int32) for k, f in parts])
    good = int((rows["inlier"] > min_inlier).sum())
    if good < 3:
        raise StageError(
            f"only {good} of {len(rows['xy'])} instances have a posterior above surface.min_inlier = {min_inlier:g}; "
            "at least 3 are needed. Lower surface.min_inlier, or use a photograph with more repetitions."
        )
    return rows


def prepare(rows: Arrays, params: Params) -> Instances:
    """Calibrate the textons against one another (`calibration.py`)."""
    xy = rows["xy"].astype(float)
    trust = np.where(rows["inlier"] > params.min_inlier, rows["inlier"], 0.0).astype(float)
    _, texton = np.unique(rows["texton"], return_inverse=True)
    _, covariance = tensors.deviator(rows["tensor"].astype(float), rows["tensor_cov"].astype(float))
    result = calibration.calibrate(
        xy, rows["transform"].astype(float), covariance, texton, np.maximum(trust, 1e-6), params.model_error
    )
    spread = covariance * result.noise[texton][:, None, None] + (params.model_error**2 / 2) * np.eye(2)
    return Instances(rows, xy, trust, texton.astype(np.int64), result, spread)


def run(inputs: Mapping[str, Any], params: Params) -> Arrays:
    """Height, normals, their support and uncertainty, and instances with their sign resolved.

    Returns
    -------
    height (H, W) px toward the camera, mean 0; normals (H, W, 3) ∝ (−p, −q, 1); valid (H, W) bool; normal_sigma (H, W)
    degrees, the root mean square angle expected; all NaN where not valid.
    instance/… (N, …), members of usable textons: xy, transform, inlier, irradiance, irradiance_sigma as delivered; normal
    calibrated, its sign resolved; normal_sigma of the surface there; texton; state, posteriors of {as delivered, the other
    sign, not from the surface}; sign_margin, nats by which the energy rises if the patch around flips (NaN: not used).
    energy, −log evidence of the surface; candidate/… and light: see `record`.

    Raises
    ------
    StageError
        without a usable texton, or with fewer than three instances to believe in.
    """
    mask = np.asarray(inputs["image"]["mask"], bool)
    instances = prepare(collect(inputs["frontal"], params.min_inlier), params)
    used = instances.trust > 0
    box = instances.xy[used].min(0), instances.xy[used].max(0)
    area = float(np.prod(np.maximum(box[1] - box[0], 1.0)))
    spacing = float(np.sqrt(area / min(used.sum(), params.nodes)))
    robust = instances.trust * np.minimum(instances.calibration.weight, 1)
    nodes = pooling.pool(
        instances.xy, instances.calibration.w, instances.covariance, robust, spacing, params.model_error
    )
    low, high = box[0] - 2 * spacing, box[1] + 2 * spacing
    coarse = gaussian.make_field(spline.cover(low, high, spacing), nodes.xy)
    data = search_data(instances, nodes, spacing, params)
    find = sign_search.search if params.method == "collapsed" else sign_search.by_em
    candidates = find(data, coarse, spacing, params.finalists)
    best = candidates[0]
    fine = gaussian.make_field(spline.cover(low, high, params.detail * spacing), nodes.xy)
    start = gaussian.gradients(coarse, best.a)
    solution = refine.refine(fine, nodes.w, nodes.covariance, nodes.weight, start, best.smooth)
    mirror = mirrored(nodes.xy, solution, best)
    if mirror:
        solution = refine.flipped(solution)
    results = outputs(mask, instances, solution, fine, spacing)
    margin = np.append(sign_search.margins(data, coarse, best), np.nan)[nodes.member]
    return results | {"instance/sign_margin": margin.astype(np.float32)} | record(candidates, mirror)


def search_data(instances: Instances, nodes: pooling.Nodes, spacing: float, params: Params) -> sign_search.Data:
    """What the sign search is given: gradients up to sign, and irradiance on one scale."""
    d, covariance = tensors.gradient(nodes.w, nodes.covariance)
    log_outlier = -np.log(np.pi) + 0.5 * (np.linalg.slogdet(nodes.covariance)[1] - np.linalg.slogdet(covariance)[1])
    light = instances.table["irradiance"].astype(float)
    lit = (instances.trust > 0) & (light > 0) & np.isfinite(light)
    cue = None
    if params.shading and lit.sum() > 30:
        log_l, trust = np.log(np.where(lit, light, 1.0)), np.where(lit, instances.trust, 0.0)
        sigma = np.hypot(instances.table["irradiance_sigma"].astype(float), 0.01)
        present, texton = np.unique(instances.texton[lit], return_inverse=True)
        found = irradiance_field.fit(instances.xy[lit], log_l[lit], sigma[lit], texton, trust[lit], spacing, 1.0)
        offset = np.zeros(instances.texton.max() + 1)
        offset[present] = found.offset
        value, variance = pooling.average(
            log_l - offset[instances.texton], sigma**2, nodes, np.maximum(trust, 1e-9), 0.01
        )
        e = np.exp(value)
        e, variance = e / e.mean(), variance * (e / e.mean()) ** 2
        cue = shading.make_shading(nodes.xy, e, variance, tensors.normals(d))
    return sign_search.Data(nodes.xy, d, covariance, nodes.weight, log_outlier, cue)


def mirrored(xy: Float, solution: refine.Solution, best: sign_search.Candidate) -> bool:
    """Whether the mirror image is the more likely: light comes from above; without shading, a bulge rather than a bowl."""
    if best.light is not None and best.shade > 10:
        return bool(best.light.direction[3] > 0)
    return bool((solution.weight[:, None] * (xy - np.average(xy, axis=0)) * solution.gradient).sum() > 0)


def outputs(
    mask: NDArray[np.bool_],
    instances: Instances,
    solution: refine.Solution,
    field: gaussian.Field,
    spacing: float,
) -> Arrays:
    """Dense maps and instances."""
    table = instances.table
    index, p = spline.stencil(field.grid, instances.xy, 1, 0)
    stencil = np.stack((p, spline.stencil(field.grid, instances.xy, 0, 1)[1]), 1)
    g = np.einsum("npk,nk->np", stencil, solution.a[index])
    spread = support.EXCESS * support.covariance_at(field.grid, solution.factor, instances.xy)
    spread += tensors.common_error(g, instances.calibration.common)
    state = posterior_states(instances, g, spread)
    seen = (instances.trust > 0) & (state[:, 2] < 0.8)
    common = instances.calibration.common
    maps = support.dense(field, solution.a, solution.factor, mask.shape, instances.xy[seen], spacing, common)
    valid = maps["supported"] & mask
    nan = np.float32(np.nan)
    height = maps["height"] - (maps["height"][valid].mean() if valid.any() else 0.0)
    return {
        "height": np.where(valid, height, nan).astype(np.float32),
        "normals": np.where(valid[..., None], maps["normals"], nan).astype(np.float32),
        "valid": valid,
        "normal_sigma": np.where(valid, maps["sigma"], nan).astype(np.float32),
        "instance/xy": table["xy"].astype(np.float32),
        "instance/transform": table["transform"].astype(np.float32),
        "instance/normal": resolve(instances, g).astype(np.float32),
        "instance/normal_sigma": np.degrees(tensors.angular_error(g, spread)).astype(np.float32),
        "instance/inlier": table["inlier"].astype(np.float32),
        "instance/irradiance": table["irradiance"].astype(np.float32),
        "instance/irradiance_sigma": table["irradiance_sigma"].astype(np.float32),
        "instance/texton": table["texton"],
        "instance/state": state.astype(np.float32),
        "camera": np.array("orthographic"),
        "energy": np.array(-solution.evidence),
    }


def record(candidates: list[sign_search.Candidate], mirror: bool) -> Arrays:
    """What was tried: evidences (C,) in nats of the candidate sign patterns, best first, and the light of the best one.

    candidate/shape and candidate/shading add up to the evidence that ranks the tuned ones (candidate/tuned); candidate/origin
    names the start. light (4,) = (a, b, c_x, c_y): irradiance a + b n_z + c·n_xy relative to its mean, NaN without shading.
    """
    light = np.full(4, np.nan) if candidates[0].light is None else candidates[0].light.direction
    return {
        "candidate/shape": np.array([c.shape for c in candidates]),
        "candidate/shading": np.array([c.shade for c in candidates]),
        "candidate/origin": np.array([c.origin for c in candidates]),
        "candidate/tuned": np.array([c.tuned for c in candidates]),
        "light": light * np.array([1, 1, -1, -1]) if mirror else light,
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


STAGE = Stage(name="surface", version=1, params=Params, run=run, inputs=("image", "frontal"))
