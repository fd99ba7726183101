"""Rigs as files: a neutral mesh with named blendshapes, for `load_head("rig:...")` and for other programs."""

from pathlib import Path

import numpy as np

from meshanim.errors import FileFormatError, OptionError
from meshanim.export.gltf import write_morph_targets
from meshanim.files import written_whole
from meshanim.heads import Rig

__all__ = ["write_rig"]


def write_rig(path: str | Path, rig: Rig) -> None:
    """Write a rig by the ending of the path: .npz, .glb, or none for a folder of OBJ files.

    .npz holds all but texture coordinates, regions included; .glb one mesh with ARKit's names as morph target
    names, which viewers, Blender and game engines read; the folder neutral.obj and one OBJ a shape. A rig
    with texture coordinates has its vertices split along seams in .glb. Metres all.

    Raises
    ------
    OptionError
        If the path ends otherwise.
    FileFormatError
        If it cannot be written.
    """
    path = Path(path)
    match path.suffix.lower():
        case ".npz":
            arrays = {f"region_{name}": rows for name, rows in rig.regions.items()}
            arrays |= {"neutral": rig.neutral, "faces": rig.faces, "names": np.array(rig.names)}
            arrays["deltas"] = rig.deltas.astype(np.float32)
            with written_whole(path) as temporary, open(temporary, "wb") as file:
                np.savez_compressed(file, **arrays)  # type: ignore[arg-type]
        case ".glb":
            write_morph_targets(path, rig)
        case "":
            _write_folder(path, rig)
        case _:
            raise OptionError(f"a rig is written as .npz, .glb or a folder, not {path}")


def _write_folder(folder: Path, rig: Rig) -> None:
    import trimesh  # slow to load, and few need it

    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        raise FileFormatError(f"cannot make the folder {folder}: {error.strerror}") from error
    for name, delta in (("neutral", np.zeros_like(rig.neutral)), *zip(rig.names, rig.deltas)):
        if Path(name).name != name:
            raise OptionError(f"the shape {name!r} cannot be the name of a file")
        shape = trimesh.Trimesh(rig.neutral + delta, rig.faces, process=False)
        with written_whole(folder / f"{name}.obj") as temporary:
            shape.export(temporary, digits=9, include_normals=False)
