"""The embedded corpus: talking heads made from synthetic speech."""

from meshanim.datasets.synthetic.performance import CURVE_NAMES, Performance, perform
from meshanim.datasets.synthetic.style import EMOTIONS, SpeakingStyle

__all__ = ["CURVE_NAMES", "EMOTIONS", "Performance", "SpeakingStyle", "perform"]
