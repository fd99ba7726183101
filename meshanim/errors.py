"""What goes wrong by name: each error says what was given, what was expected and what to do."""

__all__ = [
    "BackendError",
    "DependencyError",
    "FileFormatError",
    "JobError",
    "MeshError",
    "MeshanimError",
    "OptionError",
    "ShapeError",
]


class MeshanimError(Exception):
    """Base of all errors a user can cause; the command line prints its one line and exits 2."""


class FileFormatError(MeshanimError):
    """A file is missing, unreadable, truncated or of another format than expected."""


class ShapeError(MeshanimError):
    """An array has another shape, unit, rate or value range than expected (NaN included)."""


class MeshError(MeshanimError):
    """A mesh breaks what an operator needs: open, non-manifold, degenerate or disconnected."""


class OptionError(MeshanimError):
    """An option or name is not one of those that exist."""


class BackendError(MeshanimError):
    """A backend was asked for that is not built or not on this machine."""


class JobError(MeshanimError):
    """Worker processes or machines were lost, and what they worked on could not be finished elsewhere."""


class DependencyError(MeshanimError):
    """A package of an extra is missing.

    Parameters
    ----------
    package : str
        What could not be imported.
    extra : str
        The extra of meshanim that brings it.
    """

    def __init__(self, package: str, extra: str):
        super().__init__(f"{package} is not installed: pip install 'meshanim[{extra}]'")
        self.package, self.extra = package, extra

    def __reduce__(self) -> tuple:
        return DependencyError, (self.package, self.extra)  # crosses from a worker process to its parent
