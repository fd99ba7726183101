"""Folders of Audio2Face checkpoints: those of any network, and actors.safetensors."""

from collections.abc import Callable, Mapping
from dataclasses import asdict
from functools import cached_property
from pathlib import Path
from typing import Any

from huggingface_hub import ModelCard
from torch import Tensor

from meshanim.errors import OptionError
from meshanim.geometry import TriangleMesh
from meshanim.models.checkpoint import Checkpoint
from meshanim.motion.animation_state import Actors, read_actors, write_actors

__all__ = ["ActorCheckpoint"]

ACTORS = "actors.safetensors"


class ActorCheckpoint(Checkpoint):
    """A network of actors, made by `cls(config, actors)`."""

    actors: Actors

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
        write_actors(save_directory / ACTORS, self.actors)
        super()._save_pretrained(save_directory)

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
    def restored(
        cls, config: Any, state: Mapping[str, Tensor], file: Callable[[str], Path]
    ) -> "ActorCheckpoint":
        model = cls(config, read_actors(file(ACTORS)))
        model.load_state_dict(state)
        return model
