"""`meshanim animate`: speech in; a video, glTF, npz or contact sheet of a talking head out."""

import sys
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import torch
from tqdm import tqdm
from tyro.conf import OmitArgPrefixes, Positional, arg

from meshanim.animator import AnimationOptions, Animator
from meshanim.audio import Waveform, load_waveform
from meshanim.errors import OptionError
from meshanim.export.usd import USD_ENDINGS
from meshanim.files import check_writable
from meshanim.heads import DefaultHead, Head
from meshanim.motion import MeshSequence
from meshanim.motion.blendshape_csv import CsvForm
from meshanim.motion.blendshape_solver import SolverOptions
from meshanim.motion.blendshape_track import BlendshapeTrack
from meshanim.motion.solve_sequence import arkit_only, solve_sequence
from meshanim.render import Camera
from meshanim.render.look import Appearance, find_person, make_appearance, person_face

__all__ = [
    "COMMANDS",
    "AnimateOptions",
    "Scene",
    "animate",
    "announce",
    "check_size",
    "heard_performance",
    "perform",
]

RECORDED = (".csv", ".npz")
DRAWN = (".mp4", ".glb", ".png")
ENDINGS = (*DRAWN, ".npz", ".csv", *USD_ENDINGS)


@dataclass(frozen=True)
class AnimateOptions:
    """Speech in; a video, glTF, USD, npz, table of weights or contact sheet of a talking head out.

    Example: meshanim animate speech.wav -o talk.mp4
    """

    speech: Positional[Path]
    """Sound file: wav, flac, ogg, mp3 and whatever else libsndfile reads. Or motion to be shown: a .csv of
    Audio2Face-3D or Live Link Face, or an .npz that `meshanim solve` wrote."""
    sound: Path | None = None
    """The sound that goes with such motion."""
    output: Annotated[Path, arg(aliases=["-o"])] = Path("talk.mp4")
    """The ending chooses: mp4 (with sound), glb (any glTF viewer), npz (vertices, pose, fps), png (contact
    sheet), csv (blendshape weights, solved), usda or usdc (the face, its shapes and weights; extra usd)."""
    neutral: Path | None = None
    """With --emotion auto, which hears the emotion in the speech: neutral speech of the same voice."""
    csv: CsvForm = "audio2face"
    """Whose columns a csv has: of Audio2Face-3D or of Live Link Face."""
    model: str = "default"
    """Checkpoint: default, a folder that `meshanim train` wrote, or a repository of the hub."""
    head: str = "default"
    """Head to animate: default, flame:/path/generic_model.pkl, rig:/path/face.glb, or own: the mesh that the
    network was trained on."""
    person: str = "ana"
    """Who, on the default head: one of the twelve people that `docs/look.md` shows."""
    skin: Path | None = None
    """Picture in MakeHuman's layout that replaces the painted skin."""
    avatar: str | None = None
    """A Gaussian avatar speaks instead of a mesh, on its own head: model/ of what `meshanim avatar fit`
    wrote. Writes mp4 or png; `meshanim avatar render` has cameras and backgrounds."""
    quality: Literal["full", "draft"] = "full"
    """Of pictures: full has hair, subsurface scattering and anti-aliasing; draft is faster than real time."""
    size: int = 512
    """Pixels along the side of a video frame, even."""
    performance: OmitArgPrefixes[AnimationOptions] = field(default_factory=AnimationOptions)


def animate(options: AnimateOptions) -> None:
    """Run the verb."""
    if options.avatar is not None:
        _animate_avatar(options.avatar, options)
        return
    ending = options.output.suffix.lower()
    if ending not in ENDINGS:
        raise OptionError(f"cannot write {options.output}: the ending must be one of {', '.join(ENDINGS)}")
    check_size(options.size)
    check_writable(options.output)
    scene, sequence = perform(options)
    if ending == ".npz":
        sequence.save(options.output)
    elif ending == ".glb":
        scene.write_glb(sequence)
    elif ending == ".png":
        scene.write_sheet(sequence)
    elif ending == ".mp4":
        scene.write_video(sequence)
    else:
        scene.write_weights(sequence)
    announce(options.output, sequence)


def check_size(size: int) -> None:
    """OptionError if pictures of a video cannot have so many pixels a side."""
    if size < 16 or size % 2:
        raise OptionError(f"size must be even and at least 16, not {size}")


def announce(output: Path, sequence: MeshSequence) -> None:
    """Say what was written."""
    count = f"{len(sequence)} frame{'s' if len(sequence) > 1 else ''}"
    print(f"wrote {output}: {count}, {sequence.duration:.2f} s at {sequence.fps:g} fps")


def perform(options: AnimateOptions) -> tuple["Scene", MeshSequence]:
    """What is drawn, and how it moves."""
    track = options.performance.track  # what cannot be read is said before long loading
    animator = Animator.from_pretrained(options.model, None if options.head == "own" else options.head)
    scene = Scene(animator, options)
    if options.speech.suffix.lower() in RECORDED:
        return scene, scene.recorded(BlendshapeTrack.load(options.speech))
    if options.sound is not None:
        raise OptionError("--sound goes with motion from a .csv or .npz; a sound file is its own")
    speech = load_waveform(options.speech, rate=None)
    performance = heard_performance(animator, speech, options.performance, options.neutral)
    if track is not None:
        stream = animator.open(speech.rate, performance, scene.template)
        if stream.without_effect:
            print(f"this head does not follow {', '.join(stream.without_effect)}", file=sys.stderr)
    sequence = animator(speech, performance, scene.template, progress=sys.stderr.isatty())
    return scene, sequence


