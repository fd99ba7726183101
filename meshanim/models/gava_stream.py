"""GAVA frame by frame: features in, frames out once they are certain, whole files in bounded memory."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from meshanim.audio import feature_windows
from meshanim.errors import OptionError, ShapeError
from meshanim.motion.lip_seal import LipSeal, sealed_frames, sealed_steps

if TYPE_CHECKING:
    from meshanim.models.gava import Gava

__all__ = ["Frames", "GavaStream", "PoseSmoothing", "StyleOverTime", "animate"]

StyleOverTime = Callable[[Float64[np.ndarray, " frames"]], Float[Tensor, "frames style"]]
"""Times, seconds, to style vectors."""


class Frames(NamedTuple):
    """Vertices in the zero pose, metres, and head rotation vectors, radians."""

    vertices: Float[Tensor, "frames vertices 3"]
    pose: Float[Tensor, "frames 3"]


@dataclass(frozen=True)
class PoseSmoothing:
    """Gaussian filter of the predicted head pose; its radius is a fixed look-ahead.

    Parameters
    ----------
    sigma : float
        Seconds; 0 for none.
    radius : float
        Seconds at which the Gaussian is cut.
    """

    sigma: float = 0.06
    radius: float = 0.134

    def kernel(self, fps: float) -> Float[Tensor, " taps"]:
        """Odd number of weights that sum to one."""
        reach = int(self.radius * fps) if self.sigma > 0 else 0
        offsets = torch.arange(-reach, reach + 1) / fps
        weights = torch.exp(-0.5 * (offsets / max(self.sigma, 1e-6)) ** 2)
        return weights / weights.sum()


class GavaStream:
    """Frames of speech that is still being spoken; all frames of all calls are those of the whole.

    A frame comes out once the speech features, the mel frames, the pose filter and the lip seal can no longer
    change it. Memory does not grow with the length of the speech.

    Parameters
    ----------
    model : Gava
        In eval mode.
    template : (V, 3), optional
        The subject at rest, metres; the checkpoint's reference if not given.
    style : (1, style) or StyleOverTime, optional
        What `Gava.style_of` gave, or styles of frames by their times; the mean style if not given.
    fps : float, optional
        Frames a second; the checkpoint's if not given.
    smoothing : PoseSmoothing
        Of the head pose.
    seal : LipSeal, optional
        Closes the lips where the features say p, b or m.
    bilabial : slice or int, optional
        Where in a speech feature the probability of a bilabial is; needed with `seal`.
    chunk : int
        Most frames computed at once.
    """

    def __init__(
        self,
        model: "Gava",
        template: Float[Tensor, "vertices 3"] | None = None,
        style: Float[Tensor, "1 style"] | StyleOverTime | None = None,
        fps: float | None = None,
        smoothing: PoseSmoothing = PoseSmoothing(),
        seal: LipSeal | None = None,
        bilabial: int | None = None,
        chunk: int = 32,
    ):
        self.model, self.config = model, model.config
        self.fps = float(model.config.fps if fps is None else fps)
        if not (math.isfinite(self.fps) and self.fps > 0):
            raise OptionError(f"fps must be positive, not {fps}")
        if seal is not None and bilabial is None:
            raise OptionError("a lip seal needs to know which feature is the probability of a bilabial")
        self.seal, self.bilabial, self.chunk = seal, bilabial, chunk
        self.template = model.surface.template if template is None else template.to(model.surface.template)
        with torch.inference_mode():
            self.embedding = model.embed(self.template[None])
            self.style = model.style_of() if style is None else style
        self.kernel = smoothing.kernel(self.fps).to(self.template)
        self.reach = len(self.kernel) // 2
        seal_reach = seal.look_ahead(self.fps) if seal is not None else 0
        self.look_ahead = max(self.reach, seal_reach)
        self.inputs = [_Input(self.config.feature_rate, self.config.window)]
        if self.config.pose:
            self.inputs.append(_Input(self.config.mel_rate, self.config.mel_frames))
        self.computed = 0
        self.given = 0
        self.ended = False
        # Frames not yet given, and the poses and seals before and after them that filters still read.
        self.waiting: list[Tensor] = []
        self.poses: list[Tensor] = []
        self.seals: list[Tensor] = []
        self.context = 0

    @torch.inference_mode()
    def push(
        self,
        features: Float[Tensor, "steps dim"],
        mel: Float[Tensor, "mel_steps bands"] | None = None,
    ) -> Frames:
        """Take the next features and mel frames; give the frames they complete (maybe none).

        Raises
        ------
        ShapeError
            If they have another width than the checkpoint's or hold NaN.
        OptionError
            If the stream is finished.
        """
        if self.ended:
            raise OptionError("the stream is finished; start another one")
        arrays = [features] if mel is None else [features, mel]
        if self.config.pose and mel is None:
            raise ShapeError("this checkpoint turns the head: push mel frames with the features")
        for entry, array, dim in zip(self.inputs, arrays, (self.config.feature_dim, self.config.mel_bands)):
            if array.shape[1] != dim:
                raise ShapeError(f"features have width {array.shape[1]}, this checkpoint reads {dim}")
            entry.push(array.to(self.template.device, torch.float32))
        self._compute(min(entry.ready(self.fps) for entry in self.inputs))
        return self._give(self.computed - self.look_ahead)

    @torch.inference_mode()
    def finish(self, frames: int | None = None) -> Frames:
        """End the speech and give the last frames.

        Parameters
        ----------
        frames : int, optional
            Frames of the whole; as many as the speech features last if not given.

        Raises
        ------
        ShapeError
            If no features were pushed.
        """
        if self.ended:
            raise OptionError("the stream is finished; start another one")
        if not all(entry.received for entry in self.inputs):
            raise ShapeError("there are no speech features: the audio is empty")
        if frames is None:
            first = self.inputs[0]
            frames = max(1, math.floor(first.received / first.rate * self.fps + 1e-6))
        self.ended = True
        self._compute(frames)
        return self._give(frames)

    def _compute(self, frames: int) -> None:
        while self.computed < frames:
            count = min(self.chunk, frames - self.computed)
            windows = [entry.windows(self.fps, count, self.computed) for entry in self.inputs]
            mel = windows[1] if len(windows) > 1 else None
            out = self.model(windows[0], mel, self.embedding, self._styles(count))
            self.waiting.append(self.template + out.displacements)
            self.poses.append(out.pose)
            if self.bilabial is not None:
                track = self.inputs[0]
                steps = sealed_steps(track.kept[:, self.bilabial])
                self.seals.append(
                    sealed_frames(steps, track.rate, self.fps, count, self.computed, track.offset)
                )
            self.computed += count
            for entry in self.inputs:
                entry.forget(self.fps, self.computed)

    def _styles(self, count: int) -> Float[Tensor, "frames style"]:
        """Of the next frames."""
        if isinstance(self.style, Tensor):
            return self.style.expand(count, -1)
        return self.style((self.computed + np.arange(count) + 0.5) / self.fps)

    def _give(self, until: int) -> Frames:
        count = max(0, min(until, self.computed) - self.given)
        if count == 0:
            return Frames(self.template.new_zeros(0, *self.template.shape), self.template.new_zeros(0, 3))
        vertices = torch.cat(self.waiting)
        self.waiting = [vertices[count:].clone()]
        vertices = vertices[:count]
        # Filters see `context` frames before the first one to be given, and all that are computed after it.
        poses = torch.cat(self.poses)
        pose = self._smoothed(poses)[self.context : self.context + count]
        if self.seal is not None:
            seals = torch.cat(self.seals)
            envelope = self.seal.envelope(seals, self.fps)[self.context : self.context + count]
            vertices = self.seal(vertices, envelope)
            self.seals = [seals[max(0, self.context + count - self.look_ahead) :].clone()]
        self.poses = [poses[max(0, self.context + count - self.look_ahead) :].clone()]
        self.context = min(self.context + count, self.look_ahead)
        self.given += count
        return Frames(vertices, pose)

    def _smoothed(self, poses: Float[Tensor, "frames 3"]) -> Float[Tensor, "frames 3"]:
        if self.reach == 0:
            return poses
        first, last = poses[:1].expand(self.reach, 3), poses[-1:].expand(self.reach, 3)
        padded = torch.cat([first, poses, last])
        return torch.einsum("fcw,w->fc", padded.unfold(0, len(self.kernel), 1), self.kernel)


class _Input:
    """A feature track of which only the part that later frames still need is kept."""

    def __init__(self, rate: float, width: int):
        self.rate, self.width = rate, width
        self.kept = torch.zeros(0, 0)
        self.offset = 0

    @property
    def received(self) -> int:
        return self.offset + len(self.kept)

    def push(self, array: Tensor) -> None:
        self.kept = torch.cat([self.kept, array]) if len(self.kept) else array

    def _last(self, frame: int, fps: float) -> float:
        """Position of the last entry of a frame's window, or of the frame itself where that is longer."""
        return (frame + 0.5) * (self.rate / fps) - 0.5 + max(self.width - 1, self.rate / fps) / 2

    def ready(self, fps: float) -> int:
        """Frames whose windows are complete."""
        count = max(0, math.floor((self.received + 0.5 - (self.width - 1) / 2) * fps / self.rate))
        while count and self._last(count - 1, fps) > self.received - 1:
            count -= 1
        return count

    def windows(self, fps: float, frames: int, first: int) -> Tensor:
        return feature_windows(self.kept, self.rate, fps, frames, self.width, first, self.offset)

    def forget(self, fps: float, frame: int) -> None:
        """Drop what no window from `frame` on reads."""
        first = math.floor(self._last(frame, fps)) - max(self.width, math.ceil(self.rate / fps) + 2)
        # At least one is kept, whose value holds beyond the end.
        drop = min(first - self.offset, len(self.kept) - 1)
        if drop > 0:
            self.kept = self.kept[drop:].clone()
            self.offset += drop


def animate(
    stream: GavaStream,
    features: Float[Tensor, "steps dim"],
    mel: Float[Tensor, "mel_steps bands"] | None,
    frames: int,
) -> Iterator[Frames]:
    """Frames of whole speech, in pieces: cost a frame and memory do not depend on the length.

    Parameters
    ----------
    stream : GavaStream
        A fresh one.
    features, mel
        Of the whole speech.
    frames : int
        How many to make.

    Raises
    ------
    ShapeError
        If there are no features.
    """
    piece = stream.chunk / stream.fps
    count = max(1, math.ceil(len(features) / (piece * stream.config.feature_rate)))
    for k in range(count):
        parts = []
        for array in (features, mel):
            if array is not None:
                first, last = (round(len(array) * j / count) for j in (k, k + 1))
                parts.append(array[first:last])
        given = stream.push(*parts)
        if stream.given > frames:
            given = Frames(*(array[: len(array) - (stream.given - frames)] for array in given))
        if len(given.pose):
            yield given
        if stream.given >= frames:
            return
    given = stream.finish(frames)
    if len(given.pose):
        yield given
