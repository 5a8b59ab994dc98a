"""Perspective: what element sizes add where a pinhole camera (`camera.py`) took the place of locally scaled orthography
(sections 2, 6 of the paper).

An element's scale is s = c_k / r at range r, so that log(cos σ_max(F T)) = h / f + const_k: element size is a depth map.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sftex_stages.geometry import blocks, gaussian, refine, spline
from sftex_stages.geometry.camera import ORTHOGRAPHIC, Camera

Float = NDArray[np.floating]

TRIALS = (0.3, 0.12, 0.7)  # image sizes over focal length that are tried first
BENDS = (0.03, 1.5)  # and the range believed
# Standard deviations of log size's constant, and of what sin² of the slant and its square add, where sizes scatter as stated:
# they go with the sizes' noise, as a slant's effect has the same causes.
OFF = (1.0, 0.01, 0.01)
CHANCE = 10.0  # nats that orthographic scenes reach by themselves: sizes that say no more say nothing
ROUNDS = 4  # of refinement for each camera tried
GAIN = 25.0  # nats over orthography that perspective must bring: 50 orthographic images reach 8
# Times what the curvature of these says of log 1/f, since neighbouring elements share errors of their size; and the most of it
DOUBT, MOST_DOUBT = 2.0, 0.5


def flatten_tensors(camera: Camera, xy: Float, w: Float, covariance: Float) -> tuple[Float, Float, Float]:
    """w (N, 2) as the rays see it, its covariance (N, 2, 2), and the change (N,) of log scale, from w (`tensors.py`)."""

    def seen(w: Float) -> tuple[Float, Float]:
        half = np.hypot(w[:, 0], w[:, 1]) / 2
        s = np.empty((len(w), 2, 2))
        s[:, 0, 0], s[:, 1, 1] = 1 - half - w[:, 0] / 2, 1 - half + w[:, 0] / 2
        s[:, 0, 1] = s[:, 1, 0] = -w[:, 1] / 2
        s = flat @ s @ np.swapaxes(flat, 1, 2)
        a, b = (s[:, 0, 0] - s[:, 1, 1]) / 2, s[:, 0, 1]
        top = (s[:, 0, 0] + s[:, 1, 1]) / 2 + np.hypot(a, b)
        return np.stack((-2 * a / top, -2 * b / top), 1), top

    flat = camera.flatten(xy)
    step = 1e-4 * np.eye(2)
    jacobian = np.stack([(seen(w + step[k])[0] - seen(w - step[k])[0]) / 2e-4 for k in range(2)], 2)
    value, top = seen(w)
    change = 0.5 * np.log(top) + np.log(camera.rays(xy)[1])
    return value, jacobian @ covariance @ np.swapaxes(jacobian, 1, 2), change


@dataclass(frozen=True)
class Sizes:
    """Log scale of the elements at M nodes, up to one constant: `value` (M,), `variance` (M,), `trust` (M,) in 0…1."""

    value: Float
    variance: Float
    trust: Float

    def heights(self, camera: Camera, xy: Float, w: Float, change: Float) -> gaussian.Heights:
        """Heights h (M,) px under a camera, at nodes `xy` (M, 2) of flattened w (M, 2); `change` (M,) of the log scale.

        Blur, and elements that are not as flat as their frame, make steep elements look a little smaller or larger than
        they are: what any even function of the slant explains proves no perspective. On a sphere nothing does.
        """
        bend, steep = camera.bend or 1.0, np.hypot(w[:, 0], w[:, 1])
        precision = self.trust / self.variance * bend**2
        value = (self.value + change - np.average(self.value, weights=self.trust)) / bend
        columns = np.stack((np.ones_like(steep), steep, steep**2), 1)
        return gaussian.Heights(value, precision, columns, np.array(OFF) / bend, np.ones(len(xy)))

    def unrelated(self, xy: Float, w: Float, change: Float) -> tuple[float, float]:
        """Log likelihood in nats of one size for all elements, at the best noise factor, and that factor."""
        stated = self.heights(ORTHOGRAPHIC, xy, w, change)

        def told(factor: float) -> float:
            height = stated
            for _ in range(ROUNDS):
                height = height.reweighted(np.zeros(len(xy)), factor)
            return height.over(factor).unrelated()

        return max((told(k), k) for k in np.geomspace(*refine.HEIGHT_FACTORS, 30).tolist())

    def alike(self, value: Float, w: Float) -> tuple[float, float]:
        """Log likelihood in nats of log sizes `value` (M,) that should all be the same but for what the slant explains, `w`
        (M, 2) of the nodes: profile of Student noise, one factor on the variance for all; and that factor."""
        steep, root = np.hypot(w[:, 0], w[:, 1]), np.sqrt(self.trust / self.variance)
        x = np.stack((np.ones_like(steep), steep, steep**2), 1) * root[:, None]
        y, weight, scale = value * root, np.ones(len(value)), 1.0
        ridge = np.append(1e-12 * float((x**2).sum()), 1 / np.square(OFF[1:]))
        for _ in range(6):
            heavy = x * weight[:, None]
            r = y - x @ np.linalg.solve(heavy.T @ x + np.diag(ridge), heavy.T @ y)
            scale = max(float(np.average(r**2, weights=weight)), 1e-12)
            weight = (gaussian.FREEDOM + 1) / (gaussian.FREEDOM + r**2 / scale)
        trials = scale * np.geomspace(0.05, 20, 40)
        student = 0.5 * (gaussian.FREEDOM + 1) * np.log1p(r[:, None] ** 2 / trials / gaussian.FREEDOM) + 0.5 * np.log(trials)
        cost = student.sum(0)
        return -float(cost.min()), float(trials[cost.argmin()])


@dataclass(frozen=True)
class View:
    """Nodes as a camera shows them: w (M, 2), its covariance (M, 2, 2), the `change` (M,) of their log `sizes`; and the nats
    (`Sizes.alike`) of one size for all, without that camera."""

    camera: Camera
    w: Float
    covariance: Float
    change: Float
    sizes: Sizes
    flat: float

    def fit(self, h: Float) -> tuple[float, float]:
        """Nats by which sizes are those of a surface of heights `h` (M,) px seen by this camera, rather than all the same; and
        the factor on their variance that is left."""
        told, noise = self.sizes.alike(self.sizes.value + self.change - self.camera.bend * h, self.w)
        return told - self.flat, noise

    def heights(self, xy: Float) -> gaussian.Heights:
        """What sizes say of heights at the nodes `xy` (M, 2)."""
        return self.sizes.heights(self.camera, xy, self.w, self.change)


def view(camera: Camera, xy: Float, w: Float, covariance: Float, sizes: Sizes) -> View:
    """Nodes at `xy` (M, 2) px, of w (M, 2) in the image and its covariance (M, 2, 2), as `camera` shows them."""
    return View(camera, *flatten_tensors(camera, xy, w, covariance), sizes, sizes.alike(sizes.value, w)[0])


def views(
    xy: Float, w: Float, covariance: Float, sizes: Sizes, centre: tuple[float, float], size: float, bend: float | None
) -> list[View]:
    """The same as the camera of 1/f `bend` shows them or, if that is not known, those do that may have been there; `centre` and
    `size` as in `choose`."""
    bends = [trial / size for trial in TRIALS] if bend is None else [bend]
    return [view(Camera(centre, k), xy, w, covariance, sizes) for k in bends]


def summit(found: dict[float, float]) -> tuple[float, float]:
    """Where the parabola, over log x, through the greatest of values {x: value} and its neighbours has its top, and the
    standard deviation of log x if the values are log likelihoods: infinite where the greatest has no neighbour on a side."""
    x = np.log(sorted(found))
    y = np.array([found[k] for k in sorted(found)])
    k = int(y.argmax())
    if not 0 < k < len(x) - 1:
        return float(np.exp(x[k])), np.inf
    left, right = x[k] - x[k - 1], x[k + 1] - x[k]
    before, after = (y[k] - y[k - 1]) / left, (y[k] - y[k + 1]) / right
    if before + after <= 0:
        return float(np.exp(x[k])), np.inf
    move = (before * right - after * left) / (2 * (before + after))
    return float(np.exp(x[k] + move)), float(np.sqrt((left + right) / (2 * (before + after))))


@dataclass(frozen=True)
class Choice:
    """A camera; nats by which it beats orthography (all that sizes have for any camera, if it is orthography); nats by which
    element size prefers sign +1 to −1 (0: it is blind), under orthography those beyond `CHANCE`; standard deviation of log 1/f,
    0 if it is known."""

    camera: Camera
    gain: float
    sign: float
    doubt: float = 0.0


def choose(
    grid: spline.Grid,
    xy: Float,
    w: Float,
    covariance: Float,
    sizes: Sizes,
    start: Float,
    smooth: gaussian.Smoothness,
    noise: float,
    centre: tuple[float, float],
    size: float,
    bend: float | None = None,
) -> Choice:
    """1/f of greatest evidence of tensors and element sizes together, for the surface near gradients `start` and its mirror.

    Parameters
    ----------
    grid, xy, w, covariance
        the field's grid; nodes (M, 2) with w (M, 2) of the image and its covariance (M, 2, 2).
    start, smooth, noise
        gradients (M, 2) with signs relative to one another, and a smoothness and a noise factor to start from.
    centre, size
        principal point (x, y) and longer side of the image, px.
    bend
        1/f if it is known: only the sign is asked for then.
    """

    def told(seen: View, signs: tuple[float, ...]) -> list[float]:
        """Log likelihood of the sizes as a camera has them for signs of the surface, given what the tensors say there.

        Tensors alone like some bends better than others, as the prior has it: that is not theirs to say.
        """
        f = gaussian.make_field(grid, xy, seen.camera.stretch(xy))
        height = seen.heights(xy)

        def evidence(sign: float, height: gaussian.Heights | None) -> float:
            smooth, noise = tuned.smooth, tuned.noise
            start = sign * tuned.gradient
            data = f, seen.w, seen.covariance, sizes.trust
            return refine.refine(*data, start, smooth, ROUNDS, height, noise, scatter).evidence

        alone = evidence(1.0, None) + np.log(seen.camera.bend) * (sizes.trust > 0).sum()  # density of sizes, not of heights
        return [evidence(sign, height) - alone for sign in signs]

    hint, tried = 0.0, views(xy, w, covariance, sizes, centre, size, bend)
    if bend is None:
        rough = gaussian.make_field(grid, xy)
        firm = np.tile(1e4 * np.eye(2), (len(xy), 1, 1))
        factor = gaussian.posterior(rough, firm, gaussian.prior(rough, gaussian.softened(rough, smooth)))
        h = gaussian.heights(rough, blocks.solve(factor, gaussian.pulled(rough, 1e4 * start)))
        up, down = (max(0.0, *(v.fit(sign * h)[0] for v in tried)) for sign in (1.0, -1.0))
        if max(up, down) < CHANCE:
            return Choice(Camera(centre, 0.0), max(up, down), 0.0)
        hint = float(np.sign(up - down)) * max(abs(up - down) - CHANCE, 0.0)
    flat, scatter = sizes.unrelated(xy, w, np.zeros(len(w)))
    # All are judged from settings that suit the flat one: rounds enough to leave them, not to find them from afar.
    tuned = refine.refine(
        gaussian.make_field(grid, xy), w, covariance, sizes.trust, start, smooth, 2 * ROUNDS, noise=noise
    )
    found: dict[float, float] = {}
    sign, doubt = 0.0, 0.0
    for trial, seen in zip(TRIALS if bend is None else (bend * size,), tried, strict=True):
        up, down = told(seen, (1.0, -1.0))
        found[trial], sign = max(up, down), up - down
        if found[trial] > flat + GAIN or bend is not None:
            break
    else:
        best = max(found, key=lambda k: found[k])
        return Choice(Camera(centre, 0.0), found[best] - flat, hint)
    if bend is None:
        ratio = 1.6
        for _ in range(5):
            best = max(found, key=lambda k: found[k])
            for k in (best * ratio, best / ratio):
                if BENDS[0] <= k <= BENDS[1] and not any(abs(np.log(k / j)) < 0.01 for j in found):
                    seen = view(Camera(centre, k / size), xy, w, covariance, sizes)
                    found[k] = told(seen, (float(np.sign(sign)),))[0]
            ratio = ratio if max(found, key=lambda k: found[k]) != best else ratio**0.5
        top, doubt = summit(found)
        bend = top / size
    return Choice(Camera(centre, bend), max(found.values()) - flat, sign, min(DOUBT * doubt, MOST_DOUBT))
