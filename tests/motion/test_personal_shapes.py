"""ARKit's shapes for other faces, and rigs that read back what was written."""

import numpy as np
import pytest
import trimesh

from meshanim.errors import FileFormatError, OptionError
from meshanim.export import write_rig
from meshanim.geometry import TriangleMesh, decimate
from meshanim.heads import Rig, load_head, rig_head
from meshanim.motion.blendshape_solver import BlendshapeSolver
from meshanim.motion.personal_shapes import personal_shapes

SHAPES = ("jawOpen", "eyeBlinkLeft", "mouthSmileRight", "browInnerUp")


@pytest.fixture(scope="module")
def head():
    return load_head("default")


@pytest.fixture(scope="module")
def few(head):
    """The default head with four of its shapes."""
    rows = [head.expression_names.index(name) for name in SHAPES]
    deltas = head.expression_directions[rows].unflatten(1, (-1, 3)).numpy().astype(np.float64)
    return rig_head(Rig(head.mesh.vertices, head.mesh.faces, SHAPES, deltas, regions=head.regions))


def deltas_of(head):
    return head.expression_directions.unflatten(1, (-1, 3)).numpy()


def test_same_topology_at_another_size_turned(few):
    """Displacements and gradients of a larger, turned head are those of the head, larger and turned."""
    angle = 0.4
    turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    target = few.mesh.with_vertices(120 * few.mesh.vertices @ turn.T + [1, 2, 3])
    for method in ("displacement", "deformation_transfer"):
        rig = personal_shapes(few, target, method)
        assert rig.names == SHAPES
        np.testing.assert_allclose(rig.deltas, 120 * deltas_of(few) @ turn.T, atol=120 * 2e-5)
        np.testing.assert_array_equal(rig.neutral, target.vertices)
        np.testing.assert_array_equal(rig.regions["lips"], few.regions["lips"])
    with pytest.raises(OptionError, match="landmarks"):
        personal_shapes(few, target, landmarks=np.zeros((3, 2), np.int64))


def test_another_topology_of_another_person(head, few):
    """Shapes on a decimated other person are near those of the original, and drive the same motion."""
    coarse = decimate(head.mesh, 5000)
    person = head.template(head.person("ana")).numpy()[0].astype(np.float64)
    target = coarse.mesh.with_vertices(coarse.operator @ person)
    rig = personal_shapes(few, target)
    truth = np.stack([coarse.operator @ delta for delta in deltas_of(few).astype(np.float64)])
    for name, delta, true in zip(SHAPES, rig.deltas, truth):
        size = np.linalg.norm(true, axis=1)
        error = np.linalg.norm(delta - true, axis=1)
        assert np.sqrt((error**2).mean()) < 0.4 * np.sqrt((size**2).mean()), name
        assert (delta * true).sum() > 0.9 * (delta**2).sum() ** 0.5 * (true**2).sum() ** 0.5, name
    carried = rig_head(rig)
    assert len(carried.regions["lips"]) > 20
    mesh_lips = target.vertices[carried.regions["lips"]]
    lips = person[head.regions["lips"]]
    assert np.abs(mesh_lips.mean(0) - lips.mean(0)).max() < 0.004
    # The weights that drive the carried shapes are found again in the motion of the true ones.
    weights = np.random.default_rng(0).uniform(0, 1, (12, 4))
    frames = target.vertices + np.tensordot(weights, truth, 1)
    found = BlendshapeSolver.from_head(carried)(frames)
    assert np.abs(found - weights).mean() < 0.08


def test_parts_that_only_the_target_has_stay_still(few):
    """A ball below the head, such as a body, is not drawn along; landmarks say where the head is."""
    ball = trimesh.creation.icosphere(2, 0.3)
    mesh = few.mesh
    vertices = np.concatenate([mesh.vertices * 1.02, ball.vertices - [0, 1.0, 0]])
    faces = np.concatenate([mesh.faces, ball.faces + mesh.n_vertices])
    marks = np.repeat(few.regions["face"][::150, None], 2, axis=1)
    for method in ("displacement", "deformation_transfer"):
        rig = personal_shapes(few, TriangleMesh(vertices, faces), method, marks)
        jaw = np.linalg.norm(rig.deltas[0, : mesh.n_vertices], axis=1).max()
        assert 0.03 < jaw < 0.05
        np.testing.assert_allclose(rig.deltas[:, mesh.n_vertices :], 0, atol=1e-12)


def test_rigs_read_back(few, tmp_path):
    small = decimate(few.mesh, 900)
    deltas = np.stack([small.operator @ delta for delta in deltas_of(few).astype(np.float64)])
    regions = {"lips": np.arange(4)}
    rig = Rig(small.mesh.vertices, small.mesh.faces, SHAPES, deltas, regions=regions)
    for name in ("a.npz", "a.glb", "folder"):
        write_rig(tmp_path / name, rig)
        back = load_head(f"rig:{tmp_path / name}")
        assert set(back.expression_names) == set(SHAPES)
        rows = [back.expression_names.index(shape) for shape in SHAPES]
        np.testing.assert_allclose(back.mesh.vertices, rig.neutral, atol=1e-7)
        np.testing.assert_array_equal(back.mesh.faces, rig.faces)
        np.testing.assert_allclose(deltas_of(back)[rows], deltas, atol=2e-7)
    np.testing.assert_array_equal(load_head(f"rig:{tmp_path / 'a.npz'}").regions["lips"], regions["lips"])
    loaded = trimesh.load(tmp_path / "a.glb")
    assert len(next(iter(loaded.geometry.values())).faces) == len(rig.faces)
    with pytest.raises(OptionError, match=r"\.glb"):
        write_rig(tmp_path / "a.fbx", rig)
    with pytest.raises(OptionError, match="name of a file"):
        write_rig(tmp_path / "odd", Rig(rig.neutral, rig.faces, ("a/b",), deltas[:1]))
    with pytest.raises(FileFormatError, match="cannot make"):
        write_rig(tmp_path / "none" / "folder", rig)


def test_textured_rig_as_glb(head, few, tmp_path):
    textured = Rig(
        head.mesh.vertices,
        head.mesh.faces,
        SHAPES,
        deltas_of(few).astype(np.float64),
        head.mesh.uv,
        head.mesh.uv_faces,
    )
    write_rig(tmp_path / "a.glb", textured)
    back = load_head(f"rig:{tmp_path / 'a.glb'}")
    assert back.mesh.uv is not None
    corners = back.mesh.vertices[back.mesh.faces]
    np.testing.assert_allclose(corners, head.mesh.vertices[head.mesh.faces], atol=1e-7)
    np.testing.assert_allclose(back.mesh.uv[back.mesh.uv_faces], head.mesh.uv[head.mesh.uv_faces], atol=1e-6)


def test_bad_options_are_named(few, unchecked):
    with pytest.raises(OptionError, match="no method"):
        personal_shapes(few, few.mesh, "magic")
    bare = rig_head(Rig(few.mesh.vertices, few.mesh.faces, (), np.zeros((0, few.n_vertices, 3))))
    with pytest.raises(OptionError, match="no expressions"):
        personal_shapes(bare, few.mesh)
