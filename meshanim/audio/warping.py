"""Dynamic time warping, and from one performance of a sentence to the times of another."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Float64, Int

from meshanim.audio.features import feature_windows, log_mel
from meshanim.audio.phonemes import VISEME_OF_PHONEME, Phoneme, phoneme_frames
from meshanim.audio.waveform import Waveform
from meshanim.errors import ShapeError

__all__ = ["dynamic_time_warping", "matching_times"]

RATE = 50.0
SOUND = 0.3
"""Weight of the sounds' distance beside that of the phonemes."""
REST = 25
"""Frames of silence put before and after."""


def dynamic_time_warping(
    cost: Float[np.ndarray, "rows columns"], penalty: float = 0.0
) -> Int[np.ndarray, "steps 2"]:
    """The monotone path of least cost from corner to corner (Sakoe and Chiba 1978).

    Parameters
    ----------
    cost : (N, M)
        Of pairing each row with each column.
    penalty : float
        Added for a step along one axis alone, which repeats a frame.

    Returns
    -------
    (steps, 2) int
        Pairs from (0, 0) to (N - 1, M - 1); a step adds one to either or both.

    Raises
    ------
    ShapeError
        If the cost is empty or not finite.
    """
    if cost.ndim != 2 or 0 in cost.shape or not np.isfinite(cost).all():
        raise ShapeError(f"costs of shape {cost.shape}; expected finite (rows, columns)")
    rows, columns = cost.shape
    total = np.full((rows + 1, columns + 1), np.inf)
    total[0, 0] = 0
    step = np.zeros((rows, columns), np.int8)
    # All entries of an anti-diagonal depend on the two before it alone.
    for diagonal in range(rows + columns - 1):
        i = np.arange(max(0, diagonal - columns + 1), min(rows, diagonal + 1))
        j = diagonal - i
        before = np.stack([total[i, j], total[i, j + 1] + penalty, total[i + 1, j] + penalty])
        best = before.argmin(0)
        step[i, j] = best
        total[i + 1, j + 1] = before[best, np.arange(len(i))] + cost[i, j]
    path = [(rows - 1, columns - 1)]
    while path[-1] != (0, 0):
        i, j = path[-1]
        move = step[i, j]
        path.append((i - (move != 2), j - (move != 1)))
    return np.array(path[::-1])


def matching_times(
    speech: Waveform,
    phonemes: Sequence[Phoneme],
    other: Waveform,
    other_phonemes: Sequence[Phoneme],
    times: Float64[np.ndarray, " times"],
) -> Float64[np.ndarray, " times"]:
    """When in `speech` happens what happens at `times` in `other`, the same words said another way.

    Dynamic time warping at 50 frames a second, guided by the phonemes (Audio2Face-3D, Sec. 3.2): a frame
    costs nothing on its own phoneme, half on one that looks alike, one on any other, and 0.3 of the
    normalised distance of the log-mel spectra beside it.

    Parameters
    ----------
    speech, other : Waveform
        Two performances.
    phonemes, other_phonemes : sequence of Phoneme
        Theirs, from 0 to the end.
    times : (T,) array
        Seconds of `other`.

    Returns
    -------
    (T,) array
        Seconds of `speech`, never falling as `times` rise.

    Raises
    ------
    ShapeError
        If one of them has no phonemes.
    """
    if not phonemes or not other_phonemes:
        raise ShapeError("time warping needs the phonemes of both performances")
    sounds, symbols = zip(*(_frames(*one) for one in ((speech, phonemes), (other, other_phonemes))))
    same = symbols[1][:, None] == symbols[0][None]
    alike = VISEME_OF_PHONEME[symbols[1]][:, None] == VISEME_OF_PHONEME[symbols[0]][None]
    distance = np.linalg.norm(sounds[1][:, None] - sounds[0][None], axis=2)
    cost = np.where(same, 0.0, np.where(alike, 0.5, 1.0)) + SOUND * distance / max(
        float(distance.mean()), 1e-9
    )
    # Silence before and after both, so that rests of any length find their place.
    edge = np.pad(cost, REST, constant_values=1.0)
    edge[:REST, :REST] = edge[-REST:, -REST:] = 0
    for rest in (slice(0, REST), slice(-REST, None)):
        edge[rest, REST:-REST] = symbols[0] != 0
        edge[REST:-REST, rest] = (symbols[1] != 0)[:, None]
    path = dynamic_time_warping(edge, penalty=0.05) - REST
    path = path[(path[:, 0] >= 0) & (path[:, 0] < len(cost))]
    path[:, 1] = path[:, 1].clip(0, cost.shape[1] - 1)
    # A frame that is held meets several of the other's: their middle.
    count = np.bincount(path[:, 0])
    middle = np.bincount(path[:, 0], path[:, 1]) / count
    at = (np.arange(len(middle)) + 0.5) / RATE
    smooth = _smoothed((middle + 0.5) / RATE)
    return np.interp(times, at, smooth)


def _frames(waveform: Waveform, phonemes: Sequence[Phoneme]) -> tuple[np.ndarray, Int[np.ndarray, " frames"]]:
    mel = log_mel(waveform)
    count = max(1, int(waveform.duration * RATE))
    frames = feature_windows(mel, 100.0, RATE, count, 1)[:, 0].numpy()
    frames = (frames - frames.mean(0)) / (frames.std(0) + 0.3)
    return frames / np.sqrt(frames.shape[1]), phoneme_frames(phonemes, count, RATE)


def _smoothed(values: Float64[np.ndarray, " frames"]) -> Float64[np.ndarray, " frames"]:
    """A mean over five frames; what never falls still does not."""
    padded = np.concatenate([np.repeat(values[0], 2), values, np.repeat(values[-1], 2)])
    return np.convolve(padded, np.full(5, 0.2), "valid")
