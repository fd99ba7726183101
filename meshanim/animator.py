"""`Animator`: speech to an animated head, whole files and streams through one path."""

import math
from collections.abc import Iterable, Iterator, Mapping
from functools import cached_property
from importlib.resources import files
from pathlib import Path
from typing import NamedTuple

import numpy as np
import soxr
import torch
from jaxtyping import Float, Float32
from torch import Tensor
from tqdm import tqdm

from meshanim.audio import SpeechEncoder, Waveform, load_encoder, load_waveform
from meshanim.errors import FileFormatError, OptionError, ShapeError
from meshanim.geometry import TriangleMesh
from meshanim.geometry.correspondence import surface_correspondence
from meshanim.heads import Head, load_head
from meshanim.models.audio2face import EmotionTrack
from meshanim.models.gava import Gava
from meshanim.models.loading import load_network
from meshanim.motion import MeshSequence
from meshanim.motion.animation_state import FacePose, face_pose, posed_face
from meshanim.motion.face_parts import FaceParts, face_parts
from meshanim.motion.idle import IdleMotion, gaze_angles
from meshanim.motion.lip_seal import LipSeal, head_lip_seal
from meshanim.motion.post_processing import PostHearing, PostProcessor, head_poses
from meshanim.performance import AnimationOptions, Network, Performance, perform

__all__ = ["AnimationOptions", "AnimationStream", "Animator", "Frames"]

Template = Float[np.ndarray, "vertices 3"]
Weights = Mapping[str, np.ndarray]
CHECKPOINTS = {"default": "gava-default"}


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
        self._animator, self.rate = animator, rate
        wanted = animator.encoder.sample_rate
        self._resample = soxr.ResampleStream(rate, wanted, 1, "float32") if rate != wanted else None
        self._performance = animator.perform(options, template)
        self.fps = self._performance.fps
        self._template = template
        self._given = 0
        self._samples = 0
        track = options.track
        blinks, gaze_seed = 0.28, options.seed
        self._parts = animator.parts
        self._hearing, self._post = None, None
        if track is not None:
            if self._parts is None:
                raise OptionError("this head has no regions that say what is skin: no post-processing")
            interval = track.first.blink_interval
            blinks, gaze_seed = (
                1 / interval if interval else 0.0,
                gaze_seed + int(track.first.eye_saccade_seed),
            )
            self._hearing = PostHearing(track, wanted)
            poses = head_poses(animator.model_head, self._parts)
            self._post = PostProcessor(track, self._parts, self._performance.template, self.fps, poses)
        if options.blinks is not None:
            blinks = options.blinks
        self._idle = IdleMotion(options.seed, blinks, options.gaze, options.sway, gaze_seed)

    @property
    def without_effect(self) -> tuple[str, ...]:
        """Controls of the post-processing that this head cannot follow."""
        return () if self._post is None else self._post.without_effect

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

    def feel(self, emotions: EmotionTrack) -> None:
        """Follow other emotions from the next frame on.

        Raises
        ------
        OptionError
            If the track does not fit the network.
        """
        self._performance.feel(emotions)

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
        if self._hearing is not None:
            samples = self._hearing.push(samples, last)
        motion = self._performance.push(samples, self._total() if last else None)
        pose = motion.pose.cpu().numpy()
        times = (self._given + np.arange(len(pose)) + 0.5) / self.fps
        self._given += len(pose)
        pose = pose + self._idle.pose(times)
        weights = self._idle.weights(times, pose)
        face = motion.face
        if self._post is not None:
            face, weights = self._processed(face, times, weights)
        if isinstance(face, FacePose):
            assert self._parts is not None
            face = posed_face(self._parts, face, self._performance.template)
        vertices = self._animator.finished(face.cpu().numpy(), weights, self._template)
        return Frames(vertices, pose.astype(np.float32))

    def _processed(
        self, face: FacePose | Tensor, times: np.ndarray, weights: Weights
    ) -> tuple[FacePose, Weights]:
        """Through the post-processing; the weights that are still to be added."""
        assert self._post is not None
        assert self._parts is not None
        if not isinstance(face, FacePose):
            face = face_pose(self._parts, face, self._performance.template)
        saccades = gaze_angles(weights)
        names = () if self._animator.model_head is None else self._animator.model_head.expression_names
        if set(weights) <= set(names):
            # The head's own shapes move the lids with the eyes.
            gain = self._post.track.values("saccade_strength", times)
            saccades = np.zeros_like(saccades)
            blink = ("eyeBlinkLeft", "eyeBlinkRight")
            rest = {name: gain * weight for name, weight in weights.items() if name not in blink}
        else:
            rest = {}
        return self._post(face, times, weights["eyeBlinkLeft"], saccades), rest

    @property
    def mesh(self) -> TriangleMesh:
        """The animated head at rest, as who speaks."""
        if self._animator.correspondence is not None:
            on_target = self._animator.is_on_target(self._template)
            return self._animator.mesh.with_vertices(self._template) if on_target else self._animator.mesh
        if self._template is None and isinstance(self._animator.model, Gava):
            return self._animator.mesh
        return self._animator.mesh.with_vertices(self._performance.template.cpu().numpy())

    def _total(self) -> int:
        return max(1, math.ceil(self._samples * self.fps / self.rate - 1e-9))


