"""Post-processing keeps the lower teeth of the default head behind its lip."""

from dataclasses import replace
from importlib.resources import files

import numpy as np
import pytest

from meshanim import Animator
from meshanim.animator import AnimationOptions
from meshanim.audio import Waveform, load_waveform
from meshanim.motion.face_parts import face_parts
from meshanim.motion.post_processing import PRESETS
from meshanim.render.look import find_person, make_appearance


def heights_over(triangles, points):
    """z of triangles (T, 3, 3) above points (P, 3) seen along z, NaN beside; and whether they face +z."""
    x, y = (triangles[None, :, :, axis] - points[:, None, None, axis] for axis in (0, 1))
    cross = np.roll(x, -1, 2) * np.roll(y, -2, 2) - np.roll(x, -2, 2) * np.roll(y, -1, 2)
    area = cross.sum(2)
    inside = (np.sign(cross) == np.sign(area)[..., None]).all(2)
    depth = (cross * triangles[None, :, :, 2]).sum(2) / np.where(area == 0, np.nan, area)
    return np.where(inside, depth, np.nan), area > 0


def farthest_through(head, vertices):
    """Metres by which a lower tooth stands before the outer skin of the lips, with no skin before it."""
    teeth, regions = face_parts(head).jaw_rigid, head.regions
    inner = np.concatenate([regions[name] for name in ("teeth", "tongue", "eyes")])
    skin = np.setdiff1d(np.concatenate([regions["lips"], regions["face"]]), inner)
    faces = head.mesh.faces[np.isin(head.mesh.faces, skin).all(1)]
    middle = head.mesh.vertices[regions["lips"]].mean(0)
    away = np.abs(head.mesh.vertices[faces].mean(1) - middle)
    faces = faces[(away[:, :2] < 0.04).all(1)]
    worst = 0.0
    for frame in vertices:
        skin_depth, outward = heights_over(frame[faces], frame[teeth])
        before = frame[teeth, None, 2] - np.where(outward, skin_depth, np.nan)
        covered = (before < 0).any(1)
        before = np.where((before > 0) & (before < 0.006), before, 0.0)
        worst = max(worst, float(before[~covered].max(initial=0)))
    return worst


@pytest.fixture(scope="module")
def animator():
    return Animator.from_pretrained("default")


def test_presets_keep_lower_teeth_behind_the_lip(animator):
    speech = load_waveform(files("meshanim") / "audio/clips/sense_and_sensibility.flac", rate=16000)
    sound = Waveform(speech.samples[:32000], 16000)
    template = make_appearance(animator.head, find_person("bruno")).template

    def through(controls, emotion):
        options = AnimationOptions(emotion=emotion, controls=controls)
        return farthest_through(animator.head, animator(sound, options, template).vertices[::3])

    framework = PRESETS["framework"]
    theirs = replace(framework, lower_teeth_height_offset=-0.1, lower_teeth_depth_offset=0.25)
    assert through(theirs, "joy") > 1.5e-3
    assert through(framework, "joy") < 0.8e-3
    assert through(framework, "neutral") == 0
    assert through(PRESETS["sdk"], "joy") == 0
