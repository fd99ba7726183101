"""Writers: glTF, video, contact sheets (npz is `MeshSequence.save`)."""

from meshanim.export.gltf import GltfMaterial, write_glb
from meshanim.export.rig import write_rig
from meshanim.export.video import contact_sheet, write_png, write_video

__all__ = ["GltfMaterial", "contact_sheet", "write_glb", "write_png", "write_rig", "write_video"]
