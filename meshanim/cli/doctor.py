"""`meshanim doctor`: what is installed, which backends work, and how to get what is missing."""

import importlib.util
import os
import platform
import shutil
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from importlib.resources import files

__all__ = ["COMMANDS", "DoctorOptions", "doctor"]


@dataclass(frozen=True)
class DoctorOptions:
    """Say what is installed, which backends work, and how to get what is missing.

    Example: meshanim doctor
    """


# module, what it is for, how to get it
OPTIONAL = [
    ("pocketsphinx", "phoneme alignment and recognition", "pip install 'meshanim[speech]'"),
    ("espeakng_loader", "synthetic voices of espeak-ng", "pip install 'meshanim[speech]'"),
    ("py_nanotts", "synthetic voices of Pico", "pip install 'meshanim[speech]'"),
    ("transformers", "wav2vec 2.0 and HuBERT encoders", "pip install 'meshanim[encoders]'"),
    ("onnx", "export of Audio2Face's networks", "pip install 'meshanim[onnx]'"),
    ("triton", "mesh attention on CUDA", "comes with torch's CUDA builds"),
    ("gsplat", "Gaussian splatting on CUDA", "pip install 'meshanim[cuda]'"),
]
REQUIRED = [
    "torch",
    "igl",
    "trimesh",
    "pymeshlab",
    "scipy",
    "fast_simplification",
    "roma",
    "soundfile",
    "soxr",
    "av",
    "accelerate",
]
DISTRIBUTIONS = {"igl": "libigl", "fast_simplification": "fast-simplification"}


def doctor(options: DoctorOptions) -> int:
    """Print the report; 1 if something required is missing, else 0."""
    import torch

    print(f"meshanim {version('meshanim')}, Python {platform.python_version()}, {platform.platform()}")
    threads = torch.get_num_threads()
    print(f"processor       {_processor()}, {os.cpu_count()} cores, torch uses {threads} threads")
    missing = [name for name in REQUIRED if importlib.util.find_spec(name) is None]
    for name in REQUIRED:
        _line(name, name not in missing, _version(name), "pip install meshanim")
    print("backends")
    _line("reference", True, "torch, on any device", "")
    try:
        from meshanim import _native

        _line("native", True, f"compiled kernels on {_native.instruction_set()}", "")
    except ImportError as error:
        _line("native", False, "", f"reinstall with a C++17 compiler and MESHANIM_NATIVE not 0 ({error})")
    cuda = torch.cuda.is_available()
    card = torch.cuda.get_device_name() if cuda else ""
    _line("cuda", cuda, card, "needs an NVIDIA GPU and a CUDA build of torch")
    print("optional")
    for name, purpose, remedy in OPTIONAL:
        _line(
            name,
            importlib.util.find_spec(name) is not None,
            f"{_version(name)}  {purpose}",
            f"{purpose}: {remedy}",
        )
    _line("flite", shutil.which("flite") is not None, "voices of flite", "voices of flite: apt install flite")
    print("what ships in the package")
    for name, path in {
        "default head": "heads/default/head.npz",
        "viseme encoder": "audio/weights/visemes.safetensors",
        "GAVA": "models/weights/gava-default/model.safetensors",
    }.items():
        found = files("meshanim").joinpath(path).is_file()
        _line(name, found, path, f"{path} is missing from the installation")
    return 1 if missing else 0


def _line(name: str, works: bool, what: str, remedy: str) -> None:
    print(f"  {'yes' if works else 'no ':3s} {name:22s} {what if works else remedy}".rstrip())


def _version(name: str) -> str:
    try:
        return version(DISTRIBUTIONS.get(name, name))
    except PackageNotFoundError:
        return ""


def _processor() -> str:
    try:
        with open("/proc/cpuinfo") as file:
            return next(line.split(":", 1)[1].strip() for line in file if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


COMMANDS = doctor
