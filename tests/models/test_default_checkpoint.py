from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest
import torch

from meshanim.audio import Waveform, load_encoder, load_waveform, log_mel
from meshanim.heads import load_head
from meshanim.models.gava import Gava
from meshanim.models.gava_stream import GavaStream, animate
from meshanim.motion.lip_seal import head_lip_seal
from meshanim.training.metrics import lip_aperture

FOLDER = Path(str(files("meshanim") / "models" / "weights" / "gava-default"))
CLIP = Path(__file__).parent.parent / "audio" / "data" / "librivox_0870.flac"


@pytest.fixture(scope="module")
def talking():
    model, encoder, head = Gava.from_pretrained(FOLDER), load_encoder("visemes"), load_head("default")

    def speak(audio: Waveform, **options):
        stream = GavaStream(model, **options)
        parts = list(animate(stream, encoder(audio), log_mel(audio), round(audio.duration * 30)))
        return torch.cat([p.vertices for p in parts]).numpy(), torch.cat([p.pose for p in parts]).numpy()

    return model, encoder, head, speak


def test_it_fits_the_package_and_its_head(talking):
    model, encoder, head, _ = talking
    assert sum(file.stat().st_size for file in FOLDER.iterdir()) < 20e6
    assert np.array_equal(model.mesh.faces, head.mesh.faces)
    assert model.config.encoder == encoder.name
    assert model.config.feature_dim == encoder.dim
    assert (model.config.features, model.config.decoder, model.config.layers) == ("LG", "gava", 3)
    assert "meshanim train gava" in (FOLDER / "PROVENANCE.md").read_text()


def test_a_recorded_voice_opens_and_closes_the_mouth(talking):
    _, encoder, head, speak = talking
    audio = load_waveform(CLIP)
    vertices, pose = speak(audio)
    assert np.isfinite(vertices).all()
    assert np.abs(pose).max() < 0.5
    pairs = torch.from_numpy(np.asarray(head.lip_pairs))
    aperture = lip_aperture(torch.from_numpy(vertices), pairs)
    assert aperture.max() > 0.006
    assert aperture.min() < 0.002
    sealed, _ = speak(audio, seal=head_lip_seal(head), bilabial=encoder.bilabial)
    closed = lip_aperture(torch.from_numpy(sealed), pairs) < 1e-3
    assert closed.float().mean() > (aperture < 1e-3).float().mean()
    ears = head.regions["ears"]
    assert np.abs(vertices[:, ears] - vertices[:1, ears]).max() < 2e-3


def test_silence_rests(talking):
    model, _, head, speak = talking
    vertices, _ = speak(Waveform(np.zeros(24000, np.float32), 16000))
    lips = head.regions["lips"]
    rest = vertices[20:] - model.surface.template.numpy()
    assert np.linalg.norm(rest[:, lips], axis=-1).max() < 0.006
    assert np.abs(np.diff(vertices[20:], axis=0)).max() < 1e-3


def test_an_unseen_template_keeps_its_shape(talking):
    model, _, head, speak = talking
    name = next(iter(head.people))
    template = head.template(head.person(name))[0]
    audio = load_waveform(CLIP)
    short = Waveform(audio.samples[:32000], audio.rate)
    other, _ = speak(short, template=template)
    own, _ = speak(short)
    moved = [v - t for v, t in ((other, template.numpy()), (own, model.surface.template.numpy()))]
    assert (
        np.linalg.norm(moved[0] - moved[1], axis=-1).mean() < 0.5 * np.linalg.norm(moved[1], axis=-1).mean()
    )
