"""How many frames a second the animator gives, by length of the speech, encoder included."""

import resource
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from meshanim.animator import AnimationOptions, Animator
from meshanim.audio import Waveform, load_waveform
from meshanim.results import Results

__all__ = ["AnimationBenchmark", "frames_per_second", "repeated", "run"]


@dataclass(frozen=True)
class AnimationBenchmark:
    """Frames a second of the model (encoder, network, seal, idle motion) and of rendering.

    Example: meshanim bench animate --json animate.json
    """

    model: str = "default"
    """Checkpoint, as of `meshanim animate`."""
    seconds: tuple[int, ...] = (5, 10, 19, 60, 600)
    """Lengths of speech; the cost a frame must not grow with them."""
    repeats: int = 3
    """Runs a length up to 60 s, of which the median counts; longer ones run once."""
    frames: int = 60
    """Frames a rendering case."""
    size: int = 512
    """Pixels along the side of a rendered frame."""
    json: Path | None = None
    """Also write the rows here."""


def run(options: AnimationBenchmark, clip: Path) -> Results:
    """Measure the animator on a recorded clip that is repeated to each length.

    Parameters
    ----------
    options : AnimationBenchmark
    clip : Path
        A sound file.
    """
    results = Results("animate")
    start = time.perf_counter()
    animator = Animator.from_pretrained(options.model)
    results.add("load", options.model, "time", time.perf_counter() - start, "s")
    speech = load_waveform(clip)
    frames_per_second(animator, repeated(speech, 1))  # warm up
    for seconds in options.seconds:
        rates = [
            frames_per_second(animator, repeated(speech, seconds))
            for _ in range(options.repeats if seconds <= 60 else 1)
        ]
        case = f"{seconds} s of speech, {animator.mesh.n_vertices} vertices"
        results.add(case, "GAVA", "speed", float(np.median(rates)), "frames/s")
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
        results.add(case, "GAVA", "peak memory so far", peak, "GiB")
    results.add("first frame", "GAVA", "sound needed", _sound_needed(animator, speech), "ms")
    return results


def repeated(speech: Waveform, seconds: int) -> Waveform:
    """So many seconds of a speech over and over."""
    count = seconds * speech.rate
    return Waveform(np.resize(speech.samples, count), speech.rate)


def frames_per_second(
    animator: Animator, speech: Waveform, clock: Callable[[], float] = time.perf_counter
) -> float:
    """Speed on a whole speech, a second of sound at a time, encoder included."""
    start = clock()
    stream, frames = animator.open(speech.rate), 0
    for offset in range(0, len(speech.samples), speech.rate):
        frames += len(stream.push(speech.samples[offset : offset + speech.rate]).pose)
    frames += len(stream.finish().pose)
    return frames / (clock() - start)


def _sound_needed(animator: Animator, speech: Waveform) -> float:
    """Milliseconds of sound after which the first frame comes out of a stream: its algorithmic latency."""
    stream = animator.open(speech.rate, AnimationOptions())
    block = speech.rate // 200
    for offset in range(0, len(speech.samples), block):
        if len(stream.push(speech.samples[offset : offset + block]).pose):
            return 1000 * (offset + block) / speech.rate
    return float("inf")
