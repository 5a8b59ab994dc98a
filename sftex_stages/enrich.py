"""Stage `enrich`: more instances of good textons, searched for where their neighbours say that they are (section 1.5).

Detectors fail where a surface is steep, dark or blurred. A texton that was found elsewhere is known well enough to be
recognised there, if only one knows where to look: textons of one print predict one another (`geometry/constellation.py`).
What is found is measured and judged as the frontal stage measures and judges its members.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from .engine.stage import Arrays, Stage, StageParams
from .frontal import no_rows, rows, template_of
from .geometry import constellation
from .geometry.constellation import SAME, Candidates, Known
from .geometry.pyramid import level_image
from .geometry.registration import Template, register
from .geometry.texton import element_radius, independent_samples, information_centre, posterior, weighted_contrast
from .geometry.views import Gauge, Views, measure

Array = NDArray[np.floating]


class Params(StageParams):
    """Parameters of `enrich`."""

    enabled: bool = Field(True, description="search for instances that detection or clustering missed")
    rounds: int = Field(2, ge=1, le=20, description="rounds of search, each from what was known and found before")
    reach: float = Field(6.0, gt=0, le=50, description="textons predict one another over this many radii")
    share: float = Field(0.3, gt=0, le=1, description="share of the instances at which a constellation must recur")
    max_disagreement: float = Field(
        2.0, gt=0, description="a texton that differs so many times more from its neighbours than they scatter is not searched"
    )
    max_doubt: float = Field(0.25, gt=0, le=1, description="places are searched that are predicted this well, in radii")
    crowd: int = Field(3, ge=1, le=1000, description="no place is searched with so many instances within a radius")
    steps: int = Field(10, ge=1, le=100, description="registration steps from the predicted view")
    max_shift: float = Field(0.5, gt=0, le=2, description="what lies farther from the prediction, in radii, is not taken")
    max_strain: float = Field(0.35, gt=0, le=2, description="nor what is strained more against it")
    max_light: float = Field(1.0, gt=0, le=5, description="nor what differs more in light (natural logarithm)")
    min_inlier: float = Field(0.8, ge=0, le=1, description="nor what has a smaller posterior of being a view of the texton")
    max_error: float = Field(
        0.75, gt=0, le=1, description="nor what is expected to be less exact than this share of the detected instances"
    )


_FIRST_STEPS = 3  # of registration, after which most of what is no instance shows
_HOPELESS = 0.5  # share of the texton's contrast that a residual is then still over


class Texton(NamedTuple):
    """A usable texton, ready to be looked for."""

    part: int
    template: Template
    gauge: Gauge
    factor: float  # px of its pyramid level per px of the image
    noise: float
    prior: float
    radius: float  # px of the frontal frame
    circular: bool


def run(inputs: Mapping[str, Any], params: Params) -> Arrays:
    """Instances of all usable textons that were found by search. Inputs `image`, `frontal`.

    Returns the fields that `frontal` has of instances, with index −1, and `texton` (N,), the number of their part.
    """
    textons = [texton_of(k, table) for k, table in enumerate(inputs["frontal"]) if bool(table["usable"])]
    found = search(inputs["image"], inputs["frontal"], textons, params) if params.enabled and textons else []
    tables = [no_rows() | {"texton": np.zeros(0, np.int32)}]
    tables += [table | {"texton": np.full(len(table["xy"]), textons[k].part, np.int32)} for k, table in found]
    return {name: np.concatenate([table[name] for table in tables]) for name in tables[0]}


def texton_of(part: int, table: Arrays) -> Texton:
    """Texton number `part` from what `frontal` delivers of it."""
    factor = 2.0 ** -int(table["level"])
    return Texton(
        part=part,
        template=template_of(table),
        gauge=Gauge(
            table["gram"], table["trend"], int(table["order"]), float(table["relief"]), float(table["inflation"]),
            float(table["scale_variance"]), table["gauge_cov"],
        ),
        factor=factor,
        noise=float(table["noise"]),
        prior=float(table["prior"]),
        radius=element_radius(table["domain"]) * float(table["spacing"]),
        circular=bool(table["circular"]),
    )  # fmt: skip


def search(image: Arrays, frontal: list[Arrays], textons: list[Texton], params: Params) -> list[tuple[int, Arrays]]:
    """What is found: tables of instances, each with the number of its texton in `textons`."""
    tables = [(k, frontal[texton.part]) for k, texton in enumerate(textons)]
    known = believed(tables, params.min_inlier)
    if len(known.xy) == 0:
        return []
    seen = [table["inlier"] > params.min_inlier for _, table in tables]
    tensor, sigma = (
        np.concatenate([table[name][good] for (_, table), good in zip(tables, seen, strict=True)]).astype(float)
        for name in ("tensor", "normal_sigma")
    )
    max_sigma = float(np.quantile(sigma, params.max_error))
    # a texton with a wrong metric would spread its error to places where no other contradicts it
    odd = constellation.disagreement(known.xy, tensor, known.texton, len(textons)) > params.max_disagreement
    radius, turns = np.array([t.radius for t in textons]), np.array([t.circular for t in textons])
    rules = constellation.learn(known, radius, turns, params.reach, params.share)
    rules = rules.take(~odd[rules.target])
    tried = Candidates.none()
    found: list[tuple[int, Arrays]] = []
    for _ in range(params.rounds):
        asked = constellation.predict(known, rules, radius, params.max_doubt, params.crowd, image["mask"], tried)
        new = []
        for k in np.unique(asked.texton):
            at, there = asked.take(asked.texton == k), known.xy[known.texton == k]
            table = look(image["rgb"], textons[k], at, there, max_sigma, params)
            if len(table["xy"]):
                new.append((int(k), table))
        if not new:
            break
        found += new
        tried = tried.join(asked)
        known = believed(tables + found, params.min_inlier)
    return found


def believed(tables: list[tuple[int, Arrays]], least: float) -> Known:
    """Instances with a posterior over `least`, of tables each with the number of its texton."""
    good = [table["inlier"] > least for _, table in tables]
    xy, transform, light = (
        np.concatenate([table[name][rows].astype(float) for (_, table), rows in zip(tables, good, strict=True)])
        for name in ("xy", "transform", "irradiance")
    )
    texton = np.concatenate([np.full(rows.sum(), k) for (k, _), rows in zip(tables, good, strict=True)])
    return Known(xy, transform, texton, np.log(np.maximum(light, 1e-9)))


def look(rgb: Array, texton: Texton, at: Candidates, known: Array, max_sigma: float, params: Params) -> Arrays:
    """The table of instances of a texton found at candidates, none of which is at `known` (m, 2)."""
    template, factor = texton.template, texton.factor
    image = level_image(rgb, round(-np.log2(factor)))
    root = np.linalg.cholesky(texton.gauge.gram)
    start = (at.xy + 0.5) * factor - 0.5 - at.transform @ information_centre(template)
    got = register(image, template, start, at.transform @ np.linalg.inv(root), min(_FIRST_STEPS, params.steps))
    contrast2 = weighted_contrast(template)
    hope = got.residual < _HOPELESS * contrast2
    if not hope.any():
        return no_rows()
    at = at.take(hope)
    got = register(image, template, got.xy[hope], got.frames[hope], max(params.steps - _FIRST_STEPS, 0))
    extent = np.array([rgb.shape[1], rgb.shape[0]], float)
    views = measure(image, template, texton.gauge, got, (2 * ((got.xy + 0.5) / factor - 0.5) - extent) / extent.max())
    inlier = posterior(got.residual, texton.noise**2, contrast2, texton.prior, independent_samples(template)) * views.credit
    xy = (views.xy + 0.5) / factor - 0.5
    moved = np.linalg.solve(at.transform, (xy - at.xy)[..., None])[..., 0]
    strain = np.linalg.solve(at.transform, got.frames @ root) - np.eye(2)
    good = (inlier > params.min_inlier) & (views.normal_sigma <= max_sigma)
    good &= np.linalg.norm(moved, axis=1) < params.max_shift * texton.radius
    good &= np.linalg.norm(strain, 2, axis=(1, 2)) < params.max_strain
    good &= np.abs(np.log(got.gain) - at.log_light) < params.max_light
    close = SAME * texton.radius
    good &= ~constellation.near_any(xy, views.transform, known, close)
    best = np.argsort(got.residual, kind="stable")
    taken = np.sort(best[constellation.first_of_each(xy[best], views.transform[best], close, good[best])])
    return rows(Views._make(column[taken] for column in views), np.full(len(taken), -1), inlier[taken], factor)


STAGE = Stage(name="enrich", version=2, params=Params, run=run, inputs=("image", "frontal"))
