"""A small face with all the parts that Audio2Face-3D knows, and sound for it."""

import numpy as np
import torch

from meshanim.audio import Waveform
from meshanim.models.audio2face.diffusion import Audio2FaceDiffusion, DiffusionConfig
from meshanim.models.audio2face.regression import Audio2FaceRegression, ImplicitClip, RegressionConfig
from meshanim.motion.animation_state import Actors, StateBasis
from meshanim.motion.face_parts import FaceParts

SKIN, TONGUE = 60, 8


def small_actors(skin=140, tongue=10, names=("anna",), seed=0):
    """60 vertices of skin, 8 of a tongue, 5 jaw points, two eyeballs of 6; random orthonormal components."""
    generator = torch.Generator().manual_seed(seed)
    count = SKIN + TONGUE
    parts = FaceParts(
        skin=np.arange(SKIN),
        tongue=np.arange(SKIN, count),
        jaw_points=np.arange(count, count + 5),
        jaw_rigid=np.arange(count, count + 5),
        right_eye=np.arange(count + 5, count + 11),
        left_eye=np.arange(count + 11, count + 17),
        upper_face=np.arange(40, SKIN),
        lip_pairs=np.array([[k, 5 + k] for k in range(5)]),
        upper_lip=np.array([[10 + k, k] for k in range(5)]),
        lower_lip=np.array([[5 + k, 15 + k] for k in range(5)]),
        lid_pairs=np.array([[20, 21], [22, 23]]),
    )

    def components(rows, points):
        matrix = torch.randn(3 * points, 3 * points, generator=generator)
        return torch.linalg.qr(matrix)[0][:rows].reshape(rows, points, 3)

    basis = StateBasis(
        parts,
        1e-4 * torch.randn(SKIN, 3, generator=generator),
        components(skin, SKIN),
        1e-4 * torch.randn(TONGUE, 3, generator=generator),
        components(tongue, TONGUE),
        eyes=True,
    )
    templates = {name: 0.05 * torch.randn(count + 17, 3, generator=generator) for name in names}
    return Actors(basis, templates, np.zeros((0, 3), np.int64))


def small_regression(seed=0, **options):
    torch.manual_seed(seed)
    defaults = {
        "feature_dim": 80,
        "encoder": "mel",
        "emotions": ("joy", "anger"),
        "languages": ("en", "zh"),
        "clips": (ImplicitClip("a", "neutral", 0, 20), ImplicitClip("b", "joy", 20, 10)),
    }
    network = Audio2FaceRegression(RegressionConfig(**(defaults | options)), small_actors())
    with torch.no_grad():
        network.state_mean.normal_()
        network.encoder.feature_mean.fill_(-8.0)
        network.encoder.feature_scale.fill_(3.0)
    return network.eval()


def noise(seconds, seed=0, rate=16000):
    generator = np.random.default_rng(seed)
    time = np.arange(int(seconds * rate)) / rate
    loud = np.square(np.sin(2 * np.pi * 1.7 * time))
    return Waveform((0.2 * loud * generator.normal(size=len(time))).astype(np.float32), rate)


def small_diffusion(seed=0, **options):
    """Recurrent and output weights large enough that its frames depend on everything before them."""
    torch.manual_seed(seed)
    defaults = {
        "feature_dim": 80,
        "encoder": "mel",
        "identities": ("anna", "ben"),
        "emotions": ("joy", "anger"),
        "width": 24,
    }
    network = Audio2FaceDiffusion(
        DiffusionConfig(**(defaults | options)), small_actors(names=("anna", "ben"))
    )
    with torch.no_grad():
        for layer in network.outputs:
            layer.weight.normal_(std=0.2)
            layer.bias.normal_(std=0.2)
        network.feature_mean.fill_(-8.0)
        network.feature_scale.fill_(3.0)
        # Geometry goes to the output directly, too, and with every step again.
        for layer, size in (
            *((g, 0.05) for g in network.geometry),
            (network.geometry_mix, 0.1),
            (network.speech_mix, 0.2),
        ):
            if layer is not None:
                layer.weight.normal_(std=size)
        for weight in network.recurrent.parameters():
            weight.normal_(std=0.3)
        network.trust.weight.fill_(1.0)
        network.manner.weight.normal_(std=0.1)
        network.mean.normal_(std=0.1)
    return network.eval()
