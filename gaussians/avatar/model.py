"""`Avatar`: 3D Gaussians on the triangles of a parametric head, posed by the head's parameters."""

import json
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from importlib.resources import files
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float, Int
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from meshanim.errors import FileFormatError, OptionError, ShapeError
from meshanim.files import read_json
from meshanim.gaussians.avatar.colors import ExpressionColors
from meshanim.gaussians.binding import Binding, bind
from meshanim.gaussians.cameras import Cameras
from meshanim.gaussians.gaussians import Gaussians
from meshanim.gaussians.splat import Rendering, rasterize
from meshanim.geometry import TriangleMesh
from meshanim.heads import Head, HeadParameters, HeadSurface, load_head

__all__ = ["GAUSSIAN_FIELDS", "Avatar", "AvatarConfig"]

GAUSSIAN_FIELDS = ("means", "scales", "rotations", "opacities", "sh0", "sh_rest", "latents")
"""Parameters with a row a Gaussian: means in units of the triangle, logarithms of scales, quaternions, logits
of opacities, harmonics, what the colour network reads."""
INPUTS = ("expression", "jaw", "eyes")
WIDTHS = {"jaw": 3, "eyes": 6}
FORMAT = "meshanim avatar 1"
PACKAGED = {"default": "weights/default"}


@dataclass(frozen=True)
class AvatarConfig:
    """What an avatar is, besides its numbers.

    Parameters
    ----------
    head : str
        What `load_head` understands.
    name : str
        Of the person.
    sh_degree : int
        0 to 3.
    latent, hidden : int
        Of the colour network; latent 0 for none.
    background : (3,) float
        What it was fitted in front of, sRGB in [0, 1].
    rest : mapping of str to float
        Weights of the head's expressions with which the face rests, where zero is not its rest.
    """

    head: str = "default"
    name: str = ""
    sh_degree: int = 1
    latent: int = 8
    hidden: int = 32
    background: tuple[float, float, float] = (1.0, 1.0, 1.0)
    rest: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self):
        if self.sh_degree not in range(4) or self.latent < 0 or self.hidden < 1:
            raise OptionError(f"an avatar cannot have {self}")


