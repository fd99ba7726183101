"""Losses of Audio2Face-3D's networks: Eqs. 1 to 5, 8, 9 and 15, with the published weights.

The published weights belong to centimetres and to a skin of 61,520 vertices. States and vertices are in
metres here; `state_units` and `CENTIMETRES` bring them to the scale of those weights, whatever the mesh.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional

from meshanim.motion.animation_state import Actors, StateBasis

__all__ = [
    "CENTIMETRES",
    "PRESETS",
    "LipReader",
    "RegressionWeights",
    "acceleration_loss",
    "implicit_emotion_loss",
    "lip_distance_loss",
    "lip_size_loss",
    "motion_loss",
    "phoneme_loss",
    "phoneme_motion_loss",
    "smoothness_loss",
    "state_loss",
    "state_units",
    "volume_stability_loss",
]

CENTIMETRES = 100.0
PUBLISHED_VERTICES = 61520
EYE_RADIUS = 1.2
"""Centimetres: an angle of an eye counts as the way of its pupil."""


@dataclass(frozen=True)
class RegressionWeights:
    """Weights of the eight terms of Eq. 1, and the two rates that the paper gives no numbers for.

    Parameters
    ----------
    state, motion, phoneme, phoneme_motion, volume, emotion, lip_distance, lip_size : float
        alpha of mse, motion, phoneme, phoneme_motion, vol_stab, emo, lip_dist, lip_size.
    beta : float
        Of exp(-beta volume), Eq. 2; volume is the root mean square of a window, full scale 1.
    gamma : float
        Of exp(-gamma opening), Eq. 4, a centimetre; the public code has 10.
    """

    state: float = 1.0
    motion: float = 10.0
    phoneme: float = 0.1
    phoneme_motion: float = 0.1
    volume: float = 100.0
    emotion: float = 1.0
    lip_distance: float = 50.0
    lip_size: float = 0.01
    beta: float = 50.0
    gamma: float = 10.0


PRESETS = {
    "james": RegressionWeights(1.0, 10.0, 0.1, 0.1, 100.0, 1.0, 50.0, 0.01),
    "claire": RegressionWeights(1.5, 10.0, 0.2, 0.1, 100.0, 1.0, 100.0, 0.0),
    "mark": RegressionWeights(1.0, 10.0, 1.0, 0.0, 100.0, 1.0, 500.0, 0.0),
}
"""The three published sets of weights (Sec. 4.1, Implementation Detail)."""


def state_units(basis: StateBasis) -> Float[Tensor, " state"]:
    """Factors that bring a state to the units of the published weights.

    Centimetres; eye angles times the eyeball's radius; coefficients of the skin as if it had as many vertices
    as the published one, for a coefficient grows with the root of their number.
    """
    factors = torch.full((basis.width,), CENTIMETRES)
    factors[basis.columns["skin"]] *= (PUBLISHED_VERTICES / len(basis.parts.skin)) ** 0.5
    factors[basis.columns["eyes"]] = EYE_RADIUS
    return factors


def state_loss(predicted: Float[Tensor, "*batch state"], true: Float[Tensor, "*batch state"]) -> Tensor:
    """Mean squared difference of states (L_mse; the paper's norm divided by its numbers)."""
    return (predicted - true).square().mean()


def motion_loss(
    predicted: Float[Tensor, "pairs 2 state"], true: Float[Tensor, "pairs 2 state"]
) -> Float[Tensor, ""]:
    """Mean squared difference of how two adjacent frames differ (L_motion)."""
    return state_loss(predicted.diff(dim=1), true.diff(dim=1))


def phoneme_loss(
    logits: Float[Tensor, "*batch steps phonemes"], labels: Int[Tensor, "*batch steps"]
) -> Float[Tensor, ""]:
    """Cross-entropy of phonemes, mean over the steps with a label from 0 on; 0 where there is none."""
    known = labels >= 0
    each = functional.cross_entropy(logits.flatten(0, -2), labels.clamp_min(0).flatten(), reduction="none")
    return (each * known.flatten()).sum() / known.sum().clamp_min(1)


def phoneme_motion_loss(
    logits: Float[Tensor, "pairs 2 steps phonemes"], labels: Int[Tensor, "pairs 2 steps"]
) -> Float[Tensor, ""]:
    """Squared difference of how probabilities and labels change between adjacent frames, mean over steps.

    Steps whose label is unknown in either frame do not count.
    """
    probabilities = logits.softmax(-1)
    known = (labels >= 0).all(1)
    truth = functional.one_hot(labels.clamp_min(0), logits.shape[-1]).to(probabilities)
    error = (probabilities.diff(dim=1) - truth.diff(dim=1))[:, 0].square().sum(-1)
    return (error * known).sum() / known.sum().clamp_min(1)


def volume_stability_loss(
    predicted: Float[Tensor, "pairs 2 state"], volume: Float[Tensor, " pairs"], beta: float
) -> Float[Tensor, ""]:
    """Squared motion weighted by exp(-beta volume): rest where nothing is heard (Eq. 2)."""
    return (torch.exp(-beta * volume) * predicted.diff(dim=1)[:, 0].square().mean(-1)).mean()


def implicit_emotion_loss(implicit: Float[Tensor, "pairs 2 numbers"]) -> Float[Tensor, ""]:
    """Squared change of the implicit emotion, of its own square (Eq. 3)."""
    change = implicit.diff(dim=1)[:, 0].square().sum(-1)
    return (change / implicit[:, 0].square().sum(-1).clamp_min(1e-12)).mean()


def lip_distance_loss(
    predicted: Float[Tensor, "*batch lips"], true: Float[Tensor, "*batch lips"], gamma: float
) -> Float[Tensor, ""]:
    """Squared difference of lip openings, weighted by exp(-gamma max(true, 0)), summed over the lips (Eq. 4).

    Parameters
    ----------
    predicted, true : (..., 5)
        Height of the upper over the lower lip at five places, centimetres.
    gamma : float
        A centimetre.
    """
    weight = torch.exp(-gamma * true.clamp_min(0))
    return (weight * (predicted - true).square()).sum(-1).mean()


def lip_size_loss(
    predicted: Float[Tensor, "*batch 2 lips"], true: Float[Tensor, "*batch 2 lips"]
) -> Float[Tensor, ""]:
    """Squared difference of the thickness of both lips, summed over the places (Eq. 5); centimetres."""
    return (predicted - true).square().sum((-2, -1)).mean()


def smoothness_loss(motion: Float[Tensor, "*batch frames numbers"]) -> Float[Tensor, "*batch"]:
    """Mean squared difference of adjacent frames, of each motion (Eq. 8, on the upper face)."""
    return motion.diff(dim=-2).square().mean((-2, -1))


def acceleration_loss(motion: Float[Tensor, "*batch frames numbers"]) -> Float[Tensor, "*batch"]:
    """Mean squared second difference, of each motion of three frames or more (Eq. 15)."""
    return motion.diff(n=2, dim=-2).square().mean((-2, -1))


class LipReader(nn.Module):
    """Lip openings and thickness, centimetres, from skin displacements or from states, without all vertices.

    Parameters
    ----------
    actors : Actors
        Basis and neutral faces.
    """

    rows: Tensor
    neutral: Tensor
    mean: Tensor
    components: Tensor
    opening: Tensor
    thickness: Tensor

    def __init__(self, actors: Actors):
        super().__init__()
        parts = actors.basis.parts
        groups = (parts.lip_pairs, parts.upper_lip, parts.lower_lip)
        flat = torch.from_numpy(parts.skin)
        vertices = torch.cat([torch.from_numpy(group).flatten() for group in groups])
        unique, inverse = vertices.unique(return_inverse=True)
        order = torch.searchsorted(flat, unique)
        counts = [group.size for group in groups]
        opening, upper, lower = (part.reshape(-1, 2) for part in inverse.split(counts))
        self.register_buffer("rows", order, persistent=False)
        neutral = torch.stack([template[unique] for template in actors.templates.values()])
        self.register_buffer("neutral", neutral, persistent=False)
        self.register_buffer("mean", actors.basis.skin_mean[order], persistent=False)
        self.register_buffer("components", actors.basis.skin_components[:, order], persistent=False)
        self.register_buffer("opening", opening, persistent=False)
        same = upper.shape == lower.shape
        self.register_buffer(
            "thickness", torch.stack([upper, lower]) if same else upper.new_zeros(2, 0, 2), persistent=False
        )

    def of_states(
        self, states: Float[Tensor, "*batch state"], subject: Int[Tensor, "*batch"]
    ) -> tuple[Float[Tensor, "*batch lips"], Float[Tensor, "*batch 2 segments"]]:
        """Openings and thickness of states of subjects, rows of the actors' templates in their order."""
        coefficients = states[..., : len(self.components)]
        moved = self.mean + torch.einsum("...k,kvc->...vc", coefficients, self.components)
        return self._measured(moved + self.neutral[subject])

    def of_skin(
        self, skin: Float[Tensor, "*batch skin 3"], subject: Int[Tensor, "*batch"]
    ) -> tuple[Float[Tensor, "*batch lips"], Float[Tensor, "*batch 2 segments"]]:
        """The same of displacements of the skin, metres."""
        return self._measured(skin[..., self.rows, :] + self.neutral[subject])

    def _measured(self, points: Float[Tensor, "*batch points 3"]) -> tuple[Tensor, Tensor]:
        heights = points[..., self.opening, 1] * CENTIMETRES
        ends = points[..., self.thickness, :] * CENTIMETRES
        size = (ends[..., 0, :] - ends[..., 1, :]).square().sum(-1).clamp_min(1e-12).sqrt()
        return heights[..., 0] - heights[..., 1], size
