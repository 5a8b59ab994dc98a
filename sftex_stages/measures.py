"""How far a recovered surface is from a known one: figures from arrays alone.

Angles are in degrees, normals are unit vectors with z toward the camera. The *flip* of a normal is (-n_x, -n_y, n_z),
its mirror image about the line of sight: the two are indistinguishable in one orthographic view of a texture.
"""

from collections.abc import Mapping
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.optimize import minimize
from scipy.spatial import cKDTree

SHARES = (5.0, 11.25, 22.5, 30.0)  # degrees: the thresholds that the literature on normals reports
SLANTS = (0, 15, 30, 45, 60, 90)  # degrees, bins of the true slant
MISS = 90.0  # degrees: the error of a pixel that has a true normal and no estimate
FLIP = np.array([-1.0, -1.0, 1.0])
MIN_TEXTON = 5  # instances: fewer tell nothing about a texton's standard deviation
FLAT_LOG = 0.02  # standard deviation of the log irradiance under which a map counts as constant


def angle(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Degrees between unit vectors a (..., 3) and b (..., 3) -> (...). Accurate near 0, unlike the arc cosine."""
    return np.degrees(2.0 * np.arcsin(np.clip(0.5 * np.linalg.norm(a - b, axis=-1), 0.0, 1.0)))


def unit(vectors: np.ndarray) -> np.ndarray:
    """Vectors (..., 3) at length 1, in double precision. A vector of length 0 becomes NaN."""
    vectors = np.asarray(vectors, float)
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.divide(vectors, length, out=np.full(vectors.shape, np.nan), where=length > 0)


def relative_to_ray(normals: np.ndarray, xy: np.ndarray, focal: float, centre: np.ndarray) -> np.ndarray:
    """Normals (..., 3) of the camera's frame turned into the frame of their own viewing ray.

    The ray at pixel x points to the camera along v ∝ (-(x - c_x)/f, -(y - c_y)/f, 1); each normal is turned by the
    smallest rotation that takes v to (0, 0, 1). `xy` (..., 2) and `centre` in px, `focal` in px.
    """
    offset = (np.asarray(xy, float) - centre) / focal
    ray = unit(np.concatenate([-offset, np.ones((*offset.shape[:-1], 1))], axis=-1))
    cosine = ray[..., 2:]
    axis = np.stack([ray[..., 1], -ray[..., 0], np.zeros(ray.shape[:-1])], axis=-1)  # v × z, length = sine
    along = np.sum(axis * normals, axis=-1, keepdims=True)
    return normals * cosine + np.cross(axis, normals) + axis * along / (1.0 + cosine)  # Rodrigues' formula


def spread(errors: np.ndarray) -> dict[str, Any]:
    """Median, mean, 90th percentile and the shares under each of `SHARES` (0…1); all None when there is nothing."""
    names = [f"under_{s:g}" for s in SHARES]
    if errors.size == 0:
        return dict.fromkeys(["median", "mean", "p90", *names])
    median, p90 = np.percentile(errors, [50, 90])
    shares = {n: float(np.mean(errors < s)) for n, s in zip(names, SHARES, strict=True)}
    return {"median": float(median), "mean": float(errors.mean()), "p90": float(p90), **shares}


def sign_share(estimate: np.ndarray, truth: np.ndarray) -> float | None:
    """Share of normals (N, 3) whose sign is right: the error as given is not larger than the error of the flip.

    The two errors compare as n_xy · t_xy compares with 0, so this is the share of n_xy · t_xy >= 0. A normal along the
    line of sight is its own flip and counts as right. 1 - share is, but for such normals, the share after one global
    flip.
    """
    if len(estimate) == 0:
        return None
    return float(np.mean(np.einsum("ij,ij->i", estimate[:, :2], truth[:, :2]) >= 0))


def calibration(errors: np.ndarray, sigma: np.ndarray, deciles: bool = False) -> dict[str, Any]:
    """Actual errors (N,) against predicted ones (N,), degrees.

    `median_ratio` is the median of error / sigma, `beyond_3` the share of errors over 3 sigma; with `deciles` also the
    median ratio in each tenth of the points in order of sigma, and `worst_factor`, the largest of ratio and 1 / ratio
    among them.
    """
    good = np.isfinite(sigma) & (sigma > 0)
    errors, sigma = errors[good], sigma[good]
    out: dict[str, Any] = {"count": int(good.sum()), "median_ratio": None, "beyond_3": None}
    if deciles:
        out |= {"decile_sigma": [], "decile_ratio": [], "worst_factor": None}
    if len(errors) == 0:
        return out
    ratio = errors / sigma
    out |= {"median_ratio": float(np.median(ratio)), "beyond_3": float(np.mean(ratio > 3))}
    if deciles and len(errors) >= 10:
        parts = np.array_split(np.argsort(sigma, kind="stable"), 10)
        out["decile_sigma"] = [float(np.median(sigma[p])) for p in parts]
        ratios = [float(np.median(ratio[p])) for p in parts]
        out["decile_ratio"] = ratios
        out["worst_factor"] = max(max(r, 1 / r) if r > 0 else float("inf") for r in ratios)
    return out


def best_constant_normal(truth: np.ndarray) -> np.ndarray:
    """The one unit normal (3,) with the least median angle to the normals (N, 3): an oracle, as it sees the truth.

    Found by the simplex method from the mean normal and from the frontal one, on at most 4000 evenly taken normals.
    """
    sample = truth[:: max(1, len(truth) // 4000)]

    def normal(pq: np.ndarray) -> np.ndarray:
        return unit(np.array([-pq[0], -pq[1], 1.0]))

    mean = unit(sample.mean(axis=0))
    starts = [np.zeros(2), -mean[:2] / max(mean[2], 0.1)]

    def cost(pq: np.ndarray) -> float:
        return float(np.median(angle(sample, normal(pq))))

    runs = []
    for start in starts:
        simplex = start + np.array([[0.0, 0.0], [0.3, 0.0], [0.0, 0.3]])
        options = {"initial_simplex": simplex, "xatol": 1e-4, "fatol": 1e-4}
        runs.append(minimize(cost, start, method="Nelder-Mead", options=options))
    return normal(min(runs, key=lambda r: r.fun).x)


def compare_normals(estimate: np.ndarray, truth: np.ndarray, misses: int) -> dict[str, Any]:
    """Dense normals (N, 3) against true ones (N, 3) of the same frame; `misses` true pixels have no estimate.

    `given` and `flipped` are over the N compared pixels, `…_all` also over the missed ones, at an error of 90°. `best`
    names the sign with the lower median. `signs_right_steep` leaves out true slants under 10°, where a sign means
    little.
    """
    given, flipped = angle(estimate, truth), angle(estimate * FLIP, truth)
    missed = np.full(misses, MISS)
    steep = truth[:, 2] < np.cos(np.radians(10.0))
    return {
        "compared": len(truth),
        "given": spread(given),
        "flipped": spread(flipped),
        "given_all": spread(np.concatenate([given, missed])),
        "flipped_all": spread(np.concatenate([flipped, missed])),
        "best": "flipped" if len(truth) and np.median(flipped) < np.median(given) else "given",
        "signs_right": sign_share(estimate, truth),
        "signs_right_flipped": sign_share(estimate * FLIP, truth),
        "signs_right_steep": sign_share(estimate[steep], truth[steep]),
    }


def compare_heights(
    estimate: np.ndarray, truth: np.ndarray, full_range: float, piece: np.ndarray, both_signs: bool
) -> dict[str, Any]:
    """RMS of the difference of heights (N,) over the truth's range, the mean difference of each piece (N,) removed.

    With `both_signs` the better of z and -z counts (`sign` says which). `rms_over_range_scaled` also removes one scale.
    """
    if len(truth) == 0 or full_range <= 0:
        return {"rms_over_range": None, "rms_over_range_scaled": None, "sign": None, "range": full_range}
    _, label = np.unique(piece, return_inverse=True)
    count = np.bincount(label)

    def centred(values: np.ndarray) -> np.ndarray:
        return values - (np.bincount(label, values) / count)[label]

    z, t = centred(estimate), centred(truth)
    rms = {s: float(np.sqrt(np.mean((s * z - t) ** 2))) for s in ((1, -1) if both_signs else (1,))}
    sign = min(rms, key=lambda s: rms[s])
    scale = max(0.0, sign * float(z @ t)) / max(float(z @ z), 1e-30)
    scaled = float(np.sqrt(np.mean((scale * sign * z - t) ** 2)))
    return {
        "rms_over_range": rms[sign] / full_range,
        "rms_over_range_scaled": scaled / full_range,
        "sign": sign,
        "range": full_range,
    }


def compare_irradiance(estimate: np.ndarray, truth: np.ndarray) -> dict[str, Any]:
    """Relative irradiance (N,) against the true one (N,), both positive, one global scale (the median ratio) removed.

    `error` is the median of |log ratio|, `correlation` Pearson's between the log maps, None where the truth does not
    vary.
    """
    if len(truth) == 0:
        return {"error": None, "p90": None, "correlation": None}
    log_estimate, log_truth = np.log(estimate), np.log(truth)
    ratio = log_estimate - log_truth
    error, p90 = np.percentile(np.abs(ratio - np.median(ratio)), [50, 90])
    correlation = None
    if log_truth.std() > FLAT_LOG and log_estimate.std() > 0:
        correlation = float(np.corrcoef(log_estimate, log_truth)[0, 1])
    return {"error": float(error), "p90": float(p90), "correlation": correlation}


def blurred_brightness(rgb: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """The light that one would take by hand: the linear image (H, W, 3) blurred over `inside` (H, W) -> (H, W).

    The Gaussian's sigma is 1/32 of the longer side; pixels outside do not leak in.
    """
    sigma = max(rgb.shape[:2]) / 32
    weight = gaussian_filter(inside.astype(float), sigma)
    return gaussian_filter(rgb.mean(axis=2) * inside, sigma) / np.maximum(weight, 1e-9)


def chart_distortion(
    chart: np.ndarray, normals: np.ndarray, height: np.ndarray, inside: np.ndarray, focal: float, centre: np.ndarray
) -> dict[str, Any]:
    """Distortion of a chart (H, W, 2) px of a known surface; `median` and `p95` of each figure over its area.

    `angle`: degrees by which the chart changes an angle at most at a point (Tissot); `area`: |change of area| / area.
    normals (H, W, 3) in the camera's frame; `focal` inf: orthographic. Under perspective, where a surface has no absolute size,
    the median change of area is removed.
    """
    slopes = np.stack(np.gradient(np.asarray(chart, float), axis=(1, 0)), -1)  # (H, W, 2, 2): d (u, v) / d (x, y)
    y, x = np.indices(inside.shape, dtype=float)
    good = inside & np.isfinite(slopes).all((2, 3)) & (normals[..., 2] > 0.02)
    j, n, z = slopes[good], normals[good], height[good]
    offset = (np.stack([x[good], y[good]], 1) - centre) / focal
    depth = 1 - z / focal
    dz = -depth[:, None] * n[:, :2] / (n[:, 2] - (n[:, :2] * offset).sum(1))[:, None]
    cross = depth[:, None, None] * offset[:, :, None] * dz[:, None, :]
    metric = (depth**2)[:, None, None] * np.eye(2) - cross - np.swapaxes(cross, 1, 2)
    metric += (1 + (offset**2).sum(1))[:, None, None] * dz[:, :, None] * dz[:, None, :]  # lengths: dxᵀ metric dx
    size = np.sqrt(np.linalg.det(metric)) if len(metric) else np.zeros(0)
    total = np.trace(j @ np.linalg.inv(metric) @ np.swapaxes(j, 1, 2), axis1=1, axis2=2)  # σ1² + σ2²
    area = np.linalg.det(j) / np.maximum(size, 1e-12)  # σ1 σ2
    ratio = np.sqrt(np.maximum(total - 2 * area, 0) / np.maximum(total + 2 * area, 1e-12))
    angle_ = np.degrees(2 * np.arcsin(np.clip(ratio, 0, 1)))
    if np.isfinite(focal) and len(area):
        area = area / np.median(area)
    values = {"angle": angle_, "area": np.abs(area - 1)}
    if not len(size):
        return {name: {"median": None, "p95": None} for name in values}
    out = {}
    for name, value in values.items():
        order = np.argsort(value)
        share = np.cumsum(size[order]) / size.sum()
        median, p95 = (float(value[order][min(int(np.searchsorted(share, q)), len(order) - 1)]) for q in (0.5, 0.95))
        out[name] = {"median": median, "p95": p95}
    return out


def compare_instances(normal: np.ndarray, sigma: np.ndarray, truth: np.ndarray) -> dict[str, Any]:
    """Instance normals (N, 3) against the true ones (N, 3) at their places; `sigma` (N,) predicts the error, degrees.

    `error` is without the two-fold ambiguity (the nearer of normal and flip counts), `error_given` with the sign as
    given.
    """
    given, flipped = angle(normal, truth), angle(normal * FLIP, truth)
    nearest = np.minimum(given, flipped)
    right, turned = sign_share(normal, truth), sign_share(normal * FLIP, truth)
    return {
        "compared": len(truth),
        "error": spread(nearest),
        "error_given": spread(given),
        "signs_right": right,
        "signs_right_best": None if right is None or turned is None else max(right, turned),
        "calibration": calibration(nearest, sigma),
    }


def split_errors(normal: np.ndarray, truth: np.ndarray, texton: np.ndarray) -> dict[str, Any]:
    """Where the error of instances comes from; normals (N, 3), their textons (N,).

    `by_slant`: two-fold error in bins of the true slant. `slant_bias`, degrees: slant less true slant, its median over a
    texton, is the texton's bias; `textons` is the median of their sizes, `within` that of the spread about them.
    """
    nearest = np.minimum(angle(normal, truth), angle(normal * FLIP, truth))
    slant, true_slant = (np.degrees(np.arccos(np.clip(n[:, 2], -1, 1))) for n in (normal, truth))
    bins = []
    for low, high in pairwise(SLANTS):
        here = nearest[(true_slant >= low) & (true_slant < high)]
        median, p90 = (float(v) for v in np.percentile(here, (50, 90))) if len(here) else (None, None)
        bins.append({"from": low, "to": high, "count": len(here), "median": median, "p90": p90})
    groups = [(slant - true_slant)[texton == k] for k in np.unique(texton)]
    groups = [g for g in groups if len(g) >= 4]
    bias = [abs(float(np.median(g))) for g in groups]
    within = [float(np.median(np.abs(g - np.median(g)))) / 0.6745 for g in groups]
    common = {name: float(np.median(v)) if groups else None for name, v in (("textons", bias), ("within", within))}
    return {"by_slant": bins, "slant_bias": common}


def recall(found: np.ndarray, true_xy: np.ndarray, radius: np.ndarray) -> dict[str, Any]:
    """Share of true instances (M, 2) that have a found one (N, 2) within their radius (M,), px."""
    if len(true_xy) == 0:
        return {"recall": None, "true": 0, "found": 0}
    hit = cKDTree(found).query(true_xy)[0] <= radius if len(found) else np.zeros(len(true_xy), bool)
    return {"recall": float(hit.mean()), "true": len(true_xy), "found": int(hit.sum())}


def irradiance_at_instances(irradiance: np.ndarray, texton: np.ndarray, truth: np.ndarray) -> dict[str, Any]:
    """Per texton of at least 5 instances, the standard deviation of log(L_i / truth): (N,) each, positive.

    `median` and `worst` over the textons, `pooled` over all their instances (each texton's own mean removed).
    """
    per_texton: dict[str, float] = {}
    residuals = []
    log_ratio = np.log(irradiance) - np.log(truth)
    for k in np.unique(texton):
        values = log_ratio[texton == k]
        if len(values) >= MIN_TEXTON:
            per_texton[str(int(k))] = float(values.std(ddof=1))
            residuals.append(values - values.mean())
    if not per_texton:
        return {"textons": 0, "median": None, "worst": None, "pooled": None, "per_texton": {}}
    stds = np.array(list(per_texton.values()))
    pooled = float(np.sqrt(np.mean(np.concatenate(residuals) ** 2)))
    return {
        "textons": len(stds),
        "median": float(np.median(stds)),
        "worst": float(stds.max()),
        "pooled": pooled,
        "per_texton": per_texton,
    }


def value_at(figures: Mapping[str, Any], path: str) -> Any:
    """The figure at a dotted path such as "normals.given.median"; None where a level is missing or None."""
    value: Any = figures
    for name in path.split("."):
        if not isinstance(value, Mapping) or name not in value:
            return None
        value = value[name]
    return value
