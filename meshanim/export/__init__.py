"""Writers: glTF, USD, tables of weights, video, contact sheets (npz is `MeshSequence.save`)."""

from meshanim.export.blendshape_motion import BlendshapeMotion
from meshanim.export.gltf import GltfMaterial, write_blendshape_glb, write_glb
from meshanim.export.rig import write_rig
from meshanim.export.track import write_track
from meshanim.export.usd import write_usd
from meshanim.export.video import contact_sheet, write_png, write_video

__all__ = [
    "BlendshapeMotion",
    "GltfMaterial",
    "contact_sheet",
    "write_blendshape_glb",
    "write_glb",
    "write_png",
    "write_rig",
    "write_track",
    "write_usd",
    "write_video",
]
