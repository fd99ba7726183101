"""The plain multi-view folder: pictures named by timestep and camera, cameras.json, head.npz.

    DIR/images/TTTTT_CAMERA.png   or .jpg; TTTTT.png alone where there is one camera
    DIR/masks/ DIR/regions/       the same names, .png; may be missing
    DIR/cameras.json              {"cameras": {NAME: {"world_to_camera": 4 x 4, "intrinsics": 3 x 3,
                                  "width": W, "height": H}}}; a NAME is a camera's, or that of one picture,
                                  TTTTT_CAMERA, where the camera moves
    DIR/head.npz                  shape (1, S), expression (T, E), rotation, neck, jaw (T, 3), eyes (T, 6),
                                  translation (T, 3): what is not there is zero; timesteps (T,): the TTTTT of
                                  each row, 0 to T - 1 if not given. May be missing
    DIR/speech/TTTTT.wav          what is heard from timestep TTTTT on, of a video; may be missing
    DIR/capture.json              name, head, background, regions, splits, fps (of videos), rest (weights of
                                  expressions with which the face rests); all of it optional
    DIR/offset.npz                static_offset (V, 3): metres, added to the head's template; may be missing
    DIR/surface.npz               the drawn triangles (`HeadSurface`), where they are not the head's own

Metres, radians, pixels; OpenCV cameras, pixel centres at half integers.
"""

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from tqdm import tqdm

from meshanim.audio import Waveform, load_waveform, save_waveform
from meshanim.datasets.capture import Capture, Picture, View, check_camera, read_image, read_plane
from meshanim.errors import FileFormatError
from meshanim.files import read_json, read_npz, written_whole
from meshanim.heads import HeadParameters, HeadSurface

__all__ = [
    "detect",
    "read_capture",
    "remove_half_written",
    "write_cameras",
    "write_capture",
    "write_parameters",
    "write_picture",
    "write_record",
    "write_speech",
]

IMAGES, MASKS, REGION_MAPS, SPEECH = "images", "masks", "regions", "speech"
ENDINGS = (".png", ".jpg", ".jpeg")
WIDTHS = {"rotation": 3, "neck": 3, "jaw": 3, "eyes": 6, "translation": 3}


def detect(directory: Path) -> bool:
    """Whether the folder has this layout."""
    return (directory / "cameras.json").is_file() and (directory / IMAGES).is_dir()


@dataclass(frozen=True)
class _Files:
    """Where the files of each picture are, by its name."""

    images: Mapping[str, Path]
    masks: Mapping[str, Path]
    regions: Mapping[str, Path]
    sizes: Mapping[str, tuple[int, int]]

    def __call__(self, name: str) -> Picture:
        size = self.sizes[name]
        image = read_image(self.images[name], size)
        mask, regions = (
            read_plane(paths[name], size) if paths else None for paths in (self.masks, self.regions)
        )
        if mask is None and image.shape[2] == 4:
            mask = np.ascontiguousarray(image[..., 3])
        return Picture(np.ascontiguousarray(image[..., :3]), mask, regions)


