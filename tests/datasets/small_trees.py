"""Small copies of published data sets, with their file names, types and quirks, on a tiny face.

Numbers of vertices are small; `small_faces` makes the published tables expect that number.
"""

import pickle
import struct
from dataclasses import replace

import numpy as np
import soundfile
import trimesh

from meshanim.datasets import faceformer, published
from meshanim.geometry import TriangleMesh

VOCASET_PEOPLE = ("FaceTalk_170904_00128_TA", "FaceTalk_170811_03275_TA", "FaceTalk_170809_00138_TA")
VOCASET_SENTENCES = {
    "FaceTalk_170904_00128_TA": (1, 2, 40),
    "FaceTalk_170811_03275_TA": (1, 21),
    "FaceTalk_170809_00138_TA": (20, 22, 40),
}


def small_mesh() -> TriangleMesh:
    sphere = trimesh.creation.icosphere(1, 0.1)
    return TriangleMesh(np.asarray(sphere.vertices), np.asarray(sphere.faces))


def small_faces(monkeypatch) -> None:
    """Let the published topologies be those of `small_mesh`."""
    count = small_mesh().n_vertices
    names = {count: "FLAME_sample.ply"}
    for name in ("vocaset", "biwi"):
        monkeypatch.setitem(published.PUBLISHED, name, replace(published.PUBLISHED[name], vertices=count))
    monkeypatch.setattr(faceformer, "TOPOLOGY_FILES", names)


def python_2_pickle(value) -> bytes:
    """As Python 2 wrote it: protocol 2, NumPy's old module names, bytes where text is."""
    return pickle.dumps(value, protocol=2).replace(b"cnumpy._core.", b"cnumpy.core.")


def template_of(subject: str) -> np.ndarray:
    seed = sum(subject.encode())
    return small_mesh().vertices * (1 + 0.02 * (seed % 7)) + 1e-4 * np.random.default_rng(seed).normal(
        size=(42, 3)
    )


def motion_of(subject: str, sentence: int, frames: int) -> np.ndarray:
    generator = np.random.default_rng([sum(subject.encode()), sentence])
    return (template_of(subject) + 0.003 * generator.normal(size=(frames, 42, 3))).astype(np.float32)


def noise(seconds: float, rate: int, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(-9000, 9000, size=round(seconds * rate)).astype(np.int16)


def write_vocaset(directory, dtype=np.float32, shuffled=True):
    """VOCA's four files: 60 frames a second, 22 kHz integers, rows of data_verts out of order."""
    directory.mkdir(parents=True, exist_ok=True)
    index, sounds, blocks, row = {}, {}, [], 0
    for person, sentences in VOCASET_SENTENCES.items():
        index[person], sounds[person] = {}, {}
        for number in sentences:
            name, frames = f"sentence{number:02d}", 30 + number % 5
            order = np.arange(frames)
            if shuffled and number == 2:
                order = np.random.default_rng(1).permutation(frames)
            blocks.append(motion_of(person, number, frames)[np.argsort(order)])
            rows = {int(frame): int(row + place) for frame, place in enumerate(order)}
            index[person][name] = dict(reversed(rows.items()))
            row += frames
            sounds[person][name] = {
                "audio": noise(frames / 60, 22000, number + len(blocks)),
                "sample_rate": 22000,
            }
    np.save(directory / "data_verts.npy", np.concatenate(blocks).astype(dtype))
    (directory / "subj_seq_to_idx.pkl").write_bytes(python_2_pickle(index))
    (directory / "raw_audio_fixed.pkl").write_bytes(python_2_pickle(sounds))
    templates = {person: template_of(person) for person in VOCASET_PEOPLE}
    (directory / "templates.pkl").write_bytes(python_2_pickle(templates))
    return directory


def write_faceformer(directory, names, fps, dtype=np.float32, rate=16000):
    """FaceFormer's folders; `names` are (subject, sentence name, number)."""
    for folder in ("wav", "vertices_npy", "templates"):
        (directory / folder).mkdir(parents=True, exist_ok=True)
    for place, (subject, sentence, number) in enumerate(names):
        frames = 20 + number % 5
        vertices = motion_of(subject, number, frames).reshape(frames, -1).astype(dtype)
        np.save(directory / "vertices_npy" / f"{subject}_{sentence}.npy", vertices)
        samples = noise(frames / fps, rate, place)
        soundfile.write(directory / "wav" / f"{subject}_{sentence}.wav", samples, rate, subtype="PCM_16")
    templates = {subject: template_of(subject) for subject, _, _ in names}
    (directory / "templates.pkl").write_bytes(python_2_pickle(templates))
    return directory


def write_biwi_raw(directory, people=("F2", "F1"), sentences=("e01", "e37", "05")):
    """One little-endian .vl a frame, millimetres, y down; obj templates; wav of 44.1 kHz."""
    mesh = small_mesh()
    (directory / "rigid_scans").mkdir(parents=True)
    for place, person in enumerate(people):
        raw = template_of(person) * 1000 * [1, -1, -1]
        trimesh.Trimesh(raw, mesh.faces, process=False).export(directory / "rigid_scans" / f"{person}.obj")
        for sentence in sentences:
            folder = directory / "faces" / person / sentence
            folder.mkdir(parents=True)
            number = int(sentence.removeprefix("e"))
            vertices = motion_of(person, number, 12).astype(np.float64) * 1000 * [1, -1, -1]
            for frame, points in enumerate(vertices, start=1):
                content = struct.pack("<I", len(points)) + points.astype("<f4").tobytes()
                (folder / f"frame_{frame:03d}.vl").write_bytes(content)
            sounds = directory / "audio" / person
            sounds.mkdir(parents=True, exist_ok=True)
            samples = noise(12 / 25, 44100, 50 * place + number)
            soundfile.write(sounds / f"{sentence}.wav", samples, 44100, subtype="PCM_16")
    return directory
