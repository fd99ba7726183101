import numpy as np
import pytest

from meshanim.errors import FileFormatError, OptionError, ShapeError
from meshanim.motion import MeshSequence


def test_npz_round_trip(tmp_path, tetrahedron):
    vertices = np.random.default_rng(0).normal(size=(5, 4, 3)).astype(np.float32)
    pose = np.full((5, 3), 0.1, np.float32)
    MeshSequence(vertices, 29.97, tetrahedron, pose).save(tmp_path / "talk.npz")
    with np.load(tmp_path / "talk.npz") as archive:
        assert {"vertices", "faces", "fps", "pose"} <= set(archive)
    back = MeshSequence.load(tmp_path / "talk.npz")
    np.testing.assert_array_equal(back.vertices, vertices)
    np.testing.assert_array_equal(back.pose, pose)
    np.testing.assert_array_equal(back.mesh.faces, tetrahedron.faces)
    assert back.fps == 29.97
    assert back.duration == pytest.approx(5 / 29.97)


def test_pose_defaults_to_zero(tetrahedron):
    assert not MeshSequence(np.zeros((2, 4, 3), np.float32), 30.0, tetrahedron).pose.any()


def test_damaged_or_foreign_files_are_named(tmp_path, tetrahedron):
    path = tmp_path / "talk.npz"
    MeshSequence(np.zeros((50, 4, 3), np.float32), 30.0, tetrahedron).save(path)
    path.write_bytes(path.read_bytes()[:300])
    with pytest.raises(FileFormatError, match=r"talk\.npz"):
        MeshSequence.load(path)
    np.savez(tmp_path / "other.npz", a=1)
    with pytest.raises(FileFormatError, match="vertices"):
        MeshSequence.load(tmp_path / "other.npz")
    with pytest.raises(FileFormatError, match=r"missing\.npz: there is no such file"):
        MeshSequence.load(tmp_path / "missing.npz")
    (tmp_path / "speech.wav").write_bytes(b"RIFF" + bytes(100))
    with pytest.raises(FileFormatError, match=r"speech\.wav: it is no \.npz") as caught:
        MeshSequence.load(tmp_path / "speech.wav")
    assert "pickle" not in str(caught.value)


def test_what_does_not_fit_is_refused(tetrahedron, unchecked):
    with pytest.raises(ShapeError, match="4, 3"):
        MeshSequence(np.zeros((2, 5, 3), np.float32), 30.0, tetrahedron)
    with pytest.raises(OptionError, match="fps"):
        MeshSequence(np.zeros((2, 4, 3), np.float32), 0.0, tetrahedron)
    with pytest.raises(ShapeError, match="pose"):
        MeshSequence(np.zeros((2, 4, 3), np.float32), 30.0, tetrahedron, np.zeros((3, 3), np.float32))
    with pytest.raises(OptionError, match=r"\.npz"):
        MeshSequence(np.zeros((2, 4, 3), np.float32), 30.0, tetrahedron).save("talk.mp4")


def test_resampled_motion_is_the_same_in_time(tetrahedron):
    """Linear motion and a steady turn come out exactly; a finer rate and back gives the frames back."""
    at = (np.arange(12, dtype=np.float32) + 0.5) / 30
    vertices = tetrahedron.vertices.astype(np.float32) + at[:, None, None]
    pose = np.stack([0 * at, at, 0 * at], 1)
    sequence = MeshSequence(vertices, 30.0, tetrahedron, pose)
    for fps, count in ((60.0, 24), (25.0, 10), (24.0, 10), (29.97, 12)):
        other = sequence.resampled(fps)
        assert (len(other), other.fps) == (count, fps)
        times = np.clip((np.arange(count) + 0.5) / fps, at[0], at[-1])
        moved = other.vertices - tetrahedron.vertices
        np.testing.assert_allclose(moved, np.broadcast_to(times[:, None, None], moved.shape), atol=1e-6)
        np.testing.assert_allclose(other.pose[:, 1], times, atol=1e-6)
        assert other.vertices.dtype == other.pose.dtype == np.float32
    assert sequence.resampled(30.0) is sequence
    one = MeshSequence(vertices[:1], 30.0, tetrahedron, pose[:1]).resampled(100.0)
    np.testing.assert_array_equal(one.vertices, np.repeat(vertices[:1], 4, 0))
    for fps in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(OptionError, match="resample"):
            sequence.resampled(fps)
