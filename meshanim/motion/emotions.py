"""Names of the emotions that Audio2Face-3D knows."""

__all__ = ["EMOTIONS"]

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
