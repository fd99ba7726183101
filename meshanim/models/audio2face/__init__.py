"""Audio2Face-3D: speech to animation states by regression, and to raw vertices by diffusion."""

from meshanim.models.audio2face.regression import Audio2FaceRegression, RegressionConfig
from meshanim.models.audio2face.regression_stream import RegressionStream
from meshanim.models.audio2face.speech import EmotionTrack

__all__ = ["Audio2FaceRegression", "EmotionTrack", "RegressionConfig", "RegressionStream"]
