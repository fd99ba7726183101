"""`Animator`: speech to an animated head, whole files and streams through one path."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import soxr
import torch
from huggingface_hub.errors import HfHubHTTPError, HFValidationError, LocalEntryNotFoundError
from jaxtyping import Float, Float32
from tqdm import tqdm
from tyro.conf import arg

from meshanim.audio import SpeechEncoder, Waveform, load_encoder, load_waveform
from meshanim.audio.encoders import MelEncoder
from meshanim.audio.features import frame_count
from meshanim.errors import FileFormatError, OptionError
from meshanim.geometry import TriangleMesh
from meshanim.geometry.correspondence import surface_correspondence
from meshanim.heads import Head, load_head
from meshanim.models.gava import Gava
from meshanim.models.gava_stream import GavaStream
from meshanim.motion import MeshSequence
from meshanim.motion.idle import IdleMotion
from meshanim.motion.lip_seal import LipSeal, head_lip_seal

__all__ = ["AnimationOptions", "AnimationStream", "Animator", "Frames"]

Template = Float[np.ndarray, "vertices 3"]
CHECKPOINTS = {"default": "gava-default"}


@dataclass(frozen=True)
class AnimationOptions:
    """How a speech is performed.

    Parameters
    ----------
    fps : float, optional
        Frames a second; those of the checkpoint if not given.
    subject : str, optional
        Whose speaking style, one of the checkpoint's training subjects; their mean if not given.
    emotion : str
        One of the checkpoint's emotions.
    intensity : float
        Of the emotion, 0 to 1.
    seed : int
        Of blinks, gaze and sway.
    blinks : float
        Blinks a second that are added, on heads that have ARKit's eye shapes; 0 for none.
    gaze, sway : float
        Gains on added shifts of gaze and on the added slow movement of the head; 0 for none.
    seal : bool
        Whether lips are closed where the encoder hears p, b or m, on heads that name lip pairs.
    """

    fps: float | None = None
    subject: Annotated[str | None, arg(aliases=["--style"])] = None
    emotion: str = "neutral"
    intensity: float = 1.0
    seed: int = 0
    blinks: float = 0.28
    gaze: float = 1.0
    sway: float = 1.0
    seal: bool = True


class Frames(NamedTuple):
    """Vertices (t, V, 3) in the zero pose, metres, and head pose (t, 3), axis-angle in radians."""

    vertices: Float32[np.ndarray, "frames vertices 3"]
    pose: Float32[np.ndarray, "frames 3"]


class AnimationStream:
    """Speech that is still being spoken to frames: what `Animator.open` gives.

    All frames of all calls are those that `Animator` gives for the whole speech. A frame appears once no
    later sample can change it.
    """

    def __init__(self, animator: "Animator", rate: int, options: AnimationOptions, template: Template | None):
        encoder = animator.encoder
        self._animator, self.rate = animator, rate
        self._resample = (
            None
            if rate == encoder.sample_rate
            else soxr.ResampleStream(rate, encoder.sample_rate, 1, "float32")
        )
        self._features = encoder.stream()
        self._mel = animator.mel.stream() if animator.model.config.pose else None
        model = animator.model
        seal = animator.lip_seal() if options.seal else None
        self._frames = GavaStream(
            model,
            template=None if template is None else torch.from_numpy(np.asarray(template, np.float32)),
            style=model.style_of(options.subject, options.emotion, options.intensity),
            fps=options.fps,
            seal=seal,
            bilabial=animator.bilabial if seal is not None else None,
        )
        self.fps = self._frames.fps
        self._idle = IdleMotion(options.seed, options.blinks, options.gaze, options.sway)
        self._given = 0
        self._samples = 0

    def push(self, samples: Float[np.ndarray, " samples"]) -> Frames:
        """Take the next samples, any number of them; give the frames that they complete (maybe none).

        Raises
        ------
        ShapeError
            If a sample is NaN or infinite.
        OptionError
            If the stream is finished.
        """
        self._samples += len(samples)
        return self._advance(np.asarray(samples, np.float32), last=False)

    def finish(self) -> Frames:
        """End the speech and give the last frames.

        Raises
        ------
        ShapeError
            If no sample was pushed.
        """
        return self._advance(np.zeros(0, np.float32), last=True)

    def _advance(self, samples: np.ndarray, last: bool) -> Frames:
        if self._resample is not None:
            samples = self._resample.resample_chunk(samples, last=last)
        features = [self._features.push(samples)]
        mel = [] if self._mel is None else [self._mel.push(samples)]
        if last:
            features.append(self._features.finish())
            if self._mel is not None:
                mel.append(self._mel.finish())
        given = self._frames.push(torch.cat(features), torch.cat(mel) if mel else None)
        parts = [given]
        if last:
            total = frame_count(Waveform(np.zeros(max(1, self._samples), np.float32), self.rate), self.fps)
            parts.append(self._frames.finish(total))
        vertices, pose = (torch.cat(arrays).numpy() for arrays in zip(*parts, strict=True))
        times = (self._given + np.arange(len(pose)) + 0.5) / self.fps
        self._given += len(pose)
        pose = pose + self._idle.pose(times)
        weights = self._idle.weights(times, pose)
        return Frames(self._animator.finished(vertices, weights), pose.astype(np.float32))


class Animator:
    """A model, the encoder it listens through, and the head it moves.

    Parameters
    ----------
    model : Gava
        The network.
    encoder : SpeechEncoder
        Must have the feature width that the network reads.
    model_head : Head, optional
        The head whose topology the network was trained on: gives identities, lip pairs and eye shapes.
    head : Head, optional
        The head to animate; `model_head` if not given. With the faces of one of the network's topologies,
        that one is animated; another topology is reached by surface correspondence.

    Raises
    ------
    OptionError
        If the encoder does not fit the network.
    """

    def __init__(
        self, model: Gava, encoder: SpeechEncoder, model_head: Head | None = None, head: Head | None = None
    ):
        if encoder.dim != model.config.feature_dim:
            raise OptionError(
                f"encoder {encoder.name} gives {encoder.dim} features a frame, the network reads "
                f"{model.config.feature_dim}: it was trained with {model.config.encoder}"
            )
        self.network = model.eval()
        views = [model.on(k) for k in range(model.n_topologies)]
        self.model = views[0]
        self.encoder = encoder
        self.mel = MelEncoder()
        self.model_head = model_head
        self.head = model_head if head is None else head
        self.correspondence = None
        if head is not None:
            own = next((view for view in views if _same_faces(head.mesh, view.mesh)), None)
            if own is None:
                self.correspondence = surface_correspondence(self.model.mesh, head.mesh)
            elif own is not self.model:
                self.model, self.model_head = own, head

    @classmethod
    def from_pretrained(
        cls, name: str | Path = "default", head: str | Head | None = None, device: str = "cpu"
    ) -> "Animator":
        """Load a checkpoint with the encoder and the head it names.

        Parameters
        ----------
        name : str or Path
            "default", a folder that `meshanim train gava` wrote, or a repository of the Hugging Face hub.
        head : str or Head, optional
            The head to animate, as `load_head` takes it; the checkpoint's own if not given.
        device : str
            Where the network runs.

        Raises
        ------
        FileFormatError
            If the checkpoint is missing or damaged.
        """
        path = Path(str(files("meshanim") / "models" / "weights" / CHECKPOINTS.get(str(name), "")))
        if str(name) not in CHECKPOINTS:
            path = Path(name)
        elif not path.is_dir():
            raise FileFormatError(f"the checkpoint '{name}' is missing from the installation: install again")
        try:
            model = Gava.from_pretrained(path).to(device)
        except (HfHubHTTPError, LocalEntryNotFoundError, HFValidationError) as error:
            raise FileFormatError(
                f"no checkpoint {name}: neither a folder here nor a repository of the hub that can be reached"
            ) from error
        model_head = load_head(model.config.head) if model.config.head else None
        own = head is None or head == model.config.head
        target = None if own else load_head(head) if isinstance(head, str) else head
        return cls(model, load_encoder(model.config.encoder), model_head, target)

    @property
    def mesh(self) -> TriangleMesh:
        """Topology and template of the animated head."""
        return self.model.mesh if self.head is None else self.head.mesh

    @property
    def bilabial(self) -> int | None:
        """Which feature is the probability of p, b or m; None if the encoder has no such class."""
        return getattr(self.encoder, "bilabial", None)

    def lip_seal(self) -> LipSeal | None:
        """The seal of the network's head; None where the head names no lip pairs or the encoder no class."""
        return None if self.bilabial is None else head_lip_seal(self.model_head)

    def open(
        self, rate: int = 16000, options: AnimationOptions | None = None, template: Template | None = None
    ) -> AnimationStream:
        """Start a stream of speech.

        Parameters
        ----------
        rate : int
            Samples a second of the blocks to come.
        options : AnimationOptions, optional
            How it is performed.
        template : (V, 3), optional
            Who speaks: the face at rest, metres, in one of the network's topologies; its own if not given.
        """
        return AnimationStream(self.on_template(template), rate, options or AnimationOptions(), template)

    def on_template(self, template: Template | None) -> "Animator":
        """The animator of the topology that has a template's number of vertices; this one if none has."""
        if template is None or len(template) == self.model.n_vertices:
            return self
        for k in range(self.network.n_topologies):
            view = self.network.on(k)
            if view.n_vertices == len(template):
                return Animator(view, self.encoder, load_head(view.config.head) if view.config.head else None)
        return self

    def stream(
        self,
        blocks: Iterable[Float[np.ndarray, " samples"]],
        rate: int = 16000,
        options: AnimationOptions | None = None,
        template: Template | None = None,
    ) -> Iterator[Float32[np.ndarray, "frames vertices 3"]]:
        """Vertices (t, V, 3) in the zero pose while blocks of samples arrive; `open` gives the pose too."""
        stream = self.open(rate, options, template)
        for block in blocks:
            frames = stream.push(block)
            if len(frames.pose):
                yield frames.vertices
        frames = stream.finish()
        if len(frames.pose):
            yield frames.vertices

    def __call__(
        self,
        speech: str | Path | Waveform,
        options: AnimationOptions | None = None,
        template: Template | None = None,
        progress: bool = False,
    ) -> MeshSequence:
        """Animate a whole speech.

        Parameters
        ----------
        speech : path or Waveform
            Any format that libsndfile reads.
        options : AnimationOptions, optional
            How it is performed.
        template : (V, 3), optional
            Who speaks: the face at rest, metres, in one of the network's topologies; its own if not given.
        progress : bool
            Whether to show a bar, in seconds of sound.

        Raises
        ------
        FileFormatError, ShapeError
            If the file is not sound, is empty or holds NaN.
        """
        fitting = self.on_template(template)
        if fitting is not self:
            return fitting(speech, options, template, progress)
        waveform = speech if isinstance(speech, Waveform) else load_waveform(speech, rate=None)
        stream = self.open(waveform.rate, options, template)
        block = max(1, waveform.rate)  # a second at a time: memory for the result only
        starts = range(0, len(waveform.samples), block)
        parts = [
            stream.push(waveform.samples[start : start + block])
            for start in tqdm(starts, desc="animate", unit="s", disable=not progress)
        ]
        parts.append(stream.finish())
        vertices = np.concatenate([part.vertices for part in parts])
        pose = np.concatenate([part.pose for part in parts])
        mesh = self.mesh
        if template is not None and self.correspondence is None:
            mesh = mesh.with_vertices(template)
        return MeshSequence(vertices, stream.fps, mesh, pose, waveform)

    def finished(self, vertices: np.ndarray, weights) -> Float32[np.ndarray, "frames vertices 3"]:
        """Add eye weights where the head has those shapes, and carry the frames over to another head."""
        head = self.model_head
        if head is not None and len(vertices) and "eyeBlinkLeft" in head.expression_names:
            rows = [head.expression_names.index(name) for name in weights]
            amounts = torch.from_numpy(np.stack(list(weights.values()), 1).astype(np.float32))
            moved = (amounts @ head.expression_directions[rows]).reshape(len(vertices), -1, 3)
            vertices = vertices + moved.numpy()
        if self.correspondence is None:
            return vertices
        return self.correspondence.carry_displacements(vertices).astype(np.float32)


def _same_faces(one: TriangleMesh, other: TriangleMesh) -> bool:
    return one.n_vertices == other.n_vertices and np.array_equal(one.faces, other.faces)
