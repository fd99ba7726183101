import json
import shutil

import numpy as np
import pytest
import torch
from audio2face_files import write_tree

from meshanim.audio import PHONEMES, pitch, synthesize_speech
from meshanim.datasets import open_dataset
from meshanim.datasets.animation_preparation import (
    StateOptions,
    lid_opening,
    phoneme_labels,
    prepare_states,
    resting_frame,
)
from meshanim.datasets.animation_states import AnimationStates, ClipArrays, at_positions
from meshanim.datasets.meshanim_format import (
    MotionSequence,
    SequenceInfo,
    Subject,
    write_dataset,
    write_sequence,
    write_subject,
)
from meshanim.errors import FileFormatError, OptionError
from meshanim.heads import load_head
from meshanim.motion.face_parts import face_parts

FPS = 30.0
TEXT = "Papa may buy a map."


@pytest.fixture(scope="module")
def head():
    return load_head("default")


@pytest.fixture(scope="module")
def corpus(tmp_path_factory, head):
    """Two sentences of one subject, spoken; jaw, smile and eyes move; a blink in the second."""
    folder = tmp_path_factory.mktemp("corpus") / "data"
    folder.mkdir()
    template = head.template_vertices.numpy()
    subject = Subject("anna", template)
    write_subject(folder, subject)
    waveform, phonemes = synthesize_speech(TEXT, "pico:en-US")
    frames = int(waveform.duration * FPS)
    time = (np.arange(frames) + 0.5) / FPS
    for number, (emotion, smile) in enumerate((("neutral", 0.0), ("joy", 0.8), ("neutral", 0.0)), 1):
        jaw = np.zeros(frames)
        for phoneme in phonemes:
            if phoneme.symbol.startswith("A"):
                jaw[(time >= phoneme.start) & (time < phoneme.end)] = 0.5
        blink = np.exp(-(((time - 0.6) / 0.06) ** 2)) * (number == 2)
        weights = {
            "jawOpen": jaw,
            "mouthSmileLeft": np.full(frames, smile),
            "eyeLookOutLeft": 0.3 * np.sin(3 * time) ** 2,
            "eyeLookInRight": 0.3 * np.sin(3 * time) ** 2,
            "eyeBlinkLeft": blink,
            "eyeBlinkRight": blink,
            "tongueOut": 0.2 * jaw,
        }
        curves = head.expression({name: torch.from_numpy(value).float() for name, value in weights.items()})
        vertices = head.deform(expression=curves).numpy()
        info = SequenceInfo(
            "anna",
            number,
            TEXT,
            FPS,
            frames,
            tuple((p.start, p.end, p.symbol) for p in phonemes),
            emotion,
            float(number == 2),
            "pico:en-US",
        )
        still = np.zeros((frames, 3), np.float32)
        write_sequence(
            folder, MotionSequence(info, vertices, still, np.zeros((frames, 0), np.float32), waveform)
        )
    names = [f"anna_sentence{k:02d}" for k in (1, 2, 3)]
    splits = {"train": names[:2], "test": names[2:]}
    write_dataset(folder, "small", FPS, "default", head.mesh, [], [subject], splits)
    return folder


@pytest.fixture(scope="module")
def states(corpus, tmp_path_factory):
    folder = tmp_path_factory.mktemp("states") / "a2f"
    done = prepare_states(open_dataset(corpus), folder, workers=1)
    assert done.explained == {"skin": pytest.approx(1), "tongue": pytest.approx(1)}
    assert done.made == {"recorded": 3, "pitch": 2, "voice": 2, "speech": 2, "silence": 2}
    assert done.labels == {"given": 3}
    assert done.lacking == ()
    return AnimationStates(folder)


def test_states_are_the_faces(states, corpus, head):
    dataset = open_dataset(corpus)
    for name in dataset.sequences:
        arrays, truth = states.arrays(name), dataset[name].vertices
        found = states.basis.vertices(torch.from_numpy(arrays.state), states.templates["anna"]).numpy()
        error = np.linalg.norm(found - truth, axis=2)
        assert error[:, states.basis.parts.skin].max() < 1e-5
        assert error[:, states.basis.parts.tongue].max() < 1e-5
        assert (
            error[:, states.basis.parts.jaw_rigid].max() < 1e-3
        )  # the shape jawOpen turns them by straight lines
        eyes = np.concatenate([states.basis.parts.left_eye, states.basis.parts.right_eye])
        assert error[:, eyes].max() < 1e-3
        np.testing.assert_array_equal(states.vertices(name, arrays.timeline), truth)
    assert states.emotions == ("neutral", "joy")
    assert states.of(made=("recorded",))[0].labels == "given"
    assert [clip.split for clip in states.of(split="test")] == ["test"]


