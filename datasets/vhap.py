"""VHAP's export, which GaussianAvatars and GEM read: transforms_*.json, images, masks, FLAME parameters.

    DIR/transforms_train.json         and _val.json, _test.json; or transforms.json alone
    DIR/images/TTTTT_CC.png           file_path
    DIR/fg_masks/TTTTT_CC.png         fg_mask_path
    DIR/flame_param/TTTTT.npz         flame_param_path: translation, rotation, neck_pose, jaw_pose (1, 3),
                                      eyes_pose (1, 6), shape (300,), expr (1, 100), static_offset (1, V, 3);
                                      dynamic_offset (1, V, 3) is not read, as GaussianAvatars does not
    DIR/canonical_flame_param.npz     the same at rest, jaw opened by 0.3 rad
    DIR/surface.npz                   ours alone: the drawn triangles (`HeadSurface`), if not the head's own

Each frame has `transform_matrix`, camera to world in OpenGL axes (x right, y up, z backwards), metres.
Combined data sets name their files relative to DIR, "../SEQUENCE/images/..."; each of their sequences was
tracked for itself, and the first one's identity (shape, static_offset) is taken for all, as GaussianAvatars
does. `val` is a camera that was left
out (8, the front, of 16), `test` a sequence that was. Names and types are those of VHAP's
export_as_nerf_dataset.py and combine_nerf_datasets.py.
"""

import json
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tqdm import tqdm

from meshanim.datasets.capture import Capture, Picture, View, check_camera, read_image, read_plane
from meshanim.datasets.capture_folder import write_image
from meshanim.errors import FileFormatError, OptionError
from meshanim.files import read_json, read_npz, written_whole
from meshanim.heads import HeadParameters, HeadSurface, load_head

__all__ = ["detect", "read_capture", "write_vhap"]

SPLITS = ("train", "val", "test")
WRITTEN_SPLITS = {
    "train": "train",
    "novel_view": "val",
    "novel_expression": "test",
    "novel_expression_known_view": "test",
}
"""What the splits of our captures are called here; others keep their names."""
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
"""From OpenGL's camera axes to OpenCV's, and back."""
PARAMETERS = {
    "shape": ("shape", None),
    "expr": ("expression", None),
    "rotation": ("rotation", 3),
    "neck_pose": ("neck", 3),
    "jaw_pose": ("jaw", 3),
    "eyes_pose": ("eyes", 6),
    "translation": ("translation", 3),
}
"""VHAP's names, ours, and columns."""
CANONICAL_JAW = 0.3


def detect(directory: Path) -> bool:
    """Whether the folder has this layout."""
    return any((directory / f"transforms{ending}.json").is_file() for ending in ("_train", ""))


@dataclass(frozen=True)
class _Files:
    images: Mapping[str, Path]
    masks: Mapping[str, Path]
    sizes: Mapping[str, tuple[int, int]]

    def __call__(self, name: str) -> Picture:
        size = self.sizes[name]
        image = read_image(self.images[name], size)
        mask = read_plane(self.masks[name], size) if name in self.masks else None
        if mask is None and image.shape[2] == 4:
            mask = np.ascontiguousarray(image[..., 3])
        return Picture(np.ascontiguousarray(image[..., :3]), mask)


