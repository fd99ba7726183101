import pickle

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from meshanim.errors import FileFormatError, OptionError, ShapeError
from meshanim.heads import REGION_NAMES, HeadParameters, load_flame, load_head


@pytest.fixture(scope="module")
def head(flame_folder):
    return load_flame(flame_folder / "generic_model.pkl")


def evaluated(content, shape, expression, pose, translation):
    """FLAME in float64 by 4 x 4 matrices, straight from the file's arrays (smplx's order of operations)."""
    directions = content["shapedirs"]
    vertices = content["v_template"] + directions[:, :, :300] @ shape + directions[:, :, 300:] @ expression
    joints = content["J_regressor"] @ vertices
    matrices = Rotation.from_rotvec(pose.reshape(5, 3)).as_matrix()
    feature = (matrices[1:] - np.eye(3)).reshape(-1)
    vertices = vertices + content["posedirs"].reshape(-1, 36).dot(feature).reshape(-1, 3)
    world = []
    for joint, parent in enumerate([-1, 0, 1, 1, 1]):
        local = np.eye(4)
        local[:3, :3] = matrices[joint]
        local[:3, 3] = joints[joint] - (joints[parent] if parent >= 0 else 0)
        world.append(local if parent < 0 else world[parent] @ local)
    for joint, matrix in enumerate(world):
        matrix[:3, 3] -= matrix[:3, :3] @ joints[joint]
    blended = np.einsum("vj,jab->vab", content["weights"], np.stack(world))
    homogeneous = np.concatenate([vertices, np.ones((len(vertices), 1))], axis=1)
    return np.einsum("vab,vb->va", blended, homogeneous)[:, :3] + translation


def random_parameters(seed, batch=2):
    generator = torch.Generator().manual_seed(seed)
    sizes = {"shape": 300, "expression": 100, "rotation": 3, "neck": 3, "jaw": 3, "eyes": 6, "translation": 3}
    return {
        name: torch.randn(batch, size, generator=generator) * (1.0 if size >= 100 else 0.5)
        for name, size in sizes.items()
    }


def test_against_float64_skinning(head, flame_content):
    given = random_parameters(0)
    out = head(HeadParameters(**given)).double().numpy()
    for row in range(2):
        values = {name: value[row].double().numpy() for name, value in given.items()}
        pose = np.concatenate([values[name] for name in ("rotation", "neck", "jaw", "eyes")])
        expected = evaluated(
            flame_content, values["shape"], values["expression"], pose, values["translation"]
        )
        np.testing.assert_allclose(out[row], expected, atol=3e-6)


def test_rest_is_the_template(head, flame_content):
    np.testing.assert_allclose(head()[0], flame_content["v_template"], atol=1e-7)
    assert head.n_vertices == 5023
    assert head.mesh.n_faces == 9976
    assert (len(head.shape_names), len(head.expression_names)) == (300, 100)


def test_fewer_coefficients_are_the_first_ones(head):
    given = random_parameters(1)
    short = HeadParameters(shape=given["shape"][:, :100], expression=given["expression"][:, :50])
    padded = HeadParameters(
        shape=torch.cat([given["shape"][:, :100], torch.zeros(2, 200)], 1),
        expression=torch.cat([given["expression"][:, :50], torch.zeros(2, 50)], 1),
    )
    torch.testing.assert_close(head(short), head(padded), atol=1e-6, rtol=0)


def test_gradients_reach_every_parameter(head):
    given = {name: value.requires_grad_() for name, value in random_parameters(2).items()}
    head(HeadParameters(**given)).square().sum().backward()
    assert all(value.grad is not None and value.grad.abs().max() > 0 for value in given.values())


def test_regions_come_from_the_masks(head, flame_folder):
    with (flame_folder / "FLAME_masks.pkl").open("rb") as stream:
        masks = pickle.load(stream)
    assert list(head.regions) == list(REGION_NAMES)
    np.testing.assert_array_equal(head.regions["lips"], np.sort(masks["lips"]))
    assert set(head.regions["upper_face"]) == set(masks["forehead"]) | set(masks["eye_region"])
    np.testing.assert_array_equal(head.regions["eyes"], np.arange(3931, 5023))
    assert set(head.masks) == set(masks)


