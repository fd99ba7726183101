"""docs/blendshapes.jpg: a sentence on the default head, and its weights replayed by another mesh.

python docs/draw_blendshapes.py
"""

from importlib.resources import as_file, files
from pathlib import Path

import numpy as np
from PIL import Image

from meshanim import Animator
from meshanim.cli.demo import CLIP
from meshanim.geometry import decimate
from meshanim.heads import load_head, rig_head
from meshanim.motion import personal_shapes
from meshanim.motion.solve_sequence import solve_sequence
from meshanim.render import portrait_camera, render_mesh

SIZE, FRAMES = 360, (10, 30, 52, 64, 80, 145)


def main() -> None:
    head = load_head("default")
    ana, other = (head.template(head.person(name)).numpy()[0] for name in list(head.people)[:4:3])
    with as_file(files("meshanim").joinpath(CLIP)) as clip:
        talk = Animator.from_pretrained("default")(clip, template=ana)
    solved = solve_sequence(talk, head)
    coarse = decimate(head.mesh, 6000)
    character = rig_head(personal_shapes(head, coarse.mesh.with_vertices(coarse.operator @ other)))
    rows = []
    for sequence in (talk, solved.motion, solved.track.animate(character)):
        camera = portrait_camera(sequence.mesh.vertices, SIZE, SIZE)
        row = [render_mesh(sequence.vertices[frame], sequence.mesh, camera) for frame in FRAMES]
        rows.append(np.hstack([image[80:300, 80:280] for image in row]))
    Image.fromarray(np.vstack(rows)).save(Path(__file__).with_name("blendshapes.jpg"), quality=85)


if __name__ == "__main__":
    main()
