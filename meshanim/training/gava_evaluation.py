"""What `meshanim evaluate gava` measures: held-out motion, baselines, and speech of real people."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float32, Int64
from tqdm import tqdm

from meshanim.audio import SpeechEncoder, Waveform, load_encoder, log_mel
from meshanim.audio.features import frame_count
from meshanim.audio.viseme_evaluation import load_clips
from meshanim.datasets.meshanim_format import MeshanimDataset, MotionSequence
from meshanim.errors import OptionError
from meshanim.heads import load_head
from meshanim.models.gava import Gava
from meshanim.models.gava_stream import GavaStream, PoseSmoothing, animate
from meshanim.motion.lip_seal import LipSeal, head_lip_seal
from meshanim.results import MetricValue, Results
from meshanim.training.metrics import aperture_extremes
from meshanim.training.motion_evaluation import JITTER_ABOVE, MotionEvaluation, masks_of_head

__all__ = ["EvaluateGavaOptions", "evaluate_gava"]

BILABIALS = ("P", "B", "M")
OPEN_VOWELS = ("AA", "AE", "AY", "AW", "AO")
CLOSED_BELOW, OPEN_ABOVE = 1e-3, 4e-3
"""Metres of lip aperture that count as closed lips and as an open mouth where there is no truth."""


class Predicted(NamedTuple):
    """What a method says of a sequence.

    Parameters
    ----------
    vertices : (T, V, 3) float32
        Zero pose.
    pose : (T, 3) float32, optional
        Head rotation, axis-angle, radians; None from a network without a pose token.
    """

    vertices: Float32[np.ndarray, "frames vertices 3"]
    pose: Float32[np.ndarray, "frames 3"] | None


Method = Callable[[MotionSequence], Predicted]


@dataclass(frozen=True)
class EvaluateGavaOptions:
    """Measure a GAVA checkpoint on held-out sequences, beside baselines.

    Example: meshanim evaluate gava --data corpus --json results.json
    """

    data: Path
    """Folder of a data set in the project's format."""
    model: str = "default"
    """default, or a folder that meshanim train gava wrote."""
    compare: tuple[Path, ...] = ()
    """Folders of other checkpoints for the same table, such as one with --decoder mlp --features G."""
    splits: tuple[str, ...] = ("test", "test_unseen")
    """Splits of the data set."""
    human: Path | None = None
    """Folder of recorded speech, each file with NAME.txt that says what is spoken."""
    jitter_above: float = JITTER_ABOVE
    """Hz above which the power of the lips' acceleration counts as jitter."""
    json: Path | None = None
    """Where to write the rows, each sequence's numbers included, for meshanim evaluate compare."""


