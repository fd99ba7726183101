"""`meshanim demo`: a person says a sentence that ships with the package, as mesh and as Gaussians."""

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from importlib.resources import as_file, files
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
from jaxtyping import Float, UInt8
from tyro.conf import arg

from meshanim.cli.animate import AnimateOptions, animate, check_size, perform
from meshanim.errors import OptionError
from meshanim.files import check_writable
from meshanim.heads import DefaultHead, Head
from meshanim.motion import MeshSequence

if TYPE_CHECKING:
    from meshanim.gaussians.avatar.model import Avatar

__all__ = ["COMMANDS", "DemoOptions", "demo", "side_by_side"]

CLIP = "audio/clips/sense_and_sensibility.flac"
ENDINGS = (".mp4", ".png")
PERSON = "ana"
"""Who the mesh is where there is no avatar, or one of nobody known."""


@dataclass(frozen=True)
class DemoOptions:
    """A person says a recorded sentence, six seconds of a LibriVox reader: mesh left, Gaussian avatar right.

    Example: meshanim demo -o demo.mp4
    """

    output: Annotated[Path, arg(aliases=["-o"])] = Path("demo.mp4")
    """mp4 (with sound) or png (contact sheet); as of `meshanim animate` with --avatar none."""
    avatar: str = "default"
    """A Gaussian avatar, as of `meshanim animate`; none: the mesh alone."""
    person: str = ""
    """Who the mesh is, as of `meshanim animate`; the avatar's own person, if not given."""
    size: int = 512
    """Pixels along the side of each of the two pictures, even."""


def demo(options: DemoOptions) -> None:
    """Run the verb."""
    started = time.perf_counter()
    with as_file(files("meshanim").joinpath(CLIP)) as spoken:
        what = AnimateOptions(spoken, output=options.output, person=options.person, size=options.size)
        if options.avatar == "none":
            animate(replace(what, person=options.person or PERSON))
        else:
            _pair(what, options.avatar)
    print(f"took {time.perf_counter() - started:.1f} s; play {options.output}")


def _pair(options: AnimateOptions, source: str) -> None:
    from meshanim.cli.avatar import write_pictures
    from meshanim.gaussians.avatar.model import Avatar

    if options.output.suffix.lower() not in ENDINGS:
        raise OptionError(
            f"cannot write {options.output}: the ending must be one of {', '.join(ENDINGS)}; --avatar none, "
            "the mesh alone, knows more"
        )
    check_size(options.size)
    check_writable(options.output)
    sequence, frames = side_by_side(options, Avatar.from_pretrained(source))
    write_pictures(options.output, frames, sequence)


def side_by_side(
    options: AnimateOptions, avatar: "Avatar"
) -> tuple[MeshSequence, Iterator[UInt8[np.ndarray, "height width 3"]]]:
    """One performance by the mesh, on the left, and by an avatar, from one camera and on one background.

    Parameters
    ----------
    options : AnimateOptions
        What is said by whom; where no person is given, the avatar's, if it is one of the twelve.
    avatar : Avatar
        Gets the moves, and has its eyes where the mesh has them: one of the same person the very vertices.

    Returns
    -------
    sequence, frames
        What is performed, and a picture a frame, `size` pixels high and twice as wide.
    """
    from meshanim.gaussians.avatar.playback import avatar_template, play
    from meshanim.gaussians.camera_paths import still_camera
    from meshanim.render import head_camera, portrait_camera
    from meshanim.render.lighting import backdrop, developed

    scene, sequence = perform(replace(options, person=options.person or _person(avatar)))
    size, head = options.size, scene.animator.head
    if scene.appearance is not None:
        camera = head_camera(scene.appearance, size, size)
    else:
        camera = portrait_camera(sequence.mesh.vertices, size, size)
    moved = camera
    if head is not None:
        shift = np.eye(4)
        shift[:3, 3] = _eyes(head, sequence.mesh.vertices) - _eyes(avatar.head, avatar_template(avatar))
        moved = replace(camera, world_to_camera=camera.world_to_camera @ shift)
    behind = developed(backdrop(size, size))
    pairs = zip(
        scene.frames(sequence, size, camera),
        play(avatar, sequence, still_camera(moved, len(sequence)), behind),
    )
    return sequence, (np.concatenate(pair, 1) for pair in pairs)


def _person(avatar: "Avatar") -> str:
    from meshanim.render.look import PEOPLE

    name = avatar.config.name.lower()
    return name if name in PEOPLE and isinstance(avatar.head, DefaultHead) else PERSON


def _eyes(head: Head, vertices: Float[np.ndarray, "vertices 3"]) -> Float[np.ndarray, " 3"]:
    """The point between the eyes; the middle of a head that has none."""
    eyes = head.regions["eyes"]
    return vertices[eyes].mean(0) if len(eyes) else (vertices.min(0) + vertices.max(0)) / 2


COMMANDS = demo
