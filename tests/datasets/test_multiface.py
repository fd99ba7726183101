"""Multiface on a small tree with its names, types and byte order, and on damaged copies of it."""

import shutil

import numpy as np
import pytest
import roma
import torch
from made_files import write_sound

from meshanim.datasets import open_dataset
from meshanim.datasets.multiface import MultifaceDataset, MultifaceOptions
from meshanim.datasets.multiface_cameras import read_krt
from meshanim.datasets.multiface_names import ENTITIES, SENTENCES
from meshanim.errors import FileFormatError, OptionError

FULL, REDUCED = 7306, 6172
FIRST, UNSEEN = "m--20180105--0000--002539136--GHS", "m--20180227--0000--6795937--GHS"  # people 2 and 4
SPOKEN = "SEN_a_good_morrow_to_you_my_boy"  # sentence 8
LAST = "SEN_youre_boiling_milk_aint_you"  # sentence 50
DROPPED = np.sort(np.random.default_rng(3).permutation(FULL)[: FULL - REDUCED])


def obj_text(vertices, faces):
    """As Multiface writes it: its own texture coordinates and a v/vt pair a corner."""
    lines = [f"v {x:.7e} {y:.7e} {z:.7e}" for x, y, z in vertices]
    lines += [f"vt {index / len(faces):.6f} {0.5:.6f}" for index in range(len(faces))]
    lines += ["f " + " ".join(f"{a + 1}/{index + 1}" for a in face) for index, face in enumerate(faces)]
    return "\n".join(lines) + "\n"


def some_faces(count):
    first = np.arange(0, count - 2, 7)
    return np.stack([first, first + 1, first + 2], axis=1)


def millimetres(seed):
    return np.random.default_rng(seed).uniform(-150, 150, (FULL, 3)).astype("<f4")


def transform(seed):
    generator = np.random.default_rng(seed)
    turn = roma.rotvec_to_rotmat(torch.from_numpy(generator.uniform(-0.5, 0.5, 3))).numpy()
    return np.concatenate([turn, generator.uniform(-100, 900, (3, 1))], axis=1)


def write_segment(person, segment, numbers, seed):
    folder = person / "tracked_mesh" / segment
    folder.mkdir(parents=True)
    for offset, number in enumerate(numbers):
        vertices = millimetres(seed + offset)
        vertices.tofile(folder / f"{number:06d}.bin")
        np.savetxt(folder / f"{number:06d}_transform.txt", transform(seed + offset))
        if offset == 0:
            (folder / f"{number:06d}.obj").write_text(obj_text(vertices, some_faces(FULL)))


KRT = """400002
7489.9 0.0 667.5
0.0 7490.1 1024.5
0.0 0.0 1.0
0.01 0.02 0.0 0.0 0.0
1.0 0.0 0.0 100.0
0.0 0.0 -1.0 -20.0
0.0 1.0 0.0 1000.0

400004
7000.0 0.0 600.0
0.0 7000.0 1000.0
0.0 0.0 1.0
0.0 0.0 0.0 0.0 0.0
1.0 0.0 0.0 0.0
0.0 1.0 0.0 0.0
0.0 0.0 1.0 900.0

"""


@pytest.fixture(scope="module")
def tree(tmp_path_factory):
    root = tmp_path_factory.mktemp("multiface")
    frames = {
        "E001_Neutral_Eyes_Open": range(102, 106, 3),
        SPOKEN: range(1000, 1006),
        LAST: range(2000, 2003),
    }
    for order, person in enumerate((root / UNSEEN, root / FIRST)):
        lines = []
        for seed, (segment, numbers) in enumerate(frames.items()):
            write_segment(person, segment, numbers, 100 * order + 10 * seed)
            lines += [f"{segment} {number:06d}" for number in numbers]
            if segment.startswith("SEN_"):
                write_sound(person / "audio" / f"{segment}.wav", len(numbers) / 30, 48000, 10 * order + seed)
        (person / "frame_list.txt").write_text("\n".join(lines) + "\n")
        (person / "KRT").write_text(KRT)
        millimetres(99).tofile(person / "vert_mean.bin")
    return root


@pytest.fixture
def copy(tree, tmp_path):
    return shutil.copytree(tree, tmp_path / "copy")


