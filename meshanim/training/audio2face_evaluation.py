"""What `meshanim evaluate a2f` measures: Audio2Face-3D's benchmark (Sec. 7), on held-out sequences."""

import hashlib
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Float64

from meshanim.audio import SpeechEncoder, load_encoder
from meshanim.datasets.meshanim_format import MeshanimDataset, MotionSequence
from meshanim.errors import OptionError
from meshanim.heads import load_head
from meshanim.models.audio2face import (
    Audio2FaceDiffusion,
    Audio2FaceRegression,
    EmotionTrack,
    FrameNoise,
    animate_diffusion,
    animate_regression,
)
from meshanim.models.gava import Gava
from meshanim.models.loading import load_network
from meshanim.models.syncnet import SyncNet, mouth_landmarks
from meshanim.results import MetricValue, Results
from meshanim.training.feature_cache import FeatureCache, cache_folder
from meshanim.training.gava_evaluation import (
    Method,
    Predicted,
    describe,
    held_still,
    load_gava,
    measure,
    speaker,
    topology_of,
)
from meshanim.training.motion_evaluation import JITTER_ABOVE, MotionEvaluation, masks_of_head
from meshanim.training.syncnet import parts_of

__all__ = ["EvaluateAudio2FaceOptions", "Expressiveness", "SyncEvaluation", "evaluate_audio2face"]

Vertices = Float[np.ndarray, "frames vertices 3"]


@dataclass(frozen=True)
class EvaluateAudio2FaceOptions:
    """Score Audio2Face networks on held-out speech: sync, jitter, bilabials, expressiveness, errors.

    Example: meshanim evaluate a2f --data corpus --models default runs/a2f --syncnet runs/syncnet
    """

    data: Path
    """Folder of a data set in the project's format."""
    models: tuple[str, ...] = ("default",)
    """Networks for one table: default (GAVA's), or folders that meshanim train wrote."""
    syncnet: Path | None = None
    """Folder that meshanim train syncnet wrote; without it no sync scores."""
    splits: tuple[str, ...] = ("test",)
    """Splits of the data set."""
    subjects: tuple[str, ...] = ()
    """Whose sequences; everybody's if not given. The regression network is one actor's."""
    parts: Path | None = None
    """JSON that names the lips where the data set has no head, for sync scores."""
    steps: int | None = None
    """Denoising steps of diffusion networks; their own if not given."""
    seed: int = 0
    """Of their noise."""
    jitter_above: float = JITTER_ABOVE
    """Hz above which the power of the lips' acceleration counts as jitter."""
    json: Path | None = None
    """Where to write the rows, each sequence's numbers included, for meshanim evaluate compare."""


class SyncEvaluation:
    """Sync scores of sequences, pooled over sequences.

    Parameters
    ----------
    network : SyncNet
        Trained.
    landmarks : sequence of int
        Vertices of the mouth on the meshes to be scored.
    fps : float
        Of their frames.
    """

    def __init__(self, network: SyncNet, landmarks: tuple[int, ...], fps: float):
        if len(landmarks) != len(network.config.landmarks):
            known = len(network.config.landmarks)
            raise OptionError(f"the SyncNet knows {known} landmarks, this mouth has {len(landmarks)}")
        self.network, self.landmarks, self.fps = network, list(landmarks), fps
        self.scores: dict[str, dict[str, tuple[float, float]]] = defaultdict(dict)
        self.frames = 0

    def add(
        self,
        name: str,
        vertices: Vertices,
        template: Float[np.ndarray, "vertices 3"],
        features: Float[torch.Tensor, "steps dim"],
    ) -> None:
        """Score one sequence; features are those of the SyncNet's encoder."""
        mouth = torch.from_numpy(np.ascontiguousarray(vertices[:, self.landmarks]))
        neutral = torch.from_numpy(template[self.landmarks])
        score = self.network.score(mouth, neutral, self.fps, features)
        for metric, value in zip(SYNC, (score.distance, score.confidence, abs(score.offset) * 1000)):
            self.scores[metric][name] = (value, 1.0)
        self.frames += len(vertices)

    def values(self) -> list[MetricValue]:
        """Distance, confidence and size of the offset."""
        mark = hashlib.blake2b(np.array(self.landmarks).tobytes(), digest_size=4).hexdigest()
        return [
            MetricValue(
                metric,
                float(np.mean([value for value, _ in self.scores[metric].values()])),
                unit,
                "mouth landmarks",
                len(self.landmarks),
                mark,
                formula,
                "sequences",
                self.frames,
                len(self.scores[metric]),
                self.scores[metric],
            )
            for metric, (unit, formula) in SYNC.items()
            if self.scores[metric]
        ]