def read_capture(directory: Path) -> Capture:
    """Open a plain multi-view folder.

    Raises
    ------
    FileFormatError
        If a file is missing or damaged, or a picture has no camera or no parameters.
    """
    cameras = _read_cameras(directory / "cameras.json")
    record = _read_record(directory / "capture.json")
    images = _listed(directory / IMAGES)
    if not images:
        raise FileFormatError(f"{directory / IMAGES} has no pictures (.png, .jpg)")
    parameters, numbers = _read_parameters(directory / "head.npz")
    places = [_place(directory, name, cameras) for name in images]
    if parameters is None:
        numbers = sorted({number for number, _ in places})
    rows = {number: row for row, number in enumerate(numbers)}
    views = []
    for name, (number, camera) in zip(images, places):
        if number not in rows:
            raise FileFormatError(
                f"{directory / 'head.npz'} has no parameters for timestep {number} of {images[name].name}"
            )
        matrices = cameras[name] if name in cameras else cameras[camera]
        views.append(View(name, rows[number], camera, *matrices))
    views.sort(key=lambda view: (view.timestep, view.camera))
    masks, regions = (_companions(directory / folder, images) for folder in (MASKS, REGION_MAPS))
    sizes = {view.name: (view.width, view.height) for view in views}
    surface = directory / "surface.npz"
    return Capture(
        name=str(record.get("name", directory.resolve().name)),
        kind="folder",
        directory=directory,
        views=tuple(views),
        splits=_splits(directory / "capture.json", record, views),
        read=_Files(images, masks, regions, sizes),
        parameters=parameters,
        timesteps=tuple(f"{number:05d}" for number in numbers),
        head_name=str(record.get("head", "")),
        static_offset=_read_offset(directory / "offset.npz"),
        surface=HeadSurface.load(surface) if surface.is_file() else None,
        region_names=tuple(record.get("regions", ())),
        background=tuple(record["background"]) if record.get("background") else None,
        fps=record.get("fps"),
        rest=record.get("rest", {}),
        speech=_speech(directory / SPEECH, rows),
    )


def _speech(folder: Path, rows: Mapping[int, int]) -> dict[int, Path]:
    """Sound files by the row that they begin with."""
    found = {}
    for path in sorted(folder.glob("[!.]*")) if folder.is_dir() else ():
        if not path.stem.isdigit() or int(path.stem) not in rows:
            raise FileFormatError(f"{path} is named after no timestep: TTTTT.wav begins with timestep TTTTT")
        found[rows[int(path.stem)]] = path
    return found


def _listed(folder: Path) -> dict[str, Path]:
    if not folder.is_dir():
        return {}
    paths = sorted(path for path in folder.iterdir() if path.suffix.lower() in ENDINGS)
    return {path.stem: path for path in paths if not path.name.startswith(".")}


def _companions(folder: Path, images: Mapping[str, Path]) -> dict[str, Path]:
    found = _listed(folder)
    missing = [name for name in images if name not in found]
    if found and missing:
        raise FileFormatError(
            f"{folder} lacks {len(missing)} of {len(images)} pictures, such as {missing[0]}.png; leave the "
            "whole folder away to do without"
        )
    return found


def _place(directory: Path, name: str, cameras: Mapping[str, Any]) -> tuple[int, str]:
    """Timestep and camera of a picture."""
    number, _, camera = name.partition("_")
    if not number.isdigit():
        raise FileFormatError(
            f"{directory / IMAGES / name} does not start with a timestep: TTTTT_CAMERA is expected"
        )
    if not camera and len(cameras) == 1:
        camera = next(iter(cameras))
    if camera not in cameras and name not in cameras:
        raise FileFormatError(
            f"{directory / 'cameras.json'} has no camera {camera!r} for picture {name}; it has "
            f"{', '.join(list(cameras)[:8])}"
        )
    return int(number), camera


def _read_cameras(path: Path) -> dict[str, tuple[np.ndarray, np.ndarray, int, int]]:
    content = read_json(path)
    listed = content.get("cameras") if isinstance(content, dict) else None
    if not isinstance(listed, dict) or not listed:
        raise FileFormatError(f'{path} holds no cameras: {{"cameras": {{NAME: ...}}}} is expected')
    cameras = {}
    for name, entry in listed.items():
        where = f"{path}: camera {name}"
        try:
            world_to_camera, intrinsics = (
                np.array(entry[key], np.float64) for key in ("world_to_camera", "intrinsics")
            )
            width, height = int(entry["width"]), int(entry["height"])
        except KeyError as error:
            raise FileFormatError(f"{where} lacks {error}") from error
        except (TypeError, ValueError) as error:
            raise FileFormatError(f"{where}: {error}") from error
        check_camera(where, world_to_camera, intrinsics)
        if width < 1 or height < 1:
            raise FileFormatError(f"{where}: {width} x {height} is no size")
        cameras[name] = (world_to_camera, intrinsics, width, height)
    return cameras


