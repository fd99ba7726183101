"""`meshanim data`: make, describe, check and convert data sets and captures."""

import json
import sys
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from tyro.conf import OmitArgPrefixes, Positional, arg

from meshanim.datasets.animation_preparation import StateOptions, prepare_states
from meshanim.datasets.capture import Capture, detect_capture, open_capture
from meshanim.datasets.capture_folder import write_capture
from meshanim.datasets.conversion import convert
from meshanim.datasets.mesh_files import load_mesh
from meshanim.datasets.motion_dataset import (
    MotionDataset,
    detect_kind,
    loader_options,
    open_dataset,
)
from meshanim.datasets.pose_augmentation import AugmentPoseOptions, augment_pose
from meshanim.datasets.synthetic.capture import CaptureOptions, synthesize_capture
from meshanim.datasets.synthetic.corpus import SynthesizeOptions, synthesize
from meshanim.datasets.synthetic.emotional_speech import EmotionalSpeechOptions, speak_emotions
from meshanim.datasets.vhap import write_vhap
from meshanim.errors import FileFormatError, MeshanimError, OptionError
from meshanim.export import write_rig
from meshanim.files import written_whole
from meshanim.heads import load_head
from meshanim.motion.personal_shapes import Method, personal_shapes
from meshanim.training.feature_cache import CacheFeaturesOptions, cache_features

__all__ = [
    "COMMANDS",
    "CheckOptions",
    "ConvertOptions",
    "InfoOptions",
    "PersonalizeOptions",
    "ReadingOptions",
]


@dataclass(frozen=True)
class ReadingOptions:
    """How to read a data set; what is not given is known or told by the files."""

    kind: str = "auto"
    """Its layout: meshanim, faceformer, vocaset, biwi, multiface, mead, unitalker, diffposetalk, audio2face,
    meshes; auto tells it by the files."""
    stride: int | None = None
    """Take every n-th frame."""
    fps: float | None = None
    """Frames a second of the files, where they do not say."""
    scale: float | None = None
    """Metres for one unit of the files (faceformer, meshes, unitalker, audio2face)."""
    faces: Path | None = None
    """A mesh file with the faces, where the data set has none."""
    published: str | None = None
    """Whose splits (faceformer): vocaset, biwi, auto, none."""
    preprocess: Literal["metres", "codetalker"] | None = None
    """BIWI's raw files: to metres, or to the unit of CodeTalker's."""
    head: str | None = None
    """A head, flame:PATH, that makes vertices of coefficients (mead, unitalker, diffposetalk)."""
    audio: Path | None = None
    """Folder of MEAD's sound."""
    config: Path | None = None
    """Audio2Face's config_dataset.py with the list of clips."""
    vertices: int | None = None
    """Multiface: 7306 or 6172."""
    dropped: Path | None = None
    """Multiface: list of the vertices that 6172 leaves out."""
    template: Path | None = None
    """Multiface: OBJ of 6172 vertices."""
    full_template: Path | None = None
    """Multiface: OBJ of 7306 vertices in the pose of the template."""

    def open(self, directory: Path) -> MotionDataset:
        """The data set in a folder, read so."""
        kind = detect_kind(directory) if self.kind == "auto" else self.kind
        given = {key: value for key, value in asdict(self).items() if key != "kind"}
        return open_dataset(directory, kind, loader_options(kind, given))


@dataclass(frozen=True)
class InfoOptions:
    """Say what a data set holds, from its headers alone.

    Example: meshanim data info vocaset
    """

    directory: Positional[Path]
    """The folder."""
    reading: OmitArgPrefixes[ReadingOptions] = ReadingOptions()
    """How to read it."""
    json: Path | None = None
    """Write it as JSON too."""


@dataclass(frozen=True)
class CheckOptions:
    """Read every file of a data set and list every defect; exit code 1 if there is one.

    Example: meshanim data check corpus
    """

    directory: Positional[Path]
    """The folder."""
    reading: OmitArgPrefixes[ReadingOptions] = ReadingOptions()
    """How to read it."""
    workers: int = 0
    """Processes; 0 takes one a core."""
    json: Path | None = None
    """Write the defects as JSON too."""


