import numpy as np
import pytest
from synthetic import detect_of, image_of, render
from synthetic_instances import instances_of, jittered

from sftex_stages import config, frontal, surface
from sftex_stages.errors import ConfigError, StageError
from sftex_stages.geometry import tensors
from sftex_stages.geometry.camera import Camera

SHAPE = (300, 360)
QUICK = {"finalists": 1, "camera": "orthographic", "nodes": 250}


def image(mask=None):
    return {"rgb": np.zeros((*SHAPE, 3), np.float32), "mask": np.ones(SHAPE, bool) if mask is None else mask}


def bumps(xy):
    """Height gradient of a doubly curved surface."""
    x, y = xy[..., 0], xy[..., 1]
    return np.stack((0.8 * np.cos(x / 70) - 0.002 * (x - 180), -0.7 * np.sin(y / 60) - 0.002 * (y - 150)), -1)


def angles(out, gradient):
    x, y = np.meshgrid(np.arange(SHAPE[1]), np.arange(SHAPE[0]))
    truth = tensors.normals(gradient(np.stack((x, y), -1).astype(float)))
    valid = out["valid"]
    found = out["normals"][valid].astype(float)
    both = [np.degrees(np.arccos(np.clip((found * truth[valid] * m).sum(-1), -1, 1))) for m in ([1, 1, 1], [-1, -1, 1])]
    return min(both, key=np.median)


@pytest.fixture(scope="module")
def found():
    xy = jittered(SHAPE, 16)
    frontal = instances_of((xy, bumps(xy)), noise=0.006)
    return surface.run({"image": image(), "frontal": frontal}, surface.Params())


def test_smooth_surface_from_signless_instances(found):
    error = angles(found, bumps)
    assert np.median(error) < 1.5
    assert (error < 5).mean() > 0.95
    assert found["valid"].mean() > 0.95


def test_outputs_are_as_documented(found):
    n = len(found["instance/xy"])
    assert found["height"].shape == SHAPE and found["height"].dtype == np.float32
    assert found["normals"].shape == (*SHAPE, 3)
    for name in ("height", "normal_sigma"):
        assert np.array_equal(np.isfinite(found[name]), found["valid"])
    valid = found["valid"]
    assert np.allclose(np.linalg.norm(found["normals"][valid], axis=1), 1, atol=1e-5)
    assert np.allclose(found["instance/state"].sum(1), 1, atol=1e-5) and found["instance/state"].shape == (n, 3)
    p, q = np.gradient(found["height"].astype(float))[::-1]
    normal = tensors.normals(np.stack((p, q), -1))[valid & np.isfinite(p) & np.isfinite(q)]
    stored = found["normals"][valid & np.isfinite(p) & np.isfinite(q)]
    assert (normal * stored).sum(-1).min() > 0.999
    evidence = found["candidate/shape"] + found["candidate/shading"] + found["candidate/sizes"]
    assert evidence[0] == evidence[found["candidate/tuned"]].max()


def test_textons_are_told_what_the_surface_says_of_them():
    xy = jittered(SHAPE, 12)
    parts = instances_of((xy, bumps(xy)), noise=0.004, textons=6)
    wrong = parts[4]["transform"] @ np.array([[1.08, 0.0], [0.0, 0.92]], np.float32)
    s = wrong @ np.swapaxes(wrong, 1, 2)
    s /= np.linalg.eigvalsh(s)[:, 1][:, None, None]
    parts[4] |= {"transform": wrong, "tensor": np.stack((s[:, 0, 0], s[:, 0, 1], s[:, 1, 1]), 1)}
    out = surface.run({"image": image(), "frontal": parts}, surface.Params(**QUICK))
    assert out["texton/part"].tolist() == list(range(6)) and (out["texton/reason"] == "").all()
    assert np.abs(out["texton/shear"][4] - [-0.08, 0]).max() < 0.015
    assert np.abs(np.delete(out["texton/shear"], 4, 0)).max() < 0.02
    assert np.abs(np.delete(out["texton/slant_bias"], 4)).max() < 1 and out["texton/noise"].shape == (6,)
    assert np.median(angles(out, bumps)) < 1


def test_sigma_is_of_the_size_of_the_error(found):
    error = angles(found, bumps)
    sigma = found["normal_sigma"][found["valid"]]
    ratio = np.sqrt((error**2).mean()) / np.sqrt((sigma**2).mean())
    assert 0.3 < ratio < 2


