"""`meshanim demo`: a talking head that says a recorded sentence that ships with the package."""

import time
from dataclasses import dataclass
from importlib.resources import as_file, files
from pathlib import Path
from typing import Annotated

import numpy as np
from tyro.conf import arg

from meshanim.cli.animate import AnimateOptions, animate, perform
from meshanim.files import check_writable

__all__ = ["COMMANDS", "DemoOptions", "demo", "side_by_side"]

CLIP = "audio/clips/sense_and_sensibility.flac"


@dataclass(frozen=True)
class DemoOptions:
    """A talking head says a recorded sentence: six seconds of a LibriVox reader.

    Example: meshanim demo -o demo.mp4
    """

    output: Annotated[Path, arg(aliases=["-o"])] = Path("demo.mp4")
    """As of `meshanim animate`."""
    person: str = "ana"
    """As of `meshanim animate`."""
    size: int = 512
    """As of `meshanim animate`."""
    avatar: str | None = None
    """A Gaussian avatar that speaks beside the mesh, as of `meshanim animate`."""


def demo(options: DemoOptions) -> None:
    """Run the verb."""
    started = time.perf_counter()
    with as_file(files("meshanim").joinpath(CLIP)) as speech:
        what = AnimateOptions(speech, options.output, person=options.person, size=options.size)
        if options.avatar is None:
            animate(what)
        else:
            side_by_side(what, options.avatar)
    print(f"took {time.perf_counter() - started:.1f} s; play {options.output}")


def side_by_side(options: AnimateOptions, avatar: str) -> None:
    """A video of one performance by the mesh, on the left, and by an avatar."""
    from meshanim.cli.avatar import write_pictures
    from meshanim.gaussians.avatar.model import Avatar
    from meshanim.gaussians.avatar.playback import avatar_template, play
    from meshanim.gaussians.camera_paths import camera_path

    check_writable(options.output)
    gaussian = Avatar.from_pretrained(avatar)
    scene, sequence = perform(options)
    size = options.size
    cameras = camera_path("front", avatar_template(gaussian), len(sequence), sequence.fps, size, size)
    pairs = zip(scene.frames(sequence, size), play(gaussian, sequence, cameras))
    write_pictures(options.output, (np.concatenate(pair, 1) for pair in pairs), sequence)


COMMANDS = demo
