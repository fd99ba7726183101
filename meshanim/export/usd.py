"""Blendshape animation as USD: a mesh with blend shapes, a skeleton for the head, a SkelAnimation."""

from pathlib import Path

import numpy as np

from meshanim.errors import DependencyError, OptionError, ShapeError
from meshanim.export.blendshape_motion import BlendshapeMotion, smooth_quaternions
from meshanim.files import written_whole

__all__ = ["USD_ENDINGS", "write_usd"]

USD_ENDINGS = (".usda", ".usdc", ".usd")
JOINTS = ("root", "root/neck")
ROOT, MESH, SKELETON = "/head", "/head/face", "/head/skeleton"
ANIMATION = f"{SKELETON}/speech"
STILL = 1e-9
"""Metres: a vertex that a shape moves less is not listed in it."""


def write_usd(path: str | Path, motion: BlendshapeMotion) -> None:
    """Write an animated face for Omniverse, Unreal, Maya, Houdini, Blender and usdview.

    Metres, y up; time code t is frame t, `timeCodesPerSecond` frames a second. The mesh is bound to two
    joints, of which root/neck turns with the head; shapes have offsets of the vertices that they move, and of
    their normals.

    Parameters
    ----------
    path : str or Path
        .usda (text), .usdc or .usd (binary), written whole.
    motion : BlendshapeMotion

    Raises
    ------
    DependencyError
        Without the extra `usd`.
    OptionError
        If the path ends otherwise, or a shape has a name that USD cannot hold.
    ShapeError
        If the motion has no frames.

    Notes
    -----
    Schemas: UsdSkel (openusd.org, Schemas In-Depth): SkelRoot, Skeleton, SkelAnimation, BlendShape.
    """
    try:
        from pxr import Gf, Sdf, Usd, UsdGeom, UsdSkel, Vt
    except ImportError as error:
        raise DependencyError("usd-core", "usd") from error
    path = Path(path)
    if path.suffix.lower() not in USD_ENDINGS:
        raise OptionError(f"USD is written as {', '.join(USD_ENDINGS)}, not {path}")
    if not len(motion.weights):
        raise ShapeError("a USD animation needs at least one frame")
    unfit = [name for name in motion.names if not Sdf.Path.IsValidIdentifier(name)]
    if unfit:
        raise OptionError(f"USD cannot hold shapes named {', '.join(unfit)}: letters, digits and _ only")

    def points(array: np.ndarray) -> Vt.Vec3fArray:
        return Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(array, np.float32))

    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetTimeCodesPerSecond(motion.fps)
    stage.SetFramesPerSecond(motion.fps)
    stage.SetStartTimeCode(0)
    stage.SetEndTimeCode(len(motion.weights) - 1)
    root = UsdSkel.Root.Define(stage, ROOT)
    stage.SetDefaultPrim(root.GetPrim())

    mesh = motion.mesh
    face = UsdGeom.Mesh.Define(stage, MESH)
    face.CreatePointsAttr(points(mesh.vertices))
    face.CreateFaceVertexCountsAttr(Vt.IntArray([3] * mesh.n_faces))
    face.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(mesh.faces.astype(np.int32).reshape(-1)))
    face.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    normals = mesh.vertex_normals
    face.CreateNormalsAttr(points(normals))
    face.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    face.CreateDisplayColorAttr([Gf.Vec3f(0.8, 0.8, 0.8)])
    low, high = _bounds(motion)
    face.CreateExtentAttr(points(np.stack([low, high])))
    if mesh.uv is not None:
        corners = mesh.faces if mesh.uv_faces is None else mesh.uv_faces
        st = UsdGeom.PrimvarsAPI(face).CreatePrimvar(
            "st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.faceVarying
        )
        st.Set(Vt.Vec2fArray.FromNumpy(mesh.uv.astype(np.float32)))
        st.SetIndices(Vt.IntArray.FromNumpy(corners.astype(np.int32).reshape(-1)))

    pivot = Gf.Vec3d(*(float(x) for x in motion.pivot))
    still, neck = Gf.Matrix4d(1), Gf.Matrix4d(1).SetTranslate(pivot)
    skeleton = UsdSkel.Skeleton.Define(stage, SKELETON)
    skeleton.CreateJointsAttr(JOINTS)
    skeleton.CreateBindTransformsAttr([still, neck])
    skeleton.CreateRestTransformsAttr([still, neck])
    animation = UsdSkel.Animation.Define(stage, ANIMATION)
    animation.CreateJointsAttr(JOINTS)
    animation.CreateTranslationsAttr([Gf.Vec3f(0), Gf.Vec3f(pivot)])
    animation.CreateScalesAttr([Gf.Vec3h(1), Gf.Vec3h(1)])
    animation.CreateBlendShapesAttr(motion.names)
    rotations, weights = animation.CreateRotationsAttr(), animation.CreateBlendShapeWeightsAttr()
    for frame, (x, y, z, w) in enumerate(smooth_quaternions(motion.pose).tolist()):
        rotations.Set([Gf.Quatf(1), Gf.Quatf(w, x, y, z)], frame)
        weights.Set(Vt.FloatArray.FromNumpy(np.ascontiguousarray(motion.weights[frame], np.float32)), frame)

    binding = UsdSkel.BindingAPI.Apply(face.GetPrim())
    binding.CreateSkeletonRel().SetTargets([SKELETON])
    follow = np.asarray(motion.follow, np.float32)
    indices = np.tile(np.array([0, 1], np.int32), mesh.n_vertices)
    shares = np.stack([1 - follow, follow], 1).reshape(-1)
    binding.CreateJointIndicesPrimvar(False, 2).Set(Vt.IntArray.FromNumpy(indices))
    binding.CreateJointWeightsPrimvar(False, 2).Set(Vt.FloatArray.FromNumpy(shares))
    binding.CreateGeomBindTransformAttr(still)
    binding.CreateBlendShapesAttr(motion.names)
    targets = binding.CreateBlendShapeTargetsRel()
    for name, delta in zip(motion.names, motion.deltas):
        shape = UsdSkel.BlendShape.Define(stage, f"{MESH}/{name}")
        turned = mesh.with_vertices(mesh.vertices + delta).vertex_normals - normals
        moved = (np.abs(delta).max(1) > STILL) | (np.abs(turned).max(1) > STILL)
        rows = np.flatnonzero(moved).astype(np.int32)
        shape.CreatePointIndicesAttr(Vt.IntArray.FromNumpy(rows))
        shape.CreateOffsetsAttr(points(delta[rows]))
        shape.CreateNormalOffsetsAttr(points(turned[rows]))
        targets.AddTarget(shape.GetPath())
    UsdSkel.BindingAPI.Apply(skeleton.GetPrim()).CreateAnimationSourceRel().SetTargets([ANIMATION])
    with written_whole(path) as temporary:
        if not stage.GetRootLayer().Export(str(temporary)):
            raise OptionError(f"USD could not write {path}")


def _bounds(motion: BlendshapeMotion) -> tuple[np.ndarray, np.ndarray]:
    """A box that the face stays in, the head not turned."""
    low, high = motion.mesh.vertices.copy(), motion.mesh.vertices.copy()
    least, most = motion.weights.min(0), motion.weights.max(0)
    for delta, small, large in zip(motion.deltas, least, most):
        low += np.minimum(delta * small, delta * large)
        high += np.maximum(delta * small, delta * large)
    return low.min(0), high.max(0)
