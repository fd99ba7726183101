"""UniTalker's folders, every kind of annotation, on small trees and on damaged copies."""

import json
import shutil

import numpy as np
import pytest
import roma
import torch
from made_files import write_flame, write_sound

from meshanim.datasets import open_dataset
from meshanim.datasets.unitalker import UniTalkerDataset, UniTalkerOptions
from meshanim.errors import FileFormatError, OptionError
from meshanim.heads import HeadParameters, load_head

PEOPLE = ["F1", "F2"]
KINDS = {
    "BIWI_23370_vertices": ("D1", 70110, 25),
    "FLAME_5023_vertices": ("D2", 15069, 60),
    "meshtalk_6172_vertices": ("meshtalk", 18516, 30),
    "3DETF_blendshape_weight": ("D3", 52, 30),
    "inhouse_blendshape_weight": ("D6", 51, 30),
    "flame_params_from_dadhead": ("D5", 413, 25),
}
# Split, person, frames.
TAKES = [("train", 0, 6), ("train", 1, 7), ("val", 0, 5), ("test", 1, 4)]


def annotation(kind, seed, frames):
    return np.random.default_rng(seed).uniform(0.1, 1, (frames, KINDS[kind][1])).astype(np.float32)


def write_json(root, split, change):
    path = root / f"{split}.json"
    record = json.loads(path.read_text())
    change(record)
    path.write_text(json.dumps(record))


def make(root, kind):
    dataset, width, fps = KINDS[kind]
    (root / "annot").mkdir(parents=True)
    entries = {"train": [], "val": [], "test": []}
    for index, (split, person, frames) in enumerate(TAKES):
        name = f"{PEOPLE[person]}_e{index:02d}"
        array = annotation(kind, index, frames)
        # BIWI's arrays are (T, V, 3) there, the others flat.
        np.save(root / "annot" / f"{name}.npy", array.reshape(frames, -1, 3) if width == 70110 else array)
        sound = f"audio/{name}.wav"
        if index == 1:
            sound = f"audio/{name}.npy"
            samples = np.random.default_rng(index).uniform(-1, 1, round(frames / fps * 16000))
            (root / "audio").mkdir(exist_ok=True)
            np.save(root / sound, samples.astype(np.float32))
        else:
            write_sound(root / sound, frames / fps, 16000, index)
        entries[split].append(
            {
                "annot_path": f"annot/{name}.npy",
                "audio_path": sound,
                "id": person,
                "annot_type": kind,
                "dataset": dataset,
                "fps": fps,
            }
        )
    for split, data in entries.items():
        (root / f"{split}.json").write_text(json.dumps({"info": {"id_list": PEOPLE}, "data": data}))
    np.save(root / "id_template.npy", np.stack([annotation(kind, 50 + i, 1)[0] for i in range(2)]))
    rng = np.random.default_rng(8)
    np.savez(
        root / "pca.npz",
        components_to_data=rng.normal(0, 1, (4, width)).astype(np.float32),
        original_data_mean=rng.normal(0, 1, width),
        data_components_mean=rng.normal(0, 1, 4),
        data_components_std=rng.uniform(1, 2, 4),
        explained_variance_ratio=np.full(4, 0.25),
        S=np.ones(4),
    )
    return root


@pytest.fixture(scope="module")
def trees(tmp_path_factory):
    root = tmp_path_factory.mktemp("unitalker")
    return {kind: make(root / kind, kind) for kind in KINDS}


@pytest.fixture
def copy(trees, tmp_path):
    return shutil.copytree(trees["meshtalk_6172_vertices"], tmp_path / "copy")


@pytest.mark.parametrize("kind", ["BIWI_23370_vertices", "FLAME_5023_vertices", "meshtalk_6172_vertices"])
def test_vertices(trees, kind):
    dataset = open_dataset(trees[kind])
    assert isinstance(dataset, UniTalkerDataset)
    name, width, fps = KINDS[kind]
    unit, scale = ("biwi", 1) if width == 70110 else ("m", 0.001 if width == 18516 else 1)
    assert (dataset.name, dataset.fps, dataset.unit, dataset.mesh) == (name, fps, unit, None)
    assert list(dataset.subjects) == PEOPLE
    assert dataset.splits == {"train": ("F1_e00", "F2_e01"), "val": ("F1_e02",), "test": ("F2_e03",)}
    sequence = dataset["F2_e01"]
    assert sequence.info.subject == "F2"
    expected = annotation(kind, 1, 7).reshape(7, -1, 3)
    np.testing.assert_allclose(sequence.vertices, expected * scale, rtol=1e-6)
    assert isinstance(sequence.vertices, np.memmap) == (scale == 1)
    np.testing.assert_allclose(
        dataset.subjects["F2"].template, annotation(kind, 51, 1).reshape(-1, 3) * scale, rtol=1e-6
    )
    assert sequence.audio.rate == 16000
    assert sequence.audio.duration == pytest.approx(7 / fps, abs=1e-3)
    assert dataset.check() == []


