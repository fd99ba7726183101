"""`meshanim demo`: a talking head that says a recorded sentence that ships with the package."""

import time
from dataclasses import dataclass
from importlib.resources import as_file, files
from pathlib import Path
from typing import Annotated

from tyro.conf import arg

from meshanim.cli.animate import AnimateOptions, animate

__all__ = ["COMMANDS", "DemoOptions", "demo"]

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


def demo(options: DemoOptions) -> None:
    """Run the verb."""
    started = time.perf_counter()
    with as_file(files("meshanim").joinpath(CLIP)) as speech:
        animate(AnimateOptions(speech, options.output, person=options.person, size=options.size))
    print(f"took {time.perf_counter() - started:.1f} s; play {options.output}")


COMMANDS = demo
