"""Audio2Emotion (Audio2Face-3D, App. A): which of six emotions is heard in speech, over time."""

from meshanim.models.audio2emotion.detection import (
    DetectedEmotions,
    EmotionDetector,
    EmotionStream,
    detect_emotions,
    load_audio2emotion,
)
from meshanim.models.audio2emotion.network import Audio2Emotion, Audio2EmotionConfig
from meshanim.models.audio2emotion.postprocessing import EmotionOptions, EmotionPostProcessor

__all__ = [
    "Audio2Emotion",
    "Audio2EmotionConfig",
    "DetectedEmotions",
    "EmotionDetector",
    "EmotionOptions",
    "EmotionPostProcessor",
    "EmotionStream",
    "detect_emotions",
    "load_audio2emotion",
]
