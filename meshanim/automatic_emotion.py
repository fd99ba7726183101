"""Emotions that are heard in the speech itself, for networks that are told emotions."""

from dataclasses import replace

import numpy as np

from meshanim.audio import Waveform
from meshanim.errors import OptionError
from meshanim.models.audio2emotion import EmotionDetector, EmotionOptions, detect_emotions
from meshanim.models.audio2face import Audio2FaceDiffusion, EmotionTrack
from meshanim.models.gava import Gava
from meshanim.motion.emotions import HEARD_EMOTIONS
from meshanim.performance import AnimationOptions, Network

__all__ = ["with_heard_emotions"]


def with_heard_emotions(
    network: Network,
    speech: Waveform,
    options: AnimationOptions,
    detector: EmotionDetector,
    post: EmotionOptions | None = None,
) -> AnimationOptions:
    """Options that say what is heard in a speech, in the words of a network.

    Audio2Face's networks follow the emotions over time, times `options.intensity`. GAVA knows one emotion for
    a whole speech: the one that is strongest on average, as strong as it is on average.

    Parameters
    ----------
    network : Gava, Audio2FaceRegression or Audio2FaceDiffusion
    speech : Waveform
    options : AnimationOptions
    detector : EmotionDetector
    post : EmotionOptions, optional

    Raises
    ------
    OptionError
        If the network knows none of the emotions, or is told sentences.
    """
    if isinstance(network, Audio2FaceDiffusion) and network.config.text:
        raise OptionError("this network is told sentences; --emotion auto gives names of emotions")
    post = EmotionOptions() if post is None else post
    emotions = tuple(name for name in network.config.emotions if name != "neutral")
    if not set(emotions) & set(HEARD_EMOTIONS):
        raise OptionError(
            f"this network knows none of {', '.join(HEARD_EMOTIONS)}; it was trained on "
            f"{', '.join(network.config.emotions) or 'no emotions'}"
        )
    found = detect_emotions(speech, detector, post, emotions)
    if isinstance(network, Gava):
        means = found.track.strengths.mean(0)
        strongest = int(np.argmax(means))
        share = float(np.clip(means[strongest], 0, 1)) * options.intensity
        return replace(options, emotion=emotions[strongest] if share > 0 else "neutral", intensity=share)
    track = EmotionTrack(found.track.times, options.intensity * found.track.strengths)
    return replace(options, emotion="neutral", intensity=1.0, emotions=track)