def test_sixty_frames_are_halved_by_the_stride_alone(trees):
    tree = trees["FLAME_5023_vertices"]
    whole = open_dataset(tree)["F1_e00"]
    dataset = open_dataset(tree, options=UniTalkerOptions(stride=2))
    assert (whole.info.fps, whole.info.frames, dataset.fps) == (60, 6, 30)
    sequence = dataset["F1_e00"]
    assert (sequence.info.fps, sequence.info.frames) == (30, 3)
    np.testing.assert_array_equal(sequence.vertices, whole.vertices[::2])


def test_a_scale_of_ones_own_and_faces(trees, tmp_path):
    tree = trees["BIWI_23370_vertices"]
    path = tmp_path / "faces.obj"
    path.write_text("v 0 0 1\n" * 23370 + "f 1 2 3\nf 2 3 23370\n")
    dataset = open_dataset(tree, options=UniTalkerOptions(scale=0.2, faces=path))
    assert dataset.unit == "m"
    expected = annotation("BIWI_23370_vertices", 0, 6).reshape(6, -1, 3) * 0.2
    np.testing.assert_allclose(dataset["F1_e00"].vertices, expected, rtol=1e-6)
    np.testing.assert_array_equal(dataset.mesh.faces, [[0, 1, 2], [1, 2, 23369]])
    mean = np.mean([subject.template for subject in dataset.subjects.values()], axis=0)
    np.testing.assert_allclose(dataset.mesh.vertices, mean, rtol=1e-6)
    path.write_text("v 0 0 1\n" * 3 + "f 1 2 3\n")
    with pytest.raises(FileFormatError, match="3 vertices, BIWI_23370_vertices 23370"):
        open_dataset(tree, options=UniTalkerOptions(faces=path))


@pytest.mark.parametrize("kind", ["3DETF_blendshape_weight", "inhouse_blendshape_weight"])
def test_blendshape_weights(trees, kind):
    dataset = open_dataset(trees[kind])
    width = KINDS[kind][1]
    assert len(dataset.curve_names) == width
    assert dataset.curve_names[3] == "blendshape_03"
    sequence = dataset["F1_e02"]
    np.testing.assert_array_equal(sequence.curves, annotation(kind, 2, 5))
    assert sequence.vertices.shape == (5, 0, 3)
    assert dataset.check() == []
    names = tuple(f"my{index}" for index in range(width))
    assert open_dataset(trees[kind], options=UniTalkerOptions(curve_names=names)).curve_names == names
    with pytest.raises(OptionError, match=f"1 curve_names are given, {kind} has {width}"):
        open_dataset(trees[kind], options=UniTalkerOptions(curve_names=("a",)))


def test_flame_of_dad_heads(trees, tmp_path):
    kind = "flame_params_from_dadhead"
    head = f"flame:{write_flame(tmp_path)}"
    dataset = open_dataset(trees[kind], options=UniTalkerOptions(head=head))
    sequence = dataset["F1_e00"]
    array = torch.from_numpy(annotation(kind, 0, 6))
    params = HeadParameters(shape=array[:, :300], expression=array[:, 300:400], jaw=array[:, 400:403])
    np.testing.assert_allclose(sequence.vertices, load_head(head)(params).numpy(), atol=1e-6)
    np.testing.assert_array_equal(sequence.coefficients["translation"], array[:, 409:412].numpy())
    np.testing.assert_array_equal(sequence.coefficients["scale"], array[:, 412:].numpy())
    np.testing.assert_array_equal(dataset.subjects["F2"].shape, annotation(kind, 51, 1)[0, :300])
    # The first column points along the first three numbers, the third across them and the last three.
    turn = np.diag([1.0, -1.0, -1.0]) @ roma.rotvec_to_rotmat(torch.from_numpy(sequence.pose)).numpy()
    first, second = array[:, 403:406].numpy(), array[:, 406:409].numpy()
    for column, direction in ((0, first), (2, np.cross(first, second))):
        unit = direction / np.linalg.norm(direction, axis=1, keepdims=True)
        np.testing.assert_allclose(turn[:, :, column], unit, atol=1e-5)
    alone = open_dataset(trees[kind])
    assert alone["F1_e00"].vertices.shape == (6, 0, 3)
    assert alone.check() == []


def test_an_upright_face_of_an_image_has_no_pose(trees, tmp_path):
    """In an image y points down: DAD-3DHeads turns an upright face by half a turn about x."""
    copy = shutil.copytree(trees["flame_params_from_dadhead"], tmp_path / "copy")
    array = annotation("flame_params_from_dadhead", 0, 6)
    array[:, 403:409] = [1, 0, 0, 0, -1, 0]
    np.save(copy / "annot" / "F1_e00.npy", array)
    np.testing.assert_allclose(open_dataset(copy)["F1_e00"].pose, 0, atol=1e-6)
    array[3, 403:409] = 0
    np.save(copy / "annot" / "F1_e00.npy", array)
    with pytest.raises(FileFormatError, match=r"F1_e00\.npy: frame 3 has no rotation"):
        open_dataset(copy)["F1_e00"]


