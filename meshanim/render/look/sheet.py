"""Contact sheets of the people: python -m meshanim.render.look.sheet people -o people.jpg"""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import torch
import tyro
from PIL import Image, ImageDraw
from tqdm import tqdm

from meshanim.files import written_whole
from meshanim.heads import DefaultHead, HeadParameters, load_head
from meshanim.render.camera import portrait_camera
from meshanim.render.look.appearance import Appearance, make_appearance
from meshanim.render.look.assets import look_assets
from meshanim.render.look.people import PEOPLE, find_person
from meshanim.render.renderer import Renderer, head_camera

__all__ = ["EXPRESSIONS", "closeup_sheet", "expression_sheet", "people_sheet", "pose_person"]


def _both(**weights: float) -> dict[str, float]:
    return {f"{name}{side}": weight for name, weight in weights.items() for side in ("Left", "Right")}


EXPRESSIONS: dict[str, dict[str, float]] = {
    "neutral": {},
    "smile": _both(mouthSmile=0.75, cheekSquint=0.5),
    "grin": {
        **_both(mouthSmile=0.7, mouthUpperUp=0.5, mouthLowerDown=0.25, cheekSquint=0.7),
        "jawOpen": 0.06,
        "lipSeal": 0.0,
    },
    "open": {"jawOpen": 0.7, "lipSeal": 0.0},
    "blink": _both(eyeBlink=1.0),
    "surprise": {
        **_both(browOuterUp=0.9, eyeWide=0.8),
        "browInnerUp": 0.9,
        "jawOpen": 0.35,
        "lipSeal": 0.0,
    },
    "anger": _both(browDown=1.0, eyeSquint=0.4, noseSneer=0.5, mouthPress=0.5),
    "pucker": {"mouthPucker": 0.9},
}


def pose_person(
    head: DefaultHead, appearance: Appearance, weights: Mapping[str, float]
) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) and expression weights (E,) of a person; lips closed unless `lipSeal` is given."""
    weights = {"lipSeal": 1.0, **weights}
    rest = appearance.person.rest_expression
    total = {name: weights.get(name, 0.0) + rest.get(name, 0.0) for name in {**weights, **rest}}
    parameters = HeadParameters(
        shape=torch.from_numpy(appearance.shape)[None], expression=head.expression(total)
    )
    with torch.no_grad():
        vertices = head(parameters)[0].numpy()
    return vertices, head.expression(weights)[0].numpy()


def people_sheet(
    head: DefaultHead, names: list[str], size: int = 320, columns: int = 6, texels: int = 1024
) -> np.ndarray:
    """Every person from the front and from the side, an image (H, W, 3) uint8."""
    assets = look_assets(head, texels)
    tiles = []
    for name in tqdm(names, unit="person"):
        appearance = make_appearance(head, find_person(name), texels, assets)
        vertices, expression = pose_person(head, appearance, {})
        for azimuth in (-0.17, 0.70):
            camera = head_camera(appearance, size, size, azimuth, 0.03)
            renderer = Renderer(head, appearance, camera=camera)
            tiles.append(_label(renderer.frame(vertices, expression), appearance.person.name))
    return _tiled(tiles, columns)


def expression_sheet(head: DefaultHead, names: list[str], size: int = 320) -> np.ndarray:
    """Each person in each of `EXPRESSIONS`, a row a person."""
    assets = look_assets(head)
    tiles = []
    for name in tqdm(names, unit="person"):
        appearance = make_appearance(head, find_person(name), assets=assets)
        renderer = Renderer(head, appearance, camera=head_camera(appearance, size, size, 0.24, 0.02))
        for title, weights in EXPRESSIONS.items():
            tiles.append(_label(renderer.frame(*pose_person(head, appearance, weights)), title))
    return _tiled(tiles, len(EXPRESSIONS) // 2)


def closeup_sheet(head: DefaultHead, names: list[str], size: int = 320) -> np.ndarray:
    """Eye, shut eye, mouth and open mouth of each person."""
    assets = look_assets(head)
    tiles = []
    for name in tqdm(names, unit="person"):
        appearance = make_appearance(head, find_person(name), assets=assets)
        eye = appearance.eyes[0].center + np.array([0, 0.004, 0.01])
        mouth = np.array([0, appearance.template[head.lip_pairs.ravel(), 1].mean(), appearance.mouth_front])
        for center, reach, azimuth, title in (
            (eye, 0.026, 0.17, "neutral"),
            (eye, 0.026, 0.17, "blink"),
            (mouth, 0.034, 0.0, "neutral"),
            (mouth, 0.034, 0.35, "grin"),
            (mouth, 0.034, 0.0, "open"),
            (mouth, 0.034, 0.7, "open"),
        ):
            corners = center + reach * np.array([[-1, -1, 0], [1, 1, 0], [-1, 1, 0], [1, -1, 0]])
            camera = portrait_camera(corners, size, size, azimuth, 0.0, np.radians(9.0))
            renderer = Renderer(head, appearance, camera=camera)
            vertices, expression = pose_person(head, appearance, EXPRESSIONS[title])
            tiles.append(renderer.frame(vertices, expression))
    return _tiled(tiles, 6)


def _label(image: np.ndarray, text: str) -> np.ndarray:
    picture = Image.fromarray(image)
    ImageDraw.Draw(picture).text((8, 6), text, fill=(235, 235, 235))
    return np.asarray(picture)


def _tiled(tiles: list[np.ndarray], columns: int) -> np.ndarray:
    blank = [np.zeros_like(tiles[0])] * (-len(tiles) % columns)
    tiles = [*tiles, *blank]
    return np.concatenate(
        [np.concatenate(tiles[start : start + columns], 1) for start in range(0, len(tiles), columns)]
    )


def main(
    kind: Annotated[Literal["people", "expressions", "closeups"], tyro.conf.Positional],
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])],
    people: tuple[str, ...] = tuple(PEOPLE),
    size: int = 320,
) -> None:
    """Write a contact sheet.

    Parameters
    ----------
    kind
        What to show.
    output
        Picture file, .jpg or .png.
    people
        Names of the people.
    size
        Pixels of a tile.
    """
    head = load_head("default")
    sheet = {"people": people_sheet, "expressions": expression_sheet, "closeups": closeup_sheet}[kind]
    image = Image.fromarray(sheet(head, list(people), size))
    with written_whole(output) as path:
        image.save(path, quality=88)


if __name__ == "__main__":
    tyro.cli(main)