def test_instances_have_the_sign_of_the_surface(found):
    xy = np.rint(found["instance/xy"]).astype(int)
    inside = found["valid"][xy[:, 1], xy[:, 0]]
    normal = found["normals"][xy[inside, 1], xy[inside, 0]]
    assert ((normal[:, :2] * found["instance/normal"][inside, :2]).sum(1) > -0.02).all()


def test_same_input_gives_the_same_bytes(found):
    xy = jittered(SHAPE, 16)
    again = surface.run({"image": image(), "frontal": instances_of((xy, bumps(xy)), noise=0.006)}, surface.Params())
    assert all(np.array_equal(found[k], again[k], equal_nan=found[k].dtype.kind == "f") for k in found)


def test_mask_and_hole_are_respected():
    xy = jittered(SHAPE, 16)
    xy = xy[np.hypot(xy[:, 0] - 180, xy[:, 1] - 150) > 70]
    mask = np.ones(SHAPE, bool)
    mask[:, :60] = False
    xy = xy[mask[xy[:, 1].astype(int), xy[:, 0].astype(int)]]
    out = surface.run({"image": image(mask), "frontal": instances_of((xy, bumps(xy)))}, surface.Params())
    assert not out["valid"][:, :60].any()
    assert not out["valid"][150, 180]
    assert out["valid"][20:280, 70:100].mean() > 0.9


def test_tilted_plane_comes_out_flat():
    xy = jittered(SHAPE, 18)
    out = surface.run(
        {"image": image(), "frontal": instances_of((xy, np.tile([0.7, -0.4], (len(xy), 1))), noise=0.005)},
        surface.Params(),
    )
    error = angles(out, lambda at: np.broadcast_to([0.7, -0.4], at.shape))
    assert np.quantile(error, 0.99) < 2


def test_shading_from_above_decides_between_a_surface_and_its_mirror_image():
    xy = jittered(SHAPE, 16)
    g = bumps(xy)
    n = tensors.normals(g)
    light = 0.5 + 0.4 * n[:, 2] - 0.35 * n[:, 1] + 0.15 * n[:, 0]
    out = surface.run({"image": image(), "frontal": instances_of((xy, g), noise=0.005, light=light)}, surface.Params())
    x, y = np.meshgrid(np.arange(SHAPE[1]), np.arange(SHAPE[0]))
    truth = tensors.normals(bumps(np.stack((x, y), -1).astype(float)))[out["valid"]]
    found = out["light"][2:] / np.linalg.norm(out["light"][2:])
    assert np.allclose(found, np.array([0.15, -0.35]) / np.hypot(0.15, 0.35), atol=0.1)
    margin = out["instance/sign_margin"]
    assert np.isfinite(margin).all() and np.median(margin) > 10
    assert np.median(np.degrees(np.arccos(np.clip((out["normals"][out["valid"]] * truth).sum(1), -1, 1)))) < 1.5


def test_the_papers_em_is_a_method_too():
    xy = jittered(SHAPE, 16)
    curve = lambda at: np.stack(((180 - at[..., 0]) / 200, np.zeros(at.shape[:-1])), -1)  # noqa: E731
    out = surface.run(
        {"image": image(), "frontal": instances_of((xy, curve(xy)), noise=0.005)}, surface.Params(method="em")
    )
    assert np.median(angles(out, curve)) < 2
    assert all(str(name).startswith("em") for name in out["candidate/origin"])


def test_without_a_usable_texton_the_message_says_what_to_do():
    part = instances_of((jittered(SHAPE, 40), bumps(jittered(SHAPE, 40))), textons=1)[0]
    part["usable"] = np.array(False)
    with pytest.raises(StageError, match="none of the 1 texture elements is usable"):
        surface.run({"image": image(), "frontal": [part]}, surface.Params())


def test_too_few_instances_to_believe_in():
    part = instances_of((jittered(SHAPE, 40), bumps(jittered(SHAPE, 40))), textons=1)[0]
    part["inlier"] = np.full(len(part["xy"]), 0.5, np.float32)
    part["inlier"][:2] = 0.99
    with pytest.raises(StageError, match=r"only 2 of \d+ instances .*min_inlier"):
        surface.run({"image": image(), "frontal": [part]}, surface.Params())


