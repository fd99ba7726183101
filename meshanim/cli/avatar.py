"""`meshanim avatar`: mesh-bound Gaussian avatars."""

import sys
from collections.abc import Iterator
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Annotated

import numpy as np
from tqdm import tqdm
from tyro.conf import OmitArgPrefixes, Positional, arg

from meshanim.animator import AnimationOptions, Animator
from meshanim.audio import load_waveform
from meshanim.cli.animate import announce, check_size, heard_performance
from meshanim.errors import OptionError
from meshanim.files import check_writable
from meshanim.gaussians.avatar.evaluation import EvaluateAvatarOptions, evaluate_avatar
from meshanim.gaussians.avatar.fit import FitAvatarOptions, fit_avatar
from meshanim.gaussians.avatar.model import Avatar
from meshanim.gaussians.avatar.playback import avatar_template, play
from meshanim.gaussians.camera_paths import camera_path, read_camera_path
from meshanim.gaussians.cameras import Cameras
from meshanim.motion import MeshSequence
from meshanim.motion.blendshape_track import BlendshapeTrack

__all__ = ["COMMANDS", "RenderOptions", "render", "write_pictures"]

ENDINGS = (".mp4", ".png")


@dataclass(frozen=True)
class RenderOptions:
    """An avatar plays an animation or says a speech: a video with sound, or a contact sheet.

    Example: meshanim avatar render fitted/model --audio speech.wav --camera orbit -o talk.mp4
    """

    avatar: Positional[str]
    """Folder of an avatar: model/ of what `meshanim avatar fit` wrote."""
    motion: Path | None = None
    """Animation to play: an .npz that `meshanim animate` or `MeshSequence.save` wrote, of any topology, or a
    .csv with weights of the head's shapes (Audio2Face-3D's, or a recording of Live Link Face)."""
    audio: Path | None = None
    """Speech to say; beside --motion, the sound that goes with it."""
    camera: str = "front"
    """front, orbit (swings to both sides and back in 8 seconds), or a file in the layout of cameras.json with
    one camera or one a frame; FILE.json:NAME for one of several."""
    output: Annotated[Path, arg(aliases=["-o"])] = Path("avatar.mp4")
    """The ending chooses: mp4 (with sound) or png (contact sheet)."""
    size: int = 512
    """Pixels along the side, even; of a camera from a file, along the longer side."""
    background: tuple[float, float, float] | None = None
    """Red, green, blue within 0 to 1; what the avatar was fitted in front of, if not given."""
    head: str = ""
    """Where the head's file is, if it is not where the avatar was made."""
    model: str = "default"
    """Checkpoint that speech is animated by, as of `meshanim animate`."""
    performance: OmitArgPrefixes[AnimationOptions] = field(default_factory=AnimationOptions)


def render(options: RenderOptions) -> None:
    """Run the command."""
    _check(options)
    avatar = Avatar.from_pretrained(options.avatar, options.head)
    sequence = _sequence(avatar, options)
    cameras = _cameras(avatar, options, len(sequence), sequence.fps)
    frames = play(avatar, sequence, cameras, options.background)
    write_pictures(options.output, frames, sequence)


def write_pictures(output: Path, frames: Iterator[np.ndarray], sequence: MeshSequence) -> None:
    """Write pictures of an animation as mp4 with its sound, or as contact sheet, with a progress bar."""
    from meshanim.export import contact_sheet, write_png, write_video

    shown = tqdm(frames, total=len(sequence), desc="render", unit="frame", disable=not sys.stderr.isatty())
    if output.suffix.lower() == ".mp4":
        write_video(output, iter(shown), sequence.fps, sequence.audio)
    else:
        count = min(24, len(sequence))
        chosen = set(np.linspace(0, len(sequence) - 1, count).round().astype(int).tolist())
        kept = {index: frame for index, frame in enumerate(shown) if index in chosen}
        labels = [f"{(index + 0.5) / sequence.fps:.2f} s" for index in kept]
        write_png(output, contact_sheet(list(kept.values()), columns=6, labels=labels))
    announce(output, sequence)


def _check(options: RenderOptions) -> None:
    if options.output.suffix.lower() not in ENDINGS:
        raise OptionError(f"cannot write {options.output}: the ending must be one of {', '.join(ENDINGS)}")
    check_size(options.size)
    if options.motion is None and options.audio is None:
        raise OptionError("what is to be played? give --motion FILE.npz or --audio FILE.wav")
    if options.motion is not None:
        unused = _of_speech(options)
        if unused:
            raise OptionError(
                f"{', '.join(unused)}: how speech is animated; with --motion there is none to be"
            )
    if options.background is not None and not all(0 <= value <= 1 for value in options.background):
        raise OptionError(f"background must lie within 0 to 1, not {options.background}")
    check_writable(options.output)


def _of_speech(options: RenderOptions) -> list[str]:
    """Options that were given and that a motion has no use for; it knows `fps`."""
    usual = AnimationOptions()
    given = [] if options.model == RenderOptions(options.avatar).model else ["--model"]
    for option in fields(usual):
        value, default = (getattr(one, option.name) for one in (options.performance, usual))
        if option.name != "fps" and value is not default and value != default:
            given.append(f"--{option.name.replace('_', '-')}")
    return given


def _sequence(avatar: Avatar, options: RenderOptions) -> MeshSequence:
    speech = None if options.audio is None else load_waveform(options.audio, rate=None)
    if options.motion is not None:
        if options.motion.suffix.lower() == ".csv":
            sequence = BlendshapeTrack.load(options.motion).animate(avatar.head)
        else:
            sequence = MeshSequence.load(options.motion)
        sequence = replace(sequence, audio=speech)
        fps = options.performance.fps
        return sequence if fps is None else sequence.resampled(fps)
    assert speech is not None
    animator = Animator.from_pretrained(options.model, avatar.head)
    performance = heard_performance(animator, speech, options.performance)
    return animator(speech, performance, avatar_template(avatar), progress=sys.stderr.isatty())


def _cameras(avatar: Avatar, options: RenderOptions, frames: int, fps: float) -> Cameras:
    if ".json" not in options.camera:
        head = avatar_template(avatar)
        return camera_path(options.camera, head, frames, fps, options.size, options.size)
    cameras = read_camera_path(options.camera, frames)
    share = options.size / max(cameras.width, cameras.height)
    even = (max(2, 2 * round(share * side / 2)) for side in (cameras.width, cameras.height))
    return cameras.scaled(*even)


def _fit(options: FitAvatarOptions) -> None:
    print(fit_avatar(options, progress=sys.stderr.isatty()).table())
    print(f"wrote {options.output / 'model'}")


def _evaluate(options: EvaluateAvatarOptions) -> None:
    print(evaluate_avatar(options, progress=sys.stderr.isatty()).table())
    if options.lpips is None:
        print("LPIPS: not measured, no weights given (--lpips)")
    if options.pictures is not None:
        print(f"wrote sheets into {options.pictures}: truth, rendering, error times 4; eyes and mouth below")


COMMANDS = {"fit": _fit, "evaluate": _evaluate, "render": render}
