"""A contact sheet of captures: python docs/draw_capture.py writes capture.jpg."""

import tempfile
from pathlib import Path

import numpy as np
from PIL import Image

from meshanim.datasets import Capture, open_capture
from meshanim.datasets.synthetic.capture import CaptureOptions, synthesize_capture
from meshanim.datasets.synthetic.corpus import SynthesizeOptions
from meshanim.render import Camera, render_mesh

PEOPLE = ("bruno", "imani", "lena")
SIZE, COLUMNS = 256, 8
COLORS = np.array(
    [
        *((40, 40, 40), (120, 90, 60), (70, 70, 170), (230, 180, 150)),
        *((220, 60, 80), (250, 250, 250), (60, 200, 120)),
    ],
    np.uint8,
)


def rig_rows(capture: Capture, frame: int) -> list[np.ndarray]:
    """One frame from all 16 cameras."""
    pictures = [capture[index].image for index, view in enumerate(capture.views) if view.timestep == frame]
    return [np.concatenate(pictures[start : start + COLUMNS], axis=1) for start in (0, COLUMNS)]


def layer_row(capture: Capture, chosen: tuple[int, int]) -> np.ndarray:
    """Image, mask, regions and the mesh to bind to, of two views."""
    tiles = []
    for index in chosen:
        view, picture = capture.views[index], capture[index]
        camera = Camera(view.world_to_camera, view.intrinsics, view.width, view.height)
        assert picture.mask is not None
        assert picture.regions is not None
        tiles += [picture.image, np.repeat(picture.mask[..., None], 3, axis=2), COLORS[picture.regions]]
        tiles.append(render_mesh(capture.vertices(view.timestep).numpy(), capture.mesh, camera))
    return np.concatenate(tiles, axis=1)


def main() -> None:
    """The first person from all cameras; then all three in layers."""
    with tempfile.TemporaryDirectory() as folder:
        corpus = SynthesizeOptions(Path(folder) / "capture", sentences=2)
        folders = synthesize_capture(corpus, CaptureOptions(size=SIZE, frames=4, names=PEOPLE))
        captures = {path.name: open_capture(path) for path in folders}
        rows = rig_rows(captures[PEOPLE[0]], 1)
        for name in PEOPLE:
            capture = captures[name]
            held_out = capture.split("novel_expression")[0]
            rows.append(layer_row(capture, (capture.split("train")[20], held_out)))
        sheet = Image.fromarray(np.concatenate(rows))
    sheet = sheet.resize((COLUMNS * 168, len(rows) * 168), Image.Resampling.LANCZOS)
    sheet.save(Path(__file__).parent / "capture.jpg", quality=88)


if __name__ == "__main__":
    main()