def test_closed_eyes_are_marked(states):
    opened = states.arrays("anna_sentence02").open
    time = (np.arange(len(opened)) + 0.5) / FPS
    assert opened[np.argmin(np.abs(time - 0.6))] == 0
    assert opened[np.abs(time - 0.6) > 0.15].all()
    assert states.arrays("anna_sentence01").open.all()


def test_other_voices_keep_the_times(states):
    for made in ("pitch1", "voice1"):
        own, other = states.arrays("anna_sentence01"), states.arrays(f"anna_sentence01~{made}")
        for a, b in zip(vars(own).values(), vars(other).values()):
            np.testing.assert_array_equal(a, b)
        sounds = [states.audio(name) for name in ("anna_sentence01", f"anna_sentence01~{made}")]
        assert len(sounds[0].samples) == len(sounds[1].samples)
        f0 = [pitch(sound, 50) for sound in sounds]
        both = (f0[0] > 0) & (f0[1] > 0)
        assert abs(np.log2(np.median(f0[1][both] / f0[0][both]))) > 0.01


def test_synthetic_speech_moves_when_it_says_so(states):
    name = "anna_sentence01~speech1"
    own, spoken = states.arrays("anna_sentence01"), states.arrays(name)
    assert (np.diff(spoken.timeline) >= 0).all()
    np.testing.assert_allclose(spoken.state, at_positions(own.state, spoken.timeline))
    vertices = states.vertices(name, spoken.timeline)
    pairs = states.basis.parts.lip_pairs
    gap = (vertices[:, pairs[:, 0], 1] - vertices[:, pairs[:, 1], 1]).mean(1)
    at = ((np.arange(len(gap)) + 0.5) / FPS * 50).astype(int)
    symbols = np.array(PHONEMES)[spoken.phonemes[np.minimum(at, len(spoken.phonemes) - 1)]]
    open_frames = np.char.startswith(symbols, "A")
    closed = np.isin(symbols, ["P", "B", "M"])
    assert closed.sum() > 3
    assert gap[closed].mean() < 0.35 * gap[open_frames].mean()


def test_silence_rests(states):
    for emotion in ("neutral", "joy"):
        name = f"anna~silence-{emotion}"
        clip, arrays = states.clips[name], states.arrays(name)
        assert (clip.emotion, clip.frames, states.audio(name).duration) == (emotion, 120, 4.0)
        assert not states.audio(name).samples.any()
        assert (arrays.state == arrays.state[0]).all()
        assert (arrays.phonemes == 0).all()
        vertices = states.vertices(name, arrays.timeline[:1])
        pairs = states.basis.parts.lip_pairs
        assert (vertices[0, pairs[:, 0], 1] - vertices[0, pairs[:, 1], 1]).mean() < 0.003
        smiling = states.arrays("anna_sentence02").state[0, 0]
        assert (abs(arrays.state[0, 0] - smiling) < 0.1 * abs(smiling)) == (emotion == "joy")


def test_a_second_run_keeps_the_first_and_refuses_another(states, corpus, tmp_path):
    folder = tmp_path / "again"
    shutil.copytree(states.directory, folder)
    (folder / "a2f.json").unlink()
    lost = folder / "clips" / "anna_sentence01.json"
    lost.unlink()
    kept = folder / "clips" / "anna_sentence02.safetensors"
    before = kept.stat().st_mtime_ns
    prepare_states(open_dataset(corpus), folder, workers=1)
    assert kept.stat().st_mtime_ns == before
    assert list(AnimationStates(folder).clips.values()) == list(states.clips.values())
    for file in sorted((folder / "clips").iterdir()):
        assert file.read_bytes() == (states.directory / "clips" / file.name).read_bytes()
    with pytest.raises(OptionError, match="other data or options"):
        prepare_states(open_dataset(corpus), folder, StateOptions(skin=3), workers=1)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "note.txt").write_text("mine")
    with pytest.raises(OptionError, match="not empty"):
        prepare_states(open_dataset(corpus), tmp_path / "full", workers=1)


