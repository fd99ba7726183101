"""The layout of Audio2Face-3D's public example data: one actor, parts in files.

    DIR/audio/SHOT.wav
    DIR/cache/skin/SHOT/     SHOT.xml and SHOT.mc, or .pc2, or .npy; DIR/cache/tongue alike
    DIR/geom/skin/           neutral_pose.npy (S, 3), eye_close_pose_delta.npy, lip_open_pose_delta.npy,
                             {lip_dist,lip_size,eye_dist}_vertex_list.json
    DIR/geom/tongue/         neutral_pose.npy (U, 3), rigid_vertex_list.json
    DIR/xform/               jaw_keypoints_neutral.npy (5, 3), jaw_keypoints_cache_all.npz {SHOT: (T, 5, 3)},
                             eye_rotations_all.npz {SHOT: (T, 2, 2) degrees}, eye_saccade_rotations.npy,
                             eye_blink_keys.npy

Centimetres at 30 frames a second, a still head. The vertices of a sequence are skin, tongue and the five jaw
points, one after the other; the angles of the eyes are its coefficient `eyes`. What the files do not say is
taken so: the right eye first, x (pitch) before y (yaw), and the sound begins with the cache's first frame.
"""

import ast
import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32

from meshanim.audio import Waveform, load_waveform
from meshanim.datasets.mesh_files import as_float32, load_mesh, read_npy
from meshanim.datasets.motion_dataset import (
    DatasetOptions,
    MotionArrays,
    MotionDataset,
    SequenceInfo,
    Subject,
)
from meshanim.datasets.point_caches import find_cache, read_points
from meshanim.errors import FileFormatError, OptionError
from meshanim.geometry import TriangleMesh
from meshanim.motion.emotions import EMOTIONS
from meshanim.motion.face_parts import FaceParts

__all__ = ["Audio2FaceDataset", "Audio2FaceOptions"]

LANGUAGES = {"english": "en", "mandarin": "zh", "chinese": "zh"}
UPPER_FACE = 0.6
"""Share of the face's height above which skin is upper face: the published mask level."""


@dataclass(frozen=True)
class Audio2FaceOptions(DatasetOptions):
    """What files do not say.

    Parameters
    ----------
    fps : float
        Frames a second of the caches.
    scale : float
        Metres for one unit of the files.
    faces : path, optional
        A mesh file whose faces are the skin's.
    config : path, optional
        The published config_dataset.py, of which the list CLIPS is read (not run): actor, shot, first and
        last frame, folder of the sound, language, name of the sound, and anywhere behind them an emotion.
    """

    fps: float = 30.0
    scale: float = 0.01
    faces: Path | None = None
    config: Path | None = None

    def __post_init__(self):
        super().__post_init__()
        if not (self.fps > 0 and self.scale > 0):
            raise OptionError(f"fps and scale must be positive, not {self.fps} and {self.scale}")


@dataclass(frozen=True)
class _Clip:
    shot: str
    first: int
    last: int | None
    language: str
    sound: str
    emotion: str


