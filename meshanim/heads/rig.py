"""Any neutral mesh with named blendshapes as a head: glTF morph targets, a folder of OBJ files, or .npz."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from meshanim.errors import FileFormatError
from meshanim.geometry import TriangleMesh
from meshanim.heads.gltf_morphs import read_gltf_morphs
from meshanim.heads.head import REGION_NAMES, Head
from meshanim.heads.rig_data import Rig

__all__ = ["Rig", "load_rig", "read_rig", "rig_head", "rig_regions"]

# A vertex belongs to a region if one of these shapes moves it by more than this part of their largest move.
SUPPORT = {
    "lips": (
        "mouthClose mouthFunnel mouthPucker mouthRollLower mouthRollUpper mouthPressLeft mouthPressRight",
        0.35,
    ),
    "upper_face": (
        "browInnerUp browDownLeft browDownRight browOuterUpLeft browOuterUpRight eyeBlinkLeft eyeBlinkRight",
        0.05,
    ),
    "eyelids": ("eyeBlinkLeft eyeBlinkRight", 0.15),
    "jaw": ("jawOpen", 0.5),
    "nose": ("noseSneerLeft noseSneerRight", 0.3),
    "tongue": ("tongueOut", 0.3),
}


def read_rig(path: str | Path) -> Rig:
    """Read a neutral mesh and its blendshapes.

    Parameters
    ----------
    path : str or Path
        A .glb or .gltf with morph targets, a folder with neutral.obj and one OBJ file a shape, or an .npz
        with neutral (V, 3), faces (F, 3), names (E,) and deltas (E, V, 3), regions optional as
        "region_lips" and so on. Metres.

    Raises
    ------
    FileFormatError
        If the file is missing, damaged, or has no shapes.
    """
    path = Path(path)
    if path.is_dir():
        return _read_folder(path)
    if not path.is_file():
        raise FileFormatError(f"{path} does not exist")
    match path.suffix.lower():
        case ".glb" | ".gltf":
            return read_gltf_morphs(path)
        case ".npz":
            return _read_npz(path)
    raise FileFormatError(f"{path}: a rig is .glb, .gltf, .npz or a folder of OBJ files")


def load_rig(path: str | Path) -> Head:
    """The rig of a file as a head: `rig_head` of what `read_rig` reads.

    Raises
    ------
    FileFormatError
        As `read_rig`.
    """
    return rig_head(read_rig(path))


def rig_head(rig: Rig) -> Head:
    """A rig as a head: its blendshapes are the expressions, there is no identity, joints turn everything.

    Without skinning weights the whole mesh follows the neck joint, and the jaw and eye joints move nothing;
    the jaw is opened by its blendshape. Regions are the rig's own, or what the shapes with ARKit's names
    move.
    """
    weights = np.zeros((len(rig.neutral), 5))
    weights[:, 1] = 1
    joints = np.repeat(rig.neutral.mean(0)[None], 5, axis=0)
    # The neck joint: the middle of the lowest part, towards which a head narrows.
    low = rig.neutral[:, 1] <= np.quantile(rig.neutral[:, 1], 0.05)
    joints[:2] = rig.neutral[low].mean(0)
    return Head(
        TriangleMesh(rig.neutral, rig.faces, rig.uv, rig.uv_faces),
        np.zeros((len(rig.neutral), 3, 0)),
        np.moveaxis(rig.deltas, 0, -1),
        [],
        rig.names,
        joints,
        np.zeros((5, 3, 0)),
        weights,
        rig_regions(rig),
    )


def rig_regions(rig: Rig) -> dict[str, Int[np.ndarray, " _"]]:
    """Regions of the file where it names them, of the support of shapes with ARKit's names otherwise."""
    regions: dict[str, np.ndarray] = {name: np.zeros(0, np.int64) for name in REGION_NAMES}
    travel = dict(zip(rig.names, np.linalg.norm(rig.deltas, axis=2)))
    for region, (names, part) in SUPPORT.items():
        found = [travel[name] for name in names.split() if name in travel]
        if found:
            moved = np.max(found, axis=0)
            regions[region] = np.flatnonzero(moved > part * moved.max())
    if travel:
        moved = np.max(list(travel.values()), axis=0)
        regions["face"] = np.flatnonzero(moved > 1e-3 * moved.max())
    return {**regions, **rig.regions}


def _read_folder(folder: Path) -> Rig:
    files = {path.stem: path for path in sorted(folder.glob("*.obj"))}
    neutral_name = next((name for name in files if name.lower() == "neutral"), None)
    if neutral_name is None:
        raise FileFormatError(f"{folder} has no neutral.obj")
    neutral, faces = _read_obj(files.pop(neutral_name))
    if not files:
        raise FileFormatError(f"{folder} has no OBJ file beside the neutral one")
    deltas = []
    for path in files.values():
        vertices, shape_faces = _read_obj(path)
        if vertices.shape != neutral.shape or not np.array_equal(shape_faces, faces):
            raise FileFormatError(
                f"{path} has {len(vertices)} vertices and {len(shape_faces)} faces, the neutral "
                f"{len(neutral)} and {len(faces)}: shapes must share the neutral's topology"
            )
        deltas.append(vertices - neutral)
    return Rig(neutral, faces, tuple(files), np.stack(deltas))


def _read_obj(path: Path) -> tuple[Float[np.ndarray, "vertices 3"], Int[np.ndarray, "faces 3"]]:
    import trimesh  # slow to load, and few need it

    try:
        loaded = trimesh.load(path, process=False, maintain_order=True, force="mesh", skip_materials=True)
    except (ValueError, IndexError, KeyError, AttributeError, TypeError) as error:
        raise FileFormatError(f"{path} is no OBJ mesh: {error}") from error
    if not isinstance(loaded, trimesh.Trimesh) or len(loaded.faces) == 0:
        raise FileFormatError(f"{path} holds no triangles")
    return np.asarray(loaded.vertices, np.float64), np.asarray(loaded.faces, np.int64)


def _read_npz(path: Path) -> Rig:
    try:
        with np.load(path, allow_pickle=False) as archive:
            content: Mapping[str, np.ndarray] = {name: archive[name] for name in archive.files}
    except (ValueError, OSError, EOFError, KeyError) as error:
        raise FileFormatError(f"{path} is no .npz of plain arrays: {error}") from error
    missing = {"neutral", "faces", "names", "deltas"} - set(content)
    if missing:
        raise FileFormatError(f"{path} lacks {', '.join(sorted(missing))}")
    prefix = "region_"
    regions = {
        name.removeprefix(prefix): value.astype(np.int64)
        for name, value in content.items()
        if name.startswith(prefix)
    }
    return Rig(
        content["neutral"].astype(np.float64),
        content["faces"].astype(np.int64),
        tuple(str(name) for name in content["names"]),
        content["deltas"].astype(np.float64),
        regions=regions,
    )
