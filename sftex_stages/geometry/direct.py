"""The direct method (end of section 4): instances registered again as the surface shows them.

A surface with slope g at an instance says all of its transform but scale and in-plane rotation:

    G_i = s_i P_i R_i A,      P_i = F_i⁻¹ (I − n_xy n_xyᵀ)^½,

F_i of `perspective.py`, and A the frame that the element's appearance is drawn in, common to all its instances. With P_i held,
scale, rotation and place are registered anew, and what is left of the image decides whether the pattern is an instance.
One that the first registration had given up is measured again, freely, from where the surface puts it.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sftex_stages.geometry import registration, tensors, texton
from sftex_stages.geometry.camera import Camera

Float = NDArray[np.floating]

STEPS = 10
DAMPING, LIMIT = 1e-3, 0.35  # of registration steps, as in `registration.register`
FIT_ROUNDS = 4  # of A and the similarities in turn
NOISE_FLOOR = 0.01  # of the contrast


class Seen(NamedTuple):
    """M instances registered again: posterior `inlier` (M,); `moved` (M,), whether place and transform are new; `xy` (M, 2) px,
    `transform` (M, 2, 2)."""

    inlier: Float
    moved: NDArray[np.bool_]
    xy: Float
    transform: Float


def foreshortening(g: Float, camera: Camera, xy: Float) -> Float:
    """P (M, 2, 2) of slopes `g` (M, 2) relative to the rays of `xy` (M, 2) px: image transforms but for scale and rotation."""
    n = tensors.normals(g)
    u = -g / np.maximum(np.linalg.norm(g, axis=1, keepdims=True), 1e-12)
    root = np.eye(2) + (n[:, 2] - 1)[:, None, None] * u[:, :, None] * u[:, None, :]
    return np.asarray(np.linalg.solve(camera.flatten(xy), root))


def similar(m: Float) -> Float:
    """The turned and scaled identities s R (M, 2, 2) nearest to `m` (M, 2, 2)."""
    a, b = (m[:, 0, 0] + m[:, 1, 1]) / 2, (m[:, 1, 0] - m[:, 0, 1]) / 2
    return np.stack((np.stack((a, -b), 1), np.stack((b, a), 1)), 1)


def fit_shape(p: Float, frames: Float, weight: Float) -> Float:
    """A (2, 2), up to a turn and a size, of frames s_i P_i R_i A with foreshortenings `p` (M, 2, 2), weighted by (M,)."""
    inner = np.linalg.solve(p, frames)
    shape = np.diag([1.0, np.sign(np.average(np.sign(np.linalg.det(frames)), weights=weight)) or 1.0])
    for _ in range(FIT_ROUNDS):
        turned = np.linalg.solve(similar(inner @ np.linalg.inv(shape)), inner)
        off = np.linalg.norm(turned - np.median(turned, axis=0), axis=(1, 2))
        robust = weight / (1 + (off / (2 * np.median(off) + 1e-9)) ** 2)
        shape = np.einsum("m,mij->ij", robust, turned) / robust.sum()
    return np.asarray(shape)


def held_solver(template: registration.Template, shape: Float) -> registration.Solver:
    """Registration steps that change scale, rotation and place alone, for frames s P R A with `shape` A (2, 2)."""
    solver = registration.make_solver(template)
    turn = np.linalg.solve(shape, np.array([[0.0, -1.0], [1.0, 0.0]]) @ shape)
    free = np.zeros((6, 4))
    free[:4, 0], free[:4, 1] = np.eye(2).ravel(), turn.ravel()
    free[4, 2] = free[5, 3] = 1.0
    base = np.linalg.qr(free / solver.unit[:, None])[0]
    hessian = registration.marginal_hessian(template) * np.outer(solver.unit, solver.unit)
    values, vectors = np.linalg.eigh(base.T @ hessian @ base)
    return solver._replace(values=np.maximum(values, 0), vectors=base @ vectors)


def register_held(
    image: Float, template: registration.Template, xy: Float, frames: Float, p: Float, shape: Float, steps: int = STEPS
) -> registration.Registered:
    """Registration of M patches with their foreshortening `p` (M, 2, 2) held: frames s_i P_i R_i `shape`, from those nearest to
    `frames` (M, 2, 2) at `xy` (M, 2), px of `image`. A step that raises the residual is taken back and damped more."""
    solver = held_solver(template, shape)
    points = template.points[solver.used]

    def hold(frames: Float) -> Float:
        return p @ similar(np.linalg.solve(p, frames) @ np.linalg.inv(shape)) @ shape

    def look(xy: Float, frames: Float) -> registration.Explained:
        patches = registration.sample(image, xy, frames, points)
        return registration.explain(template, solver, patches, registration.excess_blur(template, frames))

    xy, frames = xy.copy(), hold(frames)
    damping, got = np.full(len(xy), DAMPING), look(xy, frames)
    for _ in range(steps):
        step = registration.solve_step(solver, got.left, damping, LIMIT)
        new_xy, new_frames = registration.compose_step(xy, frames, step)
        new_frames = hold(new_frames)
        new = look(new_xy, new_frames)
        better = new.residual < got.residual
        damping = np.clip(np.where(better, damping * 0.3, damping * 10), 1e-6, 1e3)
        xy[better], frames[better] = new_xy[better], new_frames[better]
        for old, now in zip(got, new, strict=True):
            old[better] = now[better]
        if np.abs(step / solver.unit).max() < 1e-3:
            break
    return registration.Registered(xy, frames, got.gain, got.variation, got.residual)


def posterior(template: registration.Template, residual: Float, inlier: Float) -> Float:
    """Posterior (M,) of being an instance, from residuals (M,), the noise found from those that were one by `inlier` (M,)."""
    contrast2, samples = texton.weighted_contrast(template), texton.independent_samples(template)
    found = inlier.copy()
    for _ in range(5):
        noise2 = max(float(np.average(residual, weights=found + 1e-9)), NOISE_FLOOR**2 * contrast2, 1e-12)
        share = float(np.clip(found.mean(), 0.05, 0.98))
        found = texton.posterior(residual, noise2, contrast2, share, samples)
    return found


def look_again(
    image: Float,
    factor: float,
    template: registration.Template,
    xy: Float,
    transform: Float,
    inlier: Float,
    p: Float,
    least: float,
) -> Seen | None:
    """All instances of one texton as a surface of foreshortenings `p` (M, 2, 2) shows them.

    Parameters
    ----------
    image, factor
        the pyramid level (h, w, C) that the element is sampled from, and its px per px of the image.
    template
        the texton, in px of that level.
    xy, transform, inlier : (M, 2), (M, 2, 2), (M,)
        as delivered, px of the image. Those of posterior 0 are left as they are: they lie on others.
    least
        posterior over which an instance counts. None with fewer than four of them: they fix no frame.
    """
    good = inlier > least
    if good.sum() < 4:
        return None
    centre = texton.information_centre(template)
    at = (xy + 0.5) * factor - 0.5 - transform @ centre
    free = registration.register(image, template, at[good], transform[good], steps=4)
    shape = fit_shape(p[good], free.frames, inlier[good])
    drawn = np.median(np.linalg.solve(transform[good], free.frames), axis=0)  # delivered transforms are of another frame
    start = transform @ drawn
    start[good], at[good] = free.frames, free.xy
    held = register_held(image, template, at, start, p, shape)
    found = np.where(inlier > 0, posterior(template, held.residual, np.where(good, inlier, 0.0)), 0.0)
    moved = ~good & (found > least)
    place, new = xy.copy(), transform.copy()
    if moved.any():
        again = registration.register(image, template, held.xy[moved], held.frames[moved], steps=STEPS)
        new[moved] = again.frames @ np.linalg.inv(drawn)
        place[moved] = (again.xy + new[moved] @ centre + 0.5) / factor - 0.5
    return Seen(found, moved, place, new)
