"""Where MediaPipe's face mesh lies on the default head: makes landmarks.npz.

`python -m meshanim.render.landmarks_build` writes meshanim/heads/default/landmarks.npz. It needs
`pip install 'meshanim[video-pose]'`; nothing of that is needed to read the file.

Every person that ships is drawn in draft from several sides; MediaPipe finds its landmarks in the pictures,
each is seen on a triangle of the head, and the median of these points on the mean head is the landmark.
"""

from pathlib import Path

import igl
import numpy as np

from meshanim.files import written_whole
from meshanim.heads import load_head
from meshanim.motion.video_pose import FaceLandmarker
from meshanim.render.look import PEOPLE, make_appearance
from meshanim.render.rasterizer import rasterize
from meshanim.render.renderer import Renderer, head_camera

__all__ = ["build"]

SIDES = tuple((azimuth, elevation) for azimuth in (-0.35, 0.0, 0.35) for elevation in (-0.1, 0.1))
"""Radians: where the cameras stand."""
SIZE = 512
SHAPE = 0.002
"""Metres that a landmark of one person lies away from another's, if nothing moves."""


def build(path: Path) -> None:
    """Write `face` (L,), `barycentric` (L, 3), `tolerance` (L,) metres."""
    head = load_head("default")
    neutral, faces = head.mesh.vertices, head.mesh.faces
    met: list[np.ndarray] = []
    with FaceLandmarker() as find:
        for person in PEOPLE.values():
            appearance = make_appearance(head, person)
            for azimuth, elevation in SIDES:
                camera = head_camera(appearance, SIZE, SIZE, azimuth, elevation)
                renderer = Renderer(head, appearance, quality="draft", camera=camera)
                landmarks = find(renderer.frame(appearance.template))
                if landmarks is None:
                    continue
                # A landmark's pixel says which triangle it is on, and where.
                buffers = rasterize(appearance.template, faces, camera, cull_backfaces=True)
                column, row = np.clip(landmarks.astype(int), 0, SIZE - 1).T
                face, weights = buffers.face[row, column], buffers.barycentric[row, column]
                points = (neutral[faces[face]] * weights[..., None]).sum(1)
                met.append(np.where(face[:, None] >= 0, points, np.nan))
    seen = np.stack(met)
    middle = np.nanmedian(seen, axis=0)
    spread = np.nanmedian(np.linalg.norm(seen - middle, axis=-1), axis=0)
    _, face, closest = igl.point_mesh_squared_distance(middle, neutral, faces)
    corners = [np.ascontiguousarray(neutral[faces[face, k]]) for k in range(3)]
    barycentric = igl.barycentric_coordinates(np.ascontiguousarray(closest), *corners)
    moves = head.expression_directions.unflatten(1, (-1, 3)).norm(dim=2).numpy().max(0)
    moved = (moves[faces[face]] * barycentric).sum(1)
    tolerance = np.sqrt(SHAPE**2 + spread**2 + (moved / 2) ** 2)
    with written_whole(path) as temporary, open(temporary, "wb") as file:
        np.savez(
            file,
            face=face.astype(np.int32),
            barycentric=barycentric.astype(np.float32),
            tolerance=tolerance.astype(np.float32),
        )
    low, middling, high = 1000 * np.quantile(tolerance, [0, 0.5, 1])
    print(f"{len(met)} pictures, {len(face)} landmarks within {low:.1f}, {middling:.1f} to {high:.1f} mm")


if __name__ == "__main__":
    build(Path(__file__).parents[1] / "heads" / "default" / "landmarks.npz")
