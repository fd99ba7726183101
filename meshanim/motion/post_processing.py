"""Audio2Face-3D's post-processing: strengths, offsets and smoothing of a face, by name, changing over time.

Source: Audio2Face-3D, Sec. 5, and the published code for formulas, defaults and ranges.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Float32, Float64
from torch import Tensor

from meshanim.errors import OptionError
from meshanim.heads import Head
from meshanim.motion.animation_state import FacePose
from meshanim.motion.face_parts import FaceParts

__all__ = [
    "PRESETS",
    "Control",
    "Poses",
    "PostHearing",
    "PostProcessing",
    "PostProcessor",
    "PostTrack",
    "head_poses",
]

CENTIMETRE = 0.01
DEGREE = math.pi / 180


class Control(NamedTuple):
    """A number of `PostProcessing`: `constant` ones cannot change within a performance."""

    name: str
    default: float
    low: float
    high: float
    unit: str
    description: str
    constant: bool


def _control(
    default: float, low: float, high: float, description: str, unit: str = "", constant: bool = False
) -> Any:
    metadata = {"low": low, "high": high, "unit": unit, "description": description, "constant": constant}
    return field(default=default, metadata=metadata)


@dataclass(frozen=True)
class PostProcessing:
    """Every control at one moment; `controls()` lists names, defaults, ranges, units and descriptions.

    Defaults and ranges are those of Audio2Face-3D's SDK, except that ranges of the lower teeth are what its
    tests use and those of eyeballs and saccades are ours, for it publishes none. Controls that it has not are
    `input_strength` (it leaves that to the caller), `prediction_delay` and `blink_interval`.

    Raises
    ------
    OptionError
        If a number is outside its range.
    """

    input_strength: float = _control(1.0, 0, 10, "gain on the sound that the network hears")
    prediction_delay: float = _control(0.0, -1, 1, "how much the face is ahead of the sound", "s", True)
    skin_strength: float = _control(1.0, 0, 2, "range of motion of the skin")
    upper_face_strength: float = _control(1.0, 0, 2, "range of motion of the upper face")
    lower_face_strength: float = _control(1.3, 0, 2, "range of motion of the lower face")
    upper_face_smoothing: float = _control(
        0.001, 0, 0.1, "time in which half of a change of the upper face is made, twice over", "s"
    )
    lower_face_smoothing: float = _control(0.0023, 0, 0.1, "the same of the lower face", "s")
    face_mask_level: float = _control(
        0.6, 0, 1, "height between upper and lower face, of the skin from bottom to top"
    )
    face_mask_softness: float = _control(0.0085, 0.001, 0.5, "width of the transition, in the same measure")
    lip_open_offset: float = _control(-0.03, -0.2, 0.2, "share of the pose with parted lips that is added")
    eyelid_open_offset: float = _control(
        0.06, -1, 1, "share of the pose with closed eyes that is taken away: positive opens"
    )
    blink_strength: float = _control(1.0, 0, 2, "range of motion of blinks")
    blink_interval: float = _control(3.6, 0, 600, "mean time between added blinks; 0 adds none", "s", True)
    lower_teeth_strength: float = _control(1.0, 0, 2, "range of motion of jaw and lower teeth")
    lower_teeth_height_offset: float = _control(0.0, -3, 3, "jaw and lower teeth moved up", "cm")
    lower_teeth_depth_offset: float = _control(0.0, -3, 3, "jaw and lower teeth moved forward", "cm")
    tongue_strength: float = _control(1.5, 0, 3, "range of motion of the tongue")
    tongue_height_offset: float = _control(0.2, -3, 3, "tongue moved up", "cm")
    tongue_depth_offset: float = _control(0.13, -3, 3, "tongue moved forward", "cm")
    eyeballs_strength: float = _control(1.0, 0, 2, "range of motion of the eyes that the network says")
    saccade_strength: float = _control(1.0, 0, 2, "range of motion of added saccades")
    right_eye_rot_x_offset: float = _control(0.0, -10, 10, "right eye turned down", "deg")
    right_eye_rot_y_offset: float = _control(0.0, -10, 10, "right eye turned to the wearer's left", "deg")
    left_eye_rot_x_offset: float = _control(0.0, -10, 10, "left eye turned down", "deg")
    left_eye_rot_y_offset: float = _control(0.0, -10, 10, "left eye turned to the wearer's left", "deg")
    eye_saccade_seed: float = _control(0.0, 0, 4999, "which saccades are added", "", True)

    def __post_init__(self):
        for control in self.controls():
            value = getattr(self, control.name)
            if not control.low <= value <= control.high:
                raise OptionError(
                    f"{control.name} is {value:g}; expected {control.low:g} to {control.high:g}"
                    f"{' ' * bool(control.unit)}{control.unit}"
                )

    @classmethod
    def controls(cls) -> tuple[Control, ...]:
        """All controls in their order."""
        return tuple(
            Control(entry.name, entry.default, **entry.metadata)  # type: ignore[arg-type]  # all have one
            for entry in fields(cls)
        )


_FRAMEWORK = PostProcessing(
    input_strength=1.3, lower_face_strength=1.7, skin_strength=1.1, lip_open_offset=-0.05,
    lower_teeth_strength=1.3, tongue_depth_offset=-0.3, saccade_strength=0.9, right_eye_rot_y_offset=-2.0,
    left_eye_rot_y_offset=2.0,
)  # fmt: skip
_CLAIRE = PostProcessing(
    lower_face_strength=1.25, lower_face_smoothing=0.006, eyelid_open_offset=0.0, lip_open_offset=0.0,
    tongue_strength=1.3, tongue_height_offset=0.0, tongue_depth_offset=0.0,
)  # fmt: skip
PRESETS: Mapping[str, PostProcessing] = {
    "neutral": PostProcessing(
        lower_face_strength=1.0, upper_face_smoothing=0.0, lower_face_smoothing=0.0, lip_open_offset=0.0,
        eyelid_open_offset=0.0, tongue_strength=1.0, tongue_height_offset=0.0, tongue_depth_offset=0.0,
    ),
    "sdk": PostProcessing(),
    "framework": _FRAMEWORK,
    "framework-diffusion": replace(_FRAMEWORK, upper_face_smoothing=0.003),
    "claire": _CLAIRE,
    "james": replace(_CLAIRE, lower_face_strength=1.2, eyelid_open_offset=0.06, lip_open_offset=-0.02),
    "mark": replace(
        _CLAIRE, lower_face_strength=1.3, lower_face_smoothing=0.0023, skin_strength=1.1,
        eyelid_open_offset=0.06, lip_open_offset=-0.03,
    ),
}  # fmt: skip
"""`neutral` changes nothing. Published are the SDK's defaults, those of the training framework for regression
and diffusion, and the settings of three actors in the sample clients (what they leave out is the SDK's). The
framework's offsets of the lower teeth (height -0.1, depth 0.25) are left out: they are for the teeth of its
actors, and push those of the default head through the lip."""


@dataclass(frozen=True)
class PostTrack:
    """Controls over time: linear between keys, constant before the first and after the last.

    Parameters
    ----------
    times : sequence of float
        Seconds, rising.
    keys : sequence of PostProcessing
        One for each time.

    Raises
    ------
    OptionError
        If there is no key, times fall or are not finite, or a constant control changes.
    """

    times: Sequence[float]
    keys: Sequence[PostProcessing]

    def __post_init__(self):
        object.__setattr__(self, "times", tuple(map(float, self.times)))
        object.__setattr__(self, "keys", tuple(self.keys))
        if not self.keys or len(self.times) != len(self.keys):
            raise OptionError(f"{len(self.times)} times and {len(self.keys)} keys; expected one for each")
        if not np.isfinite(self.times).all() or (np.diff(self.times) < 0).any():
            raise OptionError("times of keys must be finite and must not fall")
        for control in PostProcessing.controls():
            if control.constant and len({getattr(key, control.name) for key in self.keys}) > 1:
                raise OptionError(f"{control.name} cannot change over time")

    @classmethod
    def of(cls, what: "PostProcessing | PostTrack") -> "PostTrack":
        """A track, or one of constant controls."""
        return what if isinstance(what, PostTrack) else cls((0.0,), (what,))

    def values(self, name: str, times: Float[np.ndarray, " times"]) -> Float64[np.ndarray, " times"]:
        """A control at times, seconds."""
        return np.interp(times, self.times, [getattr(key, name) for key in self.keys])

    @property
    def first(self) -> PostProcessing:
        """The first key: constant controls for all time."""
        return self.keys[0]


class PostHearing:
    """Sound on its way to the network: `input_strength` and `prediction_delay`.

    A delay above 0 leaves out the first samples and ends in silence: the face is ahead. Below 0 silence comes
    first and the last samples are not heard. As many samples come out as went in.

    Parameters
    ----------
    track : PostTrack
        Controls over time.
    rate : int
        Samples a second.
    """

    def __init__(self, track: PostTrack, rate: int):
        self.track, self.rate = track, rate
        shift = round(track.first.prediction_delay * rate)
        self.received, self.skipped, self.to_skip = 0, 0, max(shift, 0)
        self.held = np.zeros(max(-shift, 0), np.float32)

    def push(
        self, samples: Float[np.ndarray, " samples"], last: bool = False
    ) -> Float32[np.ndarray, " heard"]:
        """The next samples as the network hears them."""
        times = (self.received + np.arange(len(samples))) / self.rate
        self.received += len(samples)
        samples = (samples * self.track.values("input_strength", times)).astype(np.float32)
        count = min(self.to_skip, len(samples))
        self.to_skip, self.skipped, samples = self.to_skip - count, self.skipped + count, samples[count:]
        if last:
            samples = np.concatenate([samples, np.zeros(self.skipped, np.float32)])
        line = np.concatenate([self.held, samples])
        self.held = line[len(line) - len(self.held) :]
        return line[: len(samples)]


class Poses(NamedTuple):
    """Displacements of the skin, metres: with closed eyes, and with parted lips; None where unknown."""

    eye_close: Float[Tensor, "skin 3"] | None
    lip_open: Float[Tensor, "skin 3"] | None


def head_poses(head: Head | None, parts: FaceParts) -> Poses:
    """Poses of a head by ARKit's shapes: both eyeBlink; mouthUpperUp and mouthLowerDown of both sides."""

    def pose(*stems: str) -> Float[Tensor, "skin 3"] | None:
        names = [stem + side for stem in stems for side in ("Left", "Right")]
        if head is None or not set(names) <= set(head.expression_names):
            return None
        rows = [head.expression_names.index(name) for name in names]
        return head.expression_directions[rows].sum(0).unflatten(0, (-1, 3))[parts.skin]

    return Poses(pose("eyeBlink"), pose("mouthUpperUp", "mouthLowerDown"))


class PostProcessor:
    """Frame after frame through the controls; nothing but the frames before is looked at.

    Skin: d = skin_strength d + eye_close (lids blink_strength - eyelid_open_offset) + lip_open
    lip_open_offset, then through two smoothers in a row, y += (x - y) (1 - 2^(-1 / (fps smoothing))), once
    for the upper and once for the lower face, which are mixed by the mask
    m = sigmoid((level - height) / softness). Tongue and jaw: d strength + offset. Eyes: angles strength +
    saccade saccade_strength + offset.

    Parameters
    ----------
    track : PostTrack
        Controls over time.
    parts : FaceParts
        What is skin.
    template : (V, 3)
        The face at rest, metres.
    fps : float
        Frames a second.
    poses : Poses, optional
        Where one is unknown, its controls do nothing (`without_effect`).
    """

    def __init__(
        self,
        track: PostTrack,
        parts: FaceParts,
        template: Float[Tensor, "vertices 3"],
        fps: float,
        poses: Poses | None = None,
    ):
        self.track, self.parts, self.fps = track, parts, fps
        self.poses = Poses(*(None if pose is None else pose.to(template) for pose in poses or (None, None)))
        height = template[parts.skin, 1]
        self.height = (height - height.min()) / (height.max() - height.min()).clamp_min(1e-9)
        self.smoothers = {"upper": _Smoother(), "lower": _Smoother()}

    @property
    def without_effect(self) -> tuple[str, ...]:
        """Controls that this face cannot follow."""
        lacking = []
        if self.poses.eye_close is None:
            lacking += ["eyelid_open_offset", "blink_strength"]
        if self.poses.lip_open is None:
            lacking.append("lip_open_offset")
        if not len(self.parts.jaw_points):
            lacking += [name for name in _names() if name.startswith("lower_teeth")]
        if not len(self.parts.tongue):
            lacking += [name for name in _names() if name.startswith("tongue")]
        if not len(self.parts.right_eye) and not len(self.parts.left_eye):
            lacking += [name for name in _names() if "eye_rot" in name or name.startswith("eyeballs")]
        return tuple(lacking)

    def __call__(
        self,
        face: FacePose,
        times: Float[np.ndarray, " frames"],
        lids: Float[np.ndarray, " frames"],
        saccades: Float[np.ndarray, "frames 2"],
    ) -> FacePose:
        """The next frames.

        Parameters
        ----------
        face : FacePose
            As the network says.
        times : (T,)
            Seconds.
        lids : (T,)
            How far blinks close the lids, 0 to 1.
        saccades : (T, 2)
            Pitch and yaw of both eyes that are added, radians.
        """

        def control(name: str) -> Float[Tensor, "frames 1 1"]:
            return torch.from_numpy(self.track.values(name, times)).to(face.skin)[:, None, None]

        def offset(part: str, unit: float) -> Float[Tensor, "frames 1 3"]:
            height, depth = (control(f"{part}_{name}_offset") for name in ("height", "depth"))
            return unit * torch.cat([torch.zeros_like(height), height, depth], dim=2)

        skin = control("skin_strength") * face.skin
        if self.poses.eye_close is not None:
            closed = torch.from_numpy(np.asarray(lids)).to(skin)[:, None, None]
            amount = closed * control("blink_strength") - control("eyelid_open_offset")
            skin = skin + amount * self.poses.eye_close
        if self.poses.lip_open is not None:
            skin = skin + control("lip_open_offset") * self.poses.lip_open
        mask = self._mask(times)
        upper, lower = (
            smoother(skin, self.fps, self.track.values(f"{name}_face_smoothing", times))
            for name, smoother in self.smoothers.items()
        )
        skin = upper * control("upper_face_strength") * (1 - mask)
        skin = skin + lower * control("lower_face_strength") * mask
        eyes = face.eyes * control("eyeballs_strength")
        added = torch.from_numpy(np.asarray(saccades)).to(skin)[:, None]
        turned = torch.stack(
            [
                torch.stack([control(f"{side}_eye_rot_{axis}_offset")[:, 0, 0] for axis in "xy"], 1)
                for side in ("right", "left")
            ],
            dim=1,
        )
        return FacePose(
            skin,
            face.tongue * control("tongue_strength") + offset("tongue", CENTIMETRE),
            face.jaw * control("lower_teeth_strength") + offset("lower_teeth", CENTIMETRE),
            eyes + added * control("saccade_strength") + DEGREE * turned,
        )

    def _mask(self, times: Float[np.ndarray, " frames"]) -> Float[Tensor, "masks skin 1"]:
        """1 in the lower face: one for all frames, or one each."""
        levels = self.track.values("face_mask_level", times)
        widths = self.track.values("face_mask_softness", times)
        if len(self.track.keys) == 1:
            levels, widths = levels[:1], widths[:1]
        # Row by row: the last bit of an exponential may depend on how many are taken at once.
        rows = [torch.sigmoid((level - self.height) / width) for level, width in zip(levels, widths)]
        return torch.stack(rows)[..., None] if rows else self.height.new_zeros(0, len(self.height), 1)


class _Smoother:
    """Two exponential smoothers in a row, frame by frame; the first frame is where they begin."""

    def __init__(self):
        self.levels: list[Tensor] = []

    def __call__(
        self, frames: Float[Tensor, "frames points 3"], fps: float, half_lives: Float[np.ndarray, " frames"]
    ) -> Float[Tensor, "frames points 3"]:
        out = torch.empty_like(frames)
        for number, (frame, half_life) in enumerate(zip(frames, half_lives.tolist())):
            if not self.levels:
                self.levels = [frame, frame]
            share = 1 - 0.5 ** (1 / (fps * half_life)) if half_life > 0 else 1.0
            before = frame
            for level in range(2):
                before = torch.lerp(self.levels[level], before, share) if share < 1 else before
                self.levels[level] = before
            out[number] = before
        if self.levels:
            self.levels = [level.clone() for level in self.levels]  # not views of the block
        return out


def _names() -> list[str]:
    return [control.name for control in PostProcessing.controls()]
