"""Graphs in ONNX Runtime against torch: any batch, whole streams, encoders inside and outside."""

import numpy as np
import pytest
import torch
from audio2face_small import noise, small_diffusion, small_regression

from meshanim.audio import load_encoder
from meshanim.cli import main
from meshanim.errors import DependencyError, OptionError
from meshanim.models.audio2face import (
    DiffusionStream,
    EmotionTrack,
    FrameNoise,
    animate_diffusion,
    animate_regression,
)
from meshanim.models.audio2face.diffusion import REACH
from meshanim.models.audio2face.diffusion_stream import SECOND, block_frames
from meshanim.models.audio2face.onnx import export_onnx
from meshanim.models.audio2face.regression import STEP_TIMES, WINDOW
from meshanim.models.audio2face.speech import cut_windows, features_at

onnxruntime = pytest.importorskip("onnxruntime")
STEPS = torch.from_numpy(STEP_TIMES)


def session(path):
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    return onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])


def transformer(kind, folder):
    """A small random checkpoint of the papers' encoders."""
    transformers = pytest.importorskip("transformers")
    sizes = {
        "hidden_size": 16, "num_hidden_layers": 4, "num_attention_heads": 2, "intermediate_size": 24,
        "conv_dim": [8] * 7, "num_conv_pos_embeddings": 16, "num_conv_pos_embedding_groups": 4,
    }  # fmt: skip
    name = {"wav2vec2": "Wav2Vec2", "hubert": "Hubert"}[kind]
    torch.manual_seed(0)
    config = getattr(transformers, f"{name}Config")(**sizes)
    getattr(transformers, f"{name}Model")(config).save_pretrained(folder)
    return load_encoder(f"{kind}:{folder}@3")


def close(found, expected):
    """Within 1e-4 of the largest number, and not all alike."""
    expected = expected.numpy()
    scale = np.abs(expected).max()
    assert scale > 0
    np.testing.assert_allclose(found, expected, atol=1e-4 * scale)


@pytest.mark.parametrize("batch", [1, 5])
def test_regression_is_that_of_torch(tmp_path, batch):
    network, encoder, waveform = small_regression(), load_encoder("mel"), noise(1.0)
    names = export_onnx(network, encoder, tmp_path / "r.onnx")
    run = session(tmp_path / "r.onnx")
    assert {i.name: [s if isinstance(s, int) else None for s in i.shape] for i in run.get_inputs()} == {
        name: list(shape) for name, shape in names.inputs.items()
    }
    assert names.inputs == {"input": (None, 1, WINDOW), "emotion": (None, 1, 18), "features": (None, 25, 80)}
    assert names.outputs == {"result": (None, 1, 169)}
    emotions = EmotionTrack.of(network.config.emotions, (0.0, {"joy": 0.7, "anger": 0.2}))
    implicit = network.implicit_of(clip="b", frame=2)
    expected = animate_regression(network, encoder, waveform, emotions=emotions, implicit=implicit)
    times = (torch.arange(30, dtype=torch.float64) + 0.5) / 30
    starts = [round(float(time) * 16000 - WINDOW / 2) for time in times]
    emotion = np.concatenate([implicit.numpy(), [0.7, 0.2]]).astype(np.float32)
    inputs = {
        "input": cut_windows(torch.from_numpy(waveform.samples), starts, WINDOW)[:, None].numpy(),
        "emotion": np.tile(emotion, (30, 1, 1)),
        "features": features_at(encoder(waveform), encoder.rate, times[:, None] + STEPS).numpy(),
    }
    found = [
        run.run(None, {name: value[k : k + batch] for name, value in inputs.items()})[0]
        for k in range(0, 30, batch)
    ]
    close(np.concatenate(found)[:, 0], expected)


def test_regression_with_its_encoder_has_the_public_inputs_alone(tmp_path):
    encoder, waveform = transformer("wav2vec2", tmp_path / "w"), noise(0.7)
    network = small_regression(feature_dim=16, encoder=encoder.name, hearing="window")
    names = export_onnx(network, encoder, tmp_path / "r.onnx")
    assert names.inputs == {"input": (None, 1, WINDOW), "emotion": (None, 1, 18)}
    expected = animate_regression(network, encoder, waveform, implicit=network.implicit_of("joy"))
    starts = [round((k + 0.5) / 30 * 16000 - WINDOW / 2) for k in range(21)]
    emotion = np.zeros((21, 1, 18), np.float32)
    emotion[:, 0, :16] = network.implicit_of("joy")
    windows = cut_windows(torch.from_numpy(waveform.samples), starts, WINDOW)[:, None].numpy()
    run = session(tmp_path / "r.onnx")
    parts = [run.run(None, {"input": windows[k : k + 8], "emotion": emotion[k : k + 8]}) for k in (0, 8, 16)]
    close(np.concatenate([part[0] for part in parts])[:, 0], expected)


