"""glTF and USD with named shapes, read again by trimesh, by the letter of glTF, and by Pixar's library."""

import sys

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from meshanim.cli import main
from meshanim.errors import DependencyError, OptionError, ShapeError
from meshanim.export import BlendshapeMotion, write_track, write_usd
from meshanim.heads import Rig, load_head, read_rig, rig_head
from meshanim.motion import MeshSequence
from meshanim.motion.blendshape_track import BlendshapeTrack
from tests.export.test_gltf import play, read_glb

pytest.importorskip("pxr", reason="needs the extra usd")

from pxr import Usd, UsdGeom, UsdSkel


@pytest.fixture(scope="module")
def head():
    """A ball with three shapes, of which one moves a few vertices only, and texture coordinates."""
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.1)
    rng = np.random.default_rng(0)
    deltas = rng.normal(0, 0.005, (3, *ball.vertices.shape))
    deltas[1, 20:] = 0
    faces = np.asarray(ball.faces, np.int64)
    vertices = np.asarray(ball.vertices, np.float64)
    uv = vertices[:, :2] * 5 + 0.5
    return rig_head(Rig(vertices, faces, ("jawOpen", "mouthClose", "smile_Left"), deltas, uv, faces))


def track(frames=9, seed=1):
    rng = np.random.default_rng(seed)
    pose = rng.normal(0, 0.4, (frames, 3)).astype(np.float32)
    return BlendshapeTrack(("SmileLeft", "jawOpen", "smile_Left"), _still(rng, frames), 25.0, pose)


def _still(rng, frames):
    weights = rng.uniform(0, 1, (frames, 3))
    weights[:, 0] = 0  # a shape that the head lacks, at rest
    return weights


def played_usd(path):
    """Vertices of every frame as UsdSkel's own library computes them, its stage and names of shapes."""
    stage = Usd.Stage.Open(str(path))
    root = UsdSkel.Root(stage.GetDefaultPrim())
    cache = UsdSkel.Cache()
    cache.Populate(root, Usd.PrimDefaultPredicate)
    (binding,) = cache.ComputeSkelBindings(root, Usd.PrimDefaultPredicate)
    skeleton = cache.GetSkelQuery(binding.GetSkeleton())
    (target,) = binding.GetSkinningTargets()
    mesh = UsdGeom.Mesh(target.GetPrim())
    shapes = UsdSkel.BlendShapeQuery(UsdSkel.BindingAPI(target.GetPrim()))
    animation = skeleton.GetAnimQuery()
    frames = []
    for time in range(round(stage.GetEndTimeCode()) + 1):
        points = mesh.GetPointsAttr().Get()
        weights = target.GetBlendShapeMapper().Remap(animation.ComputeBlendShapeWeights(time))
        values, indices, sub_shapes = shapes.ComputeSubShapeWeights(weights)
        assert shapes.ComputeDeformedPoints(
            values,
            indices,
            sub_shapes,
            shapes.ComputeBlendShapePointIndices(),
            shapes.ComputeSubShapePointOffsets(),
            points,
        )
        assert target.ComputeSkinnedPoints(skeleton.ComputeSkinningTransforms(time), points, time)
        frames.append(np.array(points))
    return np.stack(frames), stage, list(animation.GetBlendShapeOrder())


@pytest.mark.parametrize("ending", ["usda", "usdc", "usd"])
def test_usd_gives_our_vertices(tmp_path, head, ending):
    sequence = track().animate(head)
    path = tmp_path / f"talk.{ending}"
    write_track(path, track(), head)
    frames, stage, names = played_usd(path)
    np.testing.assert_allclose(frames, sequence.posed(head), atol=1e-6)
    assert names == ["jawOpen", "mouthClose", "smile_Left"]
    assert stage.GetTimeCodesPerSecond() == 25
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1
    assert UsdGeom.GetStageUpAxis(stage) == "Y"
    face = UsdGeom.Mesh(stage.GetPrimAtPath("/head/face"))
    np.testing.assert_array_equal(
        np.array(face.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3), head.mesh.faces
    )
    few = UsdSkel.BlendShape(stage.GetPrimAtPath("/head/face/mouthClose"))
    touched = np.isin(head.mesh.faces, np.arange(20)).any(1)  # normals of neighbours turn as well
    assert set(np.array(few.GetPointIndicesAttr().Get())) == set(np.unique(head.mesh.faces[touched]))
    uv = UsdGeom.PrimvarsAPI(face).GetPrimvar("st").ComputeFlattened()
    np.testing.assert_allclose(np.array(uv).reshape(-1, 3, 2), head.mesh.uv[head.mesh.uv_faces], atol=1e-6)
    assert path.read_bytes()[:8] in (b"#usda 1.", b"PXR-USDC")
    low, high = np.array(face.GetExtentAttr().Get())
    assert (sequence.vertices >= low - 1e-6).all()
    assert (sequence.vertices <= high + 1e-6).all()


