"""Emotions that are heard in the speech itself, for networks that are told emotions."""

from dataclasses import replace

from meshanim.audio import Waveform
from meshanim.errors import OptionError
from meshanim.models.audio2emotion import EmotionDetector, EmotionOptions, detect_emotions
from meshanim.models.audio2face import Audio2FaceDiffusion, EmotionTrack
from meshanim.motion.emotions import HEARD_EMOTIONS
from meshanim.performance import AnimationOptions, Network, told_emotions

__all__ = ["with_heard_emotions"]


def with_heard_emotions(
    network: Network,
    speech: Waveform,
    options: AnimationOptions,
    detector: EmotionDetector,
    post: EmotionOptions | None = None,
) -> AnimationOptions:
    """Options that say what is heard in a speech over time, times `options.intensity`, in a network's words.

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
    emotions = told_emotions(network)
    if not set(emotions) & set(HEARD_EMOTIONS):
        raise OptionError(
            f"this network knows none of {', '.join(HEARD_EMOTIONS)}; it was trained on "
            f"{', '.join(network.config.emotions) or 'no emotions'}"
        )
    found = detect_emotions(speech, detector, post, emotions)
    track = EmotionTrack(found.track.times, options.intensity * found.track.strengths)
    return replace(options, emotion="neutral", intensity=1.0, emotions=track)
