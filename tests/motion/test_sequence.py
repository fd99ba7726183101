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
    with pytest.raises(FileFormatError, match=r"missing\.npz"):
        MeshSequence.load(tmp_path / "missing.npz")


def test_what_does_not_fit_is_refused(tetrahedron, unchecked):
    with pytest.raises(ShapeError, match="4, 3"):
        MeshSequence(np.zeros((2, 5, 3), np.float32), 30.0, tetrahedron)
    with pytest.raises(OptionError, match="fps"):
        MeshSequence(np.zeros((2, 4, 3), np.float32), 0.0, tetrahedron)
    with pytest.raises(ShapeError, match="pose"):
        MeshSequence(np.zeros((2, 4, 3), np.float32), 30.0, tetrahedron, np.zeros((3, 3), np.float32))
    with pytest.raises(OptionError, match=r"\.npz"):
        MeshSequence(np.zeros((2, 4, 3), np.float32), 30.0, tetrahedron).save("talk.mp4")