class Animator:
    """A network, the encoder it listens through, and the head it moves.

    Parameters
    ----------
    model : Gava, Audio2FaceRegression or Audio2FaceDiffusion
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
        self,
        model: Network,
        encoder: SpeechEncoder,
        model_head: Head | None = None,
        head: Head | None = None,
    ):
        if encoder.dim != model.config.feature_dim:
            raise OptionError(
                f"encoder {encoder.name} gives {encoder.dim} features a frame, the network reads "
                f"{model.config.feature_dim}: it was trained with {model.config.encoder}"
            )
        self.network = model.eval()
        self.views = [model.on(k) for k in range(model.n_topologies)] if isinstance(model, Gava) else [model]
        self.model = self.views[0]
        self.encoder = encoder
        self.model_head = model_head
        self.head = model_head if head is None else head
        self.correspondence = None
        if head is not None:
            own = next((view for view in self.views if _same_faces(head.mesh, view)), None)
            if own is None:
                self.correspondence = surface_correspondence(self.model.mesh, head.mesh)
            elif own is not self.model or model_head is None:
                self.model, self.model_head = own, head

    @classmethod
    def from_pretrained(
        cls, name: str | Path = "default", head: str | Head | None = None, device: str = "cpu"
    ) -> "Animator":
        """Load a checkpoint with the encoder and the head it names.

        Parameters
        ----------
        name : str or Path
            "default", a folder that `meshanim train` wrote, or a repository of the Hugging Face hub.
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
        model = load_network(path, device)
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

    @cached_property
    def parts(self) -> FaceParts | None:
        """What is skin, tongue, jaw and eyes of the network's face; None where nothing says it."""
        if not isinstance(self.model, Gava):
            return self.model.actors.basis.parts
        return None if self.model_head is None else face_parts(self.model_head)

    def lip_seal(self) -> LipSeal | None:
        """The seal of the network's head; None where the head names no lip pairs or the encoder no class."""
        return None if self.bilabial is None else head_lip_seal(self.model_head)

    def perform(self, options: AnimationOptions, template: Template | None = None) -> Performance:
        """Start the network on a speech at the encoder's rate; arguments as of `open`."""
        rest = None
        if template is not None and not self.is_on_target(template):
            rest = torch.from_numpy(np.asarray(template, np.float32))
        elif self.correspondence is not None and not isinstance(self.model, Gava):
            # Moves are carried over from the face that the correspondence was found on.
            rest = torch.from_numpy(self.model.mesh.vertices.astype(np.float32))
        seal = self.lip_seal() if options.seal and isinstance(self.model, Gava) else None
        return perform(self.model, self.encoder, options, rest, self.model_head, seal)

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
            Who speaks: the face at rest, metres, in one of the network's topologies or in that of the
            animated head; its own if not given.

        Raises
        ------
        OptionError
            If the rate is not positive or an option does not fit the network.
        ShapeError
            If no topology of the network has the template's number of vertices.
        """
        if not rate > 0:
            raise OptionError(f"rate must be positive, not {rate}")
        return AnimationStream(self.on_template(template), rate, options or AnimationOptions(), template)

    def is_on_target(self, template: Template | None) -> bool:
        """Whether a template is of the head that motion is carried over to, not of the network's."""
        if template is None or self.correspondence is None or len(template) == self.model.n_vertices:
            return False
        return len(template) == self.mesh.n_vertices

    def on_template(self, template: Template | None) -> "Animator":
        """The animator of the topology that has a template's number of vertices.

        Raises
        ------
        ShapeError
            If there is none.
        """
        if template is None or len(template) == self.model.n_vertices or self.is_on_target(template):
            return self
        view = next((view for view in self.views if view.n_vertices == len(template)), None)
        if view is None:
            counts = " or ".join(str(view.n_vertices) for view in self.views)
            raise ShapeError(f"the template has {len(template)} vertices, the network's face {counts}")
        return Animator(view, self.encoder, load_head(view.config.head) if view.config.head else None)

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
            Who speaks: the face at rest, metres, in one of the network's topologies or in that of the
            animated head; its own if not given.
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
        return MeshSequence(vertices, stream.fps, stream.mesh, pose, waveform)

    def finished(
        self, vertices: np.ndarray, weights, template: Template | None = None
    ) -> Float32[np.ndarray, "frames vertices 3"]:
        """Add eye weights where the head has those shapes, and carry the frames over to another head."""
        head = self.model_head
        if head is not None and len(vertices) and weights and set(weights) <= set(head.expression_names):
            rows = [head.expression_names.index(name) for name in weights]
            amounts = torch.from_numpy(np.stack(list(weights.values()), 1).astype(np.float32))
            moved = (amounts @ head.expression_directions[rows]).reshape(len(vertices), -1, 3)
            vertices = vertices + moved.numpy()
        if self.correspondence is None:
            return vertices
        carried = self.correspondence.carry_displacements(vertices).astype(np.float32)
        if template is None or not self.is_on_target(template):
            return carried
        return carried + (np.asarray(template, np.float32) - self.mesh.vertices.astype(np.float32))


def _same_faces(mesh: TriangleMesh, network: Network) -> bool:
    if mesh.n_vertices != network.n_vertices:
        return False
    # Networks of data without faces take those of any mesh with as many vertices.
    unknown = not isinstance(network, Gava) and not len(network.actors.faces)
    return unknown or np.array_equal(mesh.faces, network.mesh.faces)
