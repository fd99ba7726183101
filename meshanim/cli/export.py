"""`meshanim export`: networks for other programs."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from meshanim.audio import load_encoder
from meshanim.errors import OptionError
from meshanim.files import check_writable
from meshanim.models.audio2face import Audio2FaceDiffusion, Audio2FaceRegression
from meshanim.models.loading import load_network

__all__ = ["COMMANDS", "OnnxOptions"]


@dataclass(frozen=True)
class OnnxOptions:
    """Write an Audio2Face network as ONNX, with the inputs and outputs of NVIDIA's (docs/audio2face.md).

    Example: meshanim export onnx runs/regression -o regression.onnx
    """

    model: Positional[str]
    """A folder that `meshanim train a2f-regression` or `a2f-diffusion` wrote, or a repository of the hub."""
    output: Annotated[Path, arg(aliases=["-o"])] = Path("network.onnx")
    """The file, .onnx."""
    steps: int | None = None
    """Denoising steps of a diffusion network; its own if not given."""


def _onnx(options: OnnxOptions) -> None:
    from meshanim.models.audio2face.onnx import export_onnx

    check_writable(options.output)
    network = load_network(options.model)
    if not isinstance(network, Audio2FaceRegression | Audio2FaceDiffusion):
        raise OptionError(
            f"{options.model} is a checkpoint of GAVA; Audio2Face's networks are written as ONNX"
        )
    names = export_onnx(network, load_encoder(network.config.encoder), options.output, options.steps)
    for title, shapes in (("inputs", names.inputs), ("outputs", names.outputs)):
        for name, shape in shapes.items():
            sizes = ", ".join("any" if size is None else str(size) for size in shape)
            print(f"{title:8s}{name} ({sizes})")
    print(f"wrote {options.output}: {options.output.stat().st_size / 1e6:.1f} MB")


COMMANDS = {"onnx": _onnx}