def test_regions_without_masks_say_so(flame_folder, tmp_path):
    (tmp_path / "generic_model.pkl").symlink_to(flame_folder / "generic_model.pkl")
    with pytest.warns(UserWarning, match="default head"):
        head = load_head(f"flame:{tmp_path / 'generic_model.pkl'}")
    assert list(head.regions) == list(REGION_NAMES)
    with pytest.raises(OptionError, match=r"landmark_embedding\.npy"):
        head.landmarks(head())


@pytest.mark.parametrize(("kind", "counts"), [("teeth", (5143, 10144)), ("split_teeth", (5431, 10648))])
def test_teeth(flame_folder, head, kind, counts):
    toothed = load_head(f"flame+{kind}:{flame_folder / 'generic_model.pkl'}")
    assert (toothed.n_vertices, toothed.mesh.n_faces) == counts
    np.testing.assert_array_equal(toothed.regions["teeth"], np.arange(5023, counts[0]))
    np.testing.assert_array_equal(toothed.mesh.faces[:9976], head.mesh.faces)
    params = HeadParameters(**random_parameters(3))
    torch.testing.assert_close(toothed(params)[:, :5023], head(params), atol=1e-6, rtol=0)
    torch.testing.assert_close(toothed.weights.sum(1), torch.ones(counts[0]))
    lower = toothed.weights[5023:, 2] == 1
    assert lower.sum() == {"teeth": 60, "split_teeth": 60 + 145}[kind]
    jaw = HeadParameters(jaw=torch.tensor([[0.3, 0, 0]]))
    moved = (toothed(jaw) - toothed())[0, 5023:].norm(dim=1)
    assert moved[~lower].max() < 1e-7
    assert moved[lower].min() > 1e-4
    smile = HeadParameters(expression=torch.ones(1, 100))
    torch.testing.assert_close(toothed(smile)[0, 5023:], toothed()[0, 5023:], atol=1e-7, rtol=0)


def test_the_shared_layout_of_the_teeth(flame_folder):
    faces = load_flame(flame_folder / "generic_model.pkl", "plain").mesh.faces[9976:] - 5023
    # Corner order as in the data that GaussianAvatars shares; first, middle and last of some strips.
    for row, triangle in ((0, [0, 31, 30]), (14, [7, 8, 37]), (28, [60, 75, 76]), (83, [88, 44, 89])):
        assert faces[row].tolist() == triangle
    for row, triangle in ((84, [45, 46, 15]), (133, [101, 116, 114]), (167, [118, 119, 59])):
        assert faces[row].tolist() == triangle
    edges = np.unique(np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0)
    assert len(edges) == 5431 - 5143


def test_split_teeth_lie_on_the_plain_ones(flame_folder):
    plain, split = (load_flame(flame_folder / "generic_model.pkl", teeth) for teeth in ("plain", "split"))
    params = HeadParameters(shape=random_parameters(4)["shape"])
    coarse, fine = plain(params)[0], split(params)[0]
    torch.testing.assert_close(fine[:5143], coarse, atol=1e-6, rtol=0)
    faces = plain.mesh.faces[9976:]
    edges = np.unique(np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0)
    middles = coarse[torch.from_numpy(edges)].mean(1)
    distance = torch.cdist(fine[5143:].double(), middles.double()).min(1).values
    assert distance.max() < 1e-6