def test_what_is_read_are_the_files(tree):
    dataset = open_dataset(tree)
    assert isinstance(dataset, MultifaceDataset)
    assert (dataset.fps, dataset.unit) == (30, "m")
    assert list(dataset.subjects) == ["002539136", "6795937"]  # in the published order, not of the disk
    assert dataset.mesh.n_vertices == FULL
    np.testing.assert_array_equal(dataset.mesh.faces, some_faces(FULL))
    assert dataset.mesh.uv_faces is not None
    name = f"002539136_{SPOKEN}"
    info = dataset.info(name)
    assert (info.sentence, info.frames, info.text) == (8, 6, "a good morrow to you my boy")
    sequence = dataset[name]
    assert sequence.vertices.dtype == np.float32
    np.testing.assert_allclose(sequence.vertices[3], millimetres(100 + 10 + 3) / 1000, rtol=1e-6)
    given = transform(113)
    rotation = roma.rotvec_to_rotmat(torch.from_numpy(sequence.pose[3])).numpy()
    np.testing.assert_allclose(rotation, given[:, :3], atol=1e-6)
    np.testing.assert_allclose(sequence.coefficients["translation"][3], given[:, 3] / 1000, rtol=1e-5)
    assert list(sequence.coefficients["frame_number"]) == list(range(1000, 1006))
    assert sequence.audio.rate == 48000
    neutral = dataset.subjects["6795937"]
    np.testing.assert_allclose(neutral.template, millimetres(0) / 1000, rtol=1e-6)
    assert neutral.attributes["template"] == "tracked_mesh/E001_Neutral_Eyes_Open/000102.bin"
    assert dataset.check() == []


def test_splits_are_those_of_facediffuser(tree):
    splits = open_dataset(tree).splits
    assert splits == {
        "train": (f"002539136_{SPOKEN}",),
        "val": (),
        "test": (f"002539136_{LAST}",),
        "test_unseen": (f"6795937_{LAST}",),
        "spare": (f"6795937_{SPOKEN}",),
    }
    assert len(ENTITIES) == 13
    assert len(set(SENTENCES)) == 50
    # FaceDiffuser numbers the sentences in the order of their names, "_" behind every letter.
    assert list(SENTENCES) == sorted(SENTENCES, key=lambda name: name[4:].replace("_", "~"))


def test_a_person_alone_and_a_stride(tree):
    whole = open_dataset(tree)[f"6795937_{SPOKEN}"]
    dataset = open_dataset(tree / UNSEEN, options=MultifaceOptions(stride=2))
    assert (dataset.fps, list(dataset.subjects)) == (15, ["6795937"])
    sequence = dataset[f"6795937_{SPOKEN}"]
    assert sequence.info.frames == len(sequence.vertices) == len(sequence.pose) == 3
    np.testing.assert_array_equal(sequence.vertices, whole.vertices[::2])
    np.testing.assert_array_equal(sequence.coefficients["frame_number"], [1000, 1002, 1004])


@pytest.mark.parametrize("form", ["text", "npy", "json", "templates"])
def test_the_reduced_topology(tree, tmp_path, form):
    kept = np.setdiff1d(np.arange(FULL), DROPPED)
    faces = some_faces(REDUCED)
    full, template = tmp_path / "full.obj", tmp_path / "template.obj"
    vertices = millimetres(42)
    full.write_text(obj_text(vertices, some_faces(FULL)))
    template.write_text(obj_text(vertices[kept], faces))
    options = MultifaceOptions(vertices=REDUCED, template=template, full_template=full)
    if form != "templates":
        path = tmp_path / f"dropped.{form}"
        if form == "npy":
            np.save(path, DROPPED)
        else:
            path.write_text(str(DROPPED.tolist()))
        options = MultifaceOptions(vertices=REDUCED, dropped=path)
    dataset = open_dataset(tree, options=options)
    name = f"6795937_{SPOKEN}"
    whole = open_dataset(tree)
    np.testing.assert_array_equal(dataset[name].vertices, whole[name].vertices[:, kept])
    assert dataset.subjects["6795937"].template.shape == (REDUCED, 3)
    if form == "templates":
        np.testing.assert_array_equal(dataset.mesh.faces, faces)
    else:
        corners = whole.mesh.vertices[whole.mesh.faces[np.isin(whole.mesh.faces, kept).all(1)]]
        np.testing.assert_allclose(dataset.mesh.vertices[dataset.mesh.faces], corners, atol=1e-12)
    assert dataset.check() == []