@dataclass(frozen=True)
class ConvertOptions:
    """Write any data set in the project's own layout or in FaceFormer's.

    Example: meshanim data convert vocaset corpus --faces FLAME_sample.ply
    """

    directory: Positional[Path]
    """The folder to read."""
    target: Positional[Path]
    """The folder to write; an interrupted run is continued."""
    format: Literal["meshanim", "faceformer", "folder", "vhap"] = "meshanim"
    """meshanim, or faceformer: wav/, vertices_npy/, templates.pkl, and the rest beside them. Of a capture
    (docs/capture.md): folder, the plain one, or vhap."""
    image_scale: float = 1.0
    """Pixels a side of a capture's pictures, as a share of what they have."""
    reading: OmitArgPrefixes[ReadingOptions] = ReadingOptions()
    """How to read it."""
    skip_defects: bool = False
    """Leave out sequences that cannot be read instead of stopping."""
    workers: int = 0
    """Processes; 0 takes one a core."""
    dask: str = ""
    """Address of a Dask scheduler, such as tcp://host:8786, whose workers convert instead."""


@dataclass(frozen=True)
class StatesOptions:
    """Make Audio2Face-3D's training data: animation states, phonemes, silence, more voices.

    Example: meshanim data a2f corpus -o corpus-a2f
    """

    directory: Positional[Path]
    """The folder to read."""
    output: Annotated[Path, arg(aliases=["-o"])]
    """The folder to write; an interrupted run is continued."""
    reading: OmitArgPrefixes[ReadingOptions] = ReadingOptions()
    """How to read it."""
    states: OmitArgPrefixes[StateOptions] = field(default_factory=StateOptions)
    """Components and augmentation."""
    topology: str = ""
    """A head (default, flame:PATH, rig:PATH) whose regions say what is skin, tongue, jaw and eyes; the data
    set's if not given."""
    parts: Path | None = None
    """A JSON file that says it instead: lists of vertices by the names of FaceParts."""
    workers: int = 0
    """Processes; 0 takes one a core."""
    dask: str = ""
    """Address of a Dask scheduler, such as tcp://host:8786, whose workers do it instead."""


@dataclass(frozen=True)
class PersonalizeOptions:
    """Give a neutral face of any topology the blendshapes of a head, ARKit's 52 by default.

    Example: meshanim data personalize character.obj -o character.glb
    """

    target: Positional[Path]
    """The face at rest, upright, facing along +z: obj, ply, glb and others."""
    output: Annotated[Path, arg(aliases=["-o"])] = Path("rig.npz")
    """The ending chooses: npz, glb (morph targets), or none for a folder of OBJ files. `--head rig:PATH` of
    other verbs takes each."""
    head: str = "default"
    """Whose shapes, as `load_head` takes it."""
    method: Method = "deformation_transfer"
    """deformation_transfer, or displacement of each vertex as its counterpart."""
    landmarks: Path | None = None
    """JSON list of pairs [vertex of the head, vertex of the target], three or more, where shape alone does
    not tell what is what."""
    scale: float = 1.0
    """Metres for one unit of the target's file: 0.01 if it is in centimetres."""


@dataclass(frozen=True)
class SynthesizeCommand:
    """Write a talking-head corpus, synthetic speech and a head that speaks it; or pictures of it (--images).

    Example: meshanim data synthesize corpus --subjects 8 --sentences 40 --fps 30 --seed 0

    Pictures: meshanim data synthesize capture --images --views 16 --names bruno
    """

    corpus: OmitArgPrefixes[SynthesizeOptions]
    """Who speaks what, and where it is written."""
    images: bool = False
    """Write pictures from many cameras (docs/capture.md) instead of the corpus: a folder a person."""
    capture: OmitArgPrefixes[CaptureOptions] = field(default_factory=CaptureOptions)
    """How --images are taken."""


def _synthesize(options: SynthesizeCommand) -> int:
    progress = sys.stderr.isatty()
    if options.images:
        for folder in synthesize_capture(options.corpus, options.capture, progress):
            print(f"wrote {folder}")
        return 0
    if options.capture != CaptureOptions():
        raise OptionError("--views, --people and the other options of pictures need --images")
    print(f"wrote {synthesize(options.corpus, progress=progress)}")
    return 0


