"""Networks in real time: time to the first frame, frames a second, and how many speakers at once."""

import os
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from tqdm import tqdm

from meshanim.animation_benchmark import frames_per_second, repeated
from meshanim.animator import Animator
from meshanim.audio import Waveform, load_encoder, load_waveform
from meshanim.errors import BackendError, OptionError
from meshanim.heads import load_head
from meshanim.models.audio2face import (
    Audio2FaceDiffusion,
    Audio2FaceRegression,
    DiffusionConfig,
    RegressionConfig,
)
from meshanim.motion.animation_state import Actors, StateBasis
from meshanim.motion.emotions import EMOTIONS
from meshanim.motion.face_parts import face_parts
from meshanim.results import Results

__all__ = ["RealtimeBenchmark", "largest", "run", "untrained"]

CLOCKS = {"wall": time.perf_counter, "processor": time.thread_time}
UNTRAINED = ("a2f-regression", "a2f-diffusion")
SKIN, TONGUE = 140, 10
"""Components of the paper."""
STAGGER = 0.5
"""Seconds over which speakers begin."""


@dataclass(frozen=True)
class RealtimeBenchmark:
    """Time to the first frame with the speech encoder in it, frames a second, concurrent speakers.

    Example: meshanim bench realtime --models default runs/regression runs/diffusion --json realtime.json
    """

    models: tuple[str, ...] = ("default", *UNTRAINED)
    """Checkpoints as of `meshanim animate`; a2f-regression and a2f-diffusion are untrained networks of the
    published sizes on the default head with the encoder `visemes`: weights do not change the time."""
    device: str = "cpu"
    """Where networks run; encoders run on the CPU."""
    seconds: int = 6
    """Of speech in every run."""
    chunk: float = 0.1
    """Seconds of sound that arrive at a time."""
    behind: float = 0.5
    """Seconds by which no speaker may ever be behind, for all to be in real time."""
    most: int = 256
    """Speakers to try at most."""
    workers: int = 0
    """Threads that speakers are shared among, each with one thread of torch; 0 takes one a core."""
    repeats: int = 3
    """Runs of which the median counts."""
    clock: Literal["wall", "processor"] = "wall"
    """What computing takes: by the wall, or by the processor, each speaker with one thread, which other
    programs disturb less. A GPU needs the wall."""
    json: Path | None = None
    """Also write the rows here."""

    def __post_init__(self):
        if min(self.seconds, self.most, self.repeats) < 1 or self.workers < 0:
            raise OptionError("seconds, most and repeats must be at least 1, workers not negative")
        if not (self.chunk > 0 and self.behind > 0):
            raise OptionError(f"chunk and behind must be positive, not {self.chunk} and {self.behind}")


def run(options: RealtimeBenchmark, clip: Path) -> Results:
    """Measure every model on a recorded clip that is repeated.

    Rows: the first frame after the first sample, the sound that it needs, computing of it; the longest
    computing of a chunk; frames a second of a whole speech; the encoder alone, a second of speech; and tracks
    that stream side by side without any being behind by more than is allowed. Sound arrives by a clock that
    goes on only while something is computed: a run takes no longer than its computing, and a speaker who is
    late is late by what a real clock would show.

    Parameters
    ----------
    options : RealtimeBenchmark
    clip : Path
        A sound file.

    Raises
    ------
    BackendError
        If there is no such device.
    """
    if options.device.startswith("cuda") and not torch.cuda.is_available():
        raise BackendError(f"no device {options.device}: torch finds no NVIDIA GPU here")
    if options.device.startswith("cuda") and options.clock == "processor":
        raise OptionError("the processor's clock does not see a GPU: take --clock wall")
    threads = torch.get_num_threads()
    if options.clock == "processor":
        torch.set_num_threads(1)
    try:
        return _measured(options, clip)
    finally:
        torch.set_num_threads(threads)


def _measured(options: RealtimeBenchmark, clip: Path) -> Results:
    results = Results("realtime")
    clock = CLOCKS[options.clock]
    speech = repeated(load_waveform(clip), options.seconds)
    workers = options.workers or _cores()
    for name in tqdm(options.models, desc="realtime", unit="model", disable=not sys.stderr.isatty()):
        animator = _animator(name, options.device)
        where = f"{options.device}, {workers} thread{'s' * (workers > 1)}, {options.clock} clock"
        _first_frame(animator, speech, options)  # warm up
        firsts = [_first_frame(animator, speech, options) for _ in range(options.repeats)]
        total, heard, longest, busy = (statistics.median(column) for column in zip(*firsts))
        results.add(name, where, "first frame", 1e3 * total, "ms")
        results.add(name, where, "sound needed", 1e3 * heard, "ms")
        results.add(name, where, "computing of it", 1e3 * (total - heard), "ms")
        results.add(name, where, "longest chunk", 1e3 * longest, "ms")
        rates = [frames_per_second(animator, speech, clock) for _ in range(options.repeats)]
        results.add(name, where, "speed", statistics.median(rates), "frames/s")
        shares = [_encoding(animator, speech, options) for _ in range(options.repeats)]
        share = 1e3 * statistics.median(shares) / options.seconds
        results.add(name, where, "encoder", share, "ms/s")

        def in_time(tracks: int, animator: Animator = animator) -> bool:
            return _most_behind(animator, speech, tracks, workers, options) <= options.behind

        # What one speaker takes of a second, as a first guess.
        guess = round(workers / busy)
        results.add(name, where, "real time", largest(in_time, options.most, guess), "tracks")
    return results


