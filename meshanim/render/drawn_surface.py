"""`drawn_surface`: what the renderer draws of a person, as a mesh that the head carries."""

import numpy as np
import scipy.sparse as sp
from jaxtyping import Bool

from meshanim.errors import OptionError
from meshanim.geometry import TriangleMesh, decimate
from meshanim.heads import DefaultHead, HeadSurface
from meshanim.heads.surface import RigidPart
from meshanim.render.look import Appearance, Surface, eye_mesh
from meshanim.render.scene import MOUTH_ISLAND, NECK_ISLAND

__all__ = ["DETAILS", "drawn_surface"]

DETAILS = ("coarse", "fine")
TOOTH_FACES = 1080
EYE = (14, 26)
"""Rings and segments of a coarse eye."""


def drawn_surface(head: DefaultHead, appearance: Appearance, detail: str = "coarse") -> HeadSurface:
    """The triangles that pictures of a person show: skin, tongue, teeth, eyes.

    Skin and tongue are one Catmull-Clark step of the head's quads. Every vertex of the result lies on the
    drawn surface at any pose; at "fine", every triangle does.

    Parameters
    ----------
    head : DefaultHead
    appearance : Appearance
        The person: teeth and eyes are theirs.
    detail : str
        "coarse": two triangles a quad of the head, their corners moved to where the subdivided surface has
        them, without the eye sockets; teeth decimated; eyes of 14 rings. About 11,600 triangles. "fine":
        what is drawn, 60,844.

    Raises
    ------
    OptionError
        If `detail` is neither.
    """
    if detail not in DETAILS:
        raise OptionError(f"detail must be {' or '.join(DETAILS)}, not '{detail}'")
    coarse = detail == "coarse"
    faces: dict[str, np.ndarray] = {}
    operators, count = [], 0
    for name, surface in (("skin", appearance.surface), ("tongue", appearance.tongue)):
        if coarse:
            quads = head.parts[name].quads[_in_sight(surface)]
            used, quads = np.unique(quads, return_inverse=True)
            # The first rows of a Catmull-Clark step are the old vertices, moved onto the new surface.
            rows = np.searchsorted(np.unique(head.parts[name].quads), used)
            operators.append(surface.operator[rows])
            faces[name] = quads.reshape(-1, 4)[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3) + count
        else:
            operators.append(surface.operator)
            faces[name] = surface.faces.astype(np.int64) + count
        count += operators[-1].shape[0]
    rigid = []
    for jaw in appearance.teeth:
        mesh = TriangleMesh(jaw.vertices.astype(np.float64), jaw.faces)
        if coarse:
            mesh = decimate(mesh, TOOTH_FACES).mesh
        rigid.append(RigidPart(jaw.anchors, jaw.rest, mesh.vertices.astype(np.float32)))
        faces[f"{jaw.jaw}_teeth"] = mesh.faces + count
        count += mesh.n_vertices
    unit, eye_faces = eye_mesh(*EYE) if coarse else eye_mesh()
    for name, eye in zip(("left_eye", "right_eye"), appearance.eyes):
        rigid.append(RigidPart(eye.anchors, eye.rest, (unit * eye.radius + eye.center).astype(np.float32)))
        faces[name] = eye_faces.astype(np.int64) + count
        count += len(unit)
    return HeadSurface(
        np.concatenate(list(faces.values())),
        sp.csr_array(sp.vstack(operators)),
        rigid,
        {name: len(part) for name, part in faces.items()},
    )


def _in_sight(surface: Surface) -> Bool[np.ndarray, " quads"]:
    """Which quads of the part are not deep in an eye socket: those that touch other skin are kept."""
    count = len(surface.faces) // 2
    corners = np.concatenate([surface.faces[:count], surface.faces[count:, 2:]], axis=1)
    socket = surface.island[:count] > MOUTH_ISLAND
    socket &= surface.island[:count] < NECK_ISLAND
    outside = np.zeros(surface.operator.shape[0], bool)
    outside[corners[~socket]] = True
    # Four fine quads lie in each old one.
    return (outside[corners].any(1) | ~socket).reshape(-1, 4).any(1)
