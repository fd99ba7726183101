from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import ConvexHull, cKDTree

from meshanim.render.look import PEOPLE, make_appearance
from meshanim.render.look.strands import strand_points
from meshanim.render.look.surface import vertex_normals


def hair_points(appearance):
    skin = appearance.surface.vertices(appearance.template)
    groups = [group for group in appearance.strands if group.kind == "hair"]
    return skin, [strand_points(group, skin, appearance.surface.faces) for group in groups]


@pytest.mark.parametrize("name", ["ana", "mei", "greta", "lena"])
def test_straight_hair_covers_the_ears(head, assets, name):
    """No point of a hair lies in an ear's convex hull, and from the side most of the ear is behind hair."""
    appearance = make_appearance(head, PEOPLE[name], 256, assets)
    skin, groups = hair_points(appearance)
    points = np.concatenate([group[:, 1:].reshape(-1, 3) for group in groups])
    for side in (1, -1):
        ear = skin[(assets.ground.ears > 0.3) & (side * skin[:, 0] > 0)]
        hull = ConvexHull(ear).equations
        assert (points @ hull[:, :3].T + hull[:, 3]).max(1).min() > 0
        outside = points[side * points[:, 0] > 0.055]
        distance, nearest = cKDTree(outside[:, 1:]).query(ear[:, 1:])
        assert np.mean((distance < 0.003) & (side * (outside[nearest] - ear)[:, 0] > 0)) > 0.8


def test_hair_lies_flat_beside_the_parting(head, assets):
    """Higher on the sides than along the parting line, where it stays within 4 mm of the head."""
    person = replace(PEOPLE["lena"], identity_strength=0.0)
    appearance = make_appearance(head, person, 256, assets)
    skin, (points,) = hair_points(appearance)
    tree, normals = cKDTree(skin), vertex_normals(skin, appearance.surface.faces)
    near = np.abs(points[:, 0, 0] - person.part_side) < 0.006
    high = points[:, 0, 1] > 0.12
    start = points[near & high, 1:3].reshape(-1, 3)
    index = tree.query(start)[1]
    height = ((start - skin[index]) * normals[index]).sum(1)
    assert np.quantile(height, 0.9) < 0.004