def test_offsets_shared_for_other_teeth(flame_folder, head):
    """5,023 rows are FLAME's, then come teeth: missing ones stay, split ones take means, spare ones go."""
    plain, split = (load_flame(flame_folder / "generic_model.pkl", teeth) for teeth in ("plain", "split"))
    offset = torch.randn((5143, 3), generator=torch.Generator().manual_seed(0)) * 1e-2
    for count in (5023, 5083, 5143):
        moved = plain.with_offset(offset[:count]).template_vertices - plain.template_vertices
        torch.testing.assert_close(moved[:count], offset[:count], atol=1e-6, rtol=0)
        assert not moved[count:].any()
        bare = head.with_offset(offset[:count])
        torch.testing.assert_close(bare.template_vertices, head.with_offset(offset[:5023]).template_vertices)
    fine = split.with_offset(offset)
    torch.testing.assert_close(fine.template_vertices[:5143], plain.with_offset(offset).template_vertices)
    torch.testing.assert_close(fine.rest_joints, plain.with_offset(offset).rest_joints)
    coarse, faces = plain.with_offset(offset).template_vertices, plain.mesh.faces[9976:]
    edges = np.unique(np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0)
    middles = coarse[torch.from_numpy(edges)].mean(1)
    distance = torch.cdist(fine.template_vertices[5143:].double(), middles.double()).min(1).values
    assert distance.max() < 1e-6
    with pytest.raises(ShapeError, match="offset must be"):
        plain.with_offset(offset[:5000])


def test_landmarks(head, flame_folder):
    embedding = np.load(flame_folder / "landmark_embedding.npy", allow_pickle=True).item()
    params = HeadParameters(**random_parameters(5))
    vertices = head(params)
    faces = head.mesh.faces

    def points(face, weights):
        corners = vertices[0].double().numpy()[faces[np.asarray(face)]]
        return (corners * np.asarray(weights)[..., None]).sum(-2)

    static = points(embedding["static_lmk_faces_idx"], embedding["static_lmk_bary_coords"])
    np.testing.assert_allclose(head.landmarks(vertices, "static")[0], static, atol=1e-6)
    full = points(embedding["full_lmk_faces_idx"][0], embedding["full_lmk_bary_coords"][0])
    np.testing.assert_allclose(head.landmarks(vertices, "full")[0], full, atol=1e-6)
    for degrees, row in ((0, 0), (17.2, 17), (-17.2, 39 + 17), (80, 39), (-80, 78)):
        # smplx reads the yaw with its sign turned.
        turn = HeadParameters(neck=torch.tensor([[0.0, -np.radians(degrees), 0.0]]).float())
        vertices = head(turn)
        contour = points(embedding["dynamic_lmk_faces_idx"][row], embedding["dynamic_lmk_bary_coords"][row])
        dynamic = head.landmarks(vertices, "dynamic", turn)[0]
        assert dynamic.shape == (68, 3)
        np.testing.assert_allclose(dynamic[:17], contour, atol=1e-6)
    with pytest.raises(OptionError, match="params"):
        head.landmarks(vertices, "dynamic")
    with pytest.raises(OptionError, match="eyebrows"):
        head.landmarks(vertices, "eyebrows")


def test_npz_and_plain_pickles_are_the_same_head(head, flame_content, flame_folder, tmp_path):
    content = {name: value for name, value in flame_content.items() if not isinstance(value, str)}
    (tmp_path / "flame2023.pkl").write_bytes(pickle.dumps(content, protocol=4))
    dense = {**content, "J_regressor": content["J_regressor"].toarray()}
    np.savez(tmp_path / "flame.npz", **dense)
    (tmp_path / "FLAME_masks.pkl").symlink_to(flame_folder / "FLAME_masks.pkl")
    params = HeadParameters(**random_parameters(6))
    for name in ("flame2023.pkl", "flame.npz"):
        torch.testing.assert_close(load_flame(tmp_path / name)(params), head(params))


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("v_template", lambda value: value[:-1], r"5022"),
        ("f", lambda value: value[:-1], r"9975"),
        ("f", lambda value: value + 4000, "names vertex"),
        ("shapedirs", lambda value: value[:, :, :150], "150"),
        ("weights", lambda value: np.full_like(value, np.nan), "NaN"),
        ("kintree_table", lambda value: value[:, ::-1], "parents"),
        ("posedirs", None, "lacks posedirs"),
    ],
)
def test_other_topologies_are_refused(flame_content, tmp_path, name, change, message):
    content = {key: value for key, value in flame_content.items() if not isinstance(value, str)}
    content["J_regressor"] = content["J_regressor"].toarray()
    content["shapedirs"] = np.zeros((5023, 3, 400), np.float16)
    if change is None:
        del content[name]
    else:
        content[name] = change(content[name])
    np.savez(tmp_path / "other.npz", **content)
    with pytest.raises(FileFormatError, match=message):
        load_flame(tmp_path / "other.npz")