class Avatar(nn.Module):
    """Gaussians bound to a head's triangles, with colours by direction and expression.

    Parameters
    ----------
    config : AvatarConfig
        What it is.
    head : Head
        The head that `config.head` names.
    surface : HeadSurface, optional
        The triangles that carry Gaussians; the head's own if not given.
    shape : (1, S), optional
        The person's identity coefficients.
    static_offset : (V, 3), optional
        Of the person, metres, added to the head's template.
    face : (N,) int64, optional
        Triangle of each Gaussian; one each if not given.
    scale, opacity
        Of the Gaussians at the start (`Binding.initial_gaussians`).
    """

    def __init__(
        self,
        config: AvatarConfig,
        head: Head,
        surface: HeadSurface | None = None,
        shape: Float[Tensor, "1 shape"] | None = None,
        static_offset: Float[Tensor, "vertices 3"] | None = None,
        face: Int[Tensor, " n"] | None = None,
        scale: tuple[float, float, float] = (0.5, 0.12, 0.5),
        opacity: float = 0.62,
    ):
        super().__init__()
        self.config = config
        self.head = head if static_offset is None else head.with_offset(static_offset)
        self.surface = HeadSurface.of_mesh(head.mesh) if surface is None else surface
        self.shape: Tensor
        self.face: Tensor
        self.static_offset: Tensor | None
        self.register_buffer("shape", torch.zeros(1, 0) if shape is None else shape.detach().clone())
        self.register_buffer("static_offset", static_offset)
        with torch.no_grad():
            rest = self.surface(self.head(HeadParameters(shape=self.shape)))[0].double().cpu().numpy()
        self.mesh = TriangleMesh(rest, self.surface.faces)
        binding = bind(self.mesh) if face is None else Binding(self.mesh, face)
        self.register_buffer("face", binding.face)
        self._binding = binding
        self.sh_degree = config.sh_degree
        """Harmonics of a higher degree are left out; a fit raises it."""
        start = binding.initial_gaussians(scale, opacity, sh_degree=config.sh_degree)
        assert start.sh is not None
        self.means = nn.Parameter(start.means)
        self.scales = nn.Parameter(start.scales.log())
        self.rotations = nn.Parameter(start.quaternions)
        self.opacities = nn.Parameter(torch.logit(start.opacities))
        self.sh0 = nn.Parameter(start.sh[:, :1].clone())
        self.sh_rest = nn.Parameter(start.sh[:, 1:].clone())
        self.latents = nn.Parameter(0.1 * torch.randn(len(binding), config.latent))
        width = len(head.expression_names) + sum(WIDTHS.values())
        self.colors = ExpressionColors(config.latent, width, config.hidden) if config.latent else None

    def __len__(self) -> int:
        """How many Gaussians there are."""
        return len(self.face)

    @property
    def binding(self) -> Binding:
        """Which triangle carries each Gaussian."""
        if self._binding.face is not self.face:
            self._binding = Binding(self.mesh, self.face)
        return self._binding

    def forward(
        self,
        posed: HeadParameters | Float[Tensor, "*batch vertices 3"],
        cameras: Cameras,
        background: Sequence[float] | Float[Tensor, "*#batch channels"] | None = None,
        parameters: HeadParameters | None = None,
        **how: Any,
    ) -> Rendering:
        """Pictures of the posed head.

        Parameters
        ----------
        posed : HeadParameters or (B, V, 3) or (V, 3)
            The head's parameters, whose `shape` is the avatar's own where it is None; or posed vertices of
            the head or of `surface`, metres.
        cameras : Cameras
            Who looks.
        background : optional
            As in `rasterize`; the one it was fitted in front of if not given.
        parameters : HeadParameters, optional
            With vertices, the expression that colours follow; neutral if not given.
        how
            Options of `rasterize`.
        """
        return self.draw(self.gaussians(posed, parameters), cameras, background, **how)

    def draw(
        self,
        gaussians: Gaussians,
        cameras: Cameras,
        background: Sequence[float] | Float[Tensor, "*#batch channels"] | None = None,
        **how: Any,
    ) -> Rendering:
        """Pictures of Gaussians that are in the world already."""
        return rasterize(
            gaussians, cameras, self.config.background if background is None else background, **how
        )

    def gaussians(
        self,
        posed: HeadParameters | Float[Tensor, "*batch vertices 3"],
        parameters: HeadParameters | None = None,
    ) -> Gaussians:
        """The Gaussians in the world, a batch of them for a batch of poses."""
        if isinstance(posed, HeadParameters):
            parameters, vertices = posed, self.vertices(posed)
        else:
            vertices = self._on_surface(posed)
        sh = None
        if self.colors is not None:
            drive = self.drive(HeadParameters() if parameters is None else parameters)
            sh = self.colors.harmonics(self.latents, drive, self.sh0, self._sh_rest)
            sh = sh[0] if vertices.ndim == 2 else sh
        return self.binding.to_world(self.local(sh), vertices)

    def local(self, sh: Float[Tensor, "*batch n coefficients 3"] | None = None) -> Gaussians:
        """The activated Gaussians in the frames of their triangles.

        Parameters
        ----------
        sh : (..., N, K, 3), optional
            Harmonics; without what expression adds if not given.
        """
        sh = torch.cat([self.sh0, self._sh_rest], 1) if sh is None else sh
        return Gaussians(self.means, self.rotations, self.scales.exp(), torch.sigmoid(self.opacities), sh=sh)

    @property
    def _sh_rest(self) -> Tensor:
        return self.sh_rest[:, : (self.sh_degree + 1) ** 2 - 1]

    def vertices(self, parameters: HeadParameters) -> Float[Tensor, "batch vertices 3"]:
        """The surface posed by parameters; the avatar's own identity where they have none."""
        if parameters.shape is None:
            given = {part.name: getattr(parameters, part.name) for part in fields(parameters)}
            parameters = HeadParameters(**(given | {"shape": self.shape}))
        return self.surface(self.head(parameters))

    def drive(self, parameters: HeadParameters) -> Float[Tensor, "batch drive"]:
        """What colours follow: expression, jaw and eyes side by side; zeros where there are none."""
        widths = {"expression": len(self.head.expression_names)} | WIDTHS
        columns = []
        for name in INPUTS:
            value = getattr(parameters, name)
            value = self.means.new_zeros(1, 0) if value is None else value.to(self.means)
            if value.shape[1] > widths[name]:
                raise ShapeError(f"{name} has {value.shape[1]} columns, the head has {widths[name]}")
            value = torch.nn.functional.pad(value, (0, widths[name] - value.shape[1]))
            columns.append(value.expand(parameters.batch, -1))
        return torch.cat(columns, 1)

    def _on_surface(self, vertices: Tensor) -> Tensor:
        count = vertices.shape[-2]
        if count == self.surface.n_vertices:
            return vertices
        if count != self.head.n_vertices:
            raise ShapeError(
                f"vertices must be {self.surface.n_vertices} of the surface or {self.head.n_vertices} of the "
                f"head, not {count}"
            )
        posed = self.surface(vertices.reshape(-1, count, 3))
        return posed.reshape(*vertices.shape[:-2], -1, 3)

    def replace(self, face: Int[Tensor, " n"], rows: Mapping[str, Tensor]) -> None:
        """Put other Gaussians in the place of all, as new `nn.Parameter`s without gradients."""
        self.face = face
        for name in GAUSSIAN_FIELDS:
            setattr(self, name, nn.Parameter(rows[name].detach().to(getattr(self, name)).contiguous()))

    def _load_from_state_dict(self, state_dict, prefix, *more):
        # Any number of Gaussians fits; the parameters stay the same objects, which an optimiser may hold.
        names = ("face", *GAUSSIAN_FIELDS)
        if all(prefix + name in state_dict for name in names):
            self.face = state_dict[prefix + "face"].to(self.face.device, copy=True)
            for name in GAUSSIAN_FIELDS:
                parameter, value = getattr(self, name), state_dict[prefix + name]
                parameter.data = value.detach().to(parameter, copy=True)
        super()._load_from_state_dict(state_dict, prefix, *more)

    # -- files --------------------------------------------------------------------------------------------

    def save_pretrained(self, directory: str | Path, half: bool = False) -> None:
        """Write config.json, avatar.safetensors and surface.npz into a folder.

        Parameters
        ----------
        directory : path
            Made if it does not exist; a folder of that name is replaced as a whole.
        half : bool
            Floats of 16 bits, of 8 for what colours change by direction, most of the numbers: a third of the
            size. Pictures of the packaged avatar differ by 0.04 of 255 in the mean, 4 at most.
        """
        final = Path(directory)
        temporary = final.with_name(f".{final.name}")
        shutil.rmtree(temporary, ignore_errors=True)
        temporary.mkdir(parents=True)
        self.write(temporary, half)
        shutil.rmtree(final, ignore_errors=True)
        temporary.rename(final)

    def write(self, directory: Path, half: bool = False) -> None:
        """The files of `save_pretrained`, into a folder that exists."""
        described = {part.name: getattr(self.config, part.name) for part in fields(self.config)}
        described = {"format": FORMAT, **described, "gaussians": len(self), "inputs": INPUTS}
        (directory / "config.json").write_text(json.dumps(described, indent=1) + "\n", encoding="utf-8")
        tensors = {name: value.detach().cpu() for name, value in self.state_dict().items()}
        tensors["face"] = tensors["face"].int()
        if half:
            reduced = {
                name: value.to(torch.float8_e4m3fn if name == "sh_rest" else torch.float16)
                for name, value in tensors.items()
                if value.is_floating_point() and name != "shape"
            }
            tensors |= reduced
        save_file(
            {name: value.contiguous() for name, value in tensors.items()}, directory / "avatar.safetensors"
        )
        self.surface.save(directory / "surface.npz")

    @classmethod
    def from_pretrained(cls, source: str | Path, head: str = "") -> "Avatar":
        """Read an avatar's folder, or one that ships with the package by name.

        Parameters
        ----------
        source : str or path
            "default", or a folder.
        head : str
            Where the head's file is, if it is not where the avatar was made.

        Raises
        ------
        FileFormatError
            If the folder is missing, damaged or holds something else.
        """
        directory = Path(source)
        if not directory.is_dir() and str(source) in PACKAGED:
            directory = Path(str(files("meshanim.gaussians.avatar") / PACKAGED[str(source)]))
        described = read_json(directory / "config.json")
        if not isinstance(described, dict) or described.get("format") != FORMAT:
            raise FileFormatError(f"{directory / 'config.json'} describes no avatar of meshanim")
        try:
            described.setdefault("rest", {})  # younger than the format
            known = {part.name: described[part.name] for part in fields(AvatarConfig)}
            tensors = load_file(directory / "avatar.safetensors")
            config = AvatarConfig(
                **(known | {"background": tuple(known["background"]), "head": head or known["head"]})
            )
            surface = HeadSurface.load(directory / "surface.npz")
            tensors = {name: t.float() if t.is_floating_point() else t.long() for name, t in tensors.items()}
            avatar = cls(
                config,
                load_head(config.head),
                surface,
                tensors["shape"],
                tensors.get("static_offset"),
                tensors["face"],
            )
            avatar.load_state_dict(tensors)
        except (OSError, SafetensorError, KeyError, RuntimeError, TypeError) as error:
            raise FileFormatError(f"{directory} holds no whole avatar: {error}") from error
        return avatar.eval()