def _description(dataset: MotionDataset) -> dict[str, Any]:
    seconds, unreadable = 0.0, 0
    for name in dataset.sequences:
        try:
            seconds += dataset.info(name).frames / dataset.fps
        except MeshanimError:
            unreadable += 1
    sizes = {len(subject.template) for subject in dataset.subjects.values()}
    return {
        "name": dataset.name,
        "kind": dataset.kind,
        "subjects": list(dataset.subjects),
        "sequences": len(dataset),
        "unreadable": unreadable,
        "seconds": round(seconds, 3),
        "fps": dataset.fps,
        "unit": dataset.unit,
        "vertices": sorted(sizes),
        "faces": dataset.mesh.n_faces if dataset.mesh else 0,
        "head": dataset.head,
        "curves": len(dataset.curve_names),
        "splits": {split: len(names) for split, names in dataset.splits.items()},
    }


def _print_description(about: Mapping[str, Any]) -> None:
    splits = ", ".join(f"{count} {split}" for split, count in about["splits"].items()) or "no splits"
    unit = {"m": "metres", "biwi": "BIWI's unit (square root of the face's area)"}[about["unit"]]
    size = ", ".join(map(str, about["vertices"]))
    print(f"{about['name']} ({about['kind']} layout)")
    print(f"{len(about['subjects'])} subjects, {about['sequences']} sequences ({splits})")
    print(f"{about['seconds'] / 60:.1f} min at {about['fps']:g} fps")
    print(f"{size} vertices in {unit}, {about['faces'] or 'no'} faces, {about['curves']} curves")
    if about["unreadable"]:
        print(f"{about['unreadable']} sequences cannot be read: meshanim data check says why")


def _write_json(path: Path | None, record: Mapping[str, Any]) -> None:
    if path is not None:
        with written_whole(path) as temporary:
            temporary.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")


def _capture_description(capture: Capture) -> dict[str, Any]:
    timesteps = {view.timestep for view in capture.views}
    return {
        "name": capture.name,
        "kind": capture.kind,
        "pictures": len(capture),
        "camera_positions": len({view.world_to_camera.tobytes() for view in capture.views}),
        "timesteps": len(timesteps),
        "sizes": sorted({(view.width, view.height) for view in capture.views}),
        "head": capture.head_name,
        "tracked": capture.parameters is not None,
        "regions": list(capture.region_names),
        "fps": capture.fps,
        "speech": len(capture.speech),
        "triangles": len(capture.surface.faces) if capture.surface else 0,
        "splits": {split: len(indices) for split, indices in capture.splits.items()},
    }


def _print_capture(about: Mapping[str, Any]) -> None:
    splits = ", ".join(f"{count} {split}" for split, count in about["splits"].items())
    sizes = ", ".join(f"{width} x {height}" for width, height in about["sizes"])
    head = f"head {about['head'] or 'not named'}" if about["tracked"] else "no parameters of a head"
    print(f"{about['name']} ({about['kind']} layout)")
    print(f"{about['pictures']} pictures of {sizes} ({splits})")
    print(f"{about['camera_positions']} camera positions, {about['timesteps']} timesteps, {head}")
    print(f"regions: {', '.join(about['regions']) or 'none'}")
    if about["fps"]:
        print(f"video: {about['fps']:g} timesteps a second, {about['speech']} sound files")


def _of_capture(options: InfoOptions | CheckOptions) -> bool:
    return options.reading.kind == "auto" and detect_capture(options.directory) is not None


def _check_capture(options: CheckOptions) -> int:
    about = None
    try:
        capture = open_capture(options.directory)
    except FileFormatError as error:
        defects = [str(error)]
    else:
        defects = capture.check(sys.stderr.isatty())
        about = _capture_description(capture)
    for defect in defects:
        print(defect, file=sys.stderr)
    if about is not None:
        _print_capture(about)
    print(f"{len(defects)} defects")
    _write_json(options.json, {"defects": defects, "dataset": about})
    return 1 if defects else 0


def _info(options: InfoOptions) -> int:
    if _of_capture(options):
        about = _capture_description(open_capture(options.directory))
        _print_capture(about)
        _write_json(options.json, about)
        return 0
    about = _description(options.reading.open(options.directory))
    _print_description(about)
    _write_json(options.json, about)
    return 0


