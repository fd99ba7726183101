import pickle

import numpy as np
import pytest
import torch

from meshanim.errors import FileFormatError, OptionError, ShapeError
from meshanim.heads import load_head
from meshanim.training.metrics.masks import PUBLISHED_MASKS, Mask, load_mask, region_mask

COUNTS = {
    "biwi_lve": (4996, 23370),
    "biwi_fdd": (7784, 23370),
    "vocaset_lve": (428, 5023),
    "vocaset_fdd": (1501, 5023),
    "vocaset_neck": (368, 5023),
    "multiface_lve": (1035, 6172),
    "multiface_fdd": (1529, 6172),
}


def write(path, indices):
    path.write_text(", ".join(map(str, indices)))
    return path


@pytest.mark.parametrize("name", COUNTS)
def test_published_text_masks(name, tmp_path):
    count, vertices = COUNTS[name]
    indices = np.random.default_rng(0).permutation(vertices)[:count]
    mask = load_mask(f"{name}:{write(tmp_path / 'mask.txt', indices)}", vertices)
    assert (mask.name, len(mask)) == (name, count)
    assert set(mask.indices) == set(indices)
    wrong = write(tmp_path / "wrong.txt", indices[1:])
    with pytest.raises(
        FileFormatError, match=rf"wrong.txt names {count - 1} vertices; {name} .* has {count}"
    ):
        load_mask(f"{name}:{wrong}", vertices)
    with pytest.raises(ShapeError, match=f"{name} is of meshes of {vertices} vertices, these have 100"):
        load_mask(f"{name}:{tmp_path / 'mask.txt'}", 100)


def test_a_published_mask_that_counts_a_vertex_twice_is_refused(tmp_path):
    path = write(tmp_path / "lve.txt", [*range(427), 5])
    with pytest.raises(FileFormatError, match="names 427 vertices"):
        load_mask(f"vocaset_lve:{path}")


def test_flame_masks(tmp_path):
    masks = {
        "lips": np.arange(254),
        "forehead": np.arange(1000, 1133),
        "eye_region": np.arange(1076, 1827),  # 133 + 751 - 57 shared = 827
    }
    path = tmp_path / "FLAME_masks.pkl"
    path.write_bytes(pickle.dumps(masks, protocol=2))
    assert len(load_mask(f"flame_lips:{path}", 5023)) == 254
    upper = load_mask(f"flame_upper_face:{path}", 5023)
    assert len(upper) == 827
    assert set(upper.indices) == set(range(1000, 1827))
    path.write_bytes(pickle.dumps(masks | {"lips": np.arange(250)}, protocol=2))
    with pytest.raises(FileFormatError, match="250 vertices"):
        load_mask(f"flame_lips:{path}")
    path.write_bytes(pickle.dumps({"lips": np.arange(254)}, protocol=2))
    with pytest.raises(FileFormatError, match="lacks forehead, eye_region"):
        load_mask(f"flame_upper_face:{path}")


def test_weighted_masks_keep_what_is_above_the_threshold(tmp_path):
    weights = np.zeros(6172)
    weights[[3, 5, 8]] = 0.1, 0.11, 0.9
    np.savetxt(tmp_path / "weighted_mouth_mask.txt", weights)
    mask = load_mask(f"meshtalk_mouth:{tmp_path / 'weighted_mouth_mask.txt'}", 6172)
    assert mask.indices.tolist() == [5, 8]
    assert PUBLISHED_MASKS["meshtalk_forehead"].threshold == 0.4
    np.savetxt(tmp_path / "short.txt", weights[1:])
    with pytest.raises(FileFormatError, match="expected 6172 weights"):
        load_mask(f"meshtalk_mouth:{tmp_path / 'short.txt'}")
    with pytest.raises(FileFormatError, match=r"0\.1, which is no vertex"):
        load_mask(str(tmp_path / "short.txt"))


def test_any_file_is_called_by_its_stem(tmp_path):
    np.save(tmp_path / "mouth.npy", np.array([4, 2, 9]))
    mask = load_mask(str(tmp_path / "mouth.npy"), 10)
    assert (mask.name, mask.indices.tolist()) == ("mouth", [2, 4, 9])
    np.save(tmp_path / "flags.npy", np.arange(10) % 2 == 0)
    assert load_mask(str(tmp_path / "flags.npy"), 10).indices.tolist() == [0, 2, 4, 6, 8]
    with pytest.raises(ShapeError, match="vertex 9, the mesh has 9"):
        load_mask(str(tmp_path / "mouth.npy"), 9)
    assert load_mask(f"unitalker_mouth:{tmp_path / 'mouth.npy'}").name == "unitalker_mouth"


def test_what_is_no_mask_is_named(tmp_path):
    with pytest.raises(OptionError, match="no published mask 'lips'; there are biwi_lve"):
        load_mask("lips:nowhere.txt")
    with pytest.raises(FileFormatError, match="nowhere"):
        load_mask(str(tmp_path / "nowhere.txt"))
    (tmp_path / "words.txt").write_text("upper lip")
    with pytest.raises(FileFormatError, match="no list of vertices"):
        load_mask(str(tmp_path / "words.txt"))
    write(tmp_path / "empty.txt", [])
    with pytest.raises(ShapeError, match="empty names no vertices"):
        load_mask(str(tmp_path / "empty.txt"))
    np.save(tmp_path / "table.npy", np.zeros((3, 2)))
    with pytest.raises(FileFormatError, match=r"shape \(3, 2\)"):
        load_mask(str(tmp_path / "table.npy"))
    (tmp_path / "evil.pkl").write_bytes(pickle.dumps(print))
    with pytest.raises(FileFormatError, match="which is no array"):
        load_mask(f"flame_lips:{tmp_path / 'evil.pkl'}")


def test_the_digest_is_of_the_vertices():
    mask = Mask("lips", np.array([1, 2, 3]))
    assert mask.digest == Mask("mouth", np.array([3, 1, 2])).digest
    assert mask.digest != Mask("lips", np.array([1, 2, 4])).digest
    assert mask.tensor().dtype == torch.int64
    with pytest.raises(ShapeError, match="twice"):
        Mask("lips", np.array([1, 1]))


def test_regions_of_a_head():
    head = load_head("default")
    lips = region_mask(head, "lips")
    assert (lips.name, len(lips)) == ("lips", len(head.regions["lips"]))
    eyes = region_mask(head, "eye_region")
    assert set(eyes.indices) == set(head.regions["eyelids"]) | set(head.regions["eyes"])
    with pytest.raises(OptionError, match="no region 'beard'"):
        region_mask(head, "beard")