SYNC = {
    "sync distance": ("none", "mean |v(lips at t) - v(sound at t)|, unit vectors of SyncNet"),
    "sync confidence": (
        "none",
        "median of that distance over shifts to 0.6 s, less the smallest",
    ),
    "sync offset": ("ms", "|shift with the smallest distance|"),
}


class Expressiveness:
    """How much of the emotions of the training data is in a motion, and whether it is the right one.

    A clip's feature is its mean displacement from the template, neutralised: less the subject's mean over
    neutral training clips (Sec. 7 does so with the features of an emotion network on pictures). Its reference
    is the mean of the emotion's training clips.

    Parameters
    ----------
    dataset : MeshanimDataset
        Its training split gives neutral means and references.
    vertices : (M,) int
        Vertices that count.
    mask : str
        Their name.
    """

    def __init__(self, dataset: MeshanimDataset, vertices: np.ndarray, mask: str):
        self.vertices, self.mask = vertices, mask
        gathered: dict[tuple[str, str], list[np.ndarray]] = defaultdict(list)
        for name in dataset.split("train"):
            sequence = dataset[name]
            info = sequence.info
            template = dataset.subjects[info.subject].template
            gathered[info.subject, info.emotion].append(self.feature(sequence.vertices, template))
        means = {key: np.mean(rows, axis=0) for key, rows in gathered.items()}
        self.neutral = {who: value for (who, emotion), value in means.items() if emotion == "neutral"}
        apart: dict[str, list[np.ndarray]] = defaultdict(list)
        for (who, emotion), value in means.items():
            if emotion != "neutral" and who in self.neutral:
                apart[emotion].append(value - self.neutral[who])
        self.references = {emotion: np.mean(rows, axis=0) for emotion, rows in apart.items()}

    def feature(self, vertices: Vertices, template: Float[np.ndarray, "vertices 3"]) -> np.ndarray:
        """Mean displacement of the vertices that count, flat, metres."""
        moved = np.asarray(vertices)[:, self.vertices].mean(0, dtype=np.float64) - template[self.vertices]
        return moved.ravel()

    def scorer(self) -> "ExpressivenessScores":
        """Fresh sums for one method."""
        return ExpressivenessScores(self)


