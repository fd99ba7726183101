"""Which moments of a person are drawn: hand-made faces, and frames of their speech."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Float32

from meshanim.audio import Waveform, voices
from meshanim.datasets.synthetic.corpus import SynthesizeOptions, act, cast, takes
from meshanim.datasets.synthetic.expressions import HELD_OUT, TRAINING
from meshanim.datasets.synthetic.performance import CURVE_NAMES
from meshanim.errors import DependencyError, OptionError

__all__ = ["Chosen", "Moment", "choose_moments", "farthest"]

TRAINING_SENTENCES, HELD_OUT_SENTENCES = 4, 2
"""Sentences from which the moments that differ most are taken."""
HAND_MADE_SHARE = 0.525, 0.6
SHAPES = 40
"""Of the default head; who speaks how does not depend on their number."""


@dataclass(frozen=True)
class Moment:
    """A face at an instant.

    Parameters
    ----------
    name : str
        "broad smile", or sentence and frame.
    curves : (53,) float32
        Weights by `CURVE_NAMES`.
    turn : (3,) float32
        Head rotation, axis-angle, radians.
    """

    name: str
    curves: Float32[np.ndarray, " curves"]
    turn: Float32[np.ndarray, "3"]

    def weights(self, expression_names: Sequence[str]) -> Float32[np.ndarray, " expressions"]:
        """The curves in a head's order; those that it has and ARKit has not are zero."""
        column = {name: index for index, name in enumerate(CURVE_NAMES)}
        known = [self.curves[column[name]] if name in column else 0.0 for name in expression_names]
        return np.array(known, np.float32)


@dataclass(frozen=True)
class Chosen:
    """Moments of one person.

    Parameters
    ----------
    training, held_out : tuple of Moment
        To train on, and others of other faces and sentences.
    speech : tuple of two Waveform
        What is heard from the first frame of each on, of a video; empty of moments that are spread.
    """

    training: tuple[Moment, ...]
    held_out: tuple[Moment, ...]
    speech: tuple[Waveform, ...] = ()


def choose_moments(corpus: SynthesizeOptions, person: int, training: int, held_out: int, kind: str) -> Chosen:
    """Moments to train on, and others of other faces and sentences.

    Parameters
    ----------
    corpus : SynthesizeOptions
        How people speak.
    person : int
        Which subject of the corpus.
    training, held_out : int
        How many.
    kind : str
        "spread" or "video".

    Raises
    ------
    DependencyError
        Without a synthetic voice.
    OptionError
        If the corpus has too few sentences, or too little is said for a video so long.
    """
    available = voices()
    if not available:
        raise DependencyError("py-nanotts", "speech")
    corpus = replace(corpus, subjects=max(corpus.subjects, person + 1))
    member = cast(corpus, SHAPES, available)[person]
    # `takes` numbers subjects by their place in the list: the seed must be this person's.
    spoken = [replace(take, seed=(corpus.seed, person, take.sentence)) for take in takes(corpus, [member])]
    if len(spoken) < 2:
        raise OptionError(f"--sentences is {len(spoken)}; images need two: one to train on, one held out")
    if kind == "video":
        shown, heard = _in_order(spoken, corpus.fps, training)
        others, heard_there = _in_order(spoken[::-1], corpus.fps, held_out)
        return Chosen(shown, others, (heard, heard_there))
    kept = min(HELD_OUT_SENTENCES, len(spoken) - 1)
    first, last = spoken[: min(TRAINING_SENTENCES, len(spoken) - kept)], spoken[len(spoken) - kept :]
    return Chosen(
        tuple(_spread(first, corpus.fps, TRAINING, training, HAND_MADE_SHARE[0])),
        tuple(_spread(last, corpus.fps, HELD_OUT, held_out, HAND_MADE_SHARE[1])),
    )


def _spread(spoken, fps: float, faces: dict[str, dict[str, float]], count: int, share: float) -> list[Moment]:
    made = min(len(faces), round(share * count))
    moments = []
    for name in list(faces)[:made]:
        curves = np.zeros(len(CURVE_NAMES), np.float32)
        for curve, weight in faces[name].items():
            curves[CURVE_NAMES.index(curve)] = weight
        moments.append(Moment(name, curves, np.zeros(3, np.float32)))
    if count == made:
        return moments
    everything = [moment for take in spoken for moment in _performed(take, fps)[0]]
    if len(everything) < count - made:
        raise OptionError(f"{len(everything)} frames are spoken, {count - made} are wanted: lower --frames")
    chosen = farthest(np.stack([moment.curves for moment in everything]), count - made)
    return moments + [everything[index] for index in sorted(chosen)]


def _in_order(spoken, fps: float, count: int) -> tuple[tuple[Moment, ...], Waveform]:
    """Sentence after sentence, and the sound of that: frame i lasts from i / fps to (i + 1) / fps seconds."""
    moments: list[Moment] = []
    heard: list[np.ndarray] = []
    for take in spoken[:-1]:  # the last one belongs to the other split
        performed, waveform = _performed(take, fps)
        moments += performed
        heard.append(waveform.samples)
        # A sentence ends within its last frame: the next one begins with a frame of its own.
        until = round(len(moments) * waveform.rate / fps)
        heard.append(np.zeros(max(0, until - sum(map(len, heard))), np.float32))
        if len(moments) >= count:
            samples = np.concatenate(heard)[: round(count * waveform.rate / fps)]
            return tuple(moments[:count]), Waveform(samples, waveform.rate)
    raise OptionError(f"{len(moments)} frames are spoken, {count} are wanted: raise --sentences or --fps")


def _performed(take, fps: float) -> tuple[list[Moment], Waveform]:
    waveform, _, performance = act(take, fps)
    name = f"{take.member.name}_sentence{take.sentence:02d}"
    moments = [
        Moment(f"{name} frame {index}", curves, turn)
        for index, (curves, turn) in enumerate(zip(performance.curves, performance.pose))
    ]
    return moments, waveform


def farthest(points: Float[np.ndarray, "points dims"], count: int) -> list[int]:
    """Indices of points that are far from each other: each the one farthest from those before it.

    The first is the one farthest from the origin. Gonzalez (1985).
    """
    distance = (points**2).sum(1)
    chosen: list[int] = []
    for _ in range(count):
        index = int(distance.argmax())
        away = ((points - points[index]) ** 2).sum(1)
        distance = np.minimum(distance, away) if chosen else away
        chosen.append(index)
    return chosen