def test_principal_components(copy):
    components = open_dataset(copy).components()
    with np.load(copy / "pca.npz") as archive:
        np.testing.assert_array_equal(components.components, archive["components_to_data"])
        np.testing.assert_allclose(components.mean, archive["original_data_mean"], rtol=1e-6)
        arrays = dict(archive)
    arrays["components_to_data"] = arrays["components_to_data"][:, 1:]
    np.savez(copy / "pca.npz", **arrays)
    dataset = open_dataset(copy)
    with pytest.raises(FileFormatError, match=r"components \(4, 18515\), expected \(any, 18516\)"):
        dataset.components()
    assert any("components (4, 18515)" in line for line in dataset.check())
    (copy / "pca.npz").unlink()
    assert open_dataset(copy).components() is None


def test_one_annotation_in_two_splits_and_two_of_a_name(copy):
    (copy / "annot" / "more").mkdir()
    np.save(copy / "annot" / "more" / "F1_e00.npy", annotation("meshtalk_6172_vertices", 70, 6))
    first = json.loads((copy / "train.json").read_text())["data"][0]
    write_json(copy, "val", lambda record: record["data"].append(first))
    other = {**first, "annot_path": "annot/more/F1_e00.npy"}
    write_json(copy, "test", lambda record: record["data"].append(other))
    dataset = open_dataset(copy)
    assert dataset.splits["train"][0] == dataset.splits["val"][1] == "annot_F1_e00"
    assert dataset.splits["test"][1] == "annot_more_F1_e00"
    assert len(dataset) == 5


def test_damage_is_listed(copy):
    annot = copy / "annot"
    np.save(annot / "F1_e00.npy", np.zeros((6, 18515), np.float32))
    bad = annotation("meshtalk_6172_vertices", 1, 7)
    bad[4, 100] = np.nan
    np.save(annot / "F2_e01.npy", bad)
    (annot / "F1_e02.npy").write_bytes((annot / "F1_e02.npy").read_bytes()[:-8])
    (copy / "audio" / "F1_e02.wav").unlink()
    write_sound(copy / "audio" / "F2_e03.wav", 1, 16000, 30)
    np.save(copy / "audio" / "F2_e01.npy", np.zeros(3733, np.float32))
    defects = open_dataset(copy).check()
    for expected in (
        "F1_e00.npy has shape (6, 18515), expected (frames, 18516): meshtalk_6172_vertices",
        "F2_e01: vertices are not finite in 1 frames, the first is 4",
        "F2_e01: the sound is silent",
        "F1_e02.npy is damaged or cut short",
        "F1_e02.wav is not a file",
        "F2_e03: 0.13 s of motion and 1.00 s of sound: the motion is 26.0 frames too short",
    ):
        assert any(expected in line for line in defects), (expected, defects)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda record: record.pop("info"), r"train\.json is no list of UniTalker: KeyError"),
        (lambda record: record["data"][0].pop("fps"), r"KeyError 'fps'"),
        (lambda record: record["data"][0].update(id=2), r"F1_e00\.npy has id 2 of 2"),
        (lambda record: record["data"][0].update(fps=25), r"mixes fps: 30 \(3\), 25 \(1\)"),
        (lambda record: record["info"].update(id_list=["F1", "F3"]), "the splits have different id_list"),
        (lambda record: record["data"].append({**record["data"][0], "id": 1}), "two different entries"),
    ],
)
def test_a_damaged_list(copy, change, message):
    write_json(copy, "train", change)
    with pytest.raises(FileFormatError, match=message):
        open_dataset(copy)


def test_damaged_templates_and_unknown_kinds(copy):
    np.save(copy / "id_template.npy", np.zeros((1, 18516)))
    with pytest.raises(FileFormatError, match="1 templates, id_list 2 names"):
        open_dataset(copy)
    np.save(copy / "id_template.npy", np.zeros((2, 70110)))
    with pytest.raises(FileFormatError, match="70110 numbers a template, meshtalk_6172_vertices has 18516"):
        open_dataset(copy)
    for split in ("train", "val", "test"):
        write_json(copy, split, lambda record: [e.update(annot_type="new") for e in record["data"]])
    with pytest.raises(FileFormatError, match="no annotation 'new'; there are BIWI_23370_vertices"):
        open_dataset(copy)
    (copy / "id_template.npy").unlink()
    with pytest.raises(FileFormatError, match=r"unitalker: train\.json, val\.json or test\.json"):
        open_dataset(copy)
