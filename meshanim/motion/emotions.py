"""Names of the emotions that Audio2Face-3D is told, and of those that are heard in speech."""

__all__ = ["EMOTIONS", "HEARD_EMOTIONS"]

EMOTIONS = (
    "amazement",
    "anger",
    "cheekiness",
    "disgust",
    "fear",
    "grief",
    "joy",
    "outofbreath",
    "pain",
    "sadness",
)
"""Audio2Face-3D's emotions (Sec. 3.1) but neutral, which is none of them."""

HEARD_EMOTIONS = ("anger", "disgust", "fear", "joy", "neutral", "sadness")
"""The classes of Audio2Emotion (App. A.1)."""