def test_the_published_layout_becomes_states(tmp_path):
    truth, turned = write_tree(tmp_path / "claire", frames=60)
    options = StateOptions(skin=5, tongue=2, pitch=0, voices=0, speech=0, silence=0.5)
    done = prepare_states(open_dataset(tmp_path / "claire"), tmp_path / "a2f", options, workers=1)
    assert done.lacking == ("jaw_rigid", "right_eye", "left_eye")
    assert done.labels["none"] == 1  # Mandarin
    states = AnimationStates(tmp_path / "a2f")
    assert states.basis.sizes == {"skin": 5, "tongue": 2, "jaw": 15, "eyes": 4}
    arrays = states.arrays("eg1")
    at = states.basis.columns
    np.testing.assert_allclose(arrays.state[:, at["eyes"]], turned["eg1"].reshape(60, 4), atol=1e-6)
    jaw = truth["eg1"][:, -5:] - states.templates["claire"][-5:].numpy()
    np.testing.assert_allclose(arrays.state[:, at["jaw"]], jaw.reshape(60, 15), atol=1e-6)
    assert states.clips["cp1"].labels == "none"
    assert (states.arrays("cp1").phonemes == -1).all()
    np.testing.assert_allclose(
        states.vertices("eg2", np.array([2.5])), truth["eg2"][2:4].mean(0)[None], atol=1e-6
    )


def test_a_resting_frame_is_silent_and_open_eyed():
    state = np.zeros((10, 1), np.float32)
    state[:, 0] = [5, 5, 1, 1.2, 1.1, 9, 9, 9, 9, 9]
    opened = np.ones(10, np.uint8)
    opened[4] = 0
    labels = np.ones(100, np.int64)
    labels[:60] = 0  # 1.2 s of silence: frames 0 to 5 at 5 a second; the last one is too near the speech
    clip = ClipArrays(state, np.arange(10.0), opened, labels)
    assert resting_frame([clip], 5.0) == (0, 3)  # of 5, 5, 1, 1.2
    talking = ClipArrays(state, np.arange(10.0), np.ones(10, np.uint8), np.full(100, -1))
    _, frame = resting_frame([talking], 5.0)
    assert state[frame, 0] == 5


def test_small_functions(head):
    rows = np.arange(12.0, dtype=np.float32).reshape(4, 3)
    np.testing.assert_allclose(at_positions(rows, np.array([-1.0, 1.25, 3.0, 9.0]))[:, 0], [0, 3.75, 9, 9])
    assert at_positions(rows[:1], np.array([0.0, 0.7])).tolist() == rows[[0, 0]].tolist()
    assert (phoneme_labels([], 4) == -1).all()
    parts = face_parts(head)
    half = head.deform(expression=head.expression({"eyeBlinkLeft": 0.5, "eyeBlinkRight": 0.5}))
    assert 0.35 < float(lid_opening(half, head.template_vertices, parts)[0]) < 0.75
    assert float(lid_opening(head.template_vertices[None], head.template_vertices, parts)[0]) == 1


def test_bad_input_is_named(states, corpus, tmp_path):
    dataset = open_dataset(corpus)
    with pytest.raises(OptionError, match="no subject 'bob'"):
        prepare_states(dataset, tmp_path / "x", StateOptions(subjects=("bob",)), workers=1)
    with pytest.raises(OptionError, match="share"):
        StateOptions(variance=0)
    with pytest.raises(OptionError, match="negative"):
        StateOptions(pitch=-1)
    few = tmp_path / "few.json"
    few.write_text(json.dumps({"skin": [99999]}))
    with pytest.raises(OptionError, match="another topology"):
        prepare_states(dataset, tmp_path / "y", parts=few, workers=1)
    with pytest.raises(FileFormatError, match="makes it"):
        AnimationStates(tmp_path)
    folder = tmp_path / "copy"
    shutil.copytree(states.directory, folder)
    (folder / "clips" / "anna_sentence01.safetensors").write_bytes(b"\0" * 40)
    with pytest.raises(FileFormatError, match="no clip"):
        AnimationStates(folder).arrays("anna_sentence01")
    with pytest.raises(OptionError, match="no clip of split val"):
        states.of(split="val")
    with pytest.raises(OptionError, match="no subject"):
        states.of(("carl",))
    moved = AnimationStates(folder)
    moved._source = {**moved._source, "directory": "nowhere"}
    with pytest.raises(FileFormatError, match="is gone"):
        moved.vertices("anna_sentence02", np.zeros(1))
    (folder / "basis.safetensors").unlink()
    with pytest.raises(FileFormatError, match="basis"):
        AnimationStates(folder)


def test_command_line(corpus, tmp_path, capsys):
    from meshanim.cli import main

    arguments = ["data", "a2f", str(corpus), "-o", str(tmp_path / "a2f"), "--workers", "1", "--skin", "4"]
    arguments += ["--speech", "0", "--voices", "0", "--pitch", "0"]
    assert main(arguments) == 0
    said = capsys.readouterr().out
    assert "3 recorded, 2 silence clips" in said
    assert "phonemes: 3 given" in said
    assert "has no" not in said
    assert AnimationStates(tmp_path / "a2f").basis.sizes["skin"] == 4
    assert main(["data", "a2f", str(tmp_path / "nothing"), "-o", str(tmp_path / "b")]) == 2