def read_capture(directory: Path) -> Capture:
    """Open a VHAP export, single or combined.

    Raises
    ------
    FileFormatError
        If a file is missing or damaged.
    """
    present = [split for split in SPLITS if (directory / f"transforms_{split}.json").is_file()]
    tables = {split: directory / f"transforms_{split}.json" for split in present}
    if not tables:
        tables = {"train": directory / "transforms.json"}
    frames = [
        (split, path, {**shared, **frame})
        for split, path in tables.items()
        for shared, frame in _read_frames(path)
    ]
    files = sorted({frame["flame_param_path"] for _, _, frame in frames if "flame_param_path" in frame})
    if files:
        absent = next((path for _, path, frame in frames if "flame_param_path" not in frame), None)
        if absent is not None:
            raise FileFormatError(f"{absent}: some frames have flame_param_path, others none")
    if not frames:
        raise FileFormatError(f"{', '.join(map(str, tables.values()))}: no frames")
    surface = directory / "surface.npz"
    # Timesteps of different sequences may have one number; their parameters' files are different ones.
    keys = sorted({_timestep(path, frame) for _, path, frame in frames})
    rows = {key: row for row, key in enumerate(keys)}
    views, images, masks, members = [], {}, {}, {}
    for split, path, frame in frames:
        view, image, mask = _view(directory, path, frame, rows[_timestep(path, frame)])
        if view.name in members:
            raise FileFormatError(f"{path} has picture {frame['file_path']} twice")
        views.append(view)
        members[view.name] = split
        images[view.name] = image
        if mask is not None:
            masks[view.name] = mask
    if masks and len(masks) < len(views):
        bare = next(view.name for view in views if view.name not in masks)
        raise FileFormatError(f"{directory}: some frames have fg_mask_path, others, such as {bare}, none")
    parameters, offset = _read_parameters(directory, [key[1] for key in keys]) if files else (None, None)
    views.sort(key=lambda view: (view.timestep, view.camera))
    return Capture(
        name=directory.resolve().name,
        kind="vhap",
        directory=directory,
        views=tuple(views),
        splits={
            split: tuple(index for index, view in enumerate(views) if members[view.name] == split)
            for split in tables
        },
        read=_Files(images, masks, {view.name: (view.width, view.height) for view in views}),
        parameters=parameters,
        timesteps=tuple(f"{number:05d}" for number, _ in keys),
        head_name=str(frames[0][2].get("head", "")),
        static_offset=offset,
        surface=HeadSurface.load(surface) if surface.is_file() else None,
    )


def _read_frames(path: Path) -> list[tuple[dict[str, Any], dict[str, Any]]]:
    content = read_json(path)
    if not isinstance(content, dict) or not isinstance(content.get("frames"), list):
        raise FileFormatError(f"{path} holds no frames")
    shared = {key: value for key, value in content.items() if key != "frames"}
    listed = content.get("timestep_indices")
    if isinstance(listed, list):
        numbers = [frame.get("timestep_index") for frame in content["frames"]]
        other = [number for number in numbers if isinstance(number, int) and number not in listed]
        if other:
            raise FileFormatError(f"{path} has frames of timestep {other[0]}, which timestep_indices lacks")
    return [(shared, frame) for frame in content["frames"]]


def _timestep(path: Path, frame: Mapping[str, Any]) -> tuple[int, str]:
    try:
        return int(frame["timestep_index"]), str(frame.get("flame_param_path", ""))
    except (KeyError, TypeError, ValueError) as error:
        raise FileFormatError(f"{path}: a frame has no timestep_index") from error


def _view(directory: Path, path: Path, frame: Mapping[str, Any], row: int) -> tuple[View, Path, Path | None]:
    file = str(frame.get("file_path", "?"))
    where = f"{path}: frame {file}"
    try:
        width, height = int(frame["w"]), int(frame["h"])
        focal = [
            float(frame[f"fl_{axis}"]) if f"fl_{axis}" in frame else _focal(frame, axis, size)
            for axis, size in (("x", width), ("y", height))
        ]
        center = [float(frame.get(f"c{axis}", size / 2)) for axis, size in (("x", width), ("y", height))]
        camera_to_world = np.array(frame["transform_matrix"], np.float64)
        image = directory / (file if Path(file).suffix else f"{file}.png")
        camera = frame.get("camera_index", frame.get("camera_id", 0))
    except KeyError as error:
        raise FileFormatError(f"{where} lacks {error}") from error
    except (TypeError, ValueError) as error:
        raise FileFormatError(f"{where}: {error}") from error
    if camera_to_world.shape != (4, 4) or not np.isfinite(camera_to_world).all():
        raise FileFormatError(f"{where}: transform_matrix is no finite 4 x 4 matrix")
    try:
        world_to_camera = OPENGL @ np.linalg.inv(camera_to_world)
    except np.linalg.LinAlgError as error:
        raise FileFormatError(f"{where}: transform_matrix has no inverse") from error
    intrinsics = np.array([[focal[0], 0, center[0]], [0, focal[1], center[1]], [0, 0, 1]])
    check_camera(where, world_to_camera, intrinsics)
    name = os.path.normpath(file).replace("images" + os.sep, "").rpartition(".")[0] or file
    mask = frame.get("fg_mask_path")
    label = f"{camera:02d}" if isinstance(camera, int) else str(camera)
    view = View(name, row, label, world_to_camera, intrinsics, width, height)
    return view, image, None if mask is None else directory / str(mask)


