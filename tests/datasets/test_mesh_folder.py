"""Any folder of meshes with wavs."""

import numpy as np
import pytest
import soundfile
import trimesh
from small_trees import motion_of, noise, small_mesh

from meshanim.datasets import MeshFolderDataset, MeshFolderOptions, open_dataset
from meshanim.errors import FileFormatError, OptionError
from meshanim.motion import MeshSequence

FRAMES = 11


@pytest.fixture
def tree(tmp_path):
    """Frames of obj whose numbers have no leading zeros, an .npy, and a saved sequence."""
    mesh = small_mesh()
    folder = tmp_path / "anna_01"
    folder.mkdir()
    for frame, vertices in enumerate(motion_of("anna", 1, FRAMES)):
        trimesh.Trimesh(vertices, mesh.faces, process=False).export(folder / f"frame{frame}.obj", digits=9)
    np.save(tmp_path / "anna_02.npy", motion_of("anna", 2, FRAMES).reshape(FRAMES, -1))
    pose = np.random.default_rng(0).normal(size=(FRAMES, 3)).astype(np.float32)
    MeshSequence(motion_of("ben", 3, FRAMES), 25.0, mesh, pose).save(tmp_path / "ben_03.npz")
    for number, name in enumerate(("anna_01", "anna_02", "ben_03")):
        soundfile.write(tmp_path / f"{name}.wav", noise(FRAMES / 25, 16000, number), 16000)
    return tmp_path


def test_all_three_kinds_of_motion(tree):
    dataset = open_dataset(tree, options=MeshFolderOptions(fps=25))
    assert isinstance(dataset, MeshFolderDataset)
    assert dataset.sequences == ("anna_01", "anna_02", "ben_03")
    assert list(dataset.subjects) == ["anna", "ben"]
    for name, subject, number in (("anna_01", "anna", 1), ("anna_02", "anna", 2), ("ben_03", "ben", 3)):
        sequence = dataset[name]
        assert np.allclose(sequence.vertices, motion_of(subject, number, FRAMES), atol=1e-8)
        assert (sequence.info.subject, sequence.info.sentence) == (subject, number)
    assert isinstance(dataset["anna_02"].vertices, np.memmap)
    assert np.abs(dataset["ben_03"].pose).max() > 0
    assert np.array_equal(dataset.mesh.faces, small_mesh().faces)
    assert dataset.check() == []
    halved = open_dataset(tree, options=MeshFolderOptions(fps=25, stride=2))
    assert halved.check() == []
    assert np.allclose(halved["anna_01"].vertices, dataset["anna_01"].vertices[::2])


def test_templates_scale_and_rate(tree):
    with pytest.raises(OptionError, match="--fps"):
        open_dataset(tree)
    (tree / "templates").mkdir()
    mesh = small_mesh()
    trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).export(tree / "templates" / "anna.ply")
    dataset = open_dataset(tree, options=MeshFolderOptions(fps=25, scale=0.01))
    assert np.allclose(dataset.subjects["anna"].template, mesh.vertices * 0.01, atol=1e-6)
    assert np.allclose(dataset["anna_02"].vertices, motion_of("anna", 2, FRAMES) * 0.01, atol=1e-7)


def test_damage_is_listed(tree):
    options = MeshFolderOptions(fps=25)
    (tree / "anna_01" / "frame5.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    np.save(tree / "anna_02.npy", np.zeros((FRAMES, 41, 3), np.float32))
    (tree / "ben_03.wav").unlink()
    faults = open_dataset(tree, options=options).check()
    assert len(faults) == 3
    for part in ("frame5.obj has 3 vertices, expected 42", "41 vertices, expected 42", "ben_03.wav is not a"):
        assert any(part in fault for fault in faults), (part, faults)


def test_a_folder_of_nothing_says_what_was_looked_for(tmp_path):
    with pytest.raises(FileFormatError, match=r"vertices_npy/.*subj_seq_to_idx"):
        open_dataset(tmp_path)
    with pytest.raises(FileFormatError, match="no folder"):
        open_dataset(tmp_path / "absent")
    with pytest.raises(OptionError, match="no kind of data set 'vocset'"):
        open_dataset(tmp_path, "vocset")
