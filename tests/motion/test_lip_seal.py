import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from meshanim.errors import OptionError
from meshanim.motion.lip_seal import LipSeal, head_lip_seal, seal_envelope, sealed_frames, sealed_steps


def test_one_sealed_frame_ramps():
    sealed = torch.zeros(21)
    sealed[10] = 1
    envelope = seal_envelope(sealed, 30.0, ramp=0.08)
    assert envelope[10] == 1
    # Squared cosine, zero 0.08 s away: one and two frames of 1/30 s.
    heights = torch.cos(torch.pi / 2 * torch.tensor([1.0, 2.0]) / 30 / 0.08).square()
    torch.testing.assert_close(envelope[11:13], heights)
    torch.testing.assert_close(envelope[8:10], heights.flip(0))
    assert envelope[13:].max() == 0
    assert envelope[:8].max() == 0


def test_weak_evidence_needs_two_steps():
    posterior = torch.zeros(20)
    posterior[5], posterior[12] = 0.3, 0.4
    assert sealed_steps(posterior).nonzero().flatten().tolist() == [12]
    posterior[6] = 0.3
    assert sealed_steps(posterior).nonzero().flatten().tolist() == [6, 12]


@settings(max_examples=50, deadline=None)
@given(
    st.lists(st.booleans(), min_size=1, max_size=60),
    st.sampled_from([10.0, 24.0, 30.0, 50.0, 60.0, 120.0]),
    st.integers(0, 10),
)
def test_no_sealed_step_falls_between_frames(values, fps, first):
    steps, rate = torch.tensor(values), 50.0
    frames = int(len(values) / rate * fps) + 2
    found = sealed_frames(steps, rate, fps, frames)
    for i in range(frames):
        inside = [k for k in range(len(values)) if i / fps <= (k + 0.5) / rate < (i + 1) / fps - 1e-12]
        around = int((i + 0.5) / fps * rate + 1e-12)
        mine = {*inside, around} & set(range(len(values)))
        assert found[i] == any(values[k] for k in mine)
    # The middle of a track gives what the whole gives.
    first = min(first, frames)
    skipped = max(0, int(first * rate / fps) - 2)
    part = sealed_frames(steps[skipped:], rate, fps, frames - first, first, skipped)
    assert torch.equal(part, found[first:])


@settings(max_examples=30, deadline=None)
@given(
    st.lists(st.booleans(), min_size=1, max_size=40),
    st.integers(0, 39),
    st.sampled_from([24.0, 30.0, 60.0]),
)
def test_no_frame_depends_on_more_than_the_look_ahead(values, cut, fps):
    sealed = torch.tensor(values).float()
    closing = torch.tensor([[0.0, -1, 0], [0, 0, 0]])
    reach = LipSeal(torch.tensor([[0, 1]]), closing).look_ahead(fps)
    cut = min(cut, len(sealed))
    early = seal_envelope(sealed[:cut], fps)
    certain = max(0, cut - reach)
    assert torch.equal(early[:certain], seal_envelope(sealed, fps)[:certain])


def test_sealing_closes_the_gap_whatever_the_field_is_scaled_to():
    pairs = torch.tensor([[0, 1]])
    for scale in (1.0, 0.01):
        closing = torch.tensor([[0.0, -0.6, 0], [0, 0.4, 0], [0, 0, 0]]) * scale
        seal = LipSeal(pairs, closing, overlap=0.0005)
        vertices = torch.tensor([[[0, 0.003, 0], [0, 0.0, 0], [1, 1, 1]]]).repeat(3, 1, 1)
        sealed = seal(vertices, torch.tensor([0.0, 0.5, 1.0]))
        gaps = sealed[:, 0, 1] - sealed[:, 1, 1]
        torch.testing.assert_close(gaps, torch.tensor([0.003, 0.00125, -0.0005]), atol=1e-7, rtol=0)
        assert torch.equal(sealed[:, 2], vertices[:, 2])
        # Lips that press together already stay as they are.
        assert torch.equal(seal(sealed[2:] - 0, torch.ones(1)), seal(sealed[2:], torch.zeros(1)))
        wide = torch.tensor([[[0, 0.03, 0], [0, 0.0, 0], [1, 1, 1]]])
        assert seal(wide, torch.ones(1))[0, 0, 1] > 0.02


def test_bad_fields_and_rates_are_named():
    with pytest.raises(OptionError, match="together"):
        LipSeal(torch.tensor([[0, 1]]), torch.tensor([[0.0, 1, 0], [0, 0, 0]]))
    with pytest.raises(OptionError, match="fps"):
        seal_envelope(torch.zeros(3), 0.0)


def test_the_default_head_declares_a_seal():
    from meshanim.heads import HeadParameters, load_head

    head = load_head("default")
    seal = head_lip_seal(head)
    opened = head(HeadParameters(expression=head.expression({"jawOpen": 0.15})))
    gaps = seal(opened, torch.ones(1))[0][seal.pairs, 1]
    assert (gaps[:, 0] - gaps[:, 1]).max() <= 0
    assert head_lip_seal(None) is None