def test_objs_that_facediffuser_rewrote(copy):
    kept = np.setdiff1d(np.arange(FULL), DROPPED)
    for path in copy.rglob("*.obj"):
        vertices = np.fromfile(path.with_suffix(".bin"), "<f4").reshape(-1, 3)
        path.write_text(obj_text(vertices[kept], some_faces(REDUCED)))
    with pytest.raises(FileFormatError, match=r"6172 vertices, expected 7306: FaceDiffuser's.*rewrote it"):
        open_dataset(copy)
    dataset = open_dataset(copy, options=MultifaceOptions(vertices=REDUCED))
    name = f"6795937_{SPOKEN}"
    raw = np.fromfile(copy / UNSEEN / "tracked_mesh" / SPOKEN / "001002.bin", "<f4").reshape(-1, 3)
    np.testing.assert_allclose(dataset[name].vertices[2], raw[kept] / 1000, rtol=1e-6)


def test_a_reduced_topology_that_cannot_be_told(tree, tmp_path):
    with pytest.raises(OptionError, match="1134 left out: give dropped, or template"):
        open_dataset(tree, options=MultifaceOptions(vertices=REDUCED))
    with pytest.raises(OptionError, match="7306 or 6172"):
        MultifaceOptions(vertices=5023)
    path = tmp_path / "dropped.txt"
    path.write_text("1, 2, 3")
    with pytest.raises(FileFormatError, match=r"3 different vertices in 3 numbers, expected 1134"):
        open_dataset(tree, options=MultifaceOptions(vertices=REDUCED, dropped=path))
    full, template = tmp_path / "full.obj", tmp_path / "template.obj"
    full.write_text(obj_text(millimetres(1), some_faces(FULL)))
    template.write_text(obj_text(millimetres(1)[:REDUCED] + 0.5, some_faces(REDUCED)))
    with pytest.raises(FileFormatError, match="6172 vertices have no counterpart within"):
        open_dataset(tree, options=MultifaceOptions(vertices=REDUCED, template=template, full_template=full))


def test_damage_is_listed(copy):
    person = copy / UNSEEN
    folder = person / "tracked_mesh" / SPOKEN
    cut = folder / "001002.bin"
    cut.write_bytes(cut.read_bytes()[:-4])
    small = folder.parent / LAST / "002001.bin"
    small.write_bytes(small.read_bytes()[: 12 * REDUCED])
    other = copy / FIRST / "tracked_mesh" / SPOKEN
    bad = np.fromfile(other / "001001.bin", "<f4")
    bad[7] = np.nan
    bad.tofile(other / "001001.bin")
    (copy / FIRST / "audio" / f"{LAST}.wav").unlink()
    write_sound(person / "audio" / f"{LAST}.wav", 1.0, 48000, 77)
    defects = open_dataset(copy).check()
    for expected in (
        f"6795937_{SPOKEN}: {cut} has {FULL * 12 - 4} bytes, no whole vertices, expected 7306",
        f"6795937_{LAST}: {small} has 6172 vertices, expected 7306",
        f"002539136_{SPOKEN}: vertices are not finite in 1 frames, the first is 1",
        f"{LAST}.wav is not a file",
        "the motion is 27.0 frames too short",
    ):
        assert any(expected in line for line in defects), (expected, defects)


def test_gaps_and_lists_that_disagree(copy):
    person = copy / FIRST
    folder = person / "tracked_mesh" / SPOKEN
    lines = (person / "frame_list.txt").read_text().splitlines()
    kept = [line for line in lines if line not in (f"{SPOKEN} 001002", f"{SPOKEN} 001003")]
    (person / "frame_list.txt").write_text("\n".join([*kept, f"{LAST} 002003"]))
    (folder / "001003.bin").unlink()
    (copy / UNSEEN / "frame_list.txt").unlink()
    dataset = open_dataset(copy)
    name = f"002539136_{SPOKEN}"
    assert list(dataset[name].coefficients["frame_number"]) == [1000, 1001, 1004, 1005]
    defects = dataset.check()
    for expected in (
        f"{name}: 2 frames missing in 1 gaps, the first between 001001 and 001004",
        f"{name}: 1 frames are not in frame_list.txt, such as 001002.bin",
        f"002539136_{LAST}: 1 frames of frame_list.txt are not there, such as 002003.bin",
        "no frame_list.txt",
    ):
        assert any(expected in line for line in defects), (expected, defects)