def test_glb_gives_our_vertices_and_names(tmp_path, head):
    sequence = track().animate(head)
    path = tmp_path / "talk.glb"
    write_track(path, track(), head)
    gltf, array = read_glb(path)
    assert gltf["meshes"][0]["extras"]["targetNames"] == ["jawOpen", "mouthClose", "smile_Left"]
    posed = sequence.posed(head)
    for frame in range(len(sequence)):
        np.testing.assert_allclose(play(gltf, array, frame), posed[frame][head.mesh.faces], atol=1e-6)
    scene = trimesh.load(path)
    assert sum(len(part.faces) for part in scene.geometry.values()) == head.mesh.n_faces
    rig = read_rig(path)
    assert rig.names == head.expression_names


def test_the_default_head_in_usd_and_glb(tmp_path):
    """53 shapes on a person's face: what both files play is what the weights make, in millimetres."""
    head = load_head("default")
    rng = np.random.default_rng(3)
    weights = rng.uniform(0, 0.6, (3, 53))
    shape = head.person("ana")
    neutral, pivot = head.template(shape)[0].numpy(), head.joints(shape)[0, 1].numpy()
    given = BlendshapeTrack(
        head.expression_names, weights, 30.0, rng.normal(0, 0.2, (3, 3)).astype(np.float32)
    )
    posed = given.animate(head, neutral).posed(head, shape)
    write_track(tmp_path / "a.usdc", given, head, neutral, pivot)
    frames, _, names = played_usd(tmp_path / "a.usdc")
    assert names == list(head.expression_names)
    np.testing.assert_allclose(frames, posed, atol=2e-6)
    write_track(tmp_path / "a.glb", given, head, neutral, pivot)
    gltf, array = read_glb(tmp_path / "a.glb")
    np.testing.assert_allclose(play(gltf, array, 2), posed[2][head.mesh.faces], atol=2e-6)


def test_what_does_not_fit(tmp_path, head):
    motion = BlendshapeMotion.of(track(), head)
    with pytest.raises(OptionError, match=r"\.usda"):
        write_usd(tmp_path / "a.txt", motion)
    with pytest.raises(OptionError, match=r"\.csv"):
        write_track(tmp_path / "a.fbx", track(), head)
    empty = BlendshapeTrack(("jawOpen",), np.zeros((0, 1)), 25.0)
    for ending in ("usda", "glb"):
        with pytest.raises(ShapeError, match="at least one frame"):
            write_track(tmp_path / f"a.{ending}", empty, head)
    with pytest.raises(OptionError, match="no shape named grin"):
        write_track(tmp_path / "a.usda", BlendshapeTrack(("grin",), np.ones((2, 1)), 25.0), head)
    spoken = Rig(head.mesh.vertices, head.mesh.faces, ("say ah",), np.zeros((1, head.n_vertices, 3)))
    with pytest.raises(OptionError, match="say ah"):
        write_usd(
            tmp_path / "a.usda",
            BlendshapeMotion.of(BlendshapeTrack((), np.zeros((2, 0)), 25.0), rig_head(spoken)),
        )
    with pytest.raises(ShapeError, match="neutral"):
        BlendshapeMotion.of(track(), head, np.zeros((3, 3)))
    assert list(tmp_path.iterdir()) == []


def test_without_usd_the_extra_is_named(tmp_path, head, monkeypatch):
    monkeypatch.setitem(sys.modules, "pxr", None)
    with pytest.raises(DependencyError, match=r"meshanim\[usd\]"):
        write_track(tmp_path / "a.usda", track(), head)


@pytest.mark.parametrize("ending", ["csv", "usdc", "glb"])
def test_solve_writes_every_form(tmp_path, ending, capsys):
    head = load_head("default")
    weights = np.stack([np.linspace(0, 0.6, 6), np.full(6, 0.4)], 1)
    given = BlendshapeTrack(("jawOpen", "mouthSmileLeft"), weights, 25.0, np.full((6, 3), 0.1, np.float32))
    given.animate(head).save(tmp_path / "talk.npz")
    words = ["solve", tmp_path / "talk.npz", "-o", tmp_path / f"w.{ending}", "--csv", "livelink"]
    assert main([str(word) for word in [*words, "--replay", tmp_path / "back.npz"]]) == 0
    capsys.readouterr()
    replay = MeshSequence.load(tmp_path / "back.npz")
    posed = replay.posed(head)
    if ending == "csv":
        back = BlendshapeTrack.load(tmp_path / "w.csv")
        np.testing.assert_allclose(back.animate(head).posed(head), posed, atol=1e-5)
        np.testing.assert_allclose(back.weights[:, back.names.index("jawOpen")], weights[:, 0], atol=0.03)
    elif ending == "usdc":
        np.testing.assert_allclose(played_usd(tmp_path / "w.usdc")[0], posed, atol=1e-5)
    else:
        gltf, array = read_glb(tmp_path / "w.glb")
        np.testing.assert_allclose(play(gltf, array, 5), posed[5][head.mesh.faces], atol=1e-5)
        assert Rotation.from_quat(array(gltf["animations"][0]["samplers"][0]["output"])[0]).magnitude() > 0.1
