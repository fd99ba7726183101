import numpy as np
import pytest
import torch

from meshanim.errors import OptionError, ShapeError
from meshanim.heads import load_head
from meshanim.motion import MeshSequence
from meshanim.render import (
    DRAFT,
    FULL,
    STUDIO,
    Light,
    Lighting,
    Quality,
    Renderer,
    head_camera,
    render_sequence,
)
from meshanim.render.look import PersonParameters, make_appearance
from meshanim.render.rasterizer import native_available

pytestmark = pytest.mark.skipif(not native_available(), reason="the extension is not built")
SIZE = 96


@pytest.fixture(scope="module")
def head():
    return load_head("default")


@pytest.fixture(scope="module")
def appearance(head):
    person = PersonParameters(hair="none", tone=0.3, seed=3, moles=0, age=0.4)
    return make_appearance(head, person, size=256)


def vertices(head, appearance, **weights):
    expression = head.expression(weights)
    with torch.no_grad():
        moved = head.deform(torch.from_numpy(appearance.shape)[None], expression)[0]
        rest = head.deform(torch.from_numpy(appearance.shape)[None], head.expression({}))[0]
    return appearance.template + (moved - rest).numpy()


@pytest.fixture(scope="module")
def full(head, appearance):
    return Renderer(head, appearance, SIZE, SIZE, "full", threads=1)


@pytest.fixture(scope="module")
def draft(head, appearance):
    return Renderer(head, appearance, SIZE, SIZE, "draft", threads=1)


def test_threads_and_repetition_do_not_change_the_picture(head, appearance, full):
    image = full.frame(appearance.template)
    assert np.array_equal(image, full.frame(appearance.template))
    for threads in (2, 3):
        other = Renderer(head, appearance, SIZE, SIZE, "full", threads=threads)
        assert np.array_equal(image, other.frame(appearance.template))
    assert np.array_equal(image, full.worker().frame(appearance.template))


def test_a_frame_does_not_remember_the_one_before(head, appearance, full):
    expression = head.expression({"browInnerUp": 1.0, "jawOpen": 0.5})[0].numpy()
    moved = vertices(head, appearance, browInnerUp=1.0, jawOpen=0.5)
    before = full.frame(appearance.template)
    assert not np.array_equal(before, full.frame(moved, expression))
    assert np.array_equal(before, full.frame(appearance.template))