def test_a_template_of_speech_is_said(copy):
    person = copy / FIRST
    shutil.rmtree(person / "tracked_mesh" / "E001_Neutral_Eyes_Open")
    dataset = open_dataset(copy)
    assert dataset.subjects["002539136"].attributes["template"] == "vert_mean.bin"
    (person / "vert_mean.bin").unlink()
    dataset = open_dataset(copy)
    np.testing.assert_array_equal(
        dataset.subjects["002539136"].template, dataset[f"002539136_{SPOKEN}"].vertices[0]
    )
    assert any("002539136: no E001_Neutral_Eyes_Open" in line for line in dataset.check())


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1 0 0 5\n0 1 0 5\n", "8 numbers, expected 3 rows of 4"),
        ("1 0 0 5\n0 1 0 5\n0 0 -1 5\n", "no rotation and translation"),
        ("1 0 0 five\n0 1 0 5\n0 0 1 5\n", "no table of numbers"),
    ],
)
def test_a_damaged_head_pose(copy, text, message):
    (copy / UNSEEN / "tracked_mesh" / SPOKEN / "001001_transform.txt").write_text(text)
    dataset = open_dataset(copy)
    with pytest.raises(FileFormatError, match=f"001001_transform.txt.*{message}"):
        dataset[f"6795937_{SPOKEN}"]


def test_cameras_see_what_the_files_say(tree):
    """Projection as the release defines it: K [R_c R_f | R_c t_f + t_c] on millimetres of the mesh."""
    dataset = open_dataset(tree)
    cameras = dataset.cameras("6795937")
    assert list(cameras) == ["400002", "400004"]
    camera = cameras["400002"]
    assert (camera.width, camera.height) == (1334, 2048)
    np.testing.assert_allclose(camera.distortion, [0.01, 0.02, 0, 0, 0])
    rows = [np.array(line.split(), float) for line in KRT.splitlines()[1:8]]
    intrinsics, extrinsics = np.stack(rows[:3]), np.stack(rows[4:])
    sequence = dataset[f"6795937_{SPOKEN}"]
    given = transform(10)
    turn, shift = extrinsics[:, :3] @ given[:, :3], extrinsics[:, :3] @ given[:, 3] + extrinsics[:, 3]
    expected = (millimetres(10)[:5] @ turn.T + shift) @ intrinsics.T
    rotation = roma.rotvec_to_rotmat(torch.from_numpy(sequence.pose[0]).double()).numpy()
    matrix = camera.head_to_camera(rotation, sequence.coefficients["translation"][0].astype(np.float64))
    seen = (sequence.vertices[0, :5] @ matrix[:3, :3].T + matrix[:3, 3]) @ camera.intrinsics.T
    np.testing.assert_allclose(seen[:, :2] / seen[:, 2:], expected[:, :2] / expected[:, 2:], rtol=1e-4)
    np.testing.assert_allclose(seen[:, 2], expected[:, 2] / 1000, rtol=1e-5)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("0.0 0.0 1.0 900.0", ""), "15 lines; expected 8 a camera"),
        (("400004", "400002"), "camera 400002 twice"),
        (("0.0 0.0 -1.0 -20.0", "0.0 0.0 1.0 -20.0"), "camera 400002: R of .* is no rotation"),
        (("7489.9", "nan"), "not finite"),
        (("7489.9", "x"), "camera 400002: could not convert"),
    ],
)
def test_a_damaged_krt(tmp_path, change, message):
    path = tmp_path / "KRT"
    path.write_text(KRT.replace(*change))
    with pytest.raises(FileFormatError, match=message):
        read_krt(path)


def test_no_multiface(tmp_path):
    (tmp_path / FIRST).mkdir()
    with pytest.raises(FileFormatError, match="multiface: m--DATE"):
        open_dataset(tmp_path)