def _read_record(path: Path) -> dict[str, Any]:
    if not path.is_file():
        return {}
    record = read_json(path)
    if not isinstance(record, dict):
        raise FileFormatError(f"{path} holds {type(record).__name__}, expected an object")
    background = record.get("background")
    if background and not (isinstance(background, list) and len(background) == 3):
        raise FileFormatError(f"{path}: background is {background}, expected three numbers in [0, 1]")
    fps = record.get("fps")
    if fps is not None and not (isinstance(fps, int | float) and fps > 0):
        raise FileFormatError(f"{path}: fps is {fps}, expected frames a second")
    rest = record.get("rest", {})
    if not (isinstance(rest, dict) and all(isinstance(weight, int | float) for weight in rest.values())):
        raise FileFormatError(f"{path}: rest is {rest}, expected weights by the names of expressions")
    return record


def _read_parameters(path: Path) -> tuple[HeadParameters | None, list[int]]:
    if not path.is_file():
        return None, []
    arrays = read_npz(path)
    known = [entry.name for entry in fields(HeadParameters)]
    given = {name: arrays[name] for name in known if name in arrays}
    unknown = sorted(set(arrays) - set(known) - {"timesteps"})
    if unknown or not given:
        raise FileFormatError(
            f"{path} holds {', '.join(sorted(arrays))}; expected some of {', '.join(known)}"
        )
    count = max(len(np.atleast_2d(array)) for array in given.values())
    numbers = arrays["timesteps"].tolist() if "timesteps" in arrays else list(range(count))
    if len(set(numbers)) != len(numbers):
        raise FileFormatError(f"{path}: timesteps names a timestep twice")
    tensors = {}
    for name, array in given.items():
        array = np.atleast_2d(np.asarray(array, np.float32))
        if (
            array.ndim != 2
            or len(array) not in (1, len(numbers))
            or array.shape[1] != WIDTHS.get(name, array.shape[1])
        ):
            raise FileFormatError(
                f"{path}: {name} is {array.shape}, expected {len(numbers)} rows or one"
                + (f" of {WIDTHS[name]}" if name in WIDTHS else "")
            )
        if not np.isfinite(array).all():
            raise FileFormatError(f"{path}: {name} has numbers that are not finite")
        tensors[name] = torch.from_numpy(array)
    return HeadParameters(**tensors), [int(number) for number in numbers]


def _read_offset(path: Path) -> np.ndarray | None:
    if not path.is_file():
        return None
    offset = read_npz(path).get("static_offset", np.zeros(0))
    if offset.ndim != 2 or offset.shape[1] != 3 or not np.isfinite(offset).all():
        raise FileFormatError(f"{path}: static_offset is {offset.shape}, expected (V, 3), finite")
    return offset.astype(np.float32)


def _splits(path: Path, record: Mapping[str, Any], views: Sequence[View]) -> dict[str, tuple[int, ...]]:
    """Positions by split; everything is for training where the folder does not say."""
    where = {view.name: index for index, view in enumerate(views)}
    if "splits" not in record:
        return {"train": tuple(range(len(views)))}
    splits = {}
    for split, names in record["splits"].items():
        missing = [name for name in names if name not in where]
        if missing:
            raise FileFormatError(
                f"{path}: split {split} names {len(missing)} pictures that are missing, such as {missing[0]}"
            )
        splits[split] = tuple(where[name] for name in names)
    return splits


