import itertools
from dataclasses import replace

import numpy as np
import pytest

from meshanim.errors import OptionError
from meshanim.render.look import PEOPLE, find_person, make_appearance
from meshanim.render.look.person import skin_color


def shape_of(head, person):
    if person.identity:
        return person.identity_strength * head.person(person.identity)[0].numpy()
    return np.pad(person.shape, (0, len(head.shape_names) - len(person.shape)))


def test_there_are_twelve_and_no_two_share_seed_hair_and_eyes():
    assert len(PEOPLE) == 12
    assert len({person.seed for person in PEOPLE.values()}) == 12
    looks = {(p.hair, p.hair_color, p.eye_color, p.tone) for p in PEOPLE.values()}
    assert len(looks) == 12
    assert find_person("ANA") is PEOPLE["ana"]
    with pytest.raises(OptionError, match="zoe"):
        find_person("zoe")


def test_faces_differ_by_millimetres(head):
    """Root mean square distance of the faces' vertices after taking out their mean offset, each pair."""
    directions = head.shape_directions.numpy().reshape(len(head.shape_names), -1, 3)
    face = np.flatnonzero(head.masks["face"] > 0.5)
    heads = [np.tensordot(shape_of(head, person), directions[:, face], 1) for person in PEOPLE.values()]
    heads = [vertices - vertices.mean(0) for vertices in heads]
    apart = [np.sqrt(((a - b) ** 2).sum(1).mean()) for a, b in itertools.combinations(heads, 2)]
    assert min(apart) > 0.002


def test_any_two_people_differ_in_tone_or_hair():
    for one, two in itertools.combinations(PEOPLE.values(), 2):
        skin = np.abs(skin_color(one.tone, one.undertone) - skin_color(two.tone, two.undertone)).sum()
        hair = np.abs(np.subtract(one.hair_color, two.hair_color)).sum() + 0.6 * (one.hair != two.hair)
        assert skin + hair > 0.12, (one.name, two.name)


@pytest.mark.parametrize("name", ["chidi", "greta", "imani"])
def test_people_are_made_whole(head, assets, name):
    appearance = make_appearance(head, PEOPLE[name], 256, assets)
    kinds = {strands.kind for strands in appearance.strands}
    assert {"hair", "brow", "lash"} <= kinds
    for strands in appearance.strands:
        assert np.isfinite(strands.offsets).all()
        assert strands.normals.shape[1] <= 16  # what the renderer draws
        assert np.linalg.norm(strands.offsets, axis=2).max() < 0.45
        assert (strands.occlusion >= 0).all()
        assert (strands.occlusion <= 1).all()
        assert np.allclose(strands.barycentric.sum(1), 1, atol=1e-5)
    moved = np.linalg.norm(appearance.template - head.mesh.vertices, axis=1)
    assert moved.max() > 0.003


def test_half_the_identity_moves_the_head_half_as_far(head, assets):
    person = replace(PEOPLE["bruno"], rest_expression={})
    whole, half, none = (
        make_appearance(head, replace(person, identity_strength=share), 256, assets).template
        for share in (1.0, 0.5, 0.0)
    )
    assert np.allclose(half - none, 0.5 * (whole - none), atol=1e-6)
    assert np.abs(none - head.mesh.vertices).max() < 1e-6
    with pytest.raises(OptionError, match="identity_strength"):
        replace(person, identity_strength=1.2)