def _check(options: CheckOptions) -> int:
    if _of_capture(options):
        return _check_capture(options)
    if options.reading.kind == "auto":
        detect_kind(options.directory)
    try:
        dataset = options.reading.open(options.directory)
    except FileFormatError as error:  # damaged where opening reads it: that is the defect
        defects: list[str] = [str(error)]
        about = None
    else:
        defects = dataset.check(sys.stderr.isatty(), options.workers)
        about = _description(dataset)
    for defect in defects:
        print(defect, file=sys.stderr)
    if about is not None:
        _print_description(about)
    print(f"{len(defects)} defects")
    _write_json(options.json, {"defects": defects, "dataset": about})
    return 1 if defects else 0


def _convert(options: ConvertOptions) -> int:
    if options.format in ("folder", "vhap"):
        capture = open_capture(options.directory, head=options.reading.head or "", scale=options.image_scale)
        write = write_vhap if options.format == "vhap" else write_capture
        print(f"wrote {write(capture, options.target, sys.stderr.isatty())}")
        return 0
    if detect_capture(options.directory) is not None:
        raise OptionError(f"{options.directory} is a capture: --format is folder or vhap")
    assert options.format in ("meshanim", "faceformer")
    dataset = options.reading.open(options.directory)
    done = convert(
        dataset,
        options.target,
        options.format,
        options.workers,
        options.dask,
        options.skip_defects,
        progress=sys.stderr.isatty(),
    )
    for name, reason in done.skipped.items():
        print(f"left out {name}: {reason}", file=sys.stderr)
    print(f"wrote {options.target}: {done.sequences} sequences, {done.kept} of them by an earlier run")
    return 0


def _augment_pose(options: AugmentPoseOptions) -> int:
    found = augment_pose(options, progress=sys.stderr.isatty())
    mean, deviation, largest, speed = np.degrees([found.mean, found.deviation, found.largest, found.speed])
    print(
        f"{found.counts.sum()} frames: rotation {mean:.2f} ± {deviation:.2f} degrees, largest {largest:.2f}, "
        f"{speed:.2f} degrees a second"
    )
    return 0


def _states(options: StatesOptions) -> int:
    done = prepare_states(
        options.reading.open(options.directory),
        options.output,
        options.states,
        options.topology,
        options.parts,
        options.workers,
        options.dask,
        progress=sys.stderr.isatty(),
    )
    skin, tongue = (100 * done.explained[part] for part in ("skin", "tongue"))
    print(
        f"wrote {options.output}: {', '.join(f'{count} {made}' for made, count in done.made.items())} clips"
    )
    print(f"components hold {skin:.2f} % of the skin's and {tongue:.2f} % of the tongue's variance")
    print(f"phonemes: {', '.join(f'{count} {source}' for source, count in done.labels.items())}")
    if done.lacking:
        print(f"this mesh has no {', '.join(done.lacking)}: not part of the states, or not measured")
    return 0


def _cache_features(options: CacheFeaturesOptions) -> None:
    print(f"wrote {cache_features(options, progress=sys.stderr.isatty())}")


def _emotional_speech(options: EmotionalSpeechOptions) -> None:
    print(f"wrote {speak_emotions(options, progress=sys.stderr.isatty())}")


def _personalize(options: PersonalizeOptions) -> None:
    target = load_mesh(options.target, scale=options.scale)
    landmarks = None if options.landmarks is None else _landmarks(options.landmarks)
    rig = personal_shapes(load_head(options.head), target, options.method, landmarks)
    write_rig(options.output, rig)
    print(f"wrote {options.output}: {len(rig.names)} shapes on {len(rig.neutral)} vertices")


def _landmarks(path: Path) -> np.ndarray:
    try:
        pairs = np.array(json.loads(path.read_text(encoding="utf-8")))
    except OSError as error:
        raise FileFormatError(f"cannot read {path}: {error.strerror or error}") from error
    except ValueError as error:
        raise FileFormatError(f"{path} is no JSON list of pairs: {error}") from error
    if pairs.ndim != 2 or pairs.shape[1] != 2 or pairs.dtype.kind != "i":
        raise FileFormatError(f"{path} is no JSON list of pairs of vertex numbers")
    return pairs


COMMANDS = {
    "synthesize": _synthesize,
    "info": _info,
    "check": _check,
    "convert": _convert,
    "augment-pose": _augment_pose,
    "a2f": _states,
    "cache-features": _cache_features,
    "personalize": _personalize,
    "emotional-speech": _emotional_speech,
}