def evaluate_gava(options: EvaluateGavaOptions, progress: bool = True) -> Results:
    """Fill the table: every metric of docs/metrics.md that the head's regions allow, models before baselines.

    Raises
    ------
    FileFormatError, OptionError
        If the data set or a checkpoint cannot be read, or they do not fit together.
    """
    dataset = MeshanimDataset(options.data)
    if not any(dataset.split(split) for split in options.splits):
        raise OptionError(f"{options.data} has no sequences in {', '.join(options.splits)}")
    models = {}
    for name in (options.model, *map(str, options.compare)):
        model = topology_of(load_gava(name), dataset)
        models[describe(name, model)] = model
    head = load_head(dataset.head) if dataset.head else None
    masks = masks_of_head(head)
    methods: dict[str, Method] = {}
    for name, model in models.items():
        encoder = load_encoder(model.config.encoder)
        methods[name] = speaker(model, encoder, dataset, None)
        seal = head_lip_seal(head)
        if seal is not None and getattr(encoder, "bilabial", None) is not None:
            methods[f"{name} + lip seal"] = speaker(model, encoder, dataset, seal)
    methods |= held_still(dataset)
    results = Results("evaluate gava")
    for split in options.splits:
        for name, predict in methods.items():
            evaluation = MotionEvaluation(masks, dataset.fps, dataset.unit, options.jitter_above)
            names = dataset.split(split)
            for value in measure(dataset, names, predict, evaluation, f"{split}: {name}", progress):
                results.add_measured(split, name, value)
    if masks.lip_pairs is not None:
        rows = articulation(
            (
                (s.vertices, s.phonemes, s.info.fps)
                for s in map(dataset.__getitem__, dataset.split(options.splits[0]))
            ),
            masks.lip_pairs,
        )
        for metric, share in rows.items():
            results.add(options.splits[0], "truth", metric, share, "share")
        if options.human is not None:
            clips = load_clips(options.human)
            for name, model in models.items():
                encoder = load_encoder(model.config.encoder)
                for label, seal in ((name, None), (f"{name} + lip seal", head_lip_seal(head))):
                    moved = (
                        (
                            spoken(model, encoder, clip.waveform, seal=seal).vertices,
                            clip.phonemes,
                            model.config.fps,
                        )
                        for clip in clips
                    )
                    for metric, share in articulation(moved, masks.lip_pairs).items():
                        results.add("human clips", label, metric, share, "share")
    if options.json is not None:
        results.save(options.json)
    return results


def load_gava(name: str) -> Gava:
    """A checkpoint by name or folder.

    Raises
    ------
    OptionError
        If it is of another network.
    """
    from meshanim.animator import Animator

    network = Animator.from_pretrained(name).network
    if not isinstance(network, Gava):
        raise OptionError(f"{name} is a checkpoint of {network.title}, not of GAVA")
    return network


def topology_of(model: Gava, dataset: MeshanimDataset) -> Gava:
    """The network on its first topology with as many vertices as a data set.

    Raises
    ------
    OptionError
        If it has none.
    """
    views = [model.on(k) for k in range(model.n_topologies)]
    for view in views:
        if view.n_vertices == dataset.surface.n_vertices:
            return view
    counts = " or ".join(str(view.n_vertices) for view in views)
    raise OptionError(
        f"the checkpoint animates {counts} vertices, {dataset.directory} has {dataset.surface.n_vertices}"
    )


def describe(name: str, model: Gava) -> str:
    """Short name for tables: the ablation's, with the checkpoint's name where it is not the default."""
    kind = f"{model.config.features}+{model.config.decoder.upper()}"
    return kind if name == "default" else f"{kind} ({Path(name).parent.name or name})"


def mean_displacement(dataset: MeshanimDataset) -> Float32[np.ndarray, "vertices 3"]:
    """Mean displacement from the template over all training frames."""
    total, frames = np.zeros((dataset.surface.n_vertices, 3)), 0
    for name in dataset.split("train"):
        sequence = dataset[name]
        moved = np.asarray(sequence.vertices) - dataset.subjects[sequence.info.subject].template
        total += moved.sum(0, dtype=np.float64)
        frames += len(sequence)
    return (total / max(frames, 1)).astype(np.float32)


def held_still(dataset: MeshanimDataset) -> dict[str, Method]:
    """Baselines that do not move: the training frames' mean displacement, and none."""
    mean = mean_displacement(dataset)

    def resting(moved: Float32[np.ndarray, "vertices 3"]) -> Method:
        def predict(sequence: MotionSequence) -> Predicted:
            frame = dataset.subjects[sequence.info.subject].template + moved
            still = np.zeros((len(sequence), 3), np.float32)
            return Predicted(np.repeat(frame[None], len(sequence), 0), still)

        return predict

    return {"mean of training": resting(mean), "template held still": resting(np.zeros_like(mean))}


