"""What the mouth aims at in each ARPAbet phoneme, and how strongly it insists.

The targets are ARKit weights; the dominances say, for each articulator, how much a phoneme resists its
neighbours (Cohen and Massaro, "Modeling coarticulation in synthetic visual speech", 1993). Jaw and lips have
their own targets, as in JALI (Edwards et al., SIGGRAPH 2016, Sec. 4).
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

__all__ = [
    "ARTICULATORS",
    "BILABIALS",
    "CONSONANTS",
    "DIPHTHONGS",
    "LABIODENTALS",
    "PHONEMES",
    "SILENCE",
    "VISEMES",
    "VOWELS",
    "Articulator",
    "Viseme",
]

SILENCE = "SIL"
BILABIALS = frozenset({"P", "B", "M"})
LABIODENTALS = frozenset({"F", "V"})
VOWELS = frozenset(["AA", "AE", "AH", "AO", "AW", "AY", "EH", "ER", "EY", "IH", "IY", "OW", "OY", "UH", "UW"])
CONSONANTS = frozenset(
    {"B", "CH", "D", "DH", "F", "G", "HH", "JH", "K", "L", "M", "N"}
    | {"NG", "P", "R", "S", "SH", "T", "TH", "V", "W", "Y", "Z", "ZH"}
)
PHONEMES = CONSONANTS | VOWELS
DIPHTHONGS = {
    "AW": ("AW1", "UH"),
    "AY": ("AY1", "IH"),
    "EY": ("EY1", "IY"),
    "OW": ("OW1", "UW"),
    "OY": ("AO", "IH"),
}
"""Each is two targets in time; a digit marks a starting point that is no phoneme of its own."""


@dataclass(frozen=True)
class Articulator:
    """A group of ARKit weights that moves as one, with its own reach in time.

    Parameters
    ----------
    channels : tuple of str
        ARKit names without Left and Right.
    lead, lag : float
        Seconds over which a phoneme makes itself felt before it starts and after it ends.
    smoothing : float
        Seconds, standard deviation of the low-pass that stands for the articulator's inertia.
    """

    channels: tuple[str, ...]
    lead: float
    lag: float
    smoothing: float


ARTICULATORS = {
    "jaw": Articulator(("jawOpen", "jawForward"), 0.038, 0.038, 0.020),
    "protrusion": Articulator(("mouthPucker", "mouthFunnel"), 0.105, 0.080, 0.022),
    "spread": Articulator(("mouthStretch", "mouthSmile", "mouthDimple"), 0.070, 0.070, 0.020),
    "aperture": Articulator(("mouthLowerDown", "mouthUpperUp"), 0.048, 0.048, 0.016),
    "roll": Articulator(
        ("mouthPress", "mouthRollLower", "mouthRollUpper", "mouthShrugLower", "mouthShrugUpper"),
        0.045,
        0.045,
        0.014,
    ),
    "tongue": Articulator(("tongueOut",), 0.040, 0.035, 0.014),
}


@dataclass(frozen=True)
class Viseme:
    """Targets by ARKit name (no side) and dominance by articulator; a name not given aims at 0."""

    targets: Mapping[str, float]
    dominance: Mapping[str, float] = field(default_factory=dict)


def _vowel(jaw: float, lower: float = 0.0, upper: float = 0.0, **targets: float) -> Viseme:
    """Vowels own the shape of the lips: they hold even the articulators that they leave at rest."""
    dominance = {"jaw": 1.4, "protrusion": 1.0, "spread": 1.0, "aperture": 1.0, "roll": 1.0, "tongue": 1.0}
    return Viseme({"jawOpen": jaw, "mouthLowerDown": lower, "mouthUpperUp": upper, **targets}, dominance)


def _consonant(jaw: float, dominance: Mapping[str, float], **targets: float) -> Viseme:
    """Consonants leave the articulators that they do not need to their neighbours."""
    weak = {"jaw": 0.5, "protrusion": 0.12, "spread": 0.2, "aperture": 0.4, "roll": 0.6, "tongue": 0.6}
    return Viseme({"jawOpen": jaw, **targets}, {**weak, **dominance})


_BILABIAL = {"jaw": 1.3, "spread": 0.3, "aperture": 2.5, "roll": 2.5}
_LABIODENTAL = {"jaw": 1.8, "protrusion": 0.4, "aperture": 2.5, "roll": 2.5}
_DENTAL = {"jaw": 1.0, "aperture": 0.9, "tongue": 2.5}
_ALVEOLAR = {"jaw": 0.9, "aperture": 0.6, "tongue": 1.0}
_SIBILANT = {"jaw": 2.6, "spread": 0.6, "aperture": 1.3}
_PALATAL = {"jaw": 2.2, "protrusion": 1.7, "aperture": 1.2}
_VELAR = {"jaw": 0.55, "aperture": 0.4}

VISEMES: dict[str, Viseme] = {
    SILENCE: Viseme({"jawOpen": 0.015}, dict.fromkeys(ARTICULATORS, 1.0)),
    "AA": _vowel(0.42, lower=0.20, upper=0.06),
    "AE": _vowel(0.39, lower=0.26, upper=0.12, mouthStretch=0.18),
    "AH": _vowel(0.26, lower=0.12, upper=0.04),
    "AO": _vowel(0.36, lower=0.08, mouthPucker=0.36, mouthFunnel=0.32),
    "AW1": _vowel(0.41, lower=0.22, upper=0.08, mouthStretch=0.06),
    "AY1": _vowel(0.42, lower=0.22, upper=0.08),
    "EH": _vowel(0.30, lower=0.22, upper=0.08, mouthStretch=0.16, mouthSmile=0.06),
    "ER": _vowel(0.17, lower=0.10, mouthPucker=0.26, mouthFunnel=0.28),
    "EY1": _vowel(0.28, lower=0.20, upper=0.08, mouthStretch=0.18, mouthSmile=0.10),
    "IH": _vowel(0.17, lower=0.16, upper=0.05, mouthStretch=0.14, mouthSmile=0.08),
    "IY": _vowel(0.12, lower=0.16, upper=0.07, mouthStretch=0.20, mouthSmile=0.20, mouthDimple=0.06),
    "OW1": _vowel(0.30, mouthPucker=0.52, mouthFunnel=0.32),
    "UH": _vowel(0.19, lower=0.06, mouthPucker=0.48, mouthFunnel=0.22),
    "UW": _vowel(0.13, mouthPucker=0.92, mouthFunnel=0.14),
    "P": _consonant(0.08, _BILABIAL, mouthPress=0.34, mouthRollLower=0.14, mouthRollUpper=0.12),
    "B": _consonant(0.08, _BILABIAL, mouthPress=0.28, mouthRollLower=0.12, mouthRollUpper=0.10),
    "M": _consonant(0.09, _BILABIAL, mouthPress=0.20, mouthRollLower=0.12, mouthRollUpper=0.10),
    "F": _consonant(0.03, _LABIODENTAL, mouthRollLower=0.45, mouthShrugLower=0.20, mouthUpperUp=0.42),
    "V": _consonant(0.04, _LABIODENTAL, mouthRollLower=0.42, mouthShrugLower=0.18, mouthUpperUp=0.40),
    "TH": _consonant(0.13, _DENTAL, mouthLowerDown=0.18, mouthUpperUp=0.06, tongueOut=0.62),
    "DH": _consonant(0.13, _DENTAL, mouthLowerDown=0.16, mouthUpperUp=0.05, tongueOut=0.52),
    "T": _consonant(0.08, _ALVEOLAR, mouthLowerDown=0.14, mouthUpperUp=0.05),
    "D": _consonant(0.09, _ALVEOLAR, mouthLowerDown=0.14, mouthUpperUp=0.05),
    "N": _consonant(0.10, _ALVEOLAR, mouthLowerDown=0.12, mouthUpperUp=0.04),
    "L": _consonant(
        0.15, {**_ALVEOLAR, "tongue": 1.6}, mouthLowerDown=0.14, mouthUpperUp=0.05, tongueOut=0.07
    ),
    "S": _consonant(0.035, _SIBILANT, mouthLowerDown=0.24, mouthUpperUp=0.12, mouthStretch=0.16),
    "Z": _consonant(0.040, _SIBILANT, mouthLowerDown=0.22, mouthUpperUp=0.11, mouthStretch=0.14),
    "SH": _consonant(0.05, _PALATAL, mouthFunnel=0.58, mouthPucker=0.16, mouthLowerDown=0.10, jawForward=0.1),
    "ZH": _consonant(0.05, _PALATAL, mouthFunnel=0.54, mouthPucker=0.14, mouthLowerDown=0.10, jawForward=0.1),
    "CH": _consonant(0.05, _PALATAL, mouthFunnel=0.55, mouthPucker=0.15, mouthLowerDown=0.10, jawForward=0.1),
    "JH": _consonant(0.05, _PALATAL, mouthFunnel=0.50, mouthPucker=0.14, mouthLowerDown=0.10, jawForward=0.1),
    "K": _consonant(0.12, _VELAR, mouthLowerDown=0.10, mouthUpperUp=0.03),
    "G": _consonant(0.13, _VELAR, mouthLowerDown=0.10, mouthUpperUp=0.03),
    "NG": _consonant(0.13, _VELAR, mouthLowerDown=0.10, mouthUpperUp=0.03),
    "HH": _consonant(0.20, dict.fromkeys(ARTICULATORS, 0.1)),
    "R": _consonant(
        0.12, {"jaw": 0.9, "protrusion": 1.1, "aperture": 0.6}, mouthPucker=0.32, mouthFunnel=0.30
    ),
    "W": _consonant(0.07, {"jaw": 1.2, "protrusion": 2.2, "spread": 1.0, "aperture": 1.2}, mouthPucker=1.0),
    "Y": _consonant(0.09, {"jaw": 0.9, "spread": 0.9}, mouthStretch=0.18, mouthSmile=0.14),
}
