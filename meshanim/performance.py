"""A network while it hears speech: samples in, motion out, for every network that the animator knows."""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, NamedTuple

import numpy as np
import torch
import tyro
from jaxtyping import Float, Float32, Float64
from torch import Tensor
from tyro.conf import arg

from meshanim.audio import SpeechEncoder
from meshanim.audio.encoders import MelEncoder
from meshanim.errors import OptionError
from meshanim.heads import Head
from meshanim.models.audio2face import (
    Audio2FaceDiffusion,
    Audio2FaceRegression,
    DiffusionStream,
    EmotionTrack,
    FrameNoise,
    RegressionStream,
)
from meshanim.models.audio2face.head_motion import head_rotation
from meshanim.models.audio2face.prompts import PHRASES, load_text_encoder, prompts, text_track
from meshanim.models.gava import Gava
from meshanim.models.gava_stream import GavaStream
from meshanim.motion.animation_state import FacePose
from meshanim.motion.lip_seal import LipSeal
from meshanim.motion.post_files import load_post_settings, post_track
from meshanim.motion.post_processing import PostProcessing, PostTrack

__all__ = [
    "AnimationOptions",
    "Motion",
    "Network",
    "Performance",
    "emotion_track",
    "perform",
    "told_emotions",
]

Network = Gava | Audio2FaceRegression | Audio2FaceDiffusion


@dataclass(frozen=True)
class AnimationOptions:
    """How a speech is performed.

    Parameters
    ----------
    fps : float, optional
        Frames a second; those of the checkpoint if not given.
    subject : str, optional
        Whose speaking style, one of the checkpoint's training subjects; their mean if not given, of
        Audio2Face's networks the first.
    emotion : str
        One of the checkpoint's emotions; a sentence for networks that are told sentences.
    intensity : float
        Of the emotion, 0 to 1.
    emotion_keys : sequence of str
        Emotions over time: 0:joy=1 2.5:anger=0.4,fear=0.2 (seconds, strengths between which
        it is linear), or 0:SENTENCE; or one .yml of NVIDIA's with a list of them.
    implicit : str, optional
        CLIP or CLIP:FRAME of training whose implicit emotion is taken, Audio2Face's regression only; the mean
        of the emotion's frames if not given.
    steps : int, optional
        Denoising steps, Audio2Face's diffusion only; the network's if not given.
    seed : int
        Of blinks, gaze and sway, and of the noise that diffusion begins with.
    blinks : float, optional
        Blinks a second that are added, on heads that have ARKit's eye shapes; 0 for none; 0.28 if not given,
        or by the post-processing's `blink_interval`.
    gaze, sway : float
        Gains on added shifts of gaze and on the added slow movement of the head; 0 for none.
    seal : bool
        Whether lips are closed where the encoder hears p, b or m, on heads that name lip pairs; GAVA only.
    post : str, optional
        Post-processing: neutral, sdk, framework, framework-diffusion, claire, james, mark; or a file of
        NVIDIA's, .yml or model_config.json, or one with keyframes.
    controls : PostProcessing or PostTrack, optional
        The same from Python.
    emotions : EmotionTrack, optional
        Emotions over time, or a row for each frame, instead of the three options above.
    noise : (steps, T, numbers), optional
        Noise from elsewhere, diffusion only.
    """

    fps: float | None = None
    subject: Annotated[str | None, arg(aliases=["--style"])] = None
    emotion: str = "neutral"
    intensity: float = 1.0
    emotion_keys: tuple[str, ...] = ()
    implicit: str | None = None
    steps: int | None = None
    seed: int = 0
    blinks: float | None = None
    gaze: float = 1.0
    sway: float = 1.0
    seal: bool = True
    post: str | None = None
    controls: Annotated[PostProcessing | PostTrack | None, tyro.conf.Fixed, tyro.conf.Suppress] = None
    emotions: Annotated[EmotionTrack | None, tyro.conf.Fixed, tyro.conf.Suppress] = None
    noise: Annotated[Tensor | None, tyro.conf.Fixed, tyro.conf.Suppress] = None

    @property
    def track(self) -> PostTrack | None:
        """Post-processing over time; None for none.

        Raises
        ------
        OptionError, FileFormatError
            If it is given twice, or cannot be read.
        """
        if self.controls is not None and self.post is not None:
            raise OptionError("give post-processing by name or file (post), or as controls, not both")
        if self.controls is not None:
            return PostTrack.of(self.controls)
        return None if self.post is None else post_track(self.post)


