"""README.md of a trained GAVA: its data, its errors on held-out sequences, and the command that made it."""

import shlex
from collections.abc import Sequence
from dataclasses import MISSING, Field, fields, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from meshanim import __version__
from meshanim.audio import SpeechEncoder
from meshanim.datasets.meshanim_format import MeshanimDataset
from meshanim.files import written_whole
from meshanim.heads import load_head
from meshanim.models.gava import Gava, model_card
from meshanim.training.gava_evaluation import speaker, topology_of
from meshanim.training.metrics import lip_vertex_error, mean_vertex_error

if TYPE_CHECKING:
    from meshanim.training.gava import TrainGavaOptions

__all__ = ["command_of", "write_card"]

MEASURED = 8
"""Most held-out sequences of a data set that the card's errors are means of."""


def write_card(folder: Path, options: "TrainGavaOptions", encoder: SpeechEncoder) -> None:
    """Write README.md into the folder of a finished model.

    Parameters
    ----------
    folder : Path
        Where `Gava.save_pretrained` wrote.
    options : TrainGavaOptions
        Of the run.
    encoder : SpeechEncoder
        The model's.
    """
    model = Gava.from_pretrained(folder)
    data, errors = [], []
    for directory in options.data:
        dataset = MeshanimDataset(directory)
        names = dataset.split("train")
        seconds = sum(dataset.info(name).frames for name in names) / dataset.fps
        data.append(
            f"- {dataset.name} (`{directory.resolve().name}`): {len(names)} training sequences, "
            f"{seconds / 60:.1f} min at {dataset.fps:g} frames a second"
        )
        errors += _errors(topology_of(model, dataset), dataset, encoder, directory.resolve().name)
    sections = {
        "Data": "\n".join(data),
        "Held-out errors": "\n".join(
            [
                "| data | split | sequences | metric | model | template held still |",
                "| --- | --- | --- | --- | --- | --- |",
                *errors,
            ]
        )
        if errors
        else "The data has no validation or test split.",
        "Training": f"    {command_of(options)}\n\nmeshanim {__version__}, torch {torch.__version__}.",
    }
    with written_whole(folder / "README.md") as temporary:
        temporary.write_text(model_card(model, sections), encoding="utf-8")


def _errors(model: Gava, dataset: MeshanimDataset, encoder: SpeechEncoder, label: str) -> list[str]:
    """Rows of the table: the first of the splits val and test, some sequences spread over it."""
    split = next((name for name in ("val", "test") if dataset.splits.get(name)), None)
    if split is None:
        return []
    names = dataset.split(split)
    names = names[:: max(1, -(-len(names) // MEASURED))]
    lips = torch.from_numpy(np.asarray(load_head(dataset.head).regions["lips"])) if dataset.head else None
    predict = speaker(model, encoder, dataset, None)
    found: dict[str, list[tuple[float, float]]] = {}
    for name in names:
        sequence = dataset[name]
        true = torch.from_numpy(np.array(sequence.vertices))
        template = torch.from_numpy(dataset.subjects[sequence.info.subject].template)
        moved, still = torch.from_numpy(predict(sequence).vertices), template.expand_as(true)
        pair = [float(mean_vertex_error(one, true)) * 1000 for one in (moved, still)]
        found.setdefault("mean vertex error, mm", []).append((pair[0], pair[1]))
        if lips is not None:
            pair = [float(lip_vertex_error(one, true, lips)) * 1000 for one in (moved, still)]
            found.setdefault(f"lip vertex error, mm, {len(lips)} vertices", []).append((pair[0], pair[1]))
    return [
        "| {} | {} | {} | {} | {:.3f} | {:.3f} |".format(
            label, split, len(values), metric, *np.mean(values, 0)
        )
        for metric, values in found.items()
    ]


def command_of(options: "TrainGavaOptions") -> str:
    """The command line that says what options say, without what is default."""
    return shlex.join(["meshanim", "train", "gava", *_words(options, "")])


def _words(options: Any, prefix: str) -> list[str]:
    words: list[str] = []
    for field in fields(options):
        value = getattr(options, field.name)
        name = field.name.replace("_", "-")
        if is_dataclass(value):
            words += _words(value, f"{prefix}{name}.")
        elif value != _default(field):
            if isinstance(value, bool):
                words.append(f"--{prefix}{name}" if value else f"--{prefix}no-{name}")
                continue
            for one in value if isinstance(value, Sequence) and not isinstance(value, str) else [value]:
                words += [f"--{prefix}{name}", str(one)]
    return words


def _default(field: Field) -> Any:
    return None if field.default is MISSING else field.default
