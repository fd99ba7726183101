"""What the trees of several data sets need: sound, and a FLAME file of random numbers."""

import pickle

import numpy as np
import soundfile
from scipy.spatial import Delaunay


def write_sound(path, seconds, rate=16000, seed=0):
    """A file of noise, different for every seed."""
    path.parent.mkdir(parents=True, exist_ok=True)
    samples = np.random.default_rng(seed).uniform(-0.5, 0.5, round(seconds * rate))
    soundfile.write(path, samples, rate)


def write_flame(folder):
    """An .npz with FLAME's names, types and shapes, and the masks beside it; returns its path."""
    generator = np.random.default_rng(0)
    plane = generator.uniform(-0.1, 0.1, (5023, 2))
    regressor = np.zeros((5, 5023))
    regressor[np.arange(5), np.arange(5)] = 1
    path = folder / "flame.npz"
    np.savez(
        path,
        f=Delaunay(plane).simplices[:9976].astype(np.uint32),
        v_template=np.concatenate([plane, generator.uniform(-0.02, 0.02, (5023, 1))], axis=1),
        shapedirs=generator.normal(0, 1e-3, (5023, 3, 400)).astype(np.float32),
        posedirs=generator.normal(0, 1e-3, (5023, 3, 36)).astype(np.float32),
        J_regressor=regressor,
        kintree_table=np.array([[2**32 - 1, 0, 1, 1, 1], [0, 1, 2, 3, 4]], np.uint32),
        weights=generator.dirichlet(np.full(5, 0.3), 5023),
    )
    names = [
        "face",
        "scalp",
        "forehead",
        "eye_region",
        "nose",
        "lips",
        "left_ear",
        "right_ear",
        "neck",
        "boundary",
    ]
    masks = {name: generator.choice(3931, 200, replace=False) for name in names}
    (folder / "FLAME_masks.pkl").write_bytes(pickle.dumps(masks, protocol=2))
    return path
