"""Pickles of arrays, read without running what a pickle may name.

FLAME, VOCASET and many templates come as pickles, some written by Python 2, some of chumpy objects. The
reader here knows arrays of NumPy, sparse matrices of SciPy, tensors of PyTorch and the array that a chumpy
object holds; any other name in a pickle is refused and told.
"""

import io
import pickle
from collections import OrderedDict
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse as sp
import torch

from meshanim.errors import FileFormatError

__all__ = ["load_npy_objects", "load_pickle", "load_pickled_bytes"]

# What damaged or foreign bytes raise while they are unpickled.
DAMAGED = (
    pickle.UnpicklingError,
    EOFError,
    ValueError,
    TypeError,
    AttributeError,
    IndexError,
    KeyError,
    ImportError,
    MemoryError,
    RuntimeError,
    UnicodeError,
)
PYTHON_2_MODULES = {"__builtin__": "builtins", "copy_reg": "copyreg"}
SPARSE_CLASSES = {"csc": sp.csc_array, "csr": sp.csr_array}


class _Shell:
    """Stands for an object of a class that is not loaded; only its attributes are kept."""

    name = ""

    def __init__(self, *arguments):
        pass

    def __setstate__(self, state):
        # Objects with slots pickle a pair (dictionary, slots).
        for part in state if isinstance(state, tuple) else (state,):
            if part:
                self.__dict__.update(part)


def _encode(text: str, encoding: str = "latin1") -> bytes:
    if encoding != "latin1":
        raise pickle.UnpicklingError(f"it encodes text as {encoding}")
    return text.encode("latin1")


def _tensor_bytes(content: bytes) -> Any:
    return torch.load(io.BytesIO(content), map_location="cpu", weights_only=True)


def _reconstruct(cls: type, base: type, state: Any) -> Any:
    """copyreg._reconstructor for shells alone."""
    if not (isinstance(cls, type) and issubclass(cls, _Shell)) or base is not object:
        raise pickle.UnpicklingError(f"it rebuilds an object of {getattr(cls, '__name__', cls)}")
    return cls()


def _numpy_name(module: str, name: str) -> Any:
    """The functions that rebuild arrays, under the module names of NumPy 1 and 2."""
    if module == "numpy" and name in ("dtype", "ndarray"):
        return getattr(np, name)
    where = module.replace("numpy._core", "numpy.core")
    return NUMPY_FUNCTIONS.get((where, name))


def _from_buffer(
    buffer: bytes | bytearray, dtype: np.dtype, shape: tuple[int, ...], order: str
) -> np.ndarray:
    return np.frombuffer(buffer, dtype).reshape(shape, order="F" if order == "F" else "C")


NUMPY_FUNCTIONS = {
    ("numpy.core.multiarray", "_reconstruct"): np.empty(0).__reduce__()[0],
    ("numpy.core.multiarray", "scalar"): np.float64(0).__reduce__()[0],
    ("numpy.core.numeric", "_frombuffer"): _from_buffer,
}


class _ArrayUnpickler(pickle.Unpickler):
    plain = {  # noqa: RUF012
        ("collections", "OrderedDict"): OrderedDict,
        ("builtins", "object"): object,
        ("builtins", "set"): set,
        ("_codecs", "encode"): _encode,
        ("copyreg", "_reconstructor"): _reconstruct,
        ("torch.storage", "_load_from_bytes"): _tensor_bytes,
        ("torch._utils", "_rebuild_tensor_v2"): torch._utils._rebuild_tensor_v2,
    }

    def find_class(self, module: str, name: str) -> Any:
        module = PYTHON_2_MODULES.get(module, module)
        if (module, name) in self.plain:
            return self.plain[module, name]
        if (found := _numpy_name(module, name)) is not None:
            return found
        family = module.split(".")[0]
        is_sparse = module.startswith("scipy.sparse") and name[:3] in SPARSE_CLASSES
        if is_sparse or family == "chumpy":
            return type(name, (_Shell,), {"name": f"{module}.{name}"})
        raise pickle.UnpicklingError(f"it names {module}.{name}, which is no array")


def _plain(value: Any) -> Any:
    """Replace shells by the arrays in them; a chumpy expression without an array stays a shell."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return type(value)(_plain(item) for item in value)
    if isinstance(value, torch.Tensor):
        return value.detach().cpu().numpy()
    if not isinstance(value, _Shell):
        return value
    state = value.__dict__
    kind = type(value).__name__[:3]
    if kind in SPARSE_CLASSES and {"data", "indices", "indptr"} <= set(state):
        shape = state.get("_shape", state.get("shape"))
        matrix = SPARSE_CLASSES[kind]((state["data"], state["indices"], state["indptr"]), shape=shape)
        matrix.check_format(full_check=True)
        return matrix
    return np.asarray(state["x"]) if isinstance(state.get("x"), np.ndarray) else value


def _load(stream, where: str | Path) -> Any:
    try:
        return _plain(_ArrayUnpickler(stream, encoding="latin1").load())
    except DAMAGED as error:
        reason = str(error) or type(error).__name__
        raise FileFormatError(f"{where} is not a whole pickle of arrays: {reason}") from error


def load_pickle(path: str | Path) -> Any:
    """Read a pickle of dictionaries, lists, numbers, text and arrays, of Python 2 or 3.

    Chumpy objects become the NumPy array they hold, SciPy matrices `scipy.sparse` arrays, PyTorch tensors
    NumPy arrays.

    Raises
    ------
    FileFormatError
        If the file is missing, truncated, or names anything but arrays.
    """
    path = Path(path)
    if not path.is_file():
        raise FileFormatError(f"{path} does not exist")
    with path.open("rb") as stream:
        return _load(stream, path)


def load_pickled_bytes(content: bytes, where: str) -> Any:
    """Read a pickle that lies inside another file, by the same rules as `load_pickle`.

    Parameters
    ----------
    content : bytes
        The pickle.
    where : str
        File and place in it, for the error.

    Raises
    ------
    FileFormatError
        If it is truncated, or names anything but arrays.
    """
    return _load(io.BytesIO(content), where)


def load_npy_objects(path: str | Path) -> Any:
    """Read a .npy file of any kind, one that holds pickled objects by the same rules as `load_pickle`.

    A single object, as `numpy.save` writes a dictionary, comes back as itself.

    Raises
    ------
    FileFormatError
        As `load_pickle`.
    """
    path = Path(path)
    if not path.is_file():
        raise FileFormatError(f"{path} does not exist")
    with path.open("rb") as stream:
        try:
            version = np.lib.format.read_magic(stream)
            read = np.lib.format.read_array_header_1_0 if version == (1, 0) else None
            header = read(stream) if read else np.lib.format.read_array_header_2_0(stream)
        except ValueError as error:
            raise FileFormatError(f"{path} is no .npy file: {error}") from error
        if not header[2].hasobject:
            stream.seek(0)
            return np.load(stream, allow_pickle=False)
        content = _load(stream, path)
    return content.item() if isinstance(content, np.ndarray) and content.shape == () else content
