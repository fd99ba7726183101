"""meshanim: mesh-centric geometric learning for talking heads."""

from importlib.metadata import version as _version
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from meshanim.animator import Animator

__version__ = _version("meshanim")
__all__ = ["Animator", "__version__"]


def __getattr__(name: str):
    # Loading the animator loads torch and the models; `import meshanim.geometry` alone should not.
    if name == "Animator":
        from meshanim.animator import Animator

        return Animator
    raise AttributeError(f"module 'meshanim' has no attribute {name!r}")