def _focal(frame: Mapping[str, Any], axis: str, size: int) -> float:
    return size / (2 * math.tan(float(frame[f"camera_angle_{axis}"]) / 2))


def _read_parameters(directory: Path, files: Sequence[str]) -> tuple[HeadParameters, np.ndarray | None]:
    rows: dict[str, list[np.ndarray]] = {ours: [] for ours, _ in PARAMETERS.values()}
    identities: dict[Path, tuple[np.ndarray, np.ndarray]] = {}  # of each sequence
    for file in files:
        path = directory / file
        arrays = read_npz(path)
        for theirs, (ours, columns) in PARAMETERS.items():
            if theirs not in arrays:
                raise FileFormatError(f"{path} lacks {theirs}")
            row = np.asarray(arrays[theirs], np.float32).reshape(-1)
            if columns not in (None, len(row)) or not np.isfinite(row).all():
                raise FileFormatError(f"{path}: {theirs} is no {columns or ''} finite numbers")
            if rows[ours] and len(row) != len(rows[ours][0]):
                raise FileFormatError(
                    f"{path}: {theirs} has {len(row)} numbers, that of other frames {len(rows[ours][0])}"
                )
            rows[ours].append(row)
        identity = rows["shape"][-1], _static_offset(path, arrays)
        first = identities.setdefault(path.parent, identity)
        if not all(np.array_equal(one, other) for one, other in zip(first, identity)):
            raise FileFormatError(f"{path}: shape or static_offset is not that of the other frames")
    shape, offset = next(iter(identities.values()))
    tensors = {name: torch.from_numpy(np.stack(values)) for name, values in rows.items()}
    tensors["shape"] = torch.from_numpy(shape)[None]
    # Zeros say nothing about the topology either: teeth may be missing from them.
    return HeadParameters(**tensors), offset if offset.any() else None


def _static_offset(path: Path, arrays: Mapping[str, np.ndarray]) -> np.ndarray:
    """(V, 3); no rows where there is none."""
    found = np.asarray(arrays.get("static_offset", np.zeros((0, 3))), np.float32)
    if found.ndim == 3 and len(found) == 1:
        found = found[0]
    if found.ndim != 2 or found.shape[1] != 3 or not np.isfinite(found).all():
        raise FileFormatError(f"{path}: static_offset is {found.shape}, expected (1, V, 3), finite")
    return found


def write_vhap(capture: Capture, target: str | Path, progress: bool = False) -> Path:
    """Write any tracked capture as VHAP exports it; pictures that are already there are kept.

    The coefficients are those of the capture's head: FLAME's, if it is FLAME; otherwise only programs that
    know the head can use them, and others the cameras, images and masks. `head` in the JSON files says which.

    Parameters
    ----------
    capture : Capture
        What to write, as large as it was opened.
    target : path
        The folder.
    progress : bool
        Show a bar.

    Raises
    ------
    OptionError
        If nobody tracked the head, or a view is in two splits.
    """
    target = Path(target)
    if capture.parameters is None:
        raise OptionError(f"{capture.directory} holds no parameters of a head")
    for folder in ("images", "fg_masks", "flame_param"):
        (target / folder).mkdir(parents=True, exist_ok=True)
    names = sorted({view.camera for view in capture.views})
    numbered = all(name.isdigit() for name in names)
    numbers = {name: int(name) if numbered else index for index, name in enumerate(names)}
    _write_parameters(capture, target)
    if capture.surface is not None:
        capture.surface.save(target / "surface.npz")
    tables: dict[str, list[dict[str, Any]]] = {}
    seen: set[int] = set()
    bar = tqdm(total=sum(map(len, capture.splits.values())), desc="pictures", disable=not progress)
    for split, indices in capture.splits.items():
        table = tables.setdefault(WRITTEN_SPLITS.get(split, split), [])
        for index in indices:
            if index in seen:
                raise OptionError(f"picture {capture.views[index].name} is in two splits")
            seen.add(index)
            table.append(_write_picture(capture, index, numbers, target))
            bar.update()
    bar.close()
    for split, frames in tables.items():
        _write_table(target / f"transforms_{split}.json", frames, capture.head_name)
    _write_table(
        target / "transforms.json", [f for frames in tables.values() for f in frames], capture.head_name
    )
    return target