@pytest.mark.parametrize("count", [3, 5, 12])
def test_very_few_instances_still_give_a_surface(count):
    xy = jittered(SHAPE, 60)[:count]
    out = surface.run({"image": image(), "frontal": instances_of((xy, bumps(xy)), textons=1)}, surface.Params())
    assert np.isfinite(out["energy"]) and out["valid"].shape == SHAPE


@pytest.fixture(scope="module")
def sheet():
    """Frontal results of a sheet under perspective, focal length 500 px, with the sign of its slopes relative to the rays."""
    camera = Camera(((SHAPE[1] - 1) / 2, (SHAPE[0] - 1) / 2), 1 / 500)
    xy = jittered(SHAPE, 14)
    h = 40 * np.sin(xy[:, 0] / 50) + 35 * np.cos(xy[:, 1] / 45) + 0.3 * xy[:, 1]
    slope = np.stack((0.8 * np.cos(xy[:, 0] / 50), 0.3 - 7 / 9 * np.sin(xy[:, 1] / 45)), 1)
    parts = instances_of((xy, camera.slopes(xy, slope)), noise=0.008)
    flatten, cosine = camera.flatten(xy), camera.rays(xy)[1]
    for k, part in enumerate(parts):
        m = np.arange(len(xy)) % len(parts) == k
        size = np.exp(h[m] / 500) / cosine[m]
        part["transform"] = (size[:, None, None] * np.linalg.inv(flatten[m]) @ part["transform"]).astype(np.float32)
        s = part["transform"] @ np.swapaxes(part["transform"], 1, 2)
        s /= np.linalg.eigvalsh(s)[:, 1][:, None, None]
        part["tensor"] = np.stack((s[:, 0, 0], s[:, 0, 1], s[:, 1, 1]), 1).astype(np.float32)
    return camera, xy, slope, parts


@pytest.mark.parametrize("given", [False, True])
def test_element_sizes_give_focal_length_sign_and_normals_in_the_cameras_frame(sheet, given):
    camera, xy, slope, parts = sheet
    chosen = {"focal_px": 500.0} if given else "auto"
    out = surface.run({"image": image(), "frontal": parts}, surface.Params(camera=chosen))
    assert str(out["camera"]) == "perspective"
    assert float(out["focal_px"]) == pytest.approx(500, rel=1e-9 if given else 0.1)
    assert (float(out["focal_sigma"]) == 0) == given and float(out["focal_sigma"]) < 100
    assert tuple(out["principal_point"]) == camera.centre
    assert out["vote/scale"].shape == (1,) and out["vote/scale"][0] > 50
    at = np.rint(xy).astype(int)
    inside = out["valid"][at[:, 1], at[:, 0]]
    truth = camera.turn(xy, tensors.normals(camera.slopes(xy, slope)))
    found = out["normals"][at[:, 1], at[:, 0]][inside]
    assert np.median(np.degrees(np.arccos(np.clip((found * truth[inside]).sum(1), -1, 1)))) < 2
    inner = np.concatenate(
        [np.flatnonzero(np.arange(len(xy)) % 3 == k) for k in range(3)]
    )  # as the instances are stored
    alike = (out["instance/normal"] * truth[inner]).sum(1)
    assert np.degrees(np.arccos(np.clip(np.median(alike), -1, 1))) < 3


def test_orthography_can_be_asked_for(sheet):
    out = surface.run({"image": image(), "frontal": sheet[3]}, surface.Params(camera="orthographic"))
    assert str(out["camera"]) == "orthographic" and np.isinf(out["focal_px"]) and not out["vote/scale"].any()


def test_focal_length_of_the_photograph_is_taken(sheet):
    own = image() | {"focal_px": np.array(500.0)}
    out = surface.run({"image": own, "frontal": sheet[3]}, surface.Params(finalists=1, nodes=250))
    assert float(out["focal_px"]) == pytest.approx(500) and out["vote/scale"][0] > 50
    out = surface.run({"image": own, "frontal": sheet[3]}, surface.Params(**QUICK))
    assert str(out["camera"]) == "orthographic"


