"""Parametric heads behind one interface."""

from typing import Literal, overload

from meshanim.errors import OptionError
from meshanim.heads.default import DefaultHead, HeadPart, load_default_head
from meshanim.heads.flame import FlameHead, load_flame
from meshanim.heads.head import JOINT_NAMES, JOINT_PARENTS, REGION_NAMES, Head, HeadParameters
from meshanim.heads.rig import load_rig, read_rig, rig_head
from meshanim.heads.rig_data import Rig
from meshanim.heads.skinning import joint_transforms, linear_blend_skinning
from meshanim.heads.surface import HeadSurface, RigidPart

__all__ = [
    "JOINT_NAMES",
    "JOINT_PARENTS",
    "REGION_NAMES",
    "DefaultHead",
    "FlameHead",
    "Head",
    "HeadParameters",
    "HeadPart",
    "HeadSurface",
    "Rig",
    "RigidPart",
    "joint_transforms",
    "linear_blend_skinning",
    "load_flame",
    "load_head",
    "load_rig",
    "read_rig",
    "rig_head",
]


FLAME_KINDS = {"flame": "none", "flame+teeth": "plain", "flame+split_teeth": "split"}


@overload
def load_head(name: Literal["default"] = "default") -> DefaultHead: ...
@overload
def load_head(name: str) -> Head: ...
def load_head(name: str = "default") -> Head:
    """Load a head by name.

    Parameters
    ----------
    name : str
        "default", the head of the library; "flame:PATH", "flame+teeth:PATH" or "flame+split_teeth:PATH",
        FLAME from its own file (`load_flame`); "rig:PATH", blendshapes from a file or folder (`load_rig`).

    Raises
    ------
    OptionError
        If the name is of another form.
    FileFormatError
        If the file is missing, damaged or of another kind.
    """
    kind, _, path = name.partition(":")
    if name == "default":
        return load_default_head()
    if kind in FLAME_KINDS and path:
        return load_flame(path, FLAME_KINDS[kind])
    if kind == "rig" and path:
        return load_rig(path)
    raise OptionError(
        f"no head named {name}; there are default, rig:PATH, {':PATH, '.join(FLAME_KINDS)}:PATH"
    )
