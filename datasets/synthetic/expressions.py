"""Hand-made faces that talking does not show: every wrinkle, gaze, mouths pulled and pressed."""

__all__ = ["HELD_OUT", "TRAINING"]


def _both(**weights: float) -> dict[str, float]:
    return {f"{name}{side}": weight for name, weight in weights.items() for side in ("Left", "Right")}


TRAINING: dict[str, dict[str, float]] = {
    "neutral": {},
    "brows up": {"browInnerUp": 0.9, **_both(browOuterUp=0.9)},
    "frown": {**_both(browDown=1.0, eyeSquint=0.35)},
    "broad smile": {**_both(mouthSmile=0.85, cheekSquint=0.7, mouthUpperUp=0.35, mouthLowerDown=0.25)},
    "jaw open": {"jawOpen": 0.75},
    "shut eyes": _both(eyeBlink=1.0),
    "disgust": {**_both(noseSneer=0.9, mouthUpperUp=0.6, browDown=0.35)},
    "pucker": {"mouthPucker": 0.9, "mouthFunnel": 0.15},
    "squint": _both(eyeSquint=0.9, cheekSquint=0.7),
    "smile": _both(mouthSmile=0.7, mouthDimple=0.4),
    "surprise": {"jawOpen": 0.45, "browInnerUp": 0.7, **_both(browOuterUp=0.7, eyeWide=0.7)},
    "mouth corners down": {"mouthShrugLower": 0.7, **_both(mouthFrown=0.8)},
    "left wink": {"eyeBlinkLeft": 1.0, "cheekSquintLeft": 0.6, "mouthSmileLeft": 0.4},
    "right brow up": {"browOuterUpRight": 0.9, "browDownLeft": 0.5},
    "funnel": {"mouthFunnel": 0.8, "jawOpen": 0.25},
    "bared teeth": {**_both(mouthStretch=0.6, mouthUpperUp=0.6, mouthLowerDown=0.6)},
    "inner brows up": {"browInnerUp": 1.0, **_both(mouthFrown=0.3)},
    "pressed lips": {"mouthShrugUpper": 0.3, **_both(mouthPress=0.8)},
    "look left": {"eyeLookOutLeft": 0.8, "eyeLookInRight": 0.8, "mouthLeft": 0.5},
    "look right": {"eyeLookInLeft": 0.8, "eyeLookOutRight": 0.8, "mouthRight": 0.5},
    "look up": _both(eyeLookUp=0.8, browOuterUp=0.3),
    "look down": _both(eyeLookDown=0.8, eyeBlink=0.25),
    "rolled lips": {"mouthRollLower": 0.7, "mouthRollUpper": 0.6},
    "puffed cheeks": {"cheekPuff": 0.8, "lipSeal": 0.5},
    "left smile": {"mouthSmileLeft": 0.8, "cheekSquintLeft": 0.5, "browOuterUpLeft": 0.6},
    "right sneer": {"noseSneerRight": 0.9, "mouthUpperUpRight": 0.6, "eyeSquintRight": 0.5},
    "tongue": {"tongueOut": 0.7, "jawOpen": 0.35},
    "jaw aside": {"jawLeft": 0.6, "jawOpen": 0.2},
}
"""Weights by ARKit name; the first are taken first."""

HELD_OUT: dict[str, dict[str, float]] = {
    "delight": {
        "browInnerUp": 0.6,
        "jawOpen": 0.35,
        **_both(browOuterUp=0.5, mouthSmile=0.7, cheekSquint=0.4),
    },
    "anger": {"jawOpen": 0.15, **_both(browDown=0.8, noseSneer=0.5, mouthStretch=0.4, mouthUpperUp=0.3)},
    "doubt": {"browOuterUpLeft": 0.8, "browDownRight": 0.6, "mouthRight": 0.4, "mouthPucker": 0.4},
    "grief": {"browInnerUp": 0.8, "mouthShrugLower": 0.5, **_both(mouthFrown=0.6, eyeSquint=0.5)},
    "smirk": {"mouthSmileRight": 0.7, "eyeSquintLeft": 0.6, "cheekSquintRight": 0.5, "eyeBlinkLeft": 0.3},
    "yawn": {"jawOpen": 0.9, "browInnerUp": 0.3, **_both(eyeBlink=0.7, browOuterUp=0.4)},
    "kiss": {"mouthPucker": 0.7, **_both(eyeBlink=1.0, browOuterUp=0.5)},
    "laugh": {"jawOpen": 0.55, **_both(mouthSmile=0.8, cheekSquint=0.8, eyeSquint=0.6, mouthUpperUp=0.4)},
}
"""Mixtures that are in none of the others."""
