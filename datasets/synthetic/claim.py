"""Who may write into a folder: a new run, or the one that began it."""

import json
from collections.abc import Mapping
from pathlib import Path

from meshanim.errors import FileFormatError, OptionError
from meshanim.files import written_whole

__all__ = ["claim_folder"]


def claim_folder(directory: Path, recorded: Mapping[str, object], what: str) -> None:
    """Make a folder ours: new, or begun with the same options, which synthesis.json keeps.

    Parameters
    ----------
    directory : Path
        The folder.
    recorded : mapping
        What decides the content of the files; fits into JSON.
    what : str
        What the folder is to hold, for the message: "corpus".

    Raises
    ------
    OptionError
        If it holds something else, or was begun with other options.
    FileFormatError
        If it cannot be made, or its record is damaged.
    """
    path = directory / "synthesis.json"
    if path.exists():
        try:
            begun = json.loads(path.read_text(encoding="utf-8"))
        except ValueError as error:
            raise FileFormatError(
                f"{path} is damaged: {error}; delete the folder or choose another"
            ) from error
        other = [key for key, value in recorded.items() if begun.get(key) != value]
        if other:
            kept = ", ".join(f"{key} {begun.get(key)}" for key in other)
            raise OptionError(f"{directory} was begun with {kept}; choose another folder or delete it")
        return
    if directory.exists() and any(directory.iterdir()):
        raise OptionError(f"{directory} is not empty and holds no {what}; choose another folder")
    try:
        directory.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FileFormatError(f"cannot write {directory}: {error.strerror}") from error
    with written_whole(path) as temporary:
        temporary.write_text(json.dumps(recorded, indent=1) + "\n", encoding="utf-8")