def as_given(out, gradient):
    """Share of valid pixels whose sign is right."""
    x, y = np.meshgrid(np.arange(SHAPE[1]), np.arange(SHAPE[0]))
    truth = tensors.normals(gradient(np.stack((x, y), -1).astype(float)))[out["valid"]]
    return ((truth[:, :2] * out["normals"][out["valid"]][:, :2]).sum(1) >= 0).mean()


@pytest.mark.parametrize(
    ("hints", "sign"),
    [
        ({"near": [[180, 150]]}, 1),
        ({"far": [[180, 150]]}, -1),
        ({"near": [[20, 20]], "far": [[180, 150]]}, -1),
        ({"convex": [[180, 150, 60]]}, 1),
        ({"convex_mask": True}, 1),
    ],
)
def test_hints_decide_between_a_dome_and_a_hollow(hints, sign):
    xy = jittered(SHAPE, 24)
    dome = lambda at: sign * (np.array([180.0, 150.0]) - at) / 220  # noqa: E731
    part = instances_of((xy, dome(xy)), noise=0.005)
    params = surface.Params(hints=surface.HintParams.model_validate(hints), **QUICK)
    out = surface.run({"image": image(), "frontal": part}, params)
    assert as_given(out, dome) > 0.98 and out["vote/hint"][0] > 100 and out["mirror_margin"][0] > 100


def test_a_hint_where_the_light_comes_from_overrules_the_habit_of_light_from_above():
    xy = jittered(SHAPE, 16)
    n = tensors.normals(bumps(xy))
    parts = instances_of((xy, bumps(xy)), noise=0.005, light=0.5 + 0.4 * n[:, 2] + 0.35 * n[:, 1] + 0.15 * n[:, 0])
    params = surface.Params(hints=surface.HintParams(light=-67.0), finalists=1, camera="orthographic")
    out = surface.run({"image": image(), "frontal": parts}, params)
    assert as_given(out, bumps) > 0.97 and out["light"][3] > 0.2


def test_pieces_that_lie_apart_have_signs_and_votes_of_their_own():
    xy = jittered(SHAPE, 14)
    xy = xy[np.abs(xy[:, 0] - 180) > 50]
    centre = lambda at: np.where(at[..., :1] < 180, 65.0, 295.0) * [1, 0] + [0, 150.0]  # noqa: E731
    pair = lambda at: np.where(at[..., :1] < 180, -1, 1) * (at - centre(at)) / 180  # noqa: E731
    hints = surface.HintParams(near=((65.0, 150.0),), far=((295.0, 150.0),))
    out = surface.run(
        {"image": image(), "frontal": instances_of((xy, pair(xy)), noise=0.005)}, surface.Params(hints=hints, **QUICK)
    )
    assert out["piece"].max() == 2 and out["piece"][150, 65] != out["piece"][150, 295]
    assert as_given(out, pair) > 0.97
    assert all(out[f"vote/{cue}"].shape == (2,) for cue in ("scale", "light", "bulge", "hint", "smoothness", "shading"))
    assert (out["vote/hint"] > 100).all() and sorted(out["vote/bulge"].tolist()) == [-0.5, 0.5]
    assert out["region_margin"].shape == (2,) and (out["region_margin"] > 5).all()


def test_a_convex_mask_turns_every_piece_toward_the_camera():
    xy = jittered(SHAPE, 14)
    xy = xy[np.abs(xy[:, 0] - 180) > 50]
    centre = lambda at: np.where(at[..., :1] < 180, 65.0, 295.0) * [1, 0] + [0, 150.0]  # noqa: E731
    domes = lambda at: (centre(at) - at) / 180  # noqa: E731
    frontal = instances_of((xy, domes(xy)), noise=0.005)
    params = surface.Params(hints=surface.HintParams(convex_mask=True, light=90.0), **QUICK)
    out = surface.run({"image": image(), "frontal": frontal}, params)
    assert out["piece"].max() == 2 and (out["vote/hint"] > 100).all()
    assert as_given(out, domes) > 0.97