class Audio2FaceDataset(MotionDataset):
    """Reads the layout above.

    Parameters
    ----------
    directory : path
        With audio/, cache/, geom/ and xform/.
    options : Audio2FaceOptions, optional
        Rate, unit, faces, list of clips.

    Attributes
    ----------
    parts : FaceParts
        By the lists of geom/.
    pose_deltas : dict of (V, 3) arrays
        What closes the eyes (`eye_close`) and opens the lips (`lip_open`), metres; where the files are there.
    saccades, blinks : arrays
        Eye rotations (N, 2), radians, and lid closures (K,), both at 30 a second; empty where there are none.

    Raises
    ------
    FileFormatError
        If a file is missing or damaged, or contradicts another one.
    """

    kind = "audio2face"
    files = "cache/skin/, geom/skin/neutral_pose.npy"
    Options = Audio2FaceOptions
    parts: FaceParts

    @classmethod
    def detect(cls, directory: Path) -> bool:
        """By the caches of skin and the neutral skin."""
        return (directory / "cache/skin").is_dir() and (directory / "geom/skin/neutral_pose.npy").exists()

    def __init__(self, directory: str | Path, options: Audio2FaceOptions | None = None):
        super().__init__(directory, options)
        self.name = self.directory.resolve().name
        self.fps = self.options.fps / self.options.stride
        self._skin = self._neutral("geom/skin/neutral_pose.npy")
        self._tongue = self._neutral("geom/tongue/neutral_pose.npy")
        jaw = self._neutral("xform/jaw_keypoints_neutral.npy")
        if len(jaw) not in (0, 5):
            raise FileFormatError(f"{self.directory} has {len(jaw)} jaw points, expected 5")
        template = np.concatenate([self._skin, self._tongue, jaw])
        self._jaw_neutral = jaw
        self.subjects = {self.name: Subject(self.name, template)}
        self.parts = self._read_parts()
        if self.options.faces is not None:
            faces = load_mesh(self.options.faces, len(self._skin)).faces
            self.mesh = TriangleMesh(template, faces)
        self._clips = self._read_clips()
        self.sequences = tuple(self._clips)
        self.splits = {}
        if not self._clips:
            raise FileFormatError(f"{self.directory} has no shots in cache/skin")

    def _neutral(self, name: str) -> Float32[np.ndarray, "points 3"]:
        path = self.directory / name
        if not path.exists():
            return np.zeros((0, 3), np.float32)
        array = read_npy(path)
        if array.ndim == 2 and array.shape[1] == 3:
            return np.array(as_float32(array, self.options.scale))
        raise FileFormatError(f"{path} has shape {array.shape}, expected (points, 3)")

    def _read_parts(self) -> FaceParts:
        count, tongue, jaw = len(self._skin), len(self._tongue), len(self._jaw_neutral)
        lips = self._lists("lip_dist_vertex_list.json")
        thickness = self._lists("lip_size_vertex_list.json")
        heights = self._skin[:, 1]
        level = heights.min() + UPPER_FACE * np.ptp(heights)
        none = np.zeros((0, 2), np.int64)
        return FaceParts(
            skin=np.arange(count),
            tongue=np.arange(count, count + tongue),
            jaw_points=np.arange(count + tongue, count + tongue + jaw),
            jaw_rigid=np.zeros(0, np.int64),
            right_eye=np.zeros(0, np.int64),
            left_eye=np.zeros(0, np.int64),
            upper_face=np.flatnonzero(heights > level),
            lip_pairs=lips[0] if lips else none,
            upper_lip=thickness[0] if len(thickness) == 2 else none,
            lower_lip=thickness[1] if len(thickness) == 2 else none,
            lid_pairs=np.concatenate(self._lists("eye_dist_vertex_list.json") or [none]),
        )

    def _lists(self, name: str) -> list[np.ndarray]:
        """Pairs of vertices of every pair of lists, upper or top first, that a file holds at any depth."""
        path = self.directory / "geom/skin" / name
        if not path.exists():
            return []
        try:
            found = _pairs(json.loads(path.read_text(encoding="utf-8")))
        except (OSError, ValueError, TypeError) as error:
            raise FileFormatError(f"{path} holds no lists of vertices: {error}") from error
        for pairs in found:
            if pairs.size and not 0 <= pairs.min() <= pairs.max() < len(self._skin):
                raise FileFormatError(f"{path} names vertex {pairs.max()}, the skin has {len(self._skin)}")
        return found

    def _read_clips(self) -> dict[str, _Clip]:
        if self.options.config is not None:
            return self._configured(self.options.config)
        folder = self.directory / "cache/skin"
        shots = sorted({path.stem for path in folder.iterdir() if not path.name.startswith(".")})
        return {
            shot: _Clip(
                shot, 0, None, "zh" if shot.startswith("cp") else "en", f"audio/{shot}.wav", "neutral"
            )
            for shot in shots
        }

    def _configured(self, path: Path) -> dict[str, _Clip]:
        try:
            tree = ast.parse(path.read_text(encoding="utf-8"))
            values = [
                node.value
                for node in tree.body
                if isinstance(node, ast.Assign | ast.AnnAssign)
                and any(
                    getattr(target, "id", "") == "CLIPS"
                    for target in (node.targets if isinstance(node, ast.Assign) else [node.target])
                )
            ]
            entries = [entry for value in values if value is not None for entry in ast.literal_eval(value)]
            clips = {}
            for _, shot, (first, last), folder, language, sound, *rest in entries:
                if self._has(shot):
                    emotion = next((word for word in rest if word in EMOTIONS), "neutral")
                    name = shot if shot not in clips else f"{shot}-{first}"
                    place = f"{Path(folder).name}/{Path(sound).name}" if folder else f"audio/{sound}"
                    clips[name] = _Clip(shot, int(first), int(last), str(language), place, emotion)
        except OSError as error:
            raise FileFormatError(f"cannot read {path}: {error.strerror}") from error
        except (SyntaxError, ValueError, TypeError) as error:
            raise FileFormatError(f"{path} has no list CLIPS of plain tuples: {error}") from error
        return clips

    def _has(self, shot: str) -> bool:
        try:
            find_cache(self.directory / "cache/skin", shot)
        except FileFormatError:
            return False
        return True

    def _rows(self, clip: _Clip, count: int) -> slice:
        end = count if clip.last is None else clip.last + 1
        if not 0 <= clip.first < end <= count:
            raise FileFormatError(
                f"{self.directory}: frames {clip.first} to {end - 1} of {clip.shot}, which has {count}"
            )
        return slice(clip.first, end)

    def info(self, name: str) -> SequenceInfo:
        """By the skin's cache and the list of clips."""
        self._known(name)
        clip = self._clips[name]
        rows = self._rows(clip, len(self._points("skin", clip.shot)))
        info = SequenceInfo(
            self.name,
            0,
            "",
            self.options.fps,
            rows.stop - rows.start,
            emotion=clip.emotion,
            intensity=float(clip.emotion != "neutral"),
            name=name,
        )
        return self._strided(info)

    def language(self, name: str) -> str:
        """As the list of clips has it, two letters; without one, shots cp1, cp2, ... are Mandarin."""
        self._known(name)
        return LANGUAGES.get(self._clips[name].language.lower(), self._clips[name].language.lower())

    def _points(self, part: str, shot: str) -> np.ndarray:
        return read_points(find_cache(self.directory / "cache" / part, shot))

    def motion(self, name: str) -> MotionArrays:
        """Skin, tongue and jaw points in metres; `eyes` (T, 2, 2): pitch and yaw, right and left, radians."""
        self._known(name)
        clip = self._clips[name]
        skin = self._points("skin", clip.shot)
        rows = self._rows(clip, len(skin))
        parts = [self._checked("skin", skin, len(self._skin), clip.shot)[rows]]
        if len(self._tongue):
            tongue = self._points("tongue", clip.shot)
            parts.append(self._checked("tongue", tongue, len(self._tongue), clip.shot, len(skin))[rows])
        vertices = np.concatenate(parts, axis=1).astype(np.float32) * np.float32(self.options.scale)
        if len(self._jaw_neutral):
            moved = self._tracked("jaw_keypoints_cache_all.npz", clip.shot, (len(skin), 5, 3))[rows]
            jaw = self._jaw_neutral + moved.astype(np.float32) * np.float32(self.options.scale)
            vertices = np.concatenate([vertices, jaw], axis=1)
        coefficients = {}
        if (self.directory / "xform/eye_rotations_all.npz").exists():
            turned = self._tracked("eye_rotations_all.npz", clip.shot, (len(skin), 2, 2))[rows]
            coefficients["eyes"] = np.radians(turned).astype(np.float32)
        return self._every(len(vertices), MotionArrays(vertices, coefficients=coefficients))

    def _checked(
        self, part: str, points: np.ndarray, count: int, shot: str, frames: int | None = None
    ) -> np.ndarray:
        if points.shape[1] != count or (frames is not None and len(points) != frames):
            raise FileFormatError(
                f"{self.directory}: {part} of {shot} has {points.shape[0]} frames of {points.shape[1]} "
                f"points, expected {frames or 'any'} of {count}"
            )
        return points

    def _tracked(self, name: str, shot: str, shape: tuple[int, ...]) -> np.ndarray:
        path = self.directory / "xform" / name
        try:
            with np.load(path, allow_pickle=False) as archive:
                array = archive[shot]
        except (OSError, KeyError, ValueError, EOFError) as error:
            raise FileFormatError(f"{path} is damaged or has no shot {shot}: {error}") from error
        except Exception as error:  # zipfile's BadZipFile and zlib's errors
            raise FileFormatError(f"{path} is damaged: {error}") from error
        if array.shape != shape:
            raise FileFormatError(f"{path}: {shot} has shape {array.shape}, expected {shape}")
        return array

    def audio(self, name: str) -> Waveform:
        """The sound from the clip's first frame to its last."""
        self._known(name)
        clip = self._clips[name]
        waveform = load_waveform(self._sound(clip), rate=None)
        if clip.first == 0 and clip.last is None:
            return waveform
        first = round(clip.first / self.options.fps * waveform.rate)
        frames = self.info(name).frames * self.options.stride
        last = first + round(frames / self.options.fps * waveform.rate)
        if first >= len(waveform.samples):
            raise FileFormatError(f"{self._sound(clip)} ends before frame {clip.first} of {clip.shot}")
        return Waveform(waveform.samples[first:last], waveform.rate)

    def audio_file(self, name: str) -> Path | None:
        """The file, where the clip is all of it."""
        clip = self._clips[name]
        return self._sound(clip) if clip.first == 0 and clip.last is None else None

    def _sound(self, clip: _Clip) -> Path:
        return self.directory / clip.sound

    @cached_property
    def pose_deltas(self) -> dict[str, Float32[np.ndarray, "vertices 3"]]:
        deltas = {}
        for name in ("eye_close", "lip_open"):
            delta = self._neutral(f"geom/skin/{name}_pose_delta.npy")
            if len(delta):
                rest = len(self.subjects[self.name].template) - len(delta)
                deltas[name] = np.pad(delta, ((0, rest), (0, 0)))
        return deltas

    @cached_property
    def saccades(self) -> Float32[np.ndarray, "keys 2"]:
        path = self.directory / "xform/eye_saccade_rotations.npy"
        array = np.radians(read_npy(path)) if path.exists() else np.zeros((0, 2))
        return np.asarray(array, np.float32)

    @cached_property
    def blinks(self) -> Float32[np.ndarray, " keys"]:
        path = self.directory / "xform/eye_blink_keys.npy"
        return np.asarray(read_npy(path) if path.exists() else np.zeros(0), np.float32)


def _pairs(content: Any) -> list[np.ndarray]:
    """Pairs of all lists named upper and lower, or top and bottom, in the order of a JSON file."""
    if not isinstance(content, dict):
        return []
    for high, low in (("upper", "lower"), ("top", "bottom")):
        if isinstance(content.get(high), list) and isinstance(content.get(low), list):
            pairs = np.array([content[high], content[low]], np.int64).T
            return [pairs.reshape(-1, 2)]
    return [pairs for value in content.values() for pairs in _pairs(value)]
