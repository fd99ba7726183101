"""Audio2Face networks on the default head: untrained, moving along the head's own shapes."""

from functools import cache

import numpy as np
import torch

from meshanim.heads import load_head
from meshanim.models.audio2face.diffusion import Audio2FaceDiffusion, DiffusionConfig
from meshanim.models.audio2face.regression import Audio2FaceRegression, ImplicitClip, RegressionConfig
from meshanim.motion.animation_state import Actors, StateBasis
from meshanim.motion.face_parts import face_parts


@cache
def head_actors():
    """Six components of skin and two of the tongue that span some of the head's shapes; two people."""
    head = load_head("default")
    parts = face_parts(head)
    names = ("jawOpen", "mouthSmileLeft", "mouthSmileRight", "browInnerUp", "mouthPucker", "eyeBlinkLeft")
    rows = [head.expression_names.index(name) for name in (*names, "tongueOut")]
    shapes = head.expression_directions[rows].unflatten(1, (-1, 3))

    def components(deltas):
        return torch.linalg.qr(deltas.flatten(1).T)[0].T.reshape(deltas.shape).contiguous()

    basis = StateBasis(
        parts,
        torch.zeros(len(parts.skin), 3),
        components(shapes[:6][:, parts.skin]),
        torch.zeros(len(parts.tongue), 3),
        components(shapes[[0, 6]][:, parts.tongue]),
        eyes=True,
    )
    shape = torch.zeros(1, len(head.shape_names))
    shape[0, 0] = 2.0
    templates = {
        "anna": torch.from_numpy(head.mesh.vertices.astype(np.float32)),
        "ben": head.template(shape)[0].float(),
    }
    return Actors(basis, templates, head.mesh.faces)


def head_regression(**options):
    torch.manual_seed(0)
    defaults = {
        "feature_dim": 80, "encoder": "mel", "emotions": ("joy", "anger"), "languages": (), "head": "default",
        "subject": "anna", "clips": (ImplicitClip("a", "neutral", 0, 20), ImplicitClip("b", "joy", 20, 10)),
    }  # fmt: skip
    network = Audio2FaceRegression(RegressionConfig(**(defaults | options)), head_actors())
    with torch.no_grad():
        network.encoder.feature_mean.fill_(-8.0)
        network.encoder.feature_scale.fill_(3.0)
        for layer in (network.skin, network.rest):
            layer.weight.normal_(std=0.3)
        network.state_scale.copy_(_scale(network.actors.basis.sizes))
    return network.eval()


def head_diffusion(**options):
    torch.manual_seed(0)
    defaults = {
        "feature_dim": 80, "encoder": "mel", "emotions": ("joy", "anger"), "head": "default",
        "identities": ("anna", "ben"), "width": 16,
    }  # fmt: skip
    network = Audio2FaceDiffusion(DiffusionConfig(**(defaults | options)), head_actors())
    with torch.no_grad():
        for layer in network.outputs:
            layer.weight.normal_(std=0.2)
        network.feature_mean.fill_(-8.0)
        network.feature_scale.fill_(3.0)
        for layer in (*network.geometry, network.geometry_mix, network.speech_mix):
            if layer is not None:
                layer.weight.normal_(std=0.1)
        for weight in network.recurrent.parameters():
            weight.normal_(std=0.3)
        network.scale.fill_(1e-3)
        for part in network.parts:
            if part.name in ("eyes", "head"):
                network.scale[part.columns] = 0.05
            elif part.name == "rig":
                network.scale[part.columns] = 0.5
    return network.eval()


def _scale(sizes):
    deviations = {"skin": 0.02, "tongue": 0.01, "jaw": 2e-3, "eyes": 0.05}
    return torch.cat([torch.full((size,), deviations[name]) for name, size in sizes.items()])
