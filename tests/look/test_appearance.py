import numpy as np
import pytest

from meshanim.errors import OptionError
from meshanim.render.look import (
    SKIN_CHANNELS,
    PersonParameters,
    make_appearance,
    pose_eye,
    pose_teeth,
    strand_points,
    wrinkle_height,
)

PERSON = PersonParameters(
    seed=5, stubble=0.4, beard_length=0.002, freckles=0.3, hair="crop", hair_length=0.03
)


@pytest.fixture(scope="module")
def appearance(head, assets):
    return make_appearance(head, PERSON, 256, assets)


def moved(head, **weights):
    vertices = head.mesh.vertices.astype(np.float32)
    rows = [head.expression_names.index(name) for name in weights]
    directions = head.expression_directions.numpy().reshape(-1, head.n_vertices, 3)
    return vertices + sum(weight * directions[row] for row, weight in zip(rows, weights.values()))


def test_textures_stay_in_range(appearance):
    skin = appearance.skin
    assert skin.shape == (256, 256, len(SKIN_CHANNELS))
    assert skin.flags.c_contiguous
    assert np.isfinite(skin).all()
    assert np.isfinite(appearance.height).all()
    painted = skin[..., :3].sum(2) > 0
    assert painted.mean() > 0.5
    assert skin[painted, :3].min() > 0
    assert skin[..., :3].max() <= 0.95
    assert np.abs(appearance.height).max() < 1e-3  # pores and lip lines, not bumps
    assert appearance.sky.min() >= 0
    assert appearance.sky.max() <= 1.001
    for eye in appearance.eyes:
        assert eye.material.iris.min() > 0
        assert eye.material.sclera.max() < 0.95


def test_the_same_seed_gives_the_same_arrays_and_another_one_does_not(head, assets, appearance):
    again = make_appearance(head, PERSON, 256, assets)
    assert np.array_equal(again.skin, appearance.skin)
    assert np.array_equal(again.height, appearance.height)
    assert np.array_equal(again.sky, appearance.sky)
    for one, two in zip(again.strands, appearance.strands):
        assert np.array_equal(one.triangle, two.triangle)
        assert np.array_equal(one.offsets, two.offsets)
        assert np.array_equal(one.color, two.color)
    other = make_appearance(head, PersonParameters(seed=6), 256, assets)
    assert np.abs(other.skin - appearance.skin).max() > 0.01


def test_strands_root_in_the_skin_and_follow_an_expression(head, appearance):
    for vertices in (moved(head), moved(head, browInnerUp=1.0, jawOpen=0.5)):
        surface = appearance.surface.vertices(vertices)
        for strands in appearance.strands:
            points = strand_points(strands, surface, appearance.surface.faces)
            corners = surface[appearance.surface.faces[strands.triangle]]
            root = np.einsum("nkd,nk->nd", corners, strands.barycentric)
            assert np.array_equal(points[:, 0], root)
    rest = appearance.surface.vertices(moved(head))
    raised = appearance.surface.vertices(moved(head, browInnerUp=1.0))
    brows = next(strands for strands in appearance.strands if strands.kind == "brow")
    lift = [strand_points(brows, surface, appearance.surface.faces)[..., 1] for surface in (rest, raised)]
    assert (lift[1] - lift[0]).max() > 0.004


def test_strands_keep_their_shape_under_a_rigid_turn(head, appearance):
    turn = np.array([[0.8, 0, 0.6], [0, 1, 0], [-0.6, 0, 0.8]], np.float32)
    surface = appearance.surface.vertices(moved(head))
    faces = appearance.surface.faces
    for strands in appearance.strands:
        still = strand_points(strands, surface, faces)
        turned = strand_points(strands, surface @ turn.T, faces)
        assert np.allclose(turned, still @ turn.T, atol=2e-6)


def test_teeth_sit_in_the_mouth_and_the_lower_ones_follow_the_jaw(head, appearance):
    rest, open_ = moved(head), moved(head, jawOpen=1.0)
    upper, lower = appearance.teeth
    mouth = head.mesh.vertices[head.masks["inside-mouth"] > 0.5]
    for teeth in (upper, lower):
        posed = pose_teeth(teeth, rest)
        assert np.allclose(posed, teeth.vertices, atol=2e-5)
        assert (posed.min(0) > mouth.min(0) - 0.004).all()
        assert (posed.max(0) < mouth.max(0) + 0.004).all()
    assert np.abs(pose_teeth(upper, open_) - upper.vertices).max() < 1e-3
    assert (lower.vertices[:, 1] - pose_teeth(lower, open_)[:, 1]).max() > 0.015


def test_eyes_turn_with_the_gaze(head, appearance):
    _, radius, straight = pose_eye(appearance.eyes[0], moved(head))
    assert np.allclose(straight, np.eye(3), atol=1e-3)
    assert 0.014 < radius < 0.019
    outwards = pose_eye(appearance.eyes[0], moved(head, eyeLookOutLeft=1.0))[2][:, 2]
    assert outwards[0] > 0.2  # the subject's left is +x
    assert pose_eye(appearance.eyes[0], moved(head, eyeLookUpLeft=1.0))[2][1, 2] > 0.1


def test_wrinkles_rest_at_the_neutral_and_grow_with_the_drive(head, appearance):
    wrinkles = appearance.wrinkles
    neutral = np.zeros(len(head.expression_names), np.float32)
    assert np.array_equal(wrinkles.amplitudes(neutral), wrinkles.rest)
    raised = neutral.copy()
    raised[head.expression_names.index("browInnerUp")] = 1
    moving = wrinkles.amplitudes(raised) - wrinkles.rest
    assert (moving > 0).sum() == 3  # the three forehead groups
    depth = wrinkle_height(wrinkles, raised, 256)
    assert -1.2e-3 < depth.min() < -1e-4
    assert np.abs(wrinkle_height(wrinkles, -raised, 256) - wrinkle_height(wrinkles, neutral, 256)).max() == 0


def test_too_many_coefficients_and_unknown_people_are_refused(head, assets):
    with pytest.raises(OptionError, match="coefficients"):
        make_appearance(head, PersonParameters(shape=(0.0,) * (len(head.shape_names) + 1)), 256, assets)
    with pytest.raises(OptionError, match="nobody"):
        make_appearance(head, PersonParameters(identity="nobody"), 256, assets)
