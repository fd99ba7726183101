"""Animation states of a small corpus: a face of 85 vertices whose lips, jaw and brows follow the loudness."""

import numpy as np
from audio2face_small import small_actors

from meshanim.audio import Waveform
from meshanim.datasets import open_dataset
from meshanim.datasets.animation_preparation import StateOptions, prepare_states
from meshanim.datasets.meshanim_format import (
    MotionSequence,
    SequenceInfo,
    Subject,
    write_dataset,
    write_sequence,
    write_subject,
)
from meshanim.geometry import TriangleMesh

FPS, RATE = 30.0, 16000


def write_states(folder, subjects=("anna",), sentences=3, seconds=1.5, turning=(), curve_names=()):
    """DIR/data, and DIR/a2f made of it; returns the second. Curves are loudness, half of it, and so on."""
    actors = small_actors(names=subjects)
    parts = actors.basis.parts
    generator = np.random.default_rng(0)
    data = folder / "data"
    data.mkdir(parents=True)
    people, names = [], []
    count = parts.largest + 1
    for name, template in actors.templates.items():
        neutral = template.numpy()
        # Upper lips over lower ones, lids apart.
        neutral[parts.lip_pairs[:, 0], 1] = neutral[parts.lip_pairs[:, 1], 1] + 0.001
        neutral[parts.lid_pairs[:, 0]] = neutral[parts.lid_pairs[:, 1]] + [0, 0.01, 0]
        person = Subject(name, neutral)
        people.append(person)
        write_subject(data, person)
        field = generator.normal(0, 1e-3, (count, 3)).astype(np.float32)
        field[parts.lip_pairs[:, 1]] = [0, -0.012, 0]
        field[parts.jaw_points] = [0, -0.008, 0]
        field[np.concatenate([parts.lid_pairs.ravel(), parts.left_eye, parts.right_eye])] = 0
        smile = generator.normal(0, 2e-3, (count, 3)).astype(np.float32)
        smile[[*parts.lid_pairs.ravel(), *parts.left_eye, *parts.right_eye, *parts.jaw_points]] = 0
        for sentence in range(1, sentences + 1):
            time = np.arange(int(seconds * RATE)) / RATE
            loud = np.square(np.sin(2 * np.pi * (1 + 0.4 * sentence) * time))
            samples = (0.3 * loud * generator.normal(size=len(time))).astype(np.float32)
            frames = int(seconds * FPS)
            amount = np.interp((np.arange(frames) + 0.5) / FPS, time, loud)[:, None, None]
            joy = sentence == 2
            vertices = (neutral + amount * field + joy * smile).astype(np.float32)
            phonemes = tuple((k / 5, (k + 1) / 5, ("M", "AA", "S")[k % 3]) for k in range(int(seconds * 5)))
            info = SequenceInfo(
                name, sentence, "", FPS, frames, phonemes, "joy" if joy else "neutral", float(joy)
            )
            pose = np.zeros((frames, 3), np.float32)
            if name in turning:
                pose[:, 1] = 0.2 * amount[:, 0, 0]
            curves = np.stack([amount[:, 0, 0] / 2**k for k in range(len(curve_names))] or [[]] * frames, -1)
            curves = curves.reshape(frames, len(curve_names)).astype(np.float32)
            write_sequence(data, MotionSequence(info, vertices, pose, curves, Waveform(samples, RATE)))
            names.append(info.name)
    faces = np.stack([np.arange(count - 2), np.arange(1, count - 1), np.arange(2, count)], axis=1)
    mesh = TriangleMesh(people[0].template, faces)
    last = f"{sentences:02d}"
    splits = {
        "train": [name for name in names if not name.endswith(last)],
        "test": [name for name in names if name.endswith(last)],
    }
    write_dataset(data, "small", FPS, "", mesh, curve_names, people, splits)
    parts.save(folder / "parts.json")
    options = StateOptions(skin=6, tongue=2, silence=1.0, pitch=0, voices=0, speech=0)
    prepare_states(open_dataset(data), folder / "a2f", options, parts=folder / "parts.json", workers=1)
    return folder / "a2f"
