"""A made file with FLAME's exact names, types and shapes; its numbers are random."""

import pickle
import sys
import types

import numpy as np
import pytest
import scipy.sparse as sp
from scipy.spatial import Delaunay

N_VERTICES, N_FACES = 5023, 9976


def chumpy_class():
    """A class that pickles as chumpy.ch.Ch does; chumpy itself need not be there."""
    module = types.ModuleType("chumpy.ch")

    class Ch:
        def __init__(self, x):
            self.x = x
            self._dirty_vars = set()

    Ch.__module__, Ch.__qualname__ = "chumpy.ch", "Ch"
    module.Ch = Ch
    return module, Ch


@pytest.fixture(scope="session")
def flame_content():
    generator = np.random.default_rng(0)
    plane = generator.uniform(-0.1, 0.1, (N_VERTICES, 2))
    faces = Delaunay(plane).simplices[:N_FACES]
    assert len(faces) == N_FACES
    vertices = np.concatenate([plane, generator.uniform(-0.02, 0.02, (N_VERTICES, 1))], axis=1)
    weights = 0.95 * generator.dirichlet(np.full(5, 0.3), N_VERTICES) + 0.01
    weights[3931:4477] = [0, 0, 0, 1, 0]
    weights[4477:] = [0, 0, 0, 0, 1]
    regressor = sp.random(5, N_VERTICES, 0.01, format="csc", random_state=1)
    regressor = sp.csc_matrix(sp.diags(1 / regressor.sum(1).A1) @ regressor)
    return {
        "f": faces.astype(np.uint32),
        "v_template": vertices,
        "shapedirs": generator.normal(0, 1e-3, (N_VERTICES, 3, 400)),
        "posedirs": generator.normal(0, 1e-3, (N_VERTICES, 3, 36)),
        "J_regressor": regressor,
        "kintree_table": np.array([[2**32 - 1, 0, 1, 1, 1], [0, 1, 2, 3, 4]], np.uint32),
        "weights": weights,
        "bs_style": "lbs",
        "bs_type": "lrotmin",
    }


@pytest.fixture(scope="session")
def flame_folder(flame_content, tmp_path_factory):
    """generic_model.pkl with chumpy objects, as in 2019 and 2020, masks and a landmark embedding."""
    folder = tmp_path_factory.mktemp("flame")
    module, ch = chumpy_class()
    sys.modules["chumpy"], sys.modules["chumpy.ch"] = types.ModuleType("chumpy"), module
    try:
        content = dict(flame_content)
        for name in ("v_template", "shapedirs", "posedirs", "weights"):
            content[name] = ch(content[name])
        written = pickle.dumps(content, protocol=2)
    finally:
        del sys.modules["chumpy"], sys.modules["chumpy.ch"]
    # The private module is where today's SciPy keeps the class; the files were written by an old one.
    written = written.replace(b"cscipy.sparse._csc\n", b"cscipy.sparse.csc\n")
    written = written.replace(b"cnumpy._core.", b"cnumpy.core.")
    (folder / "generic_model.pkl").write_bytes(written)

    sizes = {
        "face": 1787, "scalp": 489, "forehead": 133, "eye_region": 751, "nose": 379, "lips": 254,
        "left_ear": 588, "right_ear": 588, "neck": 253, "boundary": 114,
    }  # fmt: skip
    generator = np.random.default_rng(1)
    masks = {name: generator.choice(3931, size, replace=False) for name, size in sizes.items()}
    (folder / "FLAME_masks.pkl").write_bytes(pickle.dumps(masks, protocol=2))

    def points(*shape):
        return generator.integers(0, N_FACES, shape), generator.dirichlet([1, 1, 1], shape)

    embedding = {}
    for name, shape in (("static_lmk", (51,)), ("dynamic_lmk", (79, 17)), ("full_lmk", (1, 68))):
        embedding[f"{name}_faces_idx"], embedding[f"{name}_bary_coords"] = points(*shape)
    import torch

    embedding["dynamic_lmk_faces_idx"] = torch.from_numpy(embedding["dynamic_lmk_faces_idx"])
    embedding["dynamic_lmk_bary_coords"] = torch.from_numpy(embedding["dynamic_lmk_bary_coords"])
    np.save(folder / "landmark_embedding.npy", embedding, allow_pickle=True)
    return folder
