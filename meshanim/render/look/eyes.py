"""Eyes: a sphere with a corneal bulge, iris and sclera painted once in the eye's polar coordinates."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from meshanim.render.look.paint import smoothstep
from meshanim.render.look.person import EYE_COLORS, PersonParameters, srgb_to_linear

__all__ = [
    "IRIS_ANGLE",
    "IRIS_PLANE",
    "REFRACTIVE_INDEX",
    "SCLERA_ANGLE",
    "Eye",
    "EyeMaterial",
    "eye_mesh",
    "fit_sphere",
    "make_eye",
    "make_eye_material",
    "pose_eye",
    "similarity",
]

IRIS_ANGLE = 0.345
"""Half angle of the iris seen from the eye's centre: 5.7 mm on the 16.6 mm sphere of the default head."""
IRIS_PLANE = 0.925
"""Distance of the flat iris from the centre, in eye radii."""
REFRACTIVE_INDEX = 1.34
SCLERA_ANGLE = 1.95
"""The polar texture of the sclera reaches this angle from the gaze; the mesh ends there."""


@dataclass(frozen=True)
class EyeMaterial:
    """Textures of one eye; rows are the radius, columns the angle atan2(y, x) from -pi to pi (periodic).

    To shade a point q on the unit eye (gaze along +z) with theta = acos(q_z / |q|): the cornea's weight is
    1 - smoothstep(0.92, 1.12, theta / IRIS_ANGLE); its normal is q / |q| with x and y times
    1 + 0.75 weight, normalised; refract the view ray there by REFRACTIVE_INDEX, follow it to the plane
    z = IRIS_PLANE at point u; look up `iris` at (|u_xy| / sin IRIS_ANGLE, atan2(u_y, u_x)) and `sclera` at
    (theta / SCLERA_ANGLE, atan2(q_y, q_x)); blend by smoothstep(0.90, 1.10, theta / IRIS_ANGLE). Under the
    cornea diffuse light uses the concave normal (-0.75 u_x, -0.75 u_y, 1) with u over sin IRIS_ANGLE.

    Parameters
    ----------
    iris : (R, A, 3) float32
        Linear albedo over radius 0..1 of the iris disc, pupil included.
    sclera : (R, A, 3) float32
        Linear albedo over the polar angle 0..SCLERA_ANGLE.
    roughness : float
    """

    iris: Float[np.ndarray, "radii angles 3"]
    sclera: Float[np.ndarray, "radii angles 3"]
    roughness: float = 0.10


@dataclass(frozen=True)
class Eye:
    """One eye of a person.

    Parameters
    ----------
    material : EyeMaterial
    anchors : (m,) int64
        The eyeball's vertices in the head.
    rest : (m, 3) float32
        Their positions on the person's resting head.
    center : (3,) float32
        Centre of the sphere through `rest`.
    radius : float
        Its radius, metres.
    """

    material: EyeMaterial
    anchors: Int[np.ndarray, " anchors"]
    rest: Float[np.ndarray, "anchors 3"]
    center: Float[np.ndarray, " 3"]
    radius: float


def eye_mesh(rings: int = 30, segments: int = 56) -> tuple[np.ndarray, np.ndarray]:
    """Unit eye, gaze along +z: vertices (n, 3) float32, faces (f, 3) int32; a 2.6 % corneal bulge."""
    polar = np.linspace(0, 1, rings) ** 1.25 * SCLERA_ANGLE
    angle = np.arange(segments) / segments * 2 * np.pi
    theta, phi = np.meshgrid(polar, angle, indexing="ij")
    radius = 0.992 + 0.026 * (1 - smoothstep(0.12, 0.46, theta))
    unit = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1)
    row = np.arange(rings - 1)[:, None] * segments
    here = np.arange(segments)[None]
    there = (here + 1) % segments
    quads = np.stack(
        [row + here, row + segments + here, row + segments + there, row + there], axis=-1
    ).reshape(-1, 4)
    faces = np.concatenate([quads[:, [0, 1, 2]], quads[segments:, [0, 2, 3]]])
    vertices = (unit * radius[..., None]).reshape(-1, 3)
    return vertices.astype(np.float32), faces.astype(np.int32)


def fit_sphere(points: np.ndarray) -> tuple[np.ndarray, float]:
    """Least-squares sphere through points (n, 3): centre and radius."""
    points = np.asarray(points, float)
    system = np.concatenate([2 * points, np.ones((len(points), 1))], axis=1)
    solution = np.linalg.lstsq(system, (points**2).sum(1), rcond=None)[0]
    return solution[:3], float(np.sqrt(solution[3] + solution[:3] @ solution[:3]))


