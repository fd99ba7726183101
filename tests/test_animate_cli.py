"""The main command, run as a user runs it, on every output format and on bad input."""

import av
import numpy as np
import pytest
import soundfile
import trimesh
from PIL import Image

from meshanim.cli import main
from meshanim.cli.animate import AnimateOptions, perform
from meshanim.motion import MeshSequence


@pytest.fixture(scope="module")
def speech(tmp_path_factory):
    """A third of a second of something voiced."""
    path = tmp_path_factory.mktemp("speech") / "ba.wav"
    time = np.arange(5333) / 16000
    buzz = sum(np.sin(2 * np.pi * 120 * k * time) / k for k in range(1, 20))
    soundfile.write(path, 0.1 * buzz * np.sin(np.pi * time / time[-1]), 16000)
    return path


def run(*words) -> int:
    return main([str(word) for word in words])


def test_video_with_sound(speech, tmp_path):
    out = tmp_path / "talk.mp4"
    assert run("animate", speech, "-o", out, "--quality", "draft", "--size", 64) == 0
    with av.open(str(out)) as file:
        assert len(list(file.decode(video=0))) == 10
        assert (file.streams.video[0].width, file.streams.video[0].height) == (64, 64)
        assert float(file.streams.audio[0].duration * file.streams.audio[0].time_base) == pytest.approx(
            1 / 3, abs=0.07
        )


def test_npz_glb_and_sheet(speech, tmp_path):
    assert run("animate", speech, "-o", tmp_path / "talk.npz", "--seed", 3) == 0
    sequence = MeshSequence.load(tmp_path / "talk.npz")
    assert len(sequence) == 10
    assert sequence.fps == 30
    assert np.isfinite(sequence.vertices).all()
    assert run("animate", speech, "-o", tmp_path / "talk.glb") == 0
    assert len(trimesh.load(tmp_path / "talk.glb").geometry) == 5
    assert run("animate", speech, "-o", tmp_path / "talk.png", "--size", 64, "--quality", "draft") == 0
    assert Image.open(tmp_path / "talk.png").size == (6 * 32, 2 * 32)


def test_weights_out_and_in(speech, tmp_path, capsys):
    """Speech to a table; the table played again gives the vertices, the turn of the head and the sound."""
    words = ("--seed", 3, "--fps", 25)
    assert run("animate", speech, "-o", tmp_path / "talk.npz", *words) == 0
    first = MeshSequence.load(tmp_path / "talk.npz")
    assert run("animate", speech, "-o", tmp_path / "talk.csv", "--csv", "livelink", *words) == 0
    assert "residual rms [mm]" in capsys.readouterr().out
    _, again = perform(AnimateOptions(tmp_path / "talk.csv", sound=speech))
    assert (len(again), again.fps) == (9, 25)
    assert 1000 * np.linalg.norm(again.vertices - first.vertices, axis=2).max() < 1.5
    np.testing.assert_allclose(again.pose, first.pose, atol=1e-6)
    assert len(again.audio.samples) == 5333
    (tmp_path / "cut.csv").write_text((tmp_path / "talk.csv").read_text()[:-20])
    for bad, message in (
        ((tmp_path / "cut.csv",), "cut.csv: frame 9 has"),
        ((speech, "--sound", speech), "--sound"),
        ((tmp_path / "talk.npz",), "holds no blendshape weights"),
    ):
        assert run("animate", *bad, "-o", tmp_path / "x.npz") == 2
        assert message in capsys.readouterr().err


def test_another_head_by_correspondence(speech, tmp_path):
    """A rig of another topology moves its lips where the default head would."""
    from meshanim.geometry import decimate
    from meshanim.heads import load_head

    head = load_head("default")
    small = decimate(head.mesh, 2500)
    mesh, jaw = small.mesh, head.deform(None, head.expression({"jawOpen": 1.0}))[0].numpy()
    deltas = (small.operator @ (jaw - head.mesh.vertices))[None]
    np.savez(tmp_path / "rig.npz", neutral=mesh.vertices, faces=mesh.faces, deltas=deltas, names=["jawOpen"])
    out = tmp_path / "talk.npz"
    assert run("animate", speech, "-o", out, "--head", f"rig:{tmp_path / 'rig.npz'}") == 0
    sequence = MeshSequence.load(out)
    assert sequence.vertices.shape == (10, mesh.n_vertices, 3)
    moved = np.linalg.norm(sequence.vertices - mesh.vertices, axis=2).max(0)
    mouth = np.abs(mesh.vertices - head.mesh.vertices[head.regions["lips"]].mean(0)).max(1) < 0.03
    assert moved[mouth].max() > 5e-4
    assert moved[mesh.vertices[:, 1] > 0.1].max() < 2e-3


BAD = {
    "text named wav": lambda folder: (folder / "a.wav").write_text("hello"),
    "missing": lambda folder: None,
    "empty": lambda folder: soundfile.write(folder / "a.wav", np.zeros(0), 16000),
    "NaN": lambda folder: soundfile.write(
        folder / "a.wav", np.full(99, np.nan, np.float32), 16000, subtype="FLOAT"
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_sound_is_one_line_exit_2_and_no_file(name, tmp_path, capsys):
    BAD[name](tmp_path)
    out = tmp_path / "talk.npz"
    assert run("animate", tmp_path / "a.wav", "-o", out) == 2
    error = capsys.readouterr().err
    assert error.startswith("meshanim: ")
    assert error.count("\n") == 1
    assert "a.wav" in error
    assert [path.name for path in tmp_path.iterdir()] in (["a.wav"], [])


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (("-o", "talk.avi"), ".mp4"),
        (("-o", "nowhere/talk.mp4"), "nowhere"),
        (("-o", "talk.mp4", "--size", "33"), "even"),
        (("-o", "talk.npz", "--person", "nobody"), "nobody"),
        (("-o", "talk.npz", "--subject", "nobody"), "nobody"),
        (("-o", "talk.npz", "--style", "nobody"), "nobody"),
        (("-o", "talk.npz", "--fps", "0"), "fps"),
        (("-o", "talk.npz", "--head", "flame:/nowhere.pkl"), "nowhere"),
        (("-o", "talk.npz", "--model", "nowhere/at-all"), "nowhere"),
    ],
)
def test_bad_options_are_one_line_exit_2_and_no_file(speech, words, named, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert run("animate", speech, *words) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert named in error
    assert list(tmp_path.iterdir()) == []


def test_silence_and_fifty_milliseconds_and_telephone(tmp_path):
    soundfile.write(tmp_path / "silence.wav", np.zeros(8000), 16000)
    soundfile.write(tmp_path / "short.wav", 0.1 * np.ones(800), 16000)
    soundfile.write(tmp_path / "phone.wav", np.zeros((4000, 2)), 8000, subtype="PCM_24")
    for name, frames in {"silence": 15, "short": 2, "phone": 15}.items():
        out = tmp_path / f"{name}.npz"
        assert run("animate", tmp_path / f"{name}.wav", "-o", out) == 0
        assert len(MeshSequence.load(out)) == frames
