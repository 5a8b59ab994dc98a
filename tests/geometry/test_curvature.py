import numpy as np
import pytest

from sftex_stages.geometry import curvature, gaussian, refine, roughness, spline, tensors
from sftex_stages.geometry.camera import ORTHOGRAPHIC

RADIUS = 110.0
BOXES = [(np.array([-60.0, -50.0]), np.array(high)) for high in ([60.0, 70.0], [40.0, 70.0], [60.0, 30.0])]


def fitted(grid, h):
    """Coefficients of the splines nearest to a height map h(xy)."""
    low = np.array(grid.origin)
    axes = [np.linspace(low[k], low[k] + grid.cells[k] * grid.spacing, 6 * grid.cells[k]) for k in range(2)]
    xy = np.stack(np.meshgrid(*axes), -1).reshape(-1, 2)
    return np.linalg.lstsq(spline.design(grid, xy).toarray(), h(xy), rcond=None)[0]


def sphere(xy):
    return np.sqrt(RADIUS**2 - ((xy - 5) ** 2).sum(1))


def lying(xy):
    """A cylinder whose axis is turned in the image, and leans 35 degrees toward the camera."""
    lean, turn = np.radians(35), np.radians(25)
    x = xy @ np.array([np.cos(turn), np.sin(turn)])
    y = xy @ np.array([-np.sin(turn), np.cos(turn)])
    return (np.sqrt(RADIUS**2 - y**2) + x * np.sin(lean)) / np.cos(lean)


def of_cells(grid, a, energies):
    index = spline.cells(grid)
    return [np.einsum("ci,cij,cj->c", a[index], e, a[index]) for e in energies]


def areas(grid, a):
    at = spline.centres(grid)
    return grid.spacing**2 * np.sqrt(1 + (ORTHOGRAPHIC.slopes_of(grid, a, at) ** 2).sum(1))


@pytest.mark.parametrize("box", BOXES)
def test_on_a_frontal_plane_the_energies_are_those_of_the_height_map(box):
    grid = spline.cover(*box, 10.0)
    for m, cells in zip((2, 3), curvature.about(grid, np.zeros(grid.size), ORTHOGRAPHIC), strict=True):
        assert np.allclose(cells, roughness.cell_energy(grid, m), rtol=0, atol=1e-13 * cells.max())
    f = gaussian.make_field(grid, np.zeros((1, 2)))
    for a, b in zip(f.energies, curvature.follow(f, np.zeros(grid.size), ORTHOGRAPHIC).energies, strict=True):
        assert np.allclose(a, b, atol=1e-13 * np.abs(a).max())


@pytest.mark.parametrize("box", BOXES)
@pytest.mark.parametrize(("surface", "curvatures"), [(sphere, 2), (lying, 1)])
def test_round_surfaces_have_one_curvature_from_every_side_and_change_it_nowhere(box, surface, curvatures):
    grid = spline.cover(*box, 10.0)
    a = fitted(grid, surface)
    second, third = of_cells(grid, a, curvature.about(grid, a, ORTHOGRAPHIC))
    assert second / areas(grid, a) == pytest.approx(curvatures / RADIUS**2, rel=0.05)
    flat = of_cells(grid, a, [np.broadcast_to(roughness.cell_energy(grid, m), (len(second), 16, 16)) for m in (2, 3)])
    assert (flat[0] / areas(grid, a) * RADIUS**2).max() > 1.5 * curvatures  # the height map's grows on the flanks
    assert third.sum() < 0.02 * flat[1].sum()


def test_a_plane_is_free_however_it_leans():
    grid = spline.cover(*BOXES[0], 10.0)
    a = fitted(grid, lambda xy: 1.7 * xy[:, 0] - 0.6 * xy[:, 1])
    for e in of_cells(grid, a, curvature.about(grid, a, ORTHOGRAPHIC)):
        assert np.abs(e).max() < 1e-12


def test_where_the_curvature_changes_the_third_energy_says_how_fast():
    """Of a ruled surface it is the integral over the area of the squared change of its curvature along it: by differences."""
    grid = spline.cover(np.zeros(2), np.array([100.0, 100.0]), 5.0)

    def h(x):
        return 40 * np.sin(x / 40) + x**2 / 90

    a = fitted(grid, lambda xy: h(xy[:, 0]))
    third = of_cells(grid, a, curvature.about(grid, a, ORTHOGRAPHIC))[1]
    x = np.linspace(0, 100, 20001)
    slope = np.gradient(h(x), x)
    w = np.sqrt(1 + slope**2)
    bent = np.gradient(slope, x) / w**3
    density = (np.gradient(bent, x) / w) ** 2 * w * grid.spacing
    at = spline.centres(grid)[:, 0]
    for middle in np.unique(at[(at > 10) & (at < 90)]):
        cell = np.abs(x - middle) <= grid.spacing / 2
        assert third[at == middle] == pytest.approx(np.trapezoid(density[cell], x[cell]), rel=0.1, abs=1e-7)


def slopes(h, xy):
    e = 1e-3 * np.eye(2)
    return np.stack([(h(xy + e[k]) - h(xy - e[k])) / 2e-3 for k in range(2)], 1)


def seen(h, noise=0.01, count=500):
    """Field, tensors and slopes of a height map of 300 x 300 px, within 125 px of its middle."""
    rng = np.random.default_rng(0)
    xy = rng.uniform(-125, 125, (count, 2))
    xy = xy[np.linalg.norm(xy, axis=1) < 125]
    g = slopes(h, xy)
    w = tensors.predict(g)[0] + noise * rng.normal(size=g.shape)
    f = gaussian.make_field(spline.cover(np.full(2, -160.0), np.full(2, 160.0), 16.0), xy)
    return f, (w, np.tile(noise**2 * np.eye(2), (len(xy), 1, 1)), np.ones(len(xy))), g


def both(h):
    """Refined under the prior of the height map and that of curvature, and the true slopes."""
    f, data, g = seen(h)
    flat = refine.refine(f, *data, g, gaussian.Smoothness(1.0, 60.0), 5)
    follow = curvature.follow(flat.field, flat.a, ORTHOGRAPHIC)
    return flat, refine.refine(follow, *data, flat.gradient, flat.smooth, 5, None, flat.noise, camera=ORTHOGRAPHIC), g


def off(found, g):
    return np.degrees(np.arccos(np.clip((tensors.normals(found) * tensors.normals(g)).sum(1), -1, 1)))


def test_a_dome_is_known_better_by_its_curvature_and_past_the_last_instance_too():
    def dome(xy):
        return np.sqrt(150.0**2 - (xy**2).sum(1))

    flat, curved, g = both(dome)
    assert curved.evidence > flat.evidence + 30
    assert np.median(off(curved.gradient, g)) < 0.8 * np.median(off(flat.gradient, g))
    turn = np.linspace(0, 2 * np.pi, 100)
    beyond = 137 * np.stack((np.cos(turn), np.sin(turn)), 1)
    past = [np.median(off(ORTHOGRAPHIC.slopes_of(s.field.grid, s.a, beyond), slopes(dome, beyond))) for s in (flat, curved)]
    assert past[1] < 0.6 * past[0]


def test_a_sinusoid_is_known_better_by_its_heights():
    flat, curved, g = both(lambda xy: 22 * np.sin(xy[:, 0] / 22))
    assert flat.evidence > curved.evidence
    assert np.median(off(flat.gradient, g)) < np.median(off(curved.gradient, g))