def similarity(source: np.ndarray, target: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Scale, rotation, translation: target = scale * rotation @ source + translation (Umeyama 1991).

    `geometry.align` for one set of points, twenty times faster: it runs for four parts of every frame drawn.
    """
    source, target = np.asarray(source, float), np.asarray(target, float)
    from_mean, to_mean = source.mean(0), target.mean(0)
    left, singular, right = np.linalg.svd((target - to_mean).T @ (source - from_mean))
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
    rotation = (left * sign) @ right
    scale = float((singular * sign).sum() / ((source - from_mean) ** 2).sum())
    return scale, rotation, to_mean - scale * rotation @ from_mean


def make_eye(anchors: np.ndarray, head_vertices: np.ndarray, material: EyeMaterial) -> Eye:
    """Measure an eye on a person's resting head (V, 3)."""
    rest = np.asarray(head_vertices)[anchors]
    center, radius = fit_sphere(rest)
    return Eye(material, anchors, rest.astype(np.float32), center.astype(np.float32), radius)


def pose_eye(
    eye: Eye, head_vertices: Float[np.ndarray, "head_vertices 3"]
) -> tuple[Float[np.ndarray, " 3"], float, Float[np.ndarray, "3 3"]]:
    """Centre, radius and rotation of an eye on a moved head; the gaze is the rotation's third column."""
    scale, rotation, translation = similarity(eye.rest, np.asarray(head_vertices)[eye.anchors])
    return scale * rotation @ eye.center + translation, scale * eye.radius, rotation


def make_eye_material(
    person: PersonParameters, side: int, radii: int = 96, angles: int = 512, pupil: float = 0.36
) -> EyeMaterial:
    """Paint iris fibres, collarette, limbus, pupil and the sclera's veins.

    Parameters
    ----------
    person : PersonParameters
        `eye_color` and `seed` matter.
    side : int
        0 left, 1 right: other fibres and veins.
    radii, angles : int
        Texture size.
    pupil : float
        Pupil radius as a share of the iris radius.
    """
    draws = np.random.default_rng([person.seed, 99, side])
    phi = (np.arange(angles) + 0.5) / angles * 2 * np.pi - np.pi
    radius = ((np.arange(radii) + 0.5) / radii)[:, None]
    coarse, medium, fine = (_periodic(draws, count) for count in (14, 46, 110))

    wobble = 0.05 * coarse(phi)[None]
    warped = radius + 0.5 * wobble * (radius - 0.4)
    fibres = 0.55 * fine(phi + 0.5 * warped + 0.15 * coarse(phi)) + 0.55 * medium(phi + 0.25 * warped)
    outer, inner = (srgb_to_linear(color) for color in EYE_COLORS[person.eye_color])
    blend = smoothstep(0.50, 0.60, warped + wobble)[..., None]
    iris = outer * (1 - blend) + inner * blend
    iris = iris * np.exp(0.55 * fibres * smoothstep(0.3, 0.55, warped))[..., None]
    iris = iris * (1 + 0.35 * np.exp(-(((warped - 0.52 - wobble) / 0.06) ** 2)))[..., None]
    iris = iris * (1 - 0.72 * smoothstep(0.80, 1.0, radius))[..., None]
    in_pupil = smoothstep(pupil + 0.03, pupil - 0.03, radius + 0.3 * wobble)[..., None]
    iris = iris * (1 - in_pupil) + 0.004 * in_pupil

    theta = (radius * SCLERA_ANGLE) + 0 * phi
    branch, bend = _periodic(draws, 60), _periodic(draws, 23)
    path = branch(phi + 0.22 * bend(phi + 3 * theta) * theta) + 0.3 * np.sin(9 * theta + 3 * phi)
    vein = np.exp(-9 * np.abs(path)) * smoothstep(0.55, 1.15, theta)
    rim = smoothstep(0.50, 1.15, theta)[..., None]
    sclera = np.array([0.55, 0.495, 0.452]) * (1 - 0.55 * rim * np.array([0.12, 0.55, 0.58]))
    sclera = sclera * (1 - 0.50 * vein[..., None] * np.array([0.1, 0.8, 0.75]))
    return EyeMaterial(np.ascontiguousarray(iris, np.float32), np.ascontiguousarray(sclera, np.float32))


def _periodic(draws: np.random.Generator, harmonics: int, samples: int = 4096):
    """A smooth random function of an angle, tabled."""
    order = np.arange(1, harmonics + 1)
    sine, cosine = draws.normal(size=(2, harmonics)) / order**0.3
    angle = np.arange(samples + 1) / samples * 2 * np.pi
    phase = angle[:, None] * order
    table = (np.sin(phase) @ sine + np.cos(phase) @ cosine) / np.sqrt(harmonics)

    def evaluate(at: np.ndarray) -> np.ndarray:
        return np.interp(np.mod(at, 2 * np.pi), angle, table)

    return evaluate