class Motion(NamedTuple):
    """What a network says: displacements by part, or vertices (t, V, 3) in the zero pose; and head pose."""

    face: FacePose | Float[Tensor, "frames vertices 3"]
    pose: Float[Tensor, "frames 3"]


class Performance(ABC):
    """Speech that is still being spoken to motion; all of all calls are that of the whole.

    Attributes
    ----------
    fps : float
        Frames a second.
    template : (V, 3)
        The face at rest that displacements are of, metres.
    """

    fps: float
    template: Float[Tensor, "vertices 3"]

    @abstractmethod
    def push(self, samples: Float32[np.ndarray, " samples"], frames: int | None = None) -> Motion:
        """Take the next samples, 16 kHz; give the motion that they complete (maybe of no frame).

        Parameters
        ----------
        samples : (S,)
            Any number of them.
        frames : int, optional
            Where these are the last samples: frames of the whole speech, of which those that are still
            missing are given.

        Raises
        ------
        ShapeError
            If a sample is NaN or infinite, or there were none at all at the end.
        OptionError
            If the stream is finished.
        """

    @abstractmethod
    def feel(self, emotions: EmotionTrack) -> None:
        """Follow other emotions from the next frame on.

        Raises
        ------
        OptionError
            If the track does not fit the network.
        """


class GavaPerformance(Performance):
    """GAVA: features, and mel frames where it turns the head.

    Parameters
    ----------
    model : Gava
        On one of its topologies.
    encoder, options, template
        As `perform`.
    seal : LipSeal, optional
        Of its head.
    """

    def __init__(
        self,
        model: Gava,
        encoder: SpeechEncoder,
        options: AnimationOptions,
        template: Float[Tensor, "vertices 3"] | None,
        seal: LipSeal | None,
    ):
        for name in ("implicit", "steps", "noise"):
            if getattr(options, name) is not None:
                raise OptionError(f"GAVA knows no {name}; Audio2Face's networks do")
        self.model, self.subject, self.emotions = model, options.subject, emotion_track(model, options)
        if self.emotions.strengths.shape[1] != len(told_emotions(model)):
            raise OptionError(
                f"the track has {self.emotions.strengths.shape[1]} emotions, the network "
                f"{len(told_emotions(model))}"
            )
        self.features = encoder.stream()
        self.mel = MelEncoder().stream() if model.config.pose else None
        self.frames = GavaStream(
            model,
            template=template,
            style=self._styles,
            fps=options.fps,
            seal=None if seal is None else seal.to(model.surface.template.device),
            bilabial=None if seal is None else getattr(encoder, "bilabial", None),
        )
        self.fps, self.template = self.frames.fps, self.frames.template

    def _styles(self, times: Float64[np.ndarray, " frames"]) -> Float[Tensor, "frames style"]:
        return self.model.styles_over_time(self.subject, self.emotions.at(times))

    def feel(self, emotions: EmotionTrack) -> None:
        self.emotions = checked_track(emotions, self.emotions)

    def push(self, samples: Float32[np.ndarray, " samples"], frames: int | None = None) -> Motion:
        features = [self.features.push(samples)]
        mel = [] if self.mel is None else [self.mel.push(samples)]
        if frames is not None:
            features.append(self.features.finish())
            if self.mel is not None:
                mel.append(self.mel.finish())
        parts = [self.frames.push(torch.cat(features), torch.cat(mel) if mel else None)]
        if frames is not None:
            parts.append(self.frames.finish(frames))
        vertices, pose = (torch.cat(arrays) for arrays in zip(*parts, strict=True))
        return Motion(vertices, pose)


