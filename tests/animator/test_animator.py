import numpy as np
import pytest
import soundfile
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from meshanim import Animator
from meshanim.animator import AnimationOptions
from meshanim.audio import MelConfig, Waveform, load_encoder
from meshanim.audio.encoders import MelEncoder
from meshanim.errors import FileFormatError, OptionError, ShapeError
from meshanim.heads import load_head
from meshanim.models.gava import Gava, GavaConfig


def speech(seconds=1.0, rate=16000, seed=0):
    rng = np.random.default_rng(seed)
    time = np.arange(int(seconds * rate)) / rate
    tone = np.sin(2 * np.pi * 140 * time) * (0.5 + 0.5 * np.sin(2 * np.pi * 4 * time))
    return Waveform((0.2 * tone + 0.01 * rng.normal(size=len(time))).astype(np.float32), rate)


@pytest.fixture(scope="module")
def animator():
    """An untrained network whose output depends on what it hears, on the default head."""
    torch.manual_seed(0)
    head = load_head("default")
    config = GavaConfig(
        feature_dim=80, encoder="mel", feature_rate=100.0, tokens=64, width=16, rank=8, channels=16,
        eigenfunctions=8, heads=2, subjects=("ana",), head="default",
    )  # fmt: skip
    model = Gava(config, head.mesh)
    for parameter in model.parameters():  # outputs start at zero otherwise
        if parameter.abs().max() == 0:
            torch.nn.init.normal_(parameter, std=0.5)
    return Animator(model, load_encoder("mel"), head)


@settings(max_examples=10, deadline=None)
@given(cuts=st.lists(st.integers(0, 16000), max_size=6), fps=st.sampled_from([None, 25.0, 29.97, 60.0]))
def test_a_stream_gives_the_frames_of_the_file(animator, cuts, fps):
    waveform, options = speech(), AnimationOptions(fps=fps, seed=4)
    whole = animator(waveform, options)
    stream = animator.open(16000, options)
    parts = [stream.push(block) for block in np.split(waveform.samples, sorted(cuts))]
    parts.append(stream.finish())
    np.testing.assert_allclose(np.concatenate([p.vertices for p in parts]), whole.vertices, atol=2e-6)
    np.testing.assert_allclose(np.concatenate([p.pose for p in parts]), whole.pose, atol=2e-6)


def test_stream_yields_vertices_before_the_speech_ends(animator):
    waveform = speech(2.0)
    blocks = np.split(waveform.samples, 20)
    taken = []

    def microphone():
        for block in blocks:
            taken.append(len(block))
            yield block

    stream = animator.stream(microphone())
    first = next(stream)
    assert first.ndim == 3
    assert len(taken) < 12
    np.testing.assert_allclose(np.concatenate([first, *stream]), animator(waveform).vertices, atol=2e-6)


@pytest.mark.parametrize("rate", [8000, 22050, 44100, 48000])
def test_any_rate_gives_a_frame_a_period(animator, rate):
    assert len(animator(speech(1.5, rate))) == 45


def test_frames_depend_on_the_speech(animator):
    loud, silent = animator(speech()), animator(Waveform(np.zeros(16000, np.float32), 16000))
    assert np.abs(loud.vertices - silent.vertices).max() > 1e-6
    assert np.isfinite(silent.vertices).all()


def test_fifty_milliseconds_are_enough(animator):
    sequence = animator(speech(0.05))
    assert len(sequence) == 2
    assert np.isfinite(sequence.vertices).all()


def test_identity_and_idle_motion(animator):
    still = AnimationOptions(blinks=0, gaze=0, sway=0)
    shape = torch.zeros(1, len(animator.head.shape_names))
    shape[0, 0] = 2.0
    template = animator.head.template(shape)[0].numpy()
    ours, theirs = animator(speech(), still), animator(speech(), still, template)
    moved = theirs.mesh.vertices - ours.mesh.vertices
    assert np.abs(moved).max() > 1e-3
    assert np.abs(theirs.vertices[0] - theirs.mesh.vertices).max() < 0.02
    blinking = animator(speech(6.0), AnimationOptions(blinks=1.0, gaze=0, sway=0, seed=1))
    lids = animator.head.regions["eyelids"]
    calm = animator(speech(6.0), still)
    assert np.abs(blinking.vertices - calm.vertices)[:, lids].max() > 2e-3


def test_bad_sound_is_named(animator, tmp_path):
    text = tmp_path / "text.wav"
    text.write_text("this is not sound")
    with pytest.raises(FileFormatError, match=r"text\.wav"):
        animator(text)
    with pytest.raises(FileFormatError, match="missing"):
        animator(tmp_path / "missing.wav")
    broken = np.zeros(8000, np.float32)
    broken[100] = np.nan
    soundfile.write(tmp_path / "nan.wav", broken, 16000, subtype="FLOAT")
    with pytest.raises(ShapeError, match=r"nan\.wav"):
        animator(tmp_path / "nan.wav")
    soundfile.write(tmp_path / "empty.wav", np.zeros(0), 16000)
    with pytest.raises(ShapeError, match=r"empty\.wav"):
        animator(tmp_path / "empty.wav")
    with pytest.raises(ShapeError, match="NaN"):
        animator.open().push(broken)


def test_eight_kilohertz_stereo_in_24_bits(animator, tmp_path):
    samples = speech(1.0, 8000).samples
    soundfile.write(tmp_path / "phone.wav", np.stack([samples, samples], 1), 8000, subtype="PCM_24")
    assert len(animator(tmp_path / "phone.wav")) == 30


def test_wrong_names_say_what_there_is(animator):
    with pytest.raises(OptionError, match="ana"):
        animator(speech(), AnimationOptions(subject="nobody"))
    with pytest.raises(OptionError, match="neutral"):
        animator(speech(), AnimationOptions(emotion="hangry"))
    with pytest.raises(FileFormatError, match="nowhere"):
        Animator.from_pretrained("nowhere/at-all")
    with pytest.raises(OptionError, match="features"):
        Animator(animator.model, MelEncoder(MelConfig(bands=40)))


def test_checkpoint_folder_brings_encoder_and_head(animator, tmp_path):
    animator.model.save_pretrained(tmp_path / "gava")
    again = Animator.from_pretrained(tmp_path / "gava")
    np.testing.assert_allclose(again(speech()).vertices, animator(speech()).vertices, atol=1e-6)
