"""Poses from prosody and from files go beside the vertices of a data set; nothing else changes."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from meshanim.audio import Waveform
from meshanim.cli import main
from meshanim.datasets import MeshanimDataset, MotionSequence, SequenceInfo, Subject, pose_augmentation
from meshanim.datasets.meshanim_format import write_dataset, write_sequence, write_subject
from meshanim.datasets.pose_augmentation import AugmentPoseOptions, augment_pose
from meshanim.errors import FileFormatError, OptionError
from meshanim.geometry import TriangleMesh
from meshanim.motion import smooth_rotations


@pytest.fixture
def corpus(tmp_path):
    """Two sentences of two subjects on a tetrahedron, with sound that rises and falls."""
    mesh = TriangleMesh(np.eye(4, 3), np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]]))
    template, names, subjects = mesh.vertices.astype(np.float32), [], []
    for number, frames in enumerate((60, 75)):
        subject = f"person{number}"
        time = np.arange(frames * 640) / 16000
        sound = 0.3 * np.sin(2 * np.pi * 150 * time) * np.sin(2 * np.pi * (1 + number) * time) ** 2
        info = SequenceInfo(subject, 1, "", 25.0, frames)
        still = np.zeros((frames, 0), np.float32)
        sequence = MotionSequence(
            info,
            np.repeat(template[None], frames, 0),
            np.zeros((frames, 3), np.float32),
            still,
            Waveform(sound.astype(np.float32), 16000),
        )
        write_sequence(tmp_path / "corpus", sequence)
        subjects.append(Subject(subject, template))
        write_subject(tmp_path / "corpus", subjects[-1])
        names.append(info.name)
    write_dataset(tmp_path / "corpus", "small", 25.0, "", mesh, (), subjects, {"train": names})
    return tmp_path / "corpus"


def test_prosody_turns_heads_and_touches_nothing_else(corpus):
    before = {path: path.read_bytes() for path in corpus.rglob("*") if path.is_file()}
    statistics = augment_pose(AugmentPoseOptions(corpus, seed=7, workers=1), progress=False)
    changed = {path.name for path, data in before.items() if path.read_bytes() != data}
    assert changed == {"pose.npy", "dataset.json"}
    assert 0.5 < np.degrees(statistics.mean) < 15
    dataset = MeshanimDataset(corpus)
    assert dataset.check() == []
    poses = [np.asarray(dataset.motion(name).pose) for name in dataset.sequences[:2]]
    frames = min(map(len, poses))
    assert not np.allclose(poses[0][:frames], poses[1][:frames], atol=1e-3)
    augment_pose(AugmentPoseOptions(corpus, seed=7, workers=1), progress=False)
    assert np.array_equal(dataset.motion(dataset.sequences[0]).pose, poses[0])
    assert json.loads((corpus / "dataset.json").read_text())["pose"]["source"] == "prosody"


def test_tracks_are_resampled_centred_filtered_and_scaled(corpus, tmp_path):
    dataset = MeshanimDataset(corpus)
    tracks = tmp_path / "tracks"
    tracks.mkdir()
    camera = Rotation.from_rotvec([0.0, 0.7, 0.0])
    for name in dataset.sequences:
        info = dataset.info(name)
        frames = 2 * info.frames
        sway = 0.2 * np.sin(np.arange(frames)[:, None] / 9) * [0.0, 1.0, 0.0]
        np.savez(
            tracks / f"{name}.npz",
            rotation=(camera * Rotation.from_rotvec(sway)).as_rotvec(),
            fps=2 * info.fps,
        )
    options = AugmentPoseOptions(corpus, "file", tracks, center=True, gain=0.5, workers=1)
    augment_pose(options, progress=False)
    name = dataset.sequences[0]
    found, frames = np.asarray(dataset.motion(name).pose), dataset.info(name).frames
    sway = 0.2 * np.sin((2 * np.arange(frames) + 0.5) / 9)
    expected = smooth_rotations(np.outer(sway - sway.mean(), [0.0, 1.0, 0.0]))
    assert np.allclose(found, 0.5 * expected, atol=2e-3)


def test_missing_and_bad_tracks_leave_the_data_alone(corpus, tmp_path):
    dataset = MeshanimDataset(corpus)
    before = [np.array(dataset.motion(name).pose) for name in dataset.sequences]
    with pytest.raises(FileFormatError, match=dataset.sequences[0]):
        augment_pose(AugmentPoseOptions(corpus, "file", tmp_path, workers=1), progress=False)
    with pytest.raises(OptionError, match="--tracks"):
        AugmentPoseOptions(corpus, "video")
    with pytest.raises(OptionError, match="window"):
        AugmentPoseOptions(corpus, window=4)
    for name, old in zip(dataset.sequences, before):
        assert np.array_equal(dataset.motion(name).pose, old)


def test_a_damaged_track_changes_nothing_and_the_run_goes_on(corpus, tmp_path, monkeypatch):
    dataset = MeshanimDataset(corpus)
    second = dataset.sequences[1]
    tracks = tmp_path / "tracks"
    tracks.mkdir()
    for name in dataset.sequences:
        np.savez(tracks / f"{name}.npz", rotation=np.full((80, 3), 0.1), fps=25.0)
    good = (tracks / f"{second}.npz").read_bytes()
    (tracks / f"{second}.npz").write_bytes(good[: len(good) // 2])
    before = {path: path.read_bytes() for path in corpus.rglob("*") if path.is_file()}
    options = AugmentPoseOptions(corpus, "file", tracks, workers=1)
    with pytest.raises(FileFormatError, match=second):
        augment_pose(options, progress=False)
    assert all(path.read_bytes() == data for path, data in before.items())
    (tracks / f"{second}.npz").write_bytes(good)
    made, load = [], pose_augmentation.load_pose_track
    monkeypatch.setattr(
        pose_augmentation, "load_pose_track", lambda path, fps: made.append(path.stem) or load(path, fps)
    )
    augment_pose(options, progress=False)
    assert made == [second]
    assert all(np.allclose(dataset.motion(name).pose, 0.1, atol=1e-6) for name in dataset.sequences)
    assert {path for path in corpus.rglob("*") if path.is_file()} == set(before)


def test_poses_of_other_options_are_not_taken_up(corpus, tmp_path):
    dataset = MeshanimDataset(corpus)
    first, second = dataset.sequences
    np.savez(tmp_path / f"{first}.npz", rotation=np.full((80, 3), 0.1), fps=25.0)
    (tmp_path / f"{second}.npz").write_bytes(b"damaged")
    with pytest.raises(FileFormatError, match=second):
        augment_pose(AugmentPoseOptions(corpus, "file", tmp_path, workers=1), progress=False)
    np.savez(tmp_path / f"{second}.npz", rotation=np.full((80, 3), 0.1), fps=25.0)
    augment_pose(AugmentPoseOptions(corpus, "file", tmp_path, gain=2.0, workers=1), progress=False)
    assert all(np.allclose(dataset.motion(name).pose, 0.2, atol=1e-6) for name in dataset.sequences)


def test_faceformers_layout_is_named(corpus):
    (corpus / "vertices_npy").mkdir()
    with pytest.raises(FileFormatError, match="FaceFormer's layout"):
        augment_pose(AugmentPoseOptions(corpus, workers=1), progress=False)


def test_the_command_prints_and_plots(corpus, tmp_path, capsys):
    pytest.importorskip("matplotlib")
    plot = tmp_path / "poses.png"
    assert main(["data", "augment-pose", str(corpus), "--plot", str(plot), "--workers", "1"]) == 0
    assert "degrees" in capsys.readouterr().out
    assert plot.read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    assert main(["data", "augment-pose", str(corpus), "--source", "file", "--tracks", str(tmp_path)]) == 2
    assert "has no file of" in capsys.readouterr().err
