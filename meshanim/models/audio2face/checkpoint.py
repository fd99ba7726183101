"""Folders of Audio2Face checkpoints: config.json, model.safetensors, actors.safetensors."""

import json
from dataclasses import asdict
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import torch
from huggingface_hub import ModelCard, PyTorchModelHubMixin, hf_hub_download
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from meshanim.errors import FileFormatError, MeshanimError, OptionError
from meshanim.files import written_whole
from meshanim.geometry import TriangleMesh
from meshanim.motion.animation_state import Actors, read_actors, write_actors

__all__ = ["Checkpoint"]

WEIGHTS, CONFIG, ACTORS = "model.safetensors", "config.json", "actors.safetensors"


class Checkpoint(nn.Module, PyTorchModelHubMixin):
    """A network with a config and actors, saved to and loaded from a folder or the Hugging Face hub.

    A subclass is made by `cls(config, actors)` and names what it is in `title`.
    """

    title: ClassVar[str] = ""
    config: Any
    actors: Actors

    def saved(self) -> dict[str, Tensor]:
        """What is written: all of the state unless a subclass leaves something out."""
        return self.state_dict()

    @property
    def device(self) -> torch.device:
        return next(self.parameters()).device

    @property
    def n_vertices(self) -> int:
        return len(next(iter(self.actors.templates.values())))

    @cached_property
    def mesh(self) -> TriangleMesh:
        """The first actor's neutral face.

        Raises
        ------
        OptionError
            If no faces are known.
        """
        if not len(self.actors.faces):
            raise OptionError(
                "this network knows vertices but no faces: prepare its data with --faces, or animate a head "
                "with as many vertices"
            )
        return TriangleMesh(next(iter(self.actors.templates.values())).numpy(), self.actors.faces)

    def _save_pretrained(self, save_directory: Path) -> None:
        state = {name: tensor.detach().cpu().contiguous() for name, tensor in self.saved().items()}
        with written_whole(save_directory / WEIGHTS) as temporary:
            save_file(state, temporary)
        write_actors(save_directory / ACTORS, self.actors)
        with written_whole(save_directory / CONFIG) as temporary:
            temporary.write_text(json.dumps(asdict(self.config), indent=2) + "\n")

    def generate_model_card(self, *args, **kwargs) -> ModelCard:
        """README.md of a saved folder."""
        facts = "\n".join(
            f"- {name}: {value}" for name, value in asdict(self.config).items() if name != "clips"
        )
        return ModelCard(
            "---\nlibrary_name: meshanim\ntags: [talking-head, speech-driven-animation]\n---\n\n"
            f"# {self.title}\n\n{facts}\n"
        )

    @classmethod
    def _from_pretrained(  # type: ignore[override]
        cls,
        *,
        model_id: str,
        revision: str | None,
        cache_dir: str | Path | None,
        force_download: bool,
        local_files_only: bool,
        token: str | bool | None,
        config: Any = None,
        map_location: str = "cpu",
    ) -> "Checkpoint":
        if config is None:
            raise FileFormatError(f"{model_id} has no {CONFIG}; expected a folder that save_pretrained wrote")

        def file(name: str) -> Path:
            if Path(model_id).is_dir():
                return Path(model_id) / name
            return Path(
                hf_hub_download(
                    repo_id=model_id,
                    filename=name,
                    revision=revision,
                    cache_dir=cache_dir,
                    force_download=force_download,
                    token=token,
                    local_files_only=local_files_only,
                )
            )

        actors = read_actors(file(ACTORS))
        try:
            state = load_file(file(WEIGHTS), device=map_location)
            model = cls(config, actors)
            model.load_state_dict(state)
        except (OSError, SafetensorError, RuntimeError, MeshanimError) as error:
            raise FileFormatError(f"{file(WEIGHTS)} is no checkpoint of {cls.title}: {error}") from error
        return model.to(map_location).eval()
