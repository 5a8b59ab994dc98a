"""Surface stage: from instances with two-fold ambiguous normals to one smooth surface (section 4 of the paper)."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from sftex_stages.engine.stage import Arrays, Stage, StageParams
from sftex_stages.errors import StageError
from sftex_stages.geometry import gaussian, refine, sign_search, spline, support, tensors

Float = NDArray[np.float64]


class Params(StageParams):
    """Parameters of the surface stage."""

    min_inlier: float = Field(0.8, ge=0, le=1, description="Posterior above which an instance is used (the paper's 0.8).")
    model_error: float = Field(0.02, gt=0, le=0.5, description="Error of a tensor beyond its own noise (curved elements).")
    detail: float = Field(0.7, gt=0.2, le=4, description="Spacing of the surface's grid, in mean spacings of instances.")
    finalists: int = Field(4, ge=1, le=50, description="Sign patterns that are compared by their full evidence.")


def collect(frontal: list[Arrays]) -> Arrays:
    """Members of all usable textons, one row each; `texton` is the part's number."""
    names = ("xy", "transform", "scale", "tensor", "tensor_cov", "normal", "inlier", "irradiance", "irradiance_sigma", "log_scale_sigma")
    parts = [(k, f) for k, f in enumerate(frontal) if bool(f["usable"]) and len(f["xy"])]
    if not parts:
        raise StageError(
            f"none of the {len(frontal)} texture elements is usable, so there is nothing to reconstruct from. "
            "Use a larger or sharper photograph of a repeating pattern, or a mask that leaves only the patterned surface; "
            "the textons' `reason` in the frontal results says what is wrong with each."
        )
    rows = {name: np.concatenate([np.asarray(f[name]) for _, f in parts]) for name in names}
    rows["texton"] = np.concatenate([np.full(len(f["xy"]), k, np.int32) for k, f in parts])
    return rows


def run(inputs: Mapping[str, Any], params: Params) -> Arrays:
    """Height, normals, their support and uncertainty, and instances with their sign resolved.

    See the README's archive section for shapes and units of the arrays returned.

    Raises
    ------
    StageError
        without a usable texton, or with fewer than three instances to believe in.
    """
    image, rows = inputs["image"], collect(inputs["frontal"])
    mask = np.asarray(image["mask"], bool)
    xy = rows["xy"].astype(float)
    trust = np.where(rows["inlier"] > params.min_inlier, rows["inlier"], 0.0).astype(float)
    if (trust > 0).sum() < 3:
        raise StageError(
            f"only {int((trust > 0).sum())} of {len(trust)} instances have a posterior above surface.min_inlier = "
            f"{params.min_inlier:g}; at least 3 are needed. Lower surface.min_inlier, or use a photograph with more repetitions."
        )
    # What is not accepted stays in the table and gets a sign, but no say.
    trust = np.maximum(trust, 1e-6)
    w, noise = tensors.deviator(rows["tensor"].astype(float), rows["tensor_cov"].astype(float))
    used = trust > 0.1
    low, high = xy[used].min(0), xy[used].max(0)
    spacing = float(np.sqrt(np.prod(np.maximum(high - low, 1)) / used.sum()))
    solution, field, candidates, state = solve(xy, w, noise, trust, spacing, params)
    return outputs(mask, rows, solution, field, candidates, state, spacing)


def solve(
    xy: Float, w: Float, noise: Float, trust: Float, spacing: float, params: Params
) -> tuple[refine.Solution, gaussian.Field, list[sign_search.Candidate], Float]:
    """Signs by the collapsed search, then the refined surface; posteriors (N, 3) of {+, −, not from the surface}."""
    used = trust > 0.1
    low, high = xy[used].min(0) - 2 * spacing, xy[used].max(0) + 2 * spacing
    eye = np.eye(2)
    rough = noise + (2 * params.model_error) ** 2 * eye
    d, covariance = tensors.gradient(w, rough)
    log_outlier = -np.log(np.pi) + 0.5 * (np.linalg.slogdet(rough)[1] - np.linalg.slogdet(covariance)[1])
    data = sign_search.Data(xy, d, covariance, log_outlier)
    coarse = gaussian.field(spline.cover(low, high, spacing), xy)
    candidates = sign_search.search(data, coarse, spacing, trust, params.finalists)
    best = candidates[0]
    fine = gaussian.field(spline.cover(low, high, params.detail * spacing), xy)
    solution = refine.refine(fine, w, noise + params.model_error**2 * eye, trust, best.gradient, best.smooth)
    if bowl(xy, solution.gradient, trust):
        solution = refine.flipped(solution)
    return solution, fine, candidates, sign_search.states(data, solution.gradient, solution.covariance, solution.noise)


def bowl(xy: Float, g: Float, trust: Float) -> bool:
    """Whether the surface rises toward its border; without another cue the bulge is preferred to the bowl."""
    return bool((trust[:, None] * (xy - np.average(xy, axis=0, weights=trust)) * g).sum() > 0)


def outputs(
    mask: NDArray[np.bool_],
    rows: Arrays,
    solution: refine.Solution,
    field: gaussian.Field,
    candidates: list[sign_search.Candidate],
    state: Float,
    spacing: float,
) -> Arrays:
    """Dense maps and instances."""
    xy = rows["xy"].astype(float)
    accepted = (solution.weight > 0.2) & (state[:, 2] < 0.8)
    maps = support.dense(field, solution.a, solution.factor, mask.shape, xy[accepted], spacing)
    valid = maps["supported"] & mask
    nan = np.float32(np.nan)
    normal = resolve(rows["normal"].astype(float), solution.gradient)
    share = state / state.sum(1, keepdims=True)
    return {
        "height": np.where(valid, maps["height"] - maps["height"][valid].mean() if valid.any() else 0, nan).astype(np.float32),
        "normals": np.where(valid[..., None], maps["normals"], nan).astype(np.float32),
        "valid": valid,
        "normal_sigma": np.where(valid, maps["sigma"], nan).astype(np.float32),
        "instance/xy": rows["xy"].astype(np.float32),
        "instance/transform": rows["transform"].astype(np.float32),
        "instance/normal": normal.astype(np.float32),
        "instance/normal_sigma": np.degrees(tensors.angular_error(solution.gradient, solution.covariance)).astype(np.float32),
        "instance/inlier": rows["inlier"].astype(np.float32),
        "instance/irradiance": rows["irradiance"].astype(np.float32),
        "instance/irradiance_sigma": rows["irradiance_sigma"].astype(np.float32),
        "instance/texton": rows["texton"],
        "instance/state": share.astype(np.float32),
        "camera": np.array("orthographic"),
        "energy": np.array(-solution.evidence),
        "candidate/evidence": np.array([c.evidence for c in candidates]),
        "candidate/origin": np.array([c.origin for c in candidates]),
    }


def resolve(normal: Float, g: Float) -> Float:
    """Measured normals (N, 3) with the sign that is nearer to the surface's gradient `g` (N, 2)."""
    turn = np.where((normal[:, :2] * g).sum(1) > 0, -1.0, 1.0)
    return normal * np.stack((turn, turn, np.ones_like(turn)), 1)


STAGE = Stage(name="surface", version=1, params=Params, run=run, inputs=("image", "frontal"))