class ExpressivenessScores:
    """Sums of one method's clips."""

    def __init__(self, reference: Expressiveness):
        self.reference = reference
        self.strength: dict[str, tuple[float, float]] = {}
        self.recognised: dict[str, tuple[float, float]] = {}
        self.frames = 0

    def add(self, name: str, subject: str, emotion: str, vertices: Vertices, template: np.ndarray) -> None:
        """Score a clip, if its emotion and its subject's neutral face are known from training."""
        known = self.reference
        if emotion not in known.references or subject not in known.neutral:
            return
        shown: Float64[np.ndarray, " numbers"] = known.feature(vertices, template) - known.neutral[subject]
        wanted = known.references[emotion]
        self.strength[name] = (float(shown @ wanted / (wanted @ wanted)), 1.0)
        nearest = min(
            ["neutral", *known.references],
            key=lambda other: np.linalg.norm(shown - known.references.get(other, np.zeros_like(shown))),
        )
        self.recognised[name] = (float(nearest == emotion), 1.0)
        self.frames += len(vertices)

    def values(self) -> list[MetricValue]:
        """Strength along the emotion's reference, and the share of clips nearest to it."""
        known = self.reference
        mark = hashlib.blake2b(np.asarray(known.vertices).tobytes(), digest_size=4).hexdigest()
        count = len(known.references) + 1
        rows = (
            (
                "expressiveness",
                "ratio",
                "<p - n, e> / |e|^2, n neutral, n + e emotion, means",
                self.strength,
            ),
            ("emotion recognised", "share", f"nearest of {count} means is its emotion's", self.recognised),
        )
        return [
            MetricValue(
                metric,
                float(np.mean([value for value, _ in scores.values()])),
                unit,
                known.mask,
                len(known.vertices),
                mark,
                formula,
                "sequences",
                self.frames,
                len(scores),
                scores,
            )
            for metric, unit, formula, scores in rows
            if scores
        ]


def evaluate_audio2face(options: EvaluateAudio2FaceOptions, progress: bool = True) -> Results:
    """Fill the table: networks before baselines, and the truth where a metric needs none beside it.

    Raises
    ------
    FileFormatError, OptionError
        If the data set or a checkpoint cannot be read, or they do not fit together.
    """
    dataset = MeshanimDataset(options.data)
    unknown = set(options.subjects) - set(dataset.subjects)
    if unknown:
        raise OptionError(f"no subject {', '.join(sorted(unknown))}; there are {', '.join(dataset.subjects)}")
    chosen = {
        split: [
            name
            for name in dataset.split(split)
            if not options.subjects or dataset.info(name).subject in options.subjects
        ]
        for split in options.splits
    }
    if not any(chosen.values()):
        raise OptionError(f"{options.data} has no sequences to score in {', '.join(options.splits)}")
    methods: dict[str, Method] = {"truth": lambda s: Predicted(np.array(s.vertices), np.array(s.pose))}
    for name in options.models:
        label, method = method_of(name, dataset, options)
        methods[label] = method
    methods |= held_still(dataset)
    head = load_head(dataset.head) if dataset.head else None
    masks = masks_of_head(head)
    everywhere = np.arange(dataset.surface.n_vertices)
    face = everywhere if head is None else np.union1d(head.regions["upper_face"], head.regions["lips"])
    reference = Expressiveness(dataset, face, "all" if head is None else "upper face, lips")
    network = None if options.syncnet is None else load_syncnet(options.syncnet)
    results = Results("evaluate a2f")
    for split, names in chosen.items():
        for label, method in methods.items() if names else ():
            sync = None
            if network is not None:
                landmarks = mouth_landmarks(parts_of(dataset, options.parts))
                sync = SyncEvaluation(network, landmarks, dataset.fps)
            feeling = reference.scorer()
            evaluation = MotionEvaluation(masks, dataset.fps, dataset.unit, options.jitter_above)
            watched = _watched(method, dataset, sync, feeling, options)
            values = measure(dataset, names, watched, evaluation, f"{split}: {label}", progress)
            for value in [*(sync.values() if sync else []), *feeling.values(), *values]:
                results.add_measured(split, label, value)
    if options.json is not None:
        results.save(options.json)
    return results


def load_syncnet(folder: Path) -> SyncNet:
    """A SyncNet from a run's folder or the model in it."""
    inner = folder / "model"
    return SyncNet.from_pretrained(inner if inner.is_dir() else folder)