def spoken(
    model: Gava,
    encoder: SpeechEncoder,
    audio: Waveform,
    template: Float32[np.ndarray, "vertices 3"] | None = None,
    style: torch.Tensor | None = None,
    frames: int | None = None,
    fps: float | None = None,
    seal: LipSeal | None = None,
) -> Predicted:
    """Vertices and head pose of a whole speech, as the animator gives them without idle motion."""
    fps = model.config.fps if fps is None else fps
    stream = GavaStream(
        model,
        None if template is None else torch.from_numpy(template),
        style,
        fps,
        PoseSmoothing(),
        seal,
        None if seal is None else getattr(encoder, "bilabial", None),
    )
    mel = log_mel(audio) if model.config.pose else None
    count = frame_count(audio, fps) if frames is None else frames
    parts = list(animate(stream, encoder(audio).float(), mel, count))
    pose = torch.cat([part.pose for part in parts]).numpy() if model.config.pose else None
    return Predicted(torch.cat([part.vertices for part in parts]).numpy(), pose)


def speaker(model: Gava, encoder: SpeechEncoder, dataset: MeshanimDataset, seal: LipSeal | None) -> Method:
    """A function that speaks a sequence with its subject's template, style and emotion."""
    known = model.config

    def predict(sequence: MotionSequence) -> Predicted:
        info = sequence.info
        subject = info.subject if info.subject in known.subjects else None
        emotion = info.emotion if info.emotion in known.emotions else "neutral"
        with torch.no_grad():
            style = model.style_of(subject, emotion, float(info.intensity))
        template = dataset.subjects[info.subject].template
        return spoken(model, encoder, sequence.audio, template, style, info.frames, info.fps, seal)

    return predict


def measure(
    dataset: MeshanimDataset,
    names: Sequence[str],
    predict: Method,
    evaluation: MotionEvaluation,
    label: str,
    progress: bool,
) -> list[MetricValue]:
    """Score sequences one after the other; the pose where heads turn in the data set.

    Parameters
    ----------
    dataset : MeshanimDataset
        The truth.
    names : sequence of str
        Of the sequences, such as a split's.
    predict : function
        A sequence to its vertices and pose, as `speaker` gives it.
    evaluation : MotionEvaluation
        Fresh.
    label : str
        Of the progress bar.
    progress : bool
        Whether to show it.
    """
    for name in tqdm(names, desc=label, unit="clip", disable=not progress):
        sequence = dataset[name]
        vertices, pose = predict(sequence)
        evaluation.add(
            name,
            torch.from_numpy(vertices)[None],
            torch.from_numpy(np.array(sequence.vertices)),
            torch.from_numpy(dataset.subjects[sequence.info.subject].template),
            [(p.start, p.end) for p in sequence.phonemes if p.symbol in BILABIALS],
            torch.from_numpy(pose) if pose is not None and sequence.pose.any() else None,
            torch.from_numpy(np.array(sequence.pose)),
        )
    return evaluation.values()


def articulation(spoken_clips, pairs: Int64[torch.Tensor, "pairs 2"]) -> dict[str, float]:
    """Share of bilabials with closed lips and of open vowels with an open mouth, by aperture alone.

    Parameters
    ----------
    spoken_clips : iterable of (vertices, phonemes, fps)
        Zero pose.
    pairs : (P, 2) int
        Lip pairs.
    """
    closed: list[bool] = []
    opened: list[bool] = []
    for vertices, phonemes, fps in spoken_clips:
        moved = torch.from_numpy(np.array(vertices))

        def extremes(symbols: Sequence[str], moved=moved, phonemes=phonemes, fps=fps):
            spans = [(p.start, p.end) for p in phonemes if p.symbol in symbols]
            return aperture_extremes(moved, pairs, spans, fps)

        closed += (extremes(BILABIALS)[0] < CLOSED_BELOW).tolist()
        opened += (extremes(OPEN_VOWELS)[1] > OPEN_ABOVE).tolist()
    shares = {"bilabials with closed lips": closed, "open vowels with open mouth": opened}
    return {name: float(np.mean(values)) for name, values in shares.items() if values}