class RegressionPerformance(Performance):
    """Audio2Face's regression network; the head stays upright.

    Parameters
    ----------
    model : Audio2FaceRegression
    encoder, options, template
        As `perform`.
    """

    def __init__(
        self,
        model: Audio2FaceRegression,
        encoder: SpeechEncoder,
        options: AnimationOptions,
        template: Float[Tensor, "vertices 3"] | None,
    ):
        config = model.config
        for name in ("steps", "noise"):
            if getattr(options, name) is not None:
                raise OptionError(f"a regression network knows no {name}; diffusion does")
        if options.subject not in (None, config.subject):
            raise OptionError(f"no subject {options.subject!r}; this network was trained on {config.subject}")
        implicit = None
        if options.implicit is not None:
            clip, _, frame = options.implicit.partition(":")
            if frame and not frame.isdigit():
                raise OptionError(f"implicit emotion {options.implicit!r}; expected CLIP or CLIP:FRAME")
            implicit = model.implicit_of(clip=clip, frame=int(frame) if frame else None)
        self.stream = RegressionStream(model, encoder, options.fps, emotion_track(model, options), implicit)
        self.basis, self.fps = model.actors.basis.to(model.device), self.stream.fps
        self.template = _template(model, template, 0)

    def feel(self, emotions: EmotionTrack) -> None:
        self.stream.emotions = checked_track(emotions, self.stream.emotions)

    def push(self, samples: Float32[np.ndarray, " samples"], frames: int | None = None) -> Motion:
        states = _advance(self.stream, samples, frames)
        return Motion(self.basis.decode(states), states.new_zeros(len(states), 3))


class DiffusionPerformance(Performance):
    """Audio2Face's diffusion network; the head turns where its motion is generated.

    Parameters
    ----------
    model : Audio2FaceDiffusion
    encoder, options, template
        As `perform`.
    head : Head, optional
        Whose shapes a rig network's weights are of.
    """

    def __init__(
        self,
        model: Audio2FaceDiffusion,
        encoder: SpeechEncoder,
        options: AnimationOptions,
        template: Float[Tensor, "vertices 3"] | None,
        head: Head | None,
    ):
        config = model.config
        if options.implicit is not None:
            raise OptionError("a diffusion network has no implicit emotions; regression does")
        if options.fps not in (None, config.fps):
            raise OptionError(f"fps is {options.fps:g}; this network makes {config.fps:g} frames a second")
        count = config.sampling if options.steps is None else options.steps
        noise = FrameNoise(count, model.numbers, options.seed, options.noise)
        track = emotion_track(model, options)
        self.stream = DiffusionStream(model, encoder, options.subject, track, noise, options.steps)
        self.model, self.fps = model, self.stream.fps
        self.template = _template(model, template, self.stream.identity)
        self.shapes = None
        if config.target == "rig":
            known = () if head is None else head.expression_names
            missing = [name for name in config.rig if name not in known]
            if head is None or missing:
                raise OptionError(
                    f"this network makes weights of {len(config.rig)} shapes, of which the head lacks "
                    f"{', '.join(missing[:3])}: animate the head that it was trained on"
                )
            rows = [head.expression_names.index(name) for name in config.rig]
            self.shapes = head.expression_directions[rows].to(model.device)

    def feel(self, emotions: EmotionTrack) -> None:
        self.stream.emotions = checked_track(emotions, self.stream.emotions)

    def push(self, samples: Float32[np.ndarray, " samples"], frames: int | None = None) -> Motion:
        found = _advance(self.stream, samples, frames)
        pose = head_rotation(self.model.head_motion(found)) if len(found) else found.new_zeros(0, 3)
        if self.shapes is None:
            return Motion(self.model.pose(found), pose)
        moved = self.model.rig_weights(found) @ self.shapes
        return Motion(self.template + moved.unflatten(1, (-1, 3)), pose)


def perform(
    network: Network,
    encoder: SpeechEncoder,
    options: AnimationOptions,
    template: Float[Tensor, "vertices 3"] | None = None,
    head: Head | None = None,
    seal: LipSeal | None = None,
) -> Performance:
    """Start a performance of any network.

    Parameters
    ----------
    network : Gava, Audio2FaceRegression or Audio2FaceDiffusion
        In eval mode.
    encoder : SpeechEncoder
        The one that it was trained with.
    options : AnimationOptions
        How it is performed.
    template : (V, 3), optional
        Who speaks: the face at rest, metres; the network's own if not given.
    head : Head, optional
        The network's.
    seal : LipSeal, optional
        Of the head; GAVA only.

    Raises
    ------
    OptionError
        If an option does not fit the network.
    """
    if isinstance(network, Audio2FaceRegression):
        return RegressionPerformance(network, encoder, options, template)
    if isinstance(network, Audio2FaceDiffusion):
        return DiffusionPerformance(network, encoder, options, template, head)
    return GavaPerformance(network, encoder, options, template, seal)


