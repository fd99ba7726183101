"""Checkpoints in folders or on the Hugging Face hub: config.json, model.safetensors, what a network adds."""

import json
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, ClassVar

import torch
from huggingface_hub import PyTorchModelHubMixin, hf_hub_download
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from meshanim.errors import FileFormatError, MeshanimError
from meshanim.files import written_whole

__all__ = ["CONFIG", "Checkpoint"]

WEIGHTS, CONFIG = "model.safetensors", "config.json"


class Checkpoint(nn.Module, PyTorchModelHubMixin):
    """A network with a config, saved to and loaded from a folder or a repository of the hub.

    A subclass names what it is in `title`, annotates `config` in its `__init__` with a dataclass, and says
    how it is made again in `restored`.
    """

    title: ClassVar[str] = ""
    config: Any

    @property
    def device(self) -> torch.device:
        return next(self.parameters()).device

    def saved(self) -> dict[str, Tensor]:
        """What is written: all of the state unless a subclass leaves something out."""
        return self.state_dict()

    @classmethod
    def restored(cls, config: Any, state: Mapping[str, Tensor], file: Callable[[str], Path]) -> "Checkpoint":
        """The network of a config and its tensors; `file` gives the path of another file of the folder."""
        model = cls(config)
        model.load_state_dict(state)
        return model

    def _save_pretrained(self, save_directory: Path) -> None:
        state = {name: tensor.detach().cpu().contiguous() for name, tensor in self.saved().items()}
        with written_whole(save_directory / WEIGHTS) as temporary:
            save_file(state, temporary)
        with written_whole(save_directory / CONFIG) as temporary:
            temporary.write_text(json.dumps(asdict(self.config), indent=2) + "\n")

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

        try:
            model = cls.restored(config, load_file(file(WEIGHTS), device=map_location), file)
        except FileFormatError:
            raise
        except (OSError, SafetensorError, RuntimeError, MeshanimError) as error:
            raise FileFormatError(f"{file(WEIGHTS)} is no checkpoint of {cls.title}: {error}") from error
        return model.to(map_location).eval()
