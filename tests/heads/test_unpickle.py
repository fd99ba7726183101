import os
import pickle

import numpy as np
import pytest
import scipy.sparse as sp
import torch

from meshanim.errors import FileFormatError
from meshanim.unpickle import load_npy_objects, load_pickle


class Shout:
    def __reduce__(self):
        return os.system, ("touch pwned",)


class Evaluated:
    def __reduce__(self):
        return eval, ("1 + 1",)


@pytest.mark.parametrize("protocol", [0, 2, 4, 5])
def test_arrays_survive(tmp_path, protocol):
    content = {
        "array": np.arange(6.0).reshape(2, 3),
        "fortran": np.asfortranarray(np.arange(6, dtype=np.int16).reshape(2, 3)),
        "scalar": np.float32(2.5),
        "text": "a",
        "nested": {"audio": [np.arange(3), 22050], "pair": (1, None)},
        "sparse": sp.csc_matrix(np.eye(3)),
        "rows": sp.csr_matrix(np.diag([1.0, 0.0, 2.0])),
        "tensor": torch.arange(4),
    }
    path = tmp_path / "content.pkl"
    path.write_bytes(pickle.dumps(content, protocol=protocol))
    read = load_pickle(path)
    np.testing.assert_array_equal(read["array"], content["array"])
    np.testing.assert_array_equal(read["fortran"], content["fortran"])
    assert read["scalar"] == 2.5
    assert read["text"] == "a"
    np.testing.assert_array_equal(read["nested"]["audio"][0], np.arange(3))
    assert read["nested"]["pair"] == (1, None)
    np.testing.assert_array_equal(read["sparse"].toarray(), np.eye(3))
    np.testing.assert_array_equal(read["rows"].toarray(), np.diag([1.0, 0.0, 2.0]))
    np.testing.assert_array_equal(read["tensor"], np.arange(4))


def test_python_2_strings(tmp_path):
    path = tmp_path / "old.pkl"
    # What cPickle of Python 2 wrote for {'é': 'x'} in latin1.
    path.write_bytes(b"}q\x00U\x01\xe9q\x01U\x01xq\x02s.".replace(b"}q\x00", b"\x80\x02}q\x00"))
    assert load_pickle(path) == {"é": "x"}


@pytest.mark.parametrize("evil", [Shout(), Evaluated(), np.load, torch.load, pickle.loads])
@pytest.mark.parametrize("inside", [False, True])
def test_anything_else_is_refused_by_name(tmp_path, monkeypatch, evil, inside):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "evil.pkl"
    path.write_bytes(pickle.dumps({"a": np.array([evil], object) if inside else evil}))
    with pytest.raises(FileFormatError, match=r"it names .*no array"):
        load_pickle(path)
    assert not (tmp_path / "pwned").exists()


def test_a_foreign_storage_cannot_smuggle_code(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    inner = pickle.dumps(Shout())
    path = tmp_path / "evil.pkl"
    path.write_bytes(b"\x80\x02ctorch.storage\n_load_from_bytes\n" + pickle.dumps((inner,), 2)[2:-1] + b"R.")
    with pytest.raises(FileFormatError):
        load_pickle(path)
    assert not (tmp_path / "pwned").exists()


def test_damaged_files(tmp_path):
    whole = pickle.dumps({"a": np.arange(100.0)}, protocol=2)
    path = tmp_path / "cut.pkl"
    for size in (0, 1, 10, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:size])
        with pytest.raises(FileFormatError, match="cut"):
            load_pickle(path)
    path.write_text("not a pickle at all")
    with pytest.raises(FileFormatError):
        load_pickle(path)
    with pytest.raises(FileFormatError, match="does not exist"):
        load_pickle(tmp_path / "nowhere.pkl")


def test_a_sparse_matrix_with_wild_indices_is_refused(tmp_path):
    matrix = sp.csc_matrix(np.eye(3))
    matrix.indices = np.array([0, 1, 400], np.int32)
    path = tmp_path / "wild.pkl"
    path.write_bytes(pickle.dumps(matrix))
    with pytest.raises(FileFormatError):
        load_pickle(path)


def test_npy_of_objects(tmp_path):
    path = tmp_path / "a.npy"
    np.save(path, {"x": np.arange(3)}, allow_pickle=True)
    np.testing.assert_array_equal(load_npy_objects(path)["x"], np.arange(3))
    np.save(path, np.eye(2))
    np.testing.assert_array_equal(load_npy_objects(path), np.eye(2))
    np.save(path, {"x": Evaluated()}, allow_pickle=True)
    with pytest.raises(FileFormatError, match="eval"):
        load_npy_objects(path)
    path.write_bytes(b"nothing")
    with pytest.raises(FileFormatError, match=r"no \.npy"):
        load_npy_objects(path)