def heard_performance(
    animator: Animator, speech: Waveform, performance: AnimationOptions, neutral: Path | None = None
) -> AnimationOptions:
    """The options, with what is heard in the speech where the emotion is "auto"."""
    if performance.emotion != "auto":
        if neutral is not None:
            raise OptionError("--neutral goes with --emotion auto")
        return performance
    from meshanim.automatic_emotion import with_heard_emotions
    from meshanim.models.audio2emotion import EmotionDetector, load_audio2emotion

    sample = None if neutral is None else load_waveform(neutral)
    detector = EmotionDetector(load_audio2emotion(), neutral=sample)
    heard = with_heard_emotions(animator.model, speech, performance, detector)
    print("emotion: over time, heard by the default classifier (trained on synthetic voices)")
    return heard


def _animate_avatar(avatar: str, options: AnimateOptions) -> None:
    from meshanim.cli.avatar import RenderOptions, render

    if options.head != "default" or options.skin is not None:
        raise OptionError("--head and --skin are of meshes; an avatar has its own")
    recorded = options.speech.suffix.lower() in RECORDED
    render(
        RenderOptions(
            avatar,
            motion=options.speech if recorded else None,
            audio=options.sound if recorded else options.speech,
            output=options.output,
            size=options.size,
            model=options.model,
            performance=options.performance,
        )
    )


class Scene:
    """What is drawn: a person on the default head, or clay on any other."""

    def __init__(self, animator: Animator, options: AnimateOptions):
        self.animator, self.options = animator, options
        self.template: np.ndarray | None = None
        self._shape: torch.Tensor | None = None
        if isinstance(animator.head, DefaultHead):
            shape, self.template = person_face(animator.head, find_person(options.person))
            self._shape = torch.from_numpy(shape)[None]
        elif options.skin is not None:
            raise OptionError("--skin paints the default head only")
        if options.skin is not None or options.output.suffix.lower() in DRAWN:
            self.appearance  # noqa: B018, made now: what is wrong with it is said before the speech is heard

    @cached_property
    def appearance(self) -> Appearance | None:
        """How a person on the default head looks."""
        if not isinstance(self.animator.head, DefaultHead):
            return None
        person = find_person(self.options.person)
        return make_appearance(self.animator.head, person, skin_image=self.options.skin)

    def recorded(self, track: BlendshapeTrack) -> MeshSequence:
        """Weights from a file on this head, with the sound that was given."""
        if self.animator.head is None:
            raise OptionError("weights need a head with blendshapes; this checkpoint has a mesh alone")
        sequence = track.animate(self.animator.head, self.template)
        sound = self.options.sound
        return sequence if sound is None else replace(sequence, audio=load_waveform(sound, rate=None))

    def frames(self, sequence: MeshSequence, size: int, camera: Camera | None = None) -> Iterator[np.ndarray]:
        """Pictures, `size` pixels a side, from the front if no camera is given."""
        from meshanim.render import portrait_camera, render_mesh, render_sequence

        head, quality = self.animator.head, self.options.quality
        if self.appearance is not None and isinstance(head, DefaultHead):
            yield from render_sequence(sequence, head, self.appearance, size, size, quality, camera=camera)
            return
        camera = camera or portrait_camera(sequence.mesh.vertices, size, size)
        for vertices in sequence.vertices if head is None else sequence.posed(head):
            yield render_mesh(vertices, sequence.mesh, camera, quality=quality)

    def write_video(self, sequence: MeshSequence) -> None:
        from meshanim.export import write_video

        frames = tqdm(
            self.frames(sequence, self.options.size),
            total=len(sequence),
            desc="render",
            unit="frame",
            disable=not sys.stderr.isatty(),
        )
        write_video(self.options.output, iter(frames), sequence.fps, sequence.audio)

    def write_sheet(self, sequence: MeshSequence, most: int = 24) -> None:
        from meshanim.export import contact_sheet, write_png

        chosen = np.unique(np.linspace(0, len(sequence) - 1, min(most, len(sequence))).round().astype(int))
        part = MeshSequence(
            sequence.vertices[chosen], sequence.fps, sequence.mesh, sequence.pose[chosen], sequence.audio
        )
        frames = list(self.frames(part, self.options.size // 2))
        labels = [f"{(index + 0.5) / sequence.fps:.2f} s" for index in chosen]
        write_png(self.options.output, contact_sheet(frames, columns=6, labels=labels))

    def write_weights(self, sequence: MeshSequence) -> None:
        from meshanim.export import write_track

        head = self.animator.head
        if head is None or not head.expression_names:
            raise OptionError(
                "weights need a head with blendshapes; `meshanim solve` gives it the default head's"
            )
        terms = SolverOptions()
        if self.options.output.suffix.lower() == ".csv" and self.options.csv == "livelink":
            terms = arkit_only(terms, head)
        solved = solve_sequence(sequence, head, terms, progress=sys.stderr.isatty())
        neutral = sequence.mesh.vertices
        write_track(self.options.output, solved.track, head, neutral, self._pivot(head), self.options.csv)
        print(solved.residual.table())

    def _pivot(self, head: Head) -> np.ndarray:
        return head.joints(self._shape)[0, 1].numpy()

    def write_glb(self, sequence: MeshSequence) -> None:
        from meshanim.export import write_glb
        from meshanim.export.materials import gltf_materials

        head = self.animator.head
        if head is None:
            write_glb(self.options.output, sequence)
            return
        pivot = self._pivot(head)
        follow = head.weights[:, 1:].sum(1).numpy()
        materials = None
        if self.appearance is not None and isinstance(head, DefaultHead):
            materials = gltf_materials(head, self.appearance)
        write_glb(self.options.output, sequence, materials, pivot, follow)


COMMANDS = animate