def largest(holds: Callable[[int], bool], most: int, guess: int = 1) -> int:
    """The largest number up to `most` at which something holds; 0 if not at 1.

    Steps that double lead away from a guess, halves of what is left to the answer.
    """
    low, high = 0, most + 1
    number, step = min(max(guess, 1), most), 1
    while high - low > 1:
        if holds(number):
            low = number
        else:
            high = number
        outward = number + step if number == low else number - step
        step *= 2
        number = outward if low < outward < high else (low + high) // 2
    return low


def untrained(kind: str) -> Audio2FaceRegression | Audio2FaceDiffusion:
    """A network of the published sizes on the default head, with weights as training begins with.

    Parameters
    ----------
    kind : "a2f-regression" or "a2f-diffusion"
    """
    head = load_head("default")
    parts = face_parts(head)
    generator = torch.Generator().manual_seed(0)

    def components(count: int, points: int) -> torch.Tensor:
        matrix = torch.randn(3 * points, count, generator=generator)
        return torch.linalg.qr(matrix)[0].T.reshape(count, points, 3).contiguous()

    basis = StateBasis(
        parts,
        torch.zeros(len(parts.skin), 3),
        components(SKIN, len(parts.skin)),
        torch.zeros(len(parts.tongue), 3),
        components(TONGUE, len(parts.tongue)),
        eyes=True,
    )
    template = torch.from_numpy(head.mesh.vertices.astype(np.float32))
    actors = Actors(basis, {"": template}, head.mesh.faces)
    dim = load_encoder("visemes").dim
    torch.manual_seed(0)
    if kind == "a2f-regression":
        regression = RegressionConfig(feature_dim=dim, emotions=EMOTIONS, languages=(), head="default")
        return Audio2FaceRegression(regression, actors).eval()
    diffusion = DiffusionConfig(feature_dim=dim, emotions=EMOTIONS, head="default")
    return Audio2FaceDiffusion(diffusion, actors).eval()


def _animator(name: str, device: str) -> Animator:
    if name not in UNTRAINED:
        return Animator.from_pretrained(name, device=device)
    network = untrained(name).to(device)
    return Animator(network, load_encoder(network.config.encoder), load_head("default"))


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _chunks(speech: Waveform, seconds: float) -> list[np.ndarray]:
    size = max(1, round(seconds * speech.rate))
    return [speech.samples[first : first + size] for first in range(0, len(speech.samples), size)]


def _first_frame(
    animator: Animator, speech: Waveform, options: RealtimeBenchmark
) -> tuple[float, float, float, float]:
    """Seconds from the first sample to the first frame, of sound that it needs, of the longest computing, and
    of computing for a second of sound."""
    stream, now, first, heard, longest, busy = animator.open(speech.rate), 0.0, 0.0, 0.0, 0.0, 0.0
    arrived, clock = 0, CLOCKS[options.clock]
    for block in _chunks(speech, options.chunk):
        arrived += len(block)
        start = clock()
        given = len(stream.push(block).pose)
        took = clock() - start
        now, longest, busy = max(now, arrived / speech.rate) + took, max(longest, took), busy + took
        if given and not first:
            first, heard = now, arrived / speech.rate
    return first, heard, longest, busy * speech.rate / arrived


def _encoding(animator: Animator, speech: Waveform, options: RealtimeBenchmark) -> float:
    """Seconds that the encoder takes of the speech in chunks, or as a whole where it does not stream."""
    clock = CLOCKS[options.clock]
    start = clock()
    try:
        stream = animator.encoder.stream()
    except OptionError:
        animator.encoder(speech)
        return clock() - start
    for block in _chunks(speech, options.chunk):
        stream.push(block)
    stream.finish()
    return clock() - start


def _most_behind(
    animator: Animator, speech: Waveform, tracks: int, workers: int, options: RealtimeBenchmark
) -> float:
    """Seconds by which speakers were behind their sound at the worst moment; ends once it is too much."""
    chunks = _chunks(speech, options.chunk)
    shares = [range(tracks)[worker::workers] for worker in range(min(workers, tracks))]
    streams = [animator.open(speech.rate) for _ in range(tracks)]
    # Speakers begin one after the other within half a second.
    begins = [round(STAGGER / options.chunk * track / tracks) for track in range(tracks)]

    clock = CLOCKS[options.clock]

    def hear(tick: int, share: Sequence[int]) -> float:
        start = clock()
        for track in share:
            if 0 <= tick - begins[track] < len(chunks):
                streams[track].push(chunks[tick - begins[track]])
        return clock() - start

    now, behind = 0.0, 0.0
    with ThreadPoolExecutor(len(shares), initializer=torch.set_num_threads, initargs=(1,)) as pool:
        for tick in range(len(chunks) + max(begins)):
            arrived = (tick + 1) * options.chunk
            start = time.perf_counter()
            took = [done.result() for done in [pool.submit(hear, tick, share) for share in shares]]
            passed = time.perf_counter() - start if options.clock == "wall" else max(took)
            now = max(now, arrived) + passed
            behind = max(behind, now - arrived)
            if behind > options.behind:
                break
    return behind