def test_the_picture_is_where_the_mask_is(head, appearance, full):
    red = np.zeros((SIZE, SIZE, 3), np.float32)
    red[..., 0] = 1
    renderer = Renderer(head, appearance, quality="full", camera=full.camera, background=red, threads=1)
    image = renderer.frame(appearance.template)
    opacity, mask = renderer.opacity, renderer.maps(appearance.template).mask
    background = np.zeros_like(image)
    background[..., 0] = image[0, 0, 0]
    assert np.array_equal(image[opacity == 0], background[opacity == 0])
    assert opacity.max() <= 1
    # Away from the fading neck, opacity is the mask, smoothed within a pixel of its edge.
    upper = slice(0, SIZE // 2)
    assert (opacity[upper][mask[upper]] > 0.2).all()
    assert abs(opacity[upper].mean() - mask[upper].mean()) < 0.01
    assert 0.2 < mask.mean() < 0.8


def test_maps_agree_with_the_geometry(head, appearance, full):
    maps = full.maps(appearance.template)
    assert np.isfinite(maps.depth[maps.mask]).all()
    assert np.isinf(maps.depth[~maps.mask]).all()
    np.testing.assert_allclose(np.linalg.norm(maps.normal[maps.mask], axis=-1), 1, atol=1e-5)
    assert (maps.region[~maps.mask] == -1).all()
    towards = maps.normal[maps.mask] @ full.camera.world_to_camera[2, :3]
    assert np.quantile(towards, 0.98) < 0.05  # normals face the camera
    seen = {maps.region_names[index] for index in np.unique(maps.region[maps.mask])}
    assert {"lips", "nose", "ears", "left_eye", "right_eye", "scalp", "neck"} <= seen
    row, column = (
        np.argwhere(maps.region == maps.region_names.index(name)).mean(0) for name in ("nose", "lips")
    )
    assert row[0] < column[0]  # the nose above the lips
    left = np.argwhere(maps.region == maps.region_names.index("left_eye"))[:, 1].mean()
    right = np.argwhere(maps.region == maps.region_names.index("right_eye"))[:, 1].mean()
    assert left > right  # the subject's left is on the right of the picture


def test_the_mouth_opens_in_the_maps(head, appearance, full):
    def inside(maps):
        names = [maps.region_names.index(name) for name in ("tongue", "upper_teeth", "lower_teeth")]
        return np.isin(maps.region, names).sum()

    assert inside(full.maps(vertices(head, appearance, jawOpen=0.7))) > 8
    assert inside(full.maps(vertices(head, appearance, jawOpen=0.7))) > inside(full.maps(appearance.template))


def test_symmetric_light_on_a_symmetric_head(head, full):
    plain = PersonParameters(hair="none", moles=0, freckles=0, blush=0, age=0, brow_density=0.2, seed=1)
    appearance = make_appearance(head, plain, size=256)
    light = Lighting(
        (Light((0.0, 0.4, 1.0), (1.0, 1.0, 1.0), 2.0),), STUDIO.sky, STUDIO.ground, (0.0, 0.3, 1.0)
    )
    grey = np.full((SIZE, SIZE, 3), 0.2, np.float32)
    camera = head_camera(appearance, SIZE, SIZE)
    image = Renderer(head, appearance, camera=camera, lighting=light, background=grey).frame(
        appearance.template
    )
    difference = np.abs(image.astype(int) - image[:, ::-1].astype(int)).mean(-1)
    assert difference.mean() < 2.0
    assert np.quantile(difference, 0.98) < 16


def test_energy_grows_with_light_and_with_fairness(head, appearance, full):
    def brightness(lighting, person):
        camera = full.camera
        black = np.zeros((SIZE, SIZE, 3), np.float32)
        renderer = Renderer(head, person, camera=camera, lighting=lighting, background=black)
        return renderer.frame(person.template).astype(float).mean()

    none = Lighting((Light((0, 0, 1.0), (1.0, 1.0, 1.0), 0.0),), (0.0,) * 3, (0.0,) * 3, (0.0, 0.0, 1.0))
    dark = make_appearance(head, PersonParameters(hair="none", tone=0.95, seed=3), size=256)
    assert brightness(none, appearance) < 0.25 * brightness(STUDIO, appearance)
    assert brightness(STUDIO, dark) < 0.7 * brightness(STUDIO, appearance)


def test_draft_and_full_agree_in_large(appearance, draft, full):
    one, two = draft.frame(appearance.template), full.frame(appearance.template)
    blocks = [image.astype(float).reshape(SIZE // 8, 8, SIZE // 8, 8, 3).mean((1, 3)) for image in (one, two)]
    assert np.abs(blocks[0] - blocks[1]).mean() < 8
    regions = [renderer.maps(appearance.template).region for renderer in (draft, full)]
    assert np.array_equal(*regions)


def test_wrinkles_show_where_they_are(head, appearance, full):
    camera = head_camera(appearance, 256, 256)
    renderer = Renderer(head, appearance, camera=camera, threads=1)
    raised = vertices(head, appearance, browInnerUp=1.0, browOuterUpLeft=1.0, browOuterUpRight=1.0)
    weights = head.expression({"browInnerUp": 1.0, "browOuterUpLeft": 1.0, "browOuterUpRight": 1.0})
    change = np.abs(
        renderer.frame(raised, weights[0].numpy()).astype(int) - renderer.frame(raised).astype(int)
    ).mean(-1)
    rows, columns = np.nonzero(change > 4)
    assert len(rows) > 50
    region = renderer.maps(raised)
    names = ("upper_face", "scalp", "face", "eyelids")
    upper = [region.region_names.index(name) for name in names]
    forehead = np.isin(region.region[rows, columns], upper)
    assert forehead.mean() > 0.8


@pytest.mark.parametrize(
    "expression",
    [
        {"jawOpen": 1.0},
        {"eyeBlinkLeft": 1.0, "eyeBlinkRight": 1.0},
        {"tongueOut": 1.0, "jawOpen": 0.6},
        {"mouthPucker": 1.0},
    ],
)
def test_strong_expressions_draw_without_holes(head, appearance, full, expression):
    moved = vertices(head, appearance, **expression)
    image = full.frame(moved, head.expression(expression)[0].numpy())
    assert np.isfinite(full.opacity).all()
    assert np.isfinite(full._canvas.planes).all()
    # The head is one piece: nothing of the background shows inside its outline.
    mask = full.maps(moved).mask
    from scipy.ndimage import binary_fill_holes

    assert (binary_fill_holes(mask) & ~mask).sum() == 0
    assert image.std() > 10


def test_head_far_away_near_or_behind(head, appearance, full):
    for offset in ((0.0, 0.0, -5.0), (0.0, 0.0, 0.42), (0.0, 0.0, 3.0), (9.0, 0.0, 0.0)):
        image = full.frame(appearance.template + np.float32(offset))
        assert image.shape == (SIZE, SIZE, 3)
    assert full.opacity.max() == 0


def test_sequence_equals_frames(head, appearance, full):
    moved = np.stack([vertices(head, appearance, jawOpen=x) for x in (0.0, 0.2, 0.4, 0.6, 0.3)])
    pose = np.linspace(0, 0.2, 5)[:, None] * np.array([[1.0, 0.5, 0.0]])
    sequence = MeshSequence(moved, 30.0, head.mesh, pose.astype(np.float32))
    weights = np.zeros((5, len(head.expression_names)), np.float32)
    weights[:, 2] = np.linspace(0, 1, 5)
    shape = torch.from_numpy(appearance.shape)[None]
    posed = head.pose(torch.from_numpy(moved), torch.from_numpy(sequence.pose), shape).detach().numpy()
    expected = [full.frame(posed[k], weights[k]) for k in range(5)]
    for workers in (1, 2, 3):
        frames = list(
            render_sequence(sequence, head, appearance, SIZE, SIZE, expression=weights, workers=workers)
        )
        assert all(np.array_equal(a, b) for a, b in zip(frames, expected, strict=True))
    half = render_sequence(sequence, head, appearance, SIZE, SIZE)
    next(half)
    half.close()  # stopping early leaves no thread behind


def test_bad_input_is_named(head, appearance, full):
    with pytest.raises(ShapeError, match="vertices"):
        full.frame(np.zeros((7, 3), np.float32))
    with pytest.raises(ShapeError, match="finite"):
        full.frame(np.full_like(appearance.template, np.nan))
    with pytest.raises(ShapeError, match="expression"):
        full.frame(appearance.template, np.zeros(3, np.float32))
    with pytest.raises(OptionError, match="quality"):
        Renderer(head, appearance, quality="ultra")
    with pytest.raises(OptionError, match="threads"):
        Renderer(head, appearance, threads=0)
    short = MeshSequence(np.zeros((2, 4, 3), np.float32), 30.0, _tetrahedron())
    with pytest.raises(ShapeError, match="4 vertices"):
        render_sequence(short, head, appearance)


def _tetrahedron():
    from meshanim.geometry import TriangleMesh

    return TriangleMesh(np.eye(4, 3), [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])


def test_qualities():
    assert DRAFT.name == "draft"
    assert not DRAFT.scatter
    assert "hair" in FULL.strands
    assert "brow" in DRAFT.strands
    assert Quality("mine", samples=1).samples == 1
