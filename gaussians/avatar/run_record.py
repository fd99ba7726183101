"""What a fit was begun with, kept beside its checkpoints: a resumed run must go on with the same."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import numpy as np

from meshanim.datasets.capture import Capture
from meshanim.errors import FileFormatError, OptionError
from meshanim.files import read_json, written_whole
from meshanim.gaussians.avatar.pictures import PictureStore
from meshanim.gaussians.avatar.settings import FitSettings

__all__ = ["RECORD", "check_record", "fingerprints", "write_record"]

RECORD = "run.json"


def fingerprints(capture: Capture, store: PictureStore, views: tuple[int, ...]) -> dict[str, str]:
    """What of a capture decides a fit, as short digests by what they are of.

    Pictures are the first and the last that are fitted: reading all would take as long as a part of the fit.
    """
    parameters = () if capture.parameters is None else fields(capture.parameters)
    tracked = [getattr(capture.parameters, field.name) for field in parameters]
    chosen = [capture.views[index] for index in views]
    offset = np.zeros(0) if capture.static_offset is None else capture.static_offset
    return {
        "pictures' names": _digest(*(f"{view.name} {view.timestep}" for view in chosen)),
        "pictures": _digest(*(store.image(index).numpy() for index in (views[0], views[-1]))),
        "cameras": _digest(*(m for view in chosen for m in (view.world_to_camera, view.intrinsics))),
        "head parameters": _digest(*(np.zeros(0) if t is None else t.numpy() for t in tracked)),
        "surface": _digest(capture.carried.faces, offset),
    }


def write_record(directory: Path, record: Mapping[str, Any], settings: FitSettings) -> None:
    """Keep the record of a new run in its folder, which is made if it is missing.

    Raises
    ------
    FileFormatError
        If the folder cannot be made or written to.
    """
    try:
        directory.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FileFormatError(f"cannot write {directory}: {error.strerror}") from error
    with written_whole(directory / RECORD) as temporary:
        temporary.write_text(json.dumps(_whole(record, settings), indent=1) + "\n", encoding="utf-8")


def check_record(directory: Path, record: Mapping[str, Any], settings: FitSettings) -> None:
    """Compare with what the run in a folder was begun with.

    Raises
    ------
    OptionError
        If they differ; the message names what does.
    FileFormatError
        If the folder has no record, or a damaged one.
    """
    begun, now = read_json(directory / RECORD), _whole(record, settings)
    if not isinstance(begun, dict):
        raise FileFormatError(f"{directory / RECORD} is no record of a fit")
    other = [key for key in now if begun.get(key) != now[key]]
    if other[1:]:  # the settings follow from the preset and its options, which are named
        other = [key for key in other if key != "settings"]
    if other:
        told = [
            f"another {key}"
            if key in ("settings", *record["capture"])
            else f"{key} {begun.get(key)!r}, not {now[key]!r}"
            for key in other
        ]
        raise OptionError(
            f"{directory} was begun with {'; '.join(told)}: resume with the same, or choose another folder"
        )


def _whole(record: Mapping[str, Any], settings: FitSettings) -> dict[str, Any]:
    flat = {key: value for key, value in record.items() if key != "capture"} | record["capture"]
    flat["settings"] = _digest(json.dumps(asdict(settings), sort_keys=True))
    return json.loads(json.dumps(flat))  # as it is read: JSON knows no tuples


def _digest(*parts: str | np.ndarray) -> str:
    found = hashlib.sha256()
    for part in parts:
        if isinstance(part, str):
            found.update(part.encode())
        else:
            found.update(str((part.dtype, part.shape)).encode())
            found.update(np.ascontiguousarray(part).tobytes())
        found.update(b"\n")
    return found.hexdigest()[:16]