def test_the_direct_method_takes_back_what_registration_had_given_up():
    scene = render(radius=17, pitch=40, size=360)
    members = {"label": np.zeros(len(scene.xy), np.int32), "count": np.array(1)}
    inputs = {"image": image_of(scene), "detect": detect_of(scene, np.random.default_rng(1)), "cluster": members, "part": 0}
    part = frontal.run(inputs, frontal.Params())
    lost = np.flatnonzero(part["inlier"] > 0.8)[::6]
    part["inlier"][lost] = 0.3
    part["transform"][lost] = part["transform"][lost] @ np.array([[1.12, 0.1], [0.0, 0.92]], np.float32)
    given = {"image": inputs["image"], "frontal": [part]}
    out, plain = (surface.run(given, surface.Params(direct=k, finalists=1, camera="orthographic")) for k in (1, 0))
    assert (plain["instance/inlier"][lost] < 0.8).all()
    lost = lost[out["instance/inlier"][lost] > 0.8]
    assert len(lost) >= 6  # of 9; at the border the others leave the surface too free
    near = np.linalg.norm(scene.xy - part["xy"][lost, None], axis=2).argmin(1)
    normal, true = out["instance/normal"][lost], scene.normal[near]
    off = [np.degrees(np.arccos(np.clip((normal * m * true).sum(1), -1, 1))) for m in ([1, 1, 1], [-1, -1, 1])]
    assert np.median(np.minimum(*off)) < 2
    rest = part["inlier"] > 0.8
    assert np.array_equal(out["instance/transform"][rest], part["transform"][rest])


@pytest.mark.parametrize("start", ["cylinder", "sphere", "plane"])
def test_start_shape_can_be_chosen(start):
    xy = jittered(SHAPE, 24)
    dome = lambda at: (np.array([180.0, 150.0]) - at) / 220  # noqa: E731
    parts = instances_of((xy, dome(xy)), noise=0.005)
    out = surface.run({"image": image(), "frontal": parts}, surface.Params(start=start, **QUICK))
    assert all(str(name).startswith(start) for name in out["candidate/origin"])
    assert np.median(angles(out, dome)) < 1.5


def test_a_hint_outside_of_the_image_is_refused():
    parts = instances_of((jittered(SHAPE, 40), bumps(jittered(SHAPE, 40))))
    params = surface.Params(hints=surface.HintParams(far=((400.0, 20.0),)))
    with pytest.raises(StageError, match=r"surface\.hints\.far: the point \[400, 20\] lies outside .* 360 x 300"):
        surface.run({"image": image(), "frontal": parts}, params)


@pytest.mark.parametrize(
    ("yaml", "words"),
    [
        ("hints: {near: [[1, 2, 3]]}", "surface.hints.near"),
        ("hints: {convex: [[1, 2, 0]]}", "surface.hints.convex.0.2: should be greater than 0"),
        ("direct: 9", "surface.direct"),
        ("hints: {convex_mask: 1}", "surface.hints.convex_mask: should be a valid boolean"),
        ("hints: {lihgt: 90}", "surface.hints.lihgt: unknown key"),
        ("start: cone", "surface.start"),
    ],
)
def test_mistakes_in_hints_name_their_key_and_line(yaml, words):
    with pytest.raises(ConfigError) as error:
        config.parse(f"surface:\n  {yaml}\n", [surface.STAGE])
    assert words in str(error.value) and str(error.value).startswith("pipeline.yaml:2:")


def test_hints_are_read_from_yaml():
    text = "surface:\n  hints:\n    near: [[10, 20.5]]\n    light: 90\n"
    hints = config.parse(text, [surface.STAGE])["surface"].hints
    assert hints.near == ((10.0, 20.5),) and hints.light == 90 and hints.far == () and not hints.convex_mask


def ripples(xy):
    """Height gradient of folds hardly wider than instances are apart."""
    return np.stack((0.9 * np.cos(xy[..., 0] / 9), 0.3 * np.sin(xy[..., 1] / 40)), -1)


def test_cells_in_which_the_surface_turns_are_quartered(monkeypatch):
    xy = jittered(SHAPE, 9)
    n = tensors.normals(ripples(xy))
    light = 0.5 + 0.4 * n[:, 2] - 0.35 * n[:, 1] + 0.25 * n[:, 0]
    parts = instances_of((xy, ripples(xy)), noise=0.01, light=light)
    params = surface.Params(finalists=1, camera="orthographic", nodes=500)
    close = surface.run({"image": image(), "frontal": parts}, params)
    monkeypatch.setattr(surface, "TURN", np.inf)
    far = surface.run({"image": image(), "frontal": parts}, params)
    off = [np.median(angles(out, ripples)) for out in (close, far)]
    assert off[0] < 0.9 * off[1] and close["energy"] != far["energy"]