def drive(run, network, encoder, waveform, row, track, noised, inside):
    """A whole speech block by block, as a program without torch would."""
    config, total = network.config, int(np.ceil(len(waveform.samples) * network.config.fps / 16000))
    before, block, after = block_frames(config.fps)
    shapes = {i.name: i.shape for i in run.get_inputs()}
    steps, layers, _, width = shapes["input_latents"]
    latents = np.zeros((steps, layers, 1, width), np.float32)
    frames = np.zeros((steps, 1, REACH, network.numbers + 1), np.float32)
    identity = np.eye(len(config.identities), dtype=np.float32)[[row]]
    features = None if inside else encoder(waveform)
    given = []
    for begin in range(0, total, block):
        last = min(begin + block + after, total)
        times = (np.arange(begin - REACH, last) + 0.5) / config.fps
        inputs = {
            "identity": identity,
            "emotion": track.at(times[REACH:])[None].numpy(),
            "input_latents": latents,
            "noise": np.concatenate([noised[:, begin:last], 0 * noised[:1, begin:last]])[None],
            "input_frames": frames,
        }
        if inside:
            start = round((begin - before) / config.fps * 16000)
            inputs["window"] = cut_windows(torch.from_numpy(waveform.samples), [start], SECOND).numpy()
        else:
            inputs["features"] = features_at(features, encoder.rate, torch.from_numpy(times))[None].numpy()
        prediction, latents, frames = run.run(None, inputs)
        given.append(prediction[0, : min(block, last - begin)])
    return np.concatenate(given)


@pytest.mark.parametrize(("options", "steps"), [({}, None), ({"fps": 60.0}, 3), ({"layers": 1}, 1)])
def test_diffusion_blocks_are_the_whole_speech(tmp_path, options, steps):
    network, encoder, waveform = small_diffusion(**options), load_encoder("mel"), noise(1.73)
    names = export_onnx(network, encoder, tmp_path / "d.onnx", steps)
    assert list(names.inputs) == [
        "features", "identity", "emotion", "input_latents", "noise", "input_frames",
    ]  # fmt: skip
    count = steps or 2
    track = EmotionTrack.of(network.config.emotions, (0.0, {"joy": 1.0}), (1.2, {"anger": 1.0}))
    expected = animate_diffusion(
        network, encoder, waveform, "ben", track, FrameNoise(count, network.numbers, 4), steps
    )
    noised = FrameNoise(count, network.numbers, 4).frames(0, len(expected)).numpy()
    found = drive(session(tmp_path / "d.onnx"), network, encoder, waveform, 1, track, noised, False)
    close(found, expected)


def test_diffusion_with_its_encoder_hears_windows(tmp_path):
    encoder, waveform = transformer("hubert", tmp_path / "h"), noise(2.1)
    network = small_diffusion(feature_dim=16, encoder=encoder.name)
    names = export_onnx(network, encoder, tmp_path / "d.onnx")
    assert list(names.inputs) == [
        "window", "identity", "emotion", "input_latents", "noise", "input_frames",
    ]  # fmt: skip
    stream = DiffusionStream(network, encoder, "anna", noise=FrameNoise(2, network.numbers, 1))
    expected = torch.cat([stream.push(waveform.samples), stream.finish()])
    noised = FrameNoise(2, network.numbers, 1).frames(0, len(expected)).numpy()
    track = EmotionTrack.of(network.config.emotions)
    found = drive(session(tmp_path / "d.onnx"), network, encoder, waveform, 0, track, noised, True)
    close(found, expected)


def test_rig_and_text_networks(tmp_path):
    network = small_diffusion(target="rig", rig=("jawOpen", "browInnerUp"), experts=12)
    encoder, waveform = load_encoder("mel"), noise(1.1)
    export_onnx(network, encoder, tmp_path / "d.onnx")
    expected = animate_diffusion(network, encoder, waveform, "ben")
    noised = FrameNoise(2, network.numbers).frames(0, len(expected)).numpy()
    track = EmotionTrack.of(network.config.emotions)
    run = session(tmp_path / "d.onnx")
    close(drive(run, network, encoder, waveform, 1, track, noised, False), expected)
    told = small_diffusion(emotions=(), text=7)
    assert export_onnx(told, encoder, tmp_path / "t.onnx").inputs["emotion"] == (None, None, 7)


def test_what_is_refused(tmp_path, monkeypatch):
    encoder = load_encoder("mel")
    with pytest.raises(OptionError, match=r"\.onnx"):
        export_onnx(small_regression(), encoder, tmp_path / "r.pt")
    with pytest.raises(OptionError, match="denoising"):
        export_onnx(small_regression(), encoder, tmp_path / "r.onnx", steps=2)
    with pytest.raises(OptionError, match="denoising"):
        export_onnx(small_diffusion(), encoder, tmp_path / "d.onnx", steps=0)
    with pytest.raises(OptionError, match="53 features"):
        export_onnx(small_diffusion(), load_encoder("visemes"), tmp_path / "d.onnx")
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(DependencyError, match=r"meshanim\[onnx\]"):
        export_onnx(small_regression(), encoder, tmp_path / "r.onnx")
    assert list(tmp_path.iterdir()) == []


def test_the_command(tmp_path, capsys):
    small_regression().save_pretrained(tmp_path / "run" / "model")
    assert main(["export", "onnx", str(tmp_path / "run"), "-o", str(tmp_path / "r.onnx")]) == 0
    assert "emotion (any, 1, 18)" in capsys.readouterr().out
    assert session(tmp_path / "r.onnx").get_outputs()[0].name == "result"
    assert main(["export", "onnx", "default", "-o", str(tmp_path / "g.onnx")]) == 2
    assert not (tmp_path / "g.onnx").exists()
