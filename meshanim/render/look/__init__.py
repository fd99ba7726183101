"""The procedural look of the default head: skin, eyes, teeth, hair, wrinkles, and a dozen people."""

from meshanim.render.look.appearance import SKIN_CHANNELS, Appearance, make_appearance, person_face
from meshanim.render.look.assets import LookAssets, look_assets
from meshanim.render.look.eyes import Eye, EyeMaterial, eye_mesh, pose_eye
from meshanim.render.look.people import PEOPLE, find_person
from meshanim.render.look.person import PersonParameters
from meshanim.render.look.strands import Strands, strand_points
from meshanim.render.look.surface import Surface
from meshanim.render.look.teeth import Teeth, pose_teeth
from meshanim.render.look.wrinkles import Wrinkles, wrinkle_height

__all__ = [
    "PEOPLE",
    "SKIN_CHANNELS",
    "Appearance",
    "Eye",
    "EyeMaterial",
    "LookAssets",
    "PersonParameters",
    "Strands",
    "Surface",
    "Teeth",
    "Wrinkles",
    "eye_mesh",
    "find_person",
    "look_assets",
    "make_appearance",
    "person_face",
    "pose_eye",
    "pose_teeth",
    "strand_points",
    "wrinkle_height",
]
