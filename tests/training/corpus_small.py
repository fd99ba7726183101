"""A talking sphere, or another mesh: two subjects, loudness moves the upper half, in the own format."""

import numpy as np
import trimesh

from meshanim.audio import Waveform
from meshanim.datasets.meshanim_format import (
    MotionSequence,
    SequenceInfo,
    Subject,
    write_dataset,
    write_sequence,
    write_subject,
)
from meshanim.geometry import TriangleMesh

RATE, FPS = 16000, 25.0


def write_small_corpus(directory, sentences=3, seconds=1.2, mesh=None, head="", fps=FPS):
    sphere = trimesh.creation.icosphere(2, 0.1)
    # A ball without symmetry: eigenvectors of a symmetric one are whatever rounding makes of them.
    bumps = 1 + 0.02 * np.random.default_rng(0).uniform(-1, 1, (len(sphere.vertices), 1))
    mesh = mesh or TriangleMesh(np.asarray(sphere.vertices) * bumps, np.asarray(sphere.faces))
    template = mesh.vertices.astype(np.float32)
    subjects = [Subject("anna", template), Subject("ben", template * np.float32(1.05))]
    generator = np.random.default_rng(0)
    directory.mkdir(parents=True, exist_ok=True)
    names = []
    for subject in subjects:
        write_subject(directory, subject)
        for sentence in range(1, sentences + 1):
            time = np.arange(int(seconds * RATE)) / RATE
            loudness = np.square(np.sin(2 * np.pi * (1 + 0.3 * sentence) * time))
            samples = (0.3 * loudness * generator.normal(size=len(time))).astype(np.float32)
            frames = int(seconds * fps)
            at = (np.arange(frames) + 0.5) / fps
            amount = np.interp(at, time, loudness).astype(np.float32)
            lift = np.clip(template[:, 1:2], 0, None) * np.float32(0.1)
            up = np.array([0, 1, 0], np.float32)
            vertices = subject.template + amount[:, None, None] * lift * up
            pose = np.stack([0.1 * amount, 0 * amount, 0 * amount], 1).astype(np.float32)
            emotion, intensity = ("joy", 0.5) if sentence == 2 else ("neutral", 0.0)
            info = SequenceInfo(
                subject.name, sentence, "", fps, frames, ((0.2, 0.4, "B"),), emotion, intensity
            )
            curves = np.zeros((frames, 0), np.float32)
            write_sequence(directory, MotionSequence(info, vertices, pose, curves, Waveform(samples, RATE)))
            names.append(info.name)
    train, test = [n for n in names if not n.endswith("03")], [n for n in names if n.endswith("03")]
    splits = {"train": train, "test": test}
    write_dataset(directory, "sphere", fps, head, mesh, [], subjects, splits)
    return directory
