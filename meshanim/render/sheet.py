"""A contact sheet of the renderer: python -m meshanim.render.sheet OUT.jpg"""

import argparse
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageDraw

from meshanim.files import written_whole
from meshanim.heads import DefaultHead, HeadParameters, load_head
from meshanim.render.clay import render_mesh
from meshanim.render.look import make_appearance
from meshanim.render.look.appearance import Appearance
from meshanim.render.look.people import find_person
from meshanim.render.renderer import Renderer, head_camera

__all__ = ["contact_sheet"]

_BOTH = ("Left", "Right")
EXPRESSIONS: dict[str, dict[str, float]] = {
    "open": {"jawOpen": 0.6},
    "smile": {f"{name}{side}": 0.7 for name in ("mouthSmile", "cheekSquint") for side in _BOTH},
    "blink": {f"eyeBlink{side}": 1.0 for side in _BOTH},
    "surprise": {"browInnerUp": 0.9, "jawOpen": 0.3, "browOuterUpLeft": 0.9, "browOuterUpRight": 0.9},
}


def _expressive(head: DefaultHead, appearance: Appearance, weights: dict[str, float]) -> np.ndarray:
    shape = torch.from_numpy(appearance.shape)[None]
    with torch.no_grad():
        moved = head(HeadParameters(shape=shape, expression=head.expression(weights)))
        rest = head(HeadParameters(shape=shape))
    return appearance.template + (moved - rest)[0].numpy()


def _region_picture(renderer: Renderer, vertices: np.ndarray) -> np.ndarray:
    """Regions in colours of equal brightness, shaded by the normals."""
    maps = renderer.maps(vertices)
    hue = np.arange(len(maps.region_names)) * 0.618 * 2 * np.pi
    palette = 0.6 + 0.35 * np.cos(hue[:, None] + np.array([0.0, 2.1, 4.2]))
    color = palette[np.maximum(maps.region, 0)] * (0.55 + 0.45 * maps.normal[..., 2:])
    return np.where(maps.mask[..., None], 255 * np.clip(color, 0, 1), 90).astype(np.uint8)


def contact_sheet(people: tuple[str, ...] = ("ana", "chidi"), size: int = 320) -> np.ndarray:
    """A row a person: clay, draft, full, regions; then full quality in four expressions.

    Parameters
    ----------
    people : tuple of str
        Names in `meshanim.render.look.people.PEOPLE`.
    size : int
        Pixels a tile.

    Returns
    -------
    (H, W, 3) uint8.
    """
    head = load_head("default")
    rows = []
    for name in people:
        appearance = make_appearance(head, find_person(name))
        camera = head_camera(appearance, size, size, azimuth=np.radians(16))
        rest = _expressive(head, appearance, {"lipSeal": 1.0})
        draft, full = (Renderer(head, appearance, quality=q, camera=camera) for q in ("draft", "full"))
        tiles = {
            "clay": render_mesh(rest, head.mesh, camera),
            "draft": draft.frame(rest),
            "full": full.frame(rest),
            "regions": _region_picture(full, rest),
        }
        for label, weights in EXPRESSIONS.items():
            moved = _expressive(head, appearance, weights)
            tiles[label] = full.frame(moved, head.expression(weights)[0].numpy())
        labelled = [_labelled(tile, label) for label, tile in tiles.items()]
        rows += [np.concatenate(labelled[:4], axis=1), np.concatenate(labelled[4:], axis=1)]
    return np.concatenate(rows)


def _labelled(tile: np.ndarray, label: str) -> np.ndarray:
    image = Image.fromarray(tile)
    ImageDraw.Draw(image).text((8, 6), label, fill=(235, 235, 235))
    return np.asarray(image)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("output", type=Path, help="a .jpg or .png file")
    parser.add_argument("--people", nargs="+", default=["ana", "chidi"])
    parser.add_argument("--size", type=int, default=320, help="pixels a tile")
    options = parser.parse_args()
    sheet = Image.fromarray(contact_sheet(tuple(options.people), options.size))
    with written_whole(options.output) as temporary:
        sheet.save(temporary, quality=88)


if __name__ == "__main__":
    main()
