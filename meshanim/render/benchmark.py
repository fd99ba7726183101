"""How many frames a second the renderer draws."""

import time
from collections import deque

import numpy as np
import torch

from meshanim.heads import DefaultHead, HeadParameters, load_head
from meshanim.motion import MeshSequence
from meshanim.render.look import PersonParameters, make_appearance
from meshanim.render.look.appearance import Appearance
from meshanim.render.look.people import find_person
from meshanim.render.sequence import render_sequence
from meshanim.results import Results

__all__ = ["nodding_sequence", "run"]


def nodding_sequence(
    head: DefaultHead, appearance: Appearance, frames: int, fps: float = 30.0
) -> MeshSequence:
    """A person who talks without words, blinks and nods: motion that touches all of the renderer."""
    seconds = np.arange(frames) / fps
    weights = np.zeros((frames, len(head.expression_names)), np.float32)
    curves = {
        "jawOpen": 0.25 * (1 - np.cos(2 * np.pi * 3.1 * seconds)) / 2,
        "mouthSmileLeft": 0.5 + 0.5 * np.sin(2 * np.pi * 0.4 * seconds),
        "mouthSmileRight": 0.5 + 0.5 * np.sin(2 * np.pi * 0.4 * seconds),
        "browInnerUp": np.clip(np.sin(2 * np.pi * 0.3 * seconds), 0, 1),
        "eyeBlinkLeft": np.clip(np.sin(2 * np.pi * 0.6 * seconds) * 8 - 7, 0, 1),
        "eyeBlinkRight": np.clip(np.sin(2 * np.pi * 0.6 * seconds) * 8 - 7, 0, 1),
    }
    for name, curve in curves.items():
        weights[:, head.expression_names.index(name)] = curve
    with torch.no_grad():
        rest = head(HeadParameters(shape=torch.from_numpy(appearance.shape)[None]))
        moved = head(
            HeadParameters(
                shape=torch.from_numpy(appearance.shape)[None], expression=torch.from_numpy(weights)
            )
        )
    vertices = appearance.template + (moved - rest).numpy()
    pose = np.stack([0.10 * np.sin(2 * np.pi * 0.5 * seconds), 0.15 * np.sin(seconds), 0 * seconds], axis=1)
    mesh = head.mesh.with_vertices(appearance.template)
    return MeshSequence(vertices.astype(np.float32), fps, mesh, pose.astype(np.float32))


def run(
    frames: int = 60,
    size: int = 512,
    person: PersonParameters | str = "ana",
    workers: tuple[int, ...] = (1, 2),
) -> Results:
    """Frames a second of draft and full quality, motion to finished picture; pictures are not written.

    Parameters
    ----------
    frames : int
        Measured a case, after four that warm up.
    size : int
        Pixels a side.
    person : PersonParameters or str
        Hair costs; "ana" has long hair.
    workers : tuple of int
        Numbers of frames drawn at the same time.
    """
    results = Results("render")
    head = load_head("default")
    chosen = find_person(person) if isinstance(person, str) else person
    start = time.perf_counter()
    appearance = make_appearance(head, chosen)
    results.add("person", "make_appearance", "time", time.perf_counter() - start, "s")
    sequence = nodding_sequence(head, appearance, frames + 4)
    for quality in ("draft", "full"):
        for count in workers:
            pictures = render_sequence(sequence, head, appearance, size, size, quality, workers=count)
            for _ in range(4):
                next(pictures)
            start, work = time.perf_counter(), time.process_time()
            deque(pictures, maxlen=0)
            rate = frames / (time.perf_counter() - start)
            work = 1000 * (time.process_time() - work) / frames
            name = f"{count} worker{'s' if count > 1 else ''}"
            results.add(f"{quality} {size}x{size}", name, "rate", rate, "frames/s")
            results.add(f"{quality} {size}x{size}", name, "processor time a frame", work, "ms")
    return results


if __name__ == "__main__":
    print(run().table())
