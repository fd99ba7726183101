"""Moments of the demo, mesh beside avatar: python docs/draw_demo.py writes demo.jpg."""

from importlib.resources import as_file, files
from pathlib import Path

import numpy as np

from meshanim.cli.animate import AnimateOptions
from meshanim.cli.demo import CLIP, side_by_side
from meshanim.export import contact_sheet, write_png
from meshanim.gaussians.avatar import Avatar
from meshanim.heads import Head
from meshanim.motion import MeshSequence

SIZE = 320


def moments(sequence: MeshSequence, head: Head) -> dict[int, str]:
    """Frames to show: lips that part furthest, meet, lids that shut furthest, head that turns furthest."""
    assert head.lip_pairs is not None
    moves = sequence.vertices - sequence.mesh.vertices.astype(np.float32)
    lips = np.linalg.norm(np.diff(sequence.vertices[:, head.lip_pairs], axis=2)[:, :, 0], axis=2).mean(1)
    lids = moves[:, head.regions["eyelids"], 1].mean(1)
    spoken = slice(len(sequence) // 10, -len(sequence) // 10)
    first = spoken.indices(len(sequence))[0]
    turn = np.linalg.norm(sequence.pose, axis=1)
    found = {
        "lips apart": first + int(lips[spoken].argmax()),
        "lips closed": first + int(lips[spoken].argmin()),
        "blink": int(lids.argmin()),
        "head turned": int(turn.argmax()),
    }
    return {frame: f"{what}, {(frame + 0.5) / sequence.fps:.2f} s" for what, frame in found.items()}


def main() -> None:
    """The whole demo is drawn, and four of its pictures kept."""
    avatar = Avatar.from_pretrained("default")
    with as_file(files("meshanim").joinpath(CLIP)) as spoken:
        sequence, frames = side_by_side(AnimateOptions(spoken, person="", size=SIZE), avatar)
    chosen = moments(sequence, avatar.head)
    kept = {index: frame for index, frame in enumerate(frames) if index in chosen}
    sheet = contact_sheet([kept[index] for index in chosen], columns=2, labels=list(chosen.values()))
    write_png(Path(__file__).parent / "demo.jpg", sheet)


if __name__ == "__main__":
    main()