def _write_picture(capture: Capture, index: int, numbers: Mapping[str, int], target: Path) -> dict[str, Any]:
    view = capture.views[index]
    stem = f"{view.timestep:05d}_{numbers[view.camera]:02d}"
    image, mask = target / "images" / f"{stem}.png", target / "fg_masks" / f"{stem}.png"
    if not image.exists():
        picture = capture[index]
        if picture.mask is not None:
            write_image(mask, picture.mask)
        write_image(image, picture.image)
    fl_x, fl_y = float(view.intrinsics[0, 0]), float(view.intrinsics[1, 1])
    return {
        "timestep_index": view.timestep,
        "timestep_index_original": view.timestep,
        "timestep_id": capture.timesteps[view.timestep],
        "camera_index": numbers[view.camera],
        "camera_id": view.camera,
        "cx": float(view.intrinsics[0, 2]),
        "cy": float(view.intrinsics[1, 2]),
        "fl_x": fl_x,
        "fl_y": fl_y,
        "h": view.height,
        "w": view.width,
        "camera_angle_x": 2 * math.atan(view.width / (2 * fl_x)),
        "camera_angle_y": 2 * math.atan(view.height / (2 * fl_y)),
        "transform_matrix": np.linalg.inv(OPENGL @ view.world_to_camera).tolist(),
        "file_path": f"images/{stem}.png",
        **({"fg_mask_path": f"fg_masks/{stem}.png"} if mask.exists() else {}),
        "flame_param_path": f"flame_param/{view.timestep:05d}.npz",
    }


def _write_parameters(capture: Capture, target: Path) -> None:
    vertices = capture.head.n_vertices
    offset = np.zeros((1, vertices, 3), np.float32)
    if capture.static_offset is not None and len(capture.static_offset) == vertices:
        offset[0] = capture.static_offset
    elif capture.static_offset is not None:  # of another set of teeth
        offset[0] = capture.head.template_vertices - load_head(capture.head_name).template_vertices
    widths = {"shape": len(capture.head.shape_names), "expression": len(capture.head.expression_names)}
    for row in sorted({view.timestep for view in capture.views}):
        params = capture.at(row)
        arrays: dict[str, Any] = {"static_offset": offset}
        for theirs, (ours, columns) in PARAMETERS.items():
            value = getattr(params, ours)
            columns = columns or widths[ours]
            array = np.zeros((1, columns), np.float32)
            if value is not None:
                array[0, : value.shape[1]] = value[0].numpy()
            arrays[theirs] = array[0] if theirs == "shape" else array
        with written_whole(target / "flame_param" / f"{row:05d}.npz") as temporary:
            np.savez_compressed(temporary, **arrays)
    still = {key: array if key in ("shape", "static_offset") else 0 * array for key, array in arrays.items()}
    still["jaw_pose"] = np.array([[CANONICAL_JAW, 0, 0]], np.float32)
    with written_whole(target / "canonical_flame_param.npz") as temporary:
        np.savez_compressed(temporary, **still)


def _write_table(path: Path, frames: list[dict[str, Any]], head: str) -> None:
    """One transforms file; like VHAP's, it has the last frame's intrinsics for readers that share them."""
    shared = ("cx", "cy", "fl_x", "fl_y", "h", "w", "camera_angle_x", "camera_angle_y")
    content = {
        "frames": frames,
        **({key: frames[-1][key] for key in shared} if frames else {}),
        "timestep_indices": sorted({frame["timestep_index"] for frame in frames}),
        "camera_indices": sorted({frame["camera_index"] for frame in frames}),
        "head": head,
    }
    with written_whole(path) as temporary:
        temporary.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
