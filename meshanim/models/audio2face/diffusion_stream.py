"""The diffusion network while speech is being spoken: half a second at a time, with what it remembers."""

import math
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from meshanim.audio import SpeechEncoder, Waveform
from meshanim.audio.features import frame_count
from meshanim.errors import OptionError
from meshanim.models.audio2face.diffusion import REACH, Audio2FaceDiffusion
from meshanim.models.audio2face.schedule import FrameNoise
from meshanim.models.audio2face.speech import (
    RATE,
    EmotionTrack,
    FeatureReader,
    features_at,
    hearing,
    window_features,
)

__all__ = ["DiffusionStream", "animate_diffusion", "block_frames"]

SECOND = RATE
"""Samples of a window: 1 s (Sec. 4.2, Fig. 7)."""


def block_frames(fps: float) -> tuple[int, int, int]:
    """Frames of a window before its block, of it, and after it: 15, 30, 15 at 60 a second; 7, 15, 8 at 30."""
    whole, block = max(round(fps), 3), max(round(fps / 2), 1)
    after = -(-(whole - block) // 2)
    return whole - block - after, block, after


class DiffusionStream:
    """Frames of speech that is still being spoken; all of all calls are those of the whole.

    Windows of 1 s move by 0.5 s; the half second in their middle comes out. For each denoising step the GRU's
    state at the end of the block is carried over (Sec. 4.2), with the last four noisy frames before it, which
    the frames after it are mixed with. The frames after the block are computed too, for what the next
    denoising step mixes in; a step's mixing reaches four frames, so with N steps of a window whose block is
    followed by at least 4 N frames (2 at 30 a second, 3 at 60) the result is that of the whole, to rounding.
    An encoder that needs the whole utterance hears each window alone.

    Parameters
    ----------
    model : Audio2FaceDiffusion
        In eval mode.
    encoder : SpeechEncoder
        The one that the network was trained with.
    identity : str, optional
        One of the network's; its first if not given.
    emotions : EmotionTrack, optional
        Over time; neutral if not given.
    noise : FrameNoise, optional
        That of seed 0 if not given.
    steps : int, optional
        Denoising steps; the network's if not given.

    Raises
    ------
    OptionError
        If the encoder, the emotions or the identity do not fit the network.
    """

    def __init__(
        self,
        model: Audio2FaceDiffusion,
        encoder: SpeechEncoder,
        identity: str | None = None,
        emotions: EmotionTrack | None = None,
        noise: FrameNoise | None = None,
        steps: int | None = None,
    ):
        config = model.config
        if encoder.dim != config.feature_dim:
            raise OptionError(
                f"encoder {encoder.name} gives {encoder.dim} features, the network reads "
                f"{config.feature_dim}: it was trained with {config.encoder}"
            )
        self.model, self.fps = model, config.fps
        self.identity = identity_row(model, identity)
        self.emotions = track_of(model, emotions)
        self.plan = model.schedule.sampling(config.sampling if steps is None else steps)
        self.noise = FrameNoise(len(self.plan), model.numbers) if noise is None else noise
        self.reader = FeatureReader(encoder, hearing(encoder))
        self.before, self.block, self.after = block_frames(self.fps)
        self.given = 0
        empty = torch.zeros(1, 0, model.numbers, device=model.device)
        self.states: list[Tensor | None] = [None] * len(self.plan)
        self.left = [empty] * len(self.plan)

    def push(self, samples: Float[np.ndarray, " samples"]) -> Float[Tensor, "frames numbers"]:
        """Take the next samples, 16 kHz; give the frames of the blocks they complete (maybe none).

        Raises
        ------
        ShapeError
            If a sample is NaN or infinite.
        OptionError
            If the stream is finished.
        """
        self.reader.push(samples)
        parts = []
        while True:
            last = self.given + self.block + self.after
            # One frame more: of a block that would be the last, nothing is certain yet.
            end = max(self._start() + SECOND, math.ceil((last + 1) / self.fps * RATE))
            if self.reader.ended or not self.reader.reaches(end, (last - 0.5) / self.fps):
                break
            parts.append(self._frames(self.given + self.block, last))
        return torch.cat(parts) if parts else self._none()

    def finish(self, frames: int | None = None) -> Float[Tensor, "frames numbers"]:
        """End the speech and give the last frames.

        Parameters
        ----------
        frames : int, optional
            Of the whole; as many as cover the speech if not given.

        Raises
        ------
        ShapeError
            If there were no samples.
        """
        self.reader.finish()
        if frames is None:
            frames = max(1, math.ceil(self.reader.received * self.fps / RATE - 1e-9))
        parts = []
        while self.given < frames:
            end = min(self.given + self.block, frames)
            parts.append(self._frames(end, min(end + self.after, frames)))
        return torch.cat(parts) if parts else self._none()

    def _none(self) -> Float[Tensor, "frames numbers"]:
        return torch.zeros(0, self.model.numbers, device=self.model.device)

    def _start(self) -> int:
        """First sample of the window around the next block."""
        return round((self.given - self.before) / self.fps * RATE)

    def _features(self, first: int, last: int) -> Float[Tensor, "frames dim"]:
        times = (torch.arange(first, last, dtype=torch.float64) + 0.5) / self.fps
        if self.reader.mode == "speech":
            return self.reader.features_at(times)
        start = self._start()
        window = self.reader.windows([start], SECOND)
        return window_features(self.reader.encoder, window, times - start / RATE)[0]

    @torch.inference_mode()
    def _frames(self, end: int, last: int) -> Float[Tensor, "frames numbers"]:
        """Frames from the next one to `end`, with what is known up to `last`."""
        model, begin = self.model, self.given
        first = begin - self.left[0].shape[1]
        own, count = begin - first, end - begin
        device = model.device
        noise = self.noise.frames(begin, last).to(device)[:, None]
        features = self._features(first, last)[None].to(device)
        times = (np.arange(first, last) + 0.5) / self.fps
        emotions = self.emotions.at(times)[None].to(device)
        identity = torch.tensor([self.identity], device=device)
        x, left, clean = noise[0], [], noise[0]
        for number, step in enumerate(self.plan):
            seen = torch.cat([self.left[number], x], dim=1)
            left.append(seen[:, : own + count][:, -REACH:])
            time = torch.tensor([step.time], device=device)
            inputs = model.encode(features, seen, time, emotions, identity)[:, own:]
            hidden, state = model.recurrent(inputs[:, :count], self.states[number])
            self.states[number] = state
            if last > end:
                hidden = torch.cat([hidden, model.recurrent(inputs[:, count:], state)[0]], dim=1)
            clean = model.decode(hidden, inputs)
            x = step.clean * clean + step.noisy * x
            if number + 1 < len(self.plan):
                x = x + step.deviation * noise[number + 1]
        self.left, self.given = left, end
        keep = end - max(REACH, self.before) - 1
        self.reader.forget(round(keep / self.fps * RATE), keep / self.fps)
        return model.mean + x[0, :count] * model.scale


def identity_row(model: Audio2FaceDiffusion, identity: str | None) -> int:
    """Row of an identity by name; the first if none is named.

    Raises
    ------
    OptionError
        If the network has no such identity.
    """
    known = model.config.identities
    if identity is not None and identity not in known:
        raise OptionError(f"no identity {identity!r}; there are {', '.join(known)}")
    return 0 if identity is None else list(known).index(identity)


def track_of(model: Audio2FaceDiffusion, emotions: EmotionTrack | None) -> EmotionTrack:
    """The emotions that were given, or neutral.

    Raises
    ------
    OptionError
        If they do not fit the network, or it is told sentences and none is given.
    """
    config = model.config
    if emotions is None and config.text:
        raise OptionError("this network is told emotions in sentences: give them as `text_track` makes them")
    track = EmotionTrack.of(config.emotions) if emotions is None else emotions
    if track.strengths.shape[1] != config.mood:
        raise OptionError(f"the track has {track.strengths.shape[1]} emotions, the network {config.mood}")
    return track


def animate_diffusion(
    model: Audio2FaceDiffusion,
    encoder: SpeechEncoder,
    waveform: Waveform,
    identity: str | None = None,
    emotions: EmotionTrack | None = None,
    noise: FrameNoise | None = None,
    steps: int | None = None,
    hear: Literal["speech", "window"] = "speech",
) -> Float[Tensor, "frames numbers"]:
    """Frames of whole speech at once, metres and radians; memory grows with its length.

    Parameters
    ----------
    model, encoder, identity, emotions, noise, steps
        As `DiffusionStream`.
    waveform : Waveform
        Speech at any rate.
    hear : "speech" or "window"
        Features of the whole, or for every half second of the 1 s window around it, as streams hear it
        through encoders that need the whole utterance.
    """
    frames = frame_count(waveform, model.config.fps)
    times = (torch.arange(frames, dtype=torch.float64) + 0.5) / model.config.fps
    waveform = waveform.resampled(RATE)
    if hear == "speech":
        features = features_at(encoder(waveform), encoder.rate, times)
    else:
        features = _window_by_window(model, encoder, waveform, times)
    track = track_of(model, emotions)
    row = identity_row(model, identity)
    return model.sample(features, track.at(times.numpy()), row, noise, steps)


def _window_by_window(
    model: Audio2FaceDiffusion, encoder: SpeechEncoder, waveform: Waveform, times: Tensor
) -> Float[Tensor, "frames dim"]:
    before, block, _ = block_frames(model.config.fps)
    reader = FeatureReader(encoder, "window")
    reader.push(waveform.samples)
    parts = []
    for first in range(0, len(times), block):
        start = round((first - before) / model.config.fps * RATE)
        inside = times[first : first + block] - start / RATE
        parts.append(window_features(encoder, reader.windows([start], SECOND), inside)[0])
    return torch.cat(parts)
