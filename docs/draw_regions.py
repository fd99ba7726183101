"""Draw the named regions of the default head: python docs/draw_regions.py writes docs/regions.jpg."""

from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from meshanim.heads import load_head
from meshanim.render import portrait_camera, render_mesh

# Later regions are painted over earlier ones.
COLORS = {
    "scalp": (0.45, 0.50, 0.75),
    "neck": (0.55, 0.70, 0.55),
    "face": (0.90, 0.78, 0.66),
    "ears": (0.85, 0.60, 0.35),
    "nose": (0.95, 0.85, 0.30),
    "lips": (0.85, 0.25, 0.30),
    "eyelids": (0.35, 0.70, 0.75),
    "eyes": (0.95, 0.95, 0.95),
    "teeth": (0.98, 0.98, 0.85),
    "tongue": (0.95, 0.45, 0.60),
}
OVERLAPPING = {"upper_face": (0.60, 0.40, 0.80), "jaw": (0.30, 0.65, 0.45)}
SIZE = 420


def main() -> None:
    """Four views in a row: two with regions that tile the head, two with those that lie across them."""
    head = load_head("default")
    rest = head()[0].numpy()
    opened = head.deform(expression=head.expression({"jawOpen": 0.6}))[0].numpy()
    panels = []
    for colors, vertices, azimuth in (
        (COLORS, rest, 0.6),
        (COLORS, opened, 0.0),
        (OVERLAPPING, rest, 0.6),
        (OVERLAPPING, rest, 0.0),
    ):
        paint = np.full((head.n_vertices, 3), 0.72)
        for name, color in colors.items():
            paint[head.regions[name]] = color
        camera = portrait_camera(rest, SIZE, SIZE, azimuth=azimuth)
        picture = Image.fromarray(render_mesh(vertices, head.mesh, camera, paint))
        draw = ImageDraw.Draw(picture)
        for row, (name, color) in enumerate(colors.items()):
            top = 8 + 15 * row
            draw.rectangle((8, top, 20, top + 10), fill=tuple(int(255 * value) for value in color))
            draw.text((26, top - 1), name, fill=(255, 255, 255), stroke_width=1, stroke_fill=(0, 0, 0))
        panels.append(np.asarray(picture))
    Image.fromarray(np.concatenate(panels, axis=1)).save(Path(__file__).parent / "regions.jpg", quality=88)


if __name__ == "__main__":
    main()
