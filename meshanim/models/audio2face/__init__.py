"""Audio2Face-3D: speech to states by regression, to vertices or rig weights by diffusion."""

from meshanim.models.audio2face.diffusion import Audio2FaceDiffusion, DiffusionConfig
from meshanim.models.audio2face.diffusion_stream import DiffusionStream, animate_diffusion
from meshanim.models.audio2face.regression import Audio2FaceRegression, RegressionConfig
from meshanim.models.audio2face.regression_stream import RegressionStream, animate_regression
from meshanim.models.audio2face.schedule import FrameNoise
from meshanim.models.audio2face.speech import EmotionTrack

__all__ = [
    "Audio2FaceDiffusion",
    "Audio2FaceRegression",
    "DiffusionConfig",
    "DiffusionStream",
    "EmotionTrack",
    "FrameNoise",
    "RegressionConfig",
    "RegressionStream",
    "animate_diffusion",
    "animate_regression",
]