def test_files_that_are_no_models(flame_folder, tmp_path):
    cut = tmp_path / "generic_model.pkl"
    cut.write_bytes((flame_folder / "generic_model.pkl").read_bytes()[:1_000_000])
    with pytest.raises(FileFormatError, match="whole pickle"):
        load_flame(cut)
    cut.write_bytes(pickle.dumps([1, 2]))
    with pytest.raises(FileFormatError, match="dictionary"):
        load_flame(cut)
    with pytest.raises(FileFormatError, match="does not exist"):
        load_head("flame:/nowhere/generic_model.pkl")
    (tmp_path / "text.npz").write_text("text")
    with pytest.raises(FileFormatError, match="npz"):
        load_flame(tmp_path / "text.npz")
    with pytest.raises(OptionError, match="teeth"):
        load_flame(cut, "gold")


def write_template(path, vertices, faces, uv, uv_faces):
    lines = [f"v {x:.9f} {y:.9f} {z:.9f}" for x, y, z in vertices]
    lines += [f"vt {u:.9f} {v:.9f}" for u, v in uv]
    for corners, coordinates in zip(faces + 1, uv_faces + 1):
        lines.append("f " + " ".join(f"{a}/{b}" for a, b in zip(corners, coordinates)))
    path.write_text("\n".join(lines) + "\n")


@pytest.fixture
def textured(flame_content, flame_folder, tmp_path):
    """The made model with a template beside it whose texture has a seam: 5,118 coordinates."""
    (tmp_path / "generic_model.pkl").write_bytes((flame_folder / "generic_model.pkl").read_bytes())
    (tmp_path / "FLAME_masks.pkl").write_bytes((flame_folder / "FLAME_masks.pkl").read_bytes())
    faces = flame_content["f"].astype(np.int64)
    uv = np.random.default_rng(5).uniform(0, 1, (5118, 2))
    uv_faces = faces.copy()
    twice = np.unique(faces)[:95]
    for new, vertex in enumerate(twice, start=5023):  # one of the vertex's triangles lies beyond the seam
        face = np.flatnonzero((faces == vertex).any(1))[0]
        uv_faces[face][faces[face] == vertex] = new
    return tmp_path, flame_content["v_template"] + 0.001, faces, uv, uv_faces


@pytest.mark.parametrize(
    ("name", "teeth", "n_faces"),
    [("head_template_mesh.obj", "none", 9976), ("head_template.obj", "split", 10648)],
)
def test_texture_coordinates_of_the_template(textured, name, teeth, n_faces):
    folder, vertices, faces, uv, uv_faces = textured
    write_template(folder / name, vertices, faces, uv, uv_faces)
    mesh = load_flame(folder / "generic_model.pkl", teeth).mesh
    assert mesh.uv_faces.shape == (n_faces, 3)
    assert np.allclose(mesh.uv[mesh.uv_faces[:9976]], uv[uv_faces], atol=1e-8)
    assert np.array_equal(mesh.faces[:9976], faces)
    assert (mesh.uv[mesh.uv_faces[9976:]] == 0).all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda v, f, uv, t: (v, f[::-1], uv, t[::-1]), "same order"),
        (lambda v, f, uv, t: (v, np.roll(f, 1, axis=1), uv, t), "same order"),
        (lambda v, f, uv, t: (v, f[:-1], uv, t[:-1]), "9975 triangles"),
    ],
)
def test_templates_of_other_meshes_are_refused(textured, change, message):
    folder, *template = textured
    write_template(folder / "head_template_mesh.obj", *change(*template))
    with pytest.raises(FileFormatError, match=message):
        load_flame(folder / "generic_model.pkl")


def test_templates_without_texture_are_refused(textured):
    folder, vertices, faces, _, _ = textured
    lines = [f"v {x} {y} {z}" for x, y, z in vertices] + [f"f {a} {b} {c}" for a, b, c in faces + 1]
    (folder / "head_template.obj").write_text("\n".join(lines))
    with pytest.raises(FileFormatError, match="no texture coordinates"):
        load_flame(folder / "generic_model.pkl")