def _watched(
    method: Method,
    dataset: MeshanimDataset,
    sync: SyncEvaluation | None,
    feeling: ExpressivenessScores,
    options: EvaluateAudio2FaceOptions,
) -> Method:
    """The method, whose motion is scored for sync and expressiveness as it passes."""
    cache: FeatureCache | None = None
    if sync is not None:
        encoder = load_encoder(sync.network.config.encoder)
        cache = FeatureCache(cache_folder(options.data), encoder)

    def predict(sequence: MotionSequence) -> Predicted:
        given = method(sequence)
        info, template = sequence.info, dataset.subjects[sequence.info.subject].template
        if sync is not None and cache is not None:
            tracks = cache.tracks(info.name, sequence.audio, 0, lambda: ())
            assert tracks is not None  # it waits
            features = torch.from_numpy(tracks[0][0][:].astype(np.float32))
            sync.add(info.name, given.vertices, template, features)
        feeling.add(info.name, info.subject, info.emotion, given.vertices, template)
        return given

    return predict


def method_of(name: str, dataset: MeshanimDataset, options: EvaluateAudio2FaceOptions) -> tuple[str, Method]:
    """A label for tables, and a function that speaks a sequence with its subject's face and emotion.

    Raises
    ------
    OptionError
        If the network gives no vertices, or those of another mesh.
    """
    network = load_gava(name) if name == "default" else load_network(name)
    if isinstance(network, Gava):
        model = topology_of(network, dataset)
        label = f"GAVA {describe(name, model)}"
        return label, speaker(model, load_encoder(model.config.encoder), dataset, None)
    place = Path(name).name if Path(name).name != "model" else Path(name).absolute().parent.name
    if len(network.actors.faces) and not np.array_equal(network.actors.faces, dataset.surface.faces):
        raise OptionError(f"{name} was trained on another mesh than that of {dataset.directory}")
    encoder = load_encoder(network.config.encoder)
    if isinstance(network, Audio2FaceRegression):
        return f"A2F regression ({place})", regression_speaker(network, encoder, dataset)
    if network.config.target == "rig":
        raise OptionError(f"{name} gives the weights of a rig; meshanim evaluate a2f scores vertices")
    return f"A2F diffusion ({place})", diffusion_speaker(network, encoder, dataset, options)


def _emotions(known: tuple[str, ...], sequence: MotionSequence) -> EmotionTrack:
    info = sequence.info
    emotion = info.emotion if info.emotion in known else "neutral"
    return EmotionTrack.of(known, (0.0, {emotion: float(info.intensity)}))


def regression_speaker(
    network: Audio2FaceRegression, encoder: SpeechEncoder, dataset: MeshanimDataset
) -> Callable[[MotionSequence], Predicted]:
    """The actor's motion on each subject's face."""

    def predict(sequence: MotionSequence) -> Predicted:
        info = sequence.info
        emotions = _emotions(tuple(network.config.emotions), sequence)
        states = animate_regression(network, encoder, sequence.audio, info.fps, emotions)
        template = torch.from_numpy(dataset.subjects[info.subject].template)
        return Predicted(network.actors.basis.vertices(states, template).numpy(), None)

    return predict


def diffusion_speaker(
    network: Audio2FaceDiffusion,
    encoder: SpeechEncoder,
    dataset: MeshanimDataset,
    options: EvaluateAudio2FaceOptions,
) -> Callable[[MotionSequence], Predicted]:
    """Each subject's own identity, the first one's where it has none, on the subject's face.

    Raises
    ------
    OptionError
        If the network has another frame rate, or is told sentences.
    """
    if network.config.fps != dataset.fps:
        raise OptionError(
            f"the network gives {network.config.fps:g} frames a second, the data set has {dataset.fps:g}"
        )

    def predict(sequence: MotionSequence) -> Predicted:
        info = sequence.info
        identity = info.subject if info.subject in network.config.identities else None
        steps = len(network.schedule.sampling(options.steps or network.config.sampling))
        noise = FrameNoise(steps, network.numbers, options.seed)
        emotions = _emotions(tuple(network.config.emotions), sequence)
        frames = animate_diffusion(network, encoder, sequence.audio, identity, emotions, noise, options.steps)
        template = torch.from_numpy(dataset.subjects[info.subject].template)
        return Predicted(network.actors.basis.posed(network.pose(frames), template).numpy(), None)

    return predict