def write_capture(capture: Capture, target: str | Path, progress: bool = False) -> Path:
    """Write any capture as a plain folder; pictures that are already there are kept.

    Parameters
    ----------
    capture : Capture
        What to write, as large as it was opened.
    target : path
        The folder.
    progress : bool
        Show a bar.
    """
    target = Path(target)
    target.mkdir(parents=True, exist_ok=True)
    names = [f"{view.timestep:05d}_{_plain(view.camera)}" for view in capture.views]
    cameras: dict[str, tuple[np.ndarray, np.ndarray, int, int]] = {}
    for name, view in zip(names, capture.views):
        matrices = (view.world_to_camera, view.intrinsics, view.width, view.height)
        still = cameras.setdefault(_plain(view.camera), matrices)
        same = np.array_equal(still[0], matrices[0]) and np.array_equal(still[1], matrices[1])
        if not same or still[2:] != matrices[2:]:
            cameras[name] = matrices
    write_cameras(target, cameras)
    if capture.parameters is not None:
        write_parameters(target, capture.parameters, range(len(capture.timesteps)))
    if capture.surface is not None:
        capture.surface.save(target / "surface.npz")
    if capture.static_offset is not None:
        with written_whole(target / "offset.npz") as temporary:
            np.savez_compressed(temporary, static_offset=capture.static_offset)
    write_speech(target, {row: load_waveform(path, rate=None) for row, path in capture.speech.items()})
    splits = {split: [names[index] for index in indices] for split, indices in capture.splits.items()}
    record = {
        "name": capture.name,
        "head": capture.head_name,
        "background": capture.background,
        "regions": list(capture.region_names),
        "fps": capture.fps,
        "rest": dict(capture.rest),
        "frames": list(capture.timesteps),
        "splits": splits,
    }
    write_record(target, {key: value for key, value in record.items() if value})
    for index, name in enumerate(tqdm(names, "pictures", disable=not progress)):
        if not (target / IMAGES / f"{name}.png").exists():
            write_picture(target, name, capture[index])
    return target


def _plain(camera: str) -> str:
    """A camera's name as part of a file's."""
    return re.sub(r"[^\w-]", "-", camera)


def write_cameras(directory: Path, cameras: Mapping[str, tuple[np.ndarray, np.ndarray, int, int]]) -> None:
    """Write cameras.json: `world_to_camera`, `intrinsics`, width and height by name."""
    content = {
        name: {
            "world_to_camera": pose.tolist(),
            "intrinsics": intrinsics.tolist(),
            "width": width,
            "height": height,
        }
        for name, (pose, intrinsics, width, height) in cameras.items()
    }
    with written_whole(directory / "cameras.json") as temporary:
        temporary.write_text(json.dumps({"cameras": content}, indent=1) + "\n", encoding="utf-8")


def write_parameters(directory: Path, parameters: HeadParameters, timesteps: Sequence[int]) -> None:
    """Write head.npz: what of the parameters is there, and the number of each row."""
    arrays = {entry.name: getattr(parameters, entry.name) for entry in fields(parameters)}
    present = {name: value.detach().cpu().numpy() for name, value in arrays.items() if value is not None}
    with written_whole(directory / "head.npz") as temporary:
        np.savez_compressed(temporary, **present, timesteps=np.array(timesteps, np.int64))


def write_picture(directory: Path, name: str, picture: Picture) -> None:
    """Write the files of one picture, the image last."""
    planes = {REGION_MAPS: picture.regions, MASKS: picture.mask, IMAGES: picture.image}
    for folder, array in planes.items():
        if array is None:
            continue
        (directory / folder).mkdir(parents=True, exist_ok=True)
        write_image(directory / folder / f"{name}.png", array)


def write_speech(directory: Path, speech: Mapping[int, Waveform]) -> None:
    """Write speech/TTTTT.wav: what is heard from a timestep on."""
    for timestep, waveform in speech.items():
        (directory / SPEECH).mkdir(parents=True, exist_ok=True)
        save_waveform(waveform, directory / SPEECH / f"{timestep:05d}.wav")


def remove_half_written(directory: Path) -> None:
    """Remove what writers that were killed left behind."""
    for folder in (directory, *(directory / name for name in (IMAGES, MASKS, REGION_MAPS, SPEECH))):
        for left in folder.glob(".*.*"):
            left.unlink()


def write_image(path: Path, array: np.ndarray) -> None:
    """Write a PNG file whole."""
    with written_whole(path) as temporary:
        Image.fromarray(array).save(temporary, compress_level=4)


def write_record(directory: Path, record: Mapping[str, Any]) -> None:
    """Write capture.json."""
    with written_whole(directory / "capture.json") as temporary:
        temporary.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
