"""Parametric heads behind one interface."""

from meshanim.errors import OptionError
from meshanim.heads.default import DefaultHead, HeadPart, load_default_head
from meshanim.heads.head import JOINT_NAMES, JOINT_PARENTS, REGION_NAMES, Head, HeadParameters
from meshanim.heads.skinning import joint_transforms, linear_blend_skinning

__all__ = [
    "JOINT_NAMES",
    "JOINT_PARENTS",
    "REGION_NAMES",
    "DefaultHead",
    "Head",
    "HeadParameters",
    "HeadPart",
    "joint_transforms",
    "linear_blend_skinning",
    "load_head",
]


def load_head(name: str = "default") -> Head:
    """Load a head by name.

    Parameters
    ----------
    name : str
        "default", the head of the library.

    Raises
    ------
    OptionError
        If the name is of another form.
    """
    if name == "default":
        return load_default_head()
    raise OptionError(f"no head named {name}; there is default")