def checked_track(track: EmotionTrack, other: EmotionTrack) -> EmotionTrack:
    """The track, if it has as many emotions as the other; OptionError otherwise."""
    given, wanted = track.strengths.shape[1], other.strengths.shape[1]
    if given != wanted:
        raise OptionError(f"the track has {given} emotions, the network {wanted}")
    return track


def told_emotions(network: Network) -> tuple[str, ...]:
    """Emotions that a network is told by name, but neutral; none where it is told sentences."""
    if isinstance(network, Audio2FaceDiffusion) and network.config.text:
        return ()
    return tuple(name for name in network.config.emotions if name != "neutral")


def emotion_track(network: Network, options: AnimationOptions) -> EmotionTrack:
    """Emotions over time as options say.

    Raises
    ------
    OptionError
        If a key cannot be read, or the network has no such emotion.
    """
    if options.emotions is not None:
        return options.emotions
    if len(options.emotion_keys) == 1 and options.emotion_keys[0].endswith((".yml", ".yaml")):
        listed = load_post_settings(options.emotion_keys[0]).emotions
        felt = [(time, {name: by for name, by in named.items() if by}) for time, named in listed]
        return EmotionTrack.of(told_emotions(network), *felt)
    keys = _keys(options.emotion_keys)
    if keys and options.emotion != "neutral":
        raise OptionError("give one emotion for the speech (emotion), or emotions over time, not both")
    if isinstance(network, Audio2FaceDiffusion) and network.config.text:
        sentences = keys or [(0.0, options.emotion)]
        said = [(time, _sentence(what, options.intensity)) for time, what in sentences]
        return text_track(load_text_encoder(network.config.text_encoder), *said)
    emotions = told_emotions(network)
    if keys:
        if options.intensity != 1:
            raise OptionError(
                "intensity belongs to one emotion for the speech; keys have their own strengths"
            )
        return EmotionTrack.of(emotions, *((time, _mixture(what)) for time, what in keys))
    if not 0 <= options.intensity <= 1:
        raise OptionError(f"intensity must lie within 0 to 1, not {options.intensity}")
    return EmotionTrack.of(emotions, (0.0, {options.emotion: options.intensity}))


def _keys(words: Sequence[str]) -> list[tuple[float, str]]:
    """Times and what is said of them."""
    found = []
    for word in words:
        time, _, what = word.partition(":")
        try:
            seconds = float(time)
        except ValueError:
            seconds = math.nan
        if not math.isfinite(seconds) or not what:
            raise OptionError(f"emotion key {word!r}; expected SECONDS:NAME=STRENGTH,... or SECONDS:SENTENCE")
        found.append((seconds, what))
    return found


def _mixture(what: str) -> dict[str, float]:
    strengths = {}
    for entry in what.split(","):
        name, _, strength = entry.strip().partition("=")
        try:
            value = float(strength or 1.0)
        except ValueError:
            value = math.nan
        if not 0 <= value <= 1:
            raise OptionError(f"emotion {entry!r}; expected NAME or NAME=STRENGTH within 0 to 1")
        strengths[name] = value
    return strengths


def _sentence(what: str, intensity: float) -> str:
    """An emotion's name as a sentence; a sentence as it is."""
    return prompts(what, intensity)[0] if what in PHRASES else what


def _template(
    model: Audio2FaceRegression | Audio2FaceDiffusion,
    template: Float[Tensor, "vertices 3"] | None,
    row: int,
) -> Float[Tensor, "vertices 3"]:
    if template is None:
        known = model.actors.templates
        name = (
            model.config.identities[row] if isinstance(model, Audio2FaceDiffusion) else model.config.subject
        )
        template = known[name] if name in known else next(iter(known.values()))
    return template.to(model.device)


def _advance(
    stream: RegressionStream | DiffusionStream,
    samples: Float32[np.ndarray, " samples"],
    frames: int | None,
) -> Float[Tensor, "frames numbers"]:
    given = stream.push(samples)
    return given if frames is None else torch.cat([given, stream.finish(frames)])
