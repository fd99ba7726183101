import numpy as np
import pytest
import torch
from audio2face_small import SKIN, noise, small_diffusion

from meshanim.audio import load_encoder
from meshanim.audio.encoders import SpeechEncoder
from meshanim.errors import FileFormatError, OptionError, ShapeError
from meshanim.models.audio2face import EmotionTrack
from meshanim.models.audio2face.diffusion import (
    REACH,
    Audio2FaceDiffusion,
    DiffusionConfig,
    IdentityExperts,
)
from meshanim.models.audio2face.diffusion_stream import DiffusionStream, animate_diffusion, block_frames
from meshanim.models.audio2face.schedule import CosineSchedule, FrameNoise


@pytest.fixture(scope="module")
def network():
    return small_diffusion()


# -- schedule ---------------------------------------------------------------------------------------------


def test_the_cosine_schedule_is_that_of_nichol_and_dhariwal():
    kept = CosineSchedule(1000).kept
    assert kept.shape == (1000,)
    assert (np.diff(kept) < 0).all()
    for t in (1, 10, 500, 990):  # before the largest betas are cut

        def f(u):
            return np.cos((u / 1000 + 0.008) / 1.008 * np.pi / 2) ** 2

        assert kept[t - 1] == pytest.approx(f(t) / f(0), rel=1e-6)
    beta = 1 - kept[1:] / kept[:-1]
    assert beta.max() == pytest.approx(0.999)
    assert (np.diff(beta) > -1e-12).all()


def test_noise_is_added_as_eq_10_says():
    schedule = CosineSchedule(50)
    x, e = torch.randn(2, 4, 3).double(), torch.randn(2, 4, 3).double()
    found = schedule.noised(x, e, torch.tensor([3, 40]))
    for row, t in enumerate((3, 40)):
        expected = np.sqrt(schedule.kept[t]) * x[row] + np.sqrt(1 - schedule.kept[t]) * e[row]
        torch.testing.assert_close(found[row], expected)


@pytest.mark.parametrize("count", [1, 2, 5, 1000])
def test_steps_back_are_the_posterior(count):
    """By Bayes' rule: q(x_before | x_t, x_0) of two normals, in plain numbers."""
    schedule = CosineSchedule(1000)
    steps = schedule.sampling(count)
    assert len(steps) == count
    assert [step.time for step in steps] == sorted({step.time for step in steps}, reverse=True)
    assert steps[0].time == 999
    if count > 1:
        assert steps[-1].time == 0
    if count == 2:
        assert [step.time for step in steps] == [999, 0]
    for step, following in zip(steps, [*steps[1:], None]):
        kept = schedule.kept[step.time]
        before = 1.0 if following is None else schedule.kept[following.time]
        alpha = kept / before
        # x_before ~ N(sqrt(before) x0, 1 - before); x_t | x_before ~ N(sqrt(alpha) x_before, 1 - alpha)
        if before == 1.0:
            assert (step.clean, step.noisy, step.deviation) == pytest.approx((1, 0, 0), abs=1e-9)
            continue
        precision = 1 / (1 - before) + alpha / (1 - alpha)
        assert step.deviation == pytest.approx(precision**-0.5, rel=1e-6)
        assert step.clean == pytest.approx(np.sqrt(before) / (1 - before) / precision, rel=1e-6)
        assert step.noisy == pytest.approx(np.sqrt(alpha) / (1 - alpha) / precision, rel=1e-6)


def test_noise_by_frame_does_not_depend_on_the_portions():
    whole = FrameNoise(2, 40, seed=3).frames(0, 30)
    assert whole.shape == (2, 30, 40)
    part = FrameNoise(2, 40, seed=3)
    torch.testing.assert_close(part.frames(0, 12), whole[:, :12], rtol=0, atol=0)
    torch.testing.assert_close(part.frames(5, 20), whole[:, 5:20], rtol=0, atol=0)
    torch.testing.assert_close(part.frames(20, 30), whole[:, 20:30], rtol=0, atol=0)
    assert not torch.equal(FrameNoise(2, 40, seed=4).frames(0, 30), whole)
    assert abs(float(whole.mean())) < 0.1
    assert float(whole.std()) == pytest.approx(1, abs=0.05)
    given = FrameNoise(2, 40, given=whole)
    assert torch.equal(given.frames(3, 9), whole[:, 3:9])
    with pytest.raises(ShapeError, match="30 frames"):
        given.frames(20, 31)
    with pytest.raises(ShapeError, match="noise has shape"):
        FrameNoise(3, 40, given=whole)


# -- network ----------------------------------------------------------------------------------------------


def test_what_is_generated_has_all_parts(network):
    assert {part.name: part.size for part in network.parts} == {
        "skin": 3 * SKIN,
        "tongue": 10,
        "jaw": 15,
        "eyes": 4,
    }
    frames = torch.randn(5, network.numbers) * 1e-3
    pose = network.pose(frames)
    assert pose.skin.shape == (5, SKIN, 3)
    torch.testing.assert_close(pose.skin[2, 7], frames[2, 21:24])
    torch.testing.assert_close(pose.jaw[1].flatten(), frames[1, 190:205])
    vertices = network.vertices(frames, "ben")
    neutral = network.actors.templates["ben"]
    torch.testing.assert_close(vertices[:, :SKIN], neutral[:SKIN] + pose.skin)


def test_a_fresh_network_gives_the_mean_face():
    fresh = Audio2FaceDiffusion(small_diffusion().config, small_diffusion().actors).eval()
    fresh.mean.normal_()
    out = fresh.sample(torch.randn(20, 80), torch.zeros(20, 2))
    torch.testing.assert_close(out, fresh.mean.expand(20, -1))


def test_two_steps_are_two_calls(network):
    """The sampler from the definition: predict, step back to time 0 with noise, predict again."""
    features, emotions = torch.randn(40, 80), torch.rand(40, 2)
    noise = torch.randn(2, 40, network.numbers)
    found = network.sample(features, emotions, 1, FrameNoise(2, network.numbers, given=noise))
    schedule, who = network.schedule, torch.tensor([1])
    first, last = schedule.sampling(2)
    with torch.no_grad():
        clean = network(features[None], noise[:1], torch.tensor([999]), emotions[None], who)
        x = first.clean * clean + first.noisy * noise[:1] + first.deviation * noise[1:]
        clean = network(features[None], x, torch.tensor([0]), emotions[None], who)
    assert (last.clean, last.noisy) == pytest.approx((1, 0))
    torch.testing.assert_close(found, network.mean + clean[0] * network.scale)


def test_everything_matters(network):
    features, emotions = torch.randn(30, 80), torch.zeros(30, 2)
    base = network.sample(features, emotions)
    joy = emotions.clone()
    joy[15:, 0] = 1
    changed = network.sample(features, joy)
    torch.testing.assert_close(changed[:11], base[:11], atol=1e-5, rtol=0)
    assert (changed[15:] - base[15:]).abs().max() > 0.05
    for other in (
        network.sample(features, emotions, 1),
        network.sample(features, emotions, noise=FrameNoise(2, network.numbers, seed=1)),
        network.sample(features + 1, emotions),
        network.sample(features, emotions, steps=1),
    ):
        assert (other - base).abs().max() > 0.05


def test_files_keep_it(network, tmp_path):
    network.save_pretrained(tmp_path / "model")
    loaded = Audio2FaceDiffusion.from_pretrained(tmp_path / "model")
    assert loaded.config == network.config
    features, emotions = torch.randn(9, 80), torch.zeros(9, 2)
    assert torch.equal(loaded.sample(features, emotions), network.sample(features, emotions))
    (tmp_path / "model" / "actors.safetensors").unlink()
    with pytest.raises(FileFormatError, match="actors"):
        Audio2FaceDiffusion.from_pretrained(tmp_path / "model")


# -- streams ----------------------------------------------------------------------------------------------


def test_blocks_are_the_published_ones():
    assert block_frames(60) == (15, 30, 15)
    assert block_frames(30) == (7, 15, 8)
    for fps in (24, 25, 29.97, 50):
        before, block, after = block_frames(fps)
        assert before + block + after == round(fps)
        assert after >= before >= REACH


def streamed(stream, samples, blocks):
    parts, at, k = [], 0, 0
    while at < len(samples):
        count = blocks[k % len(blocks)]
        parts.append(stream.push(samples[at : at + count]))
        at, k = at + count, k + 1
    parts.append(stream.finish())
    return parts


@pytest.mark.parametrize(("fps", "steps"), [(30.0, 1), (30.0, 2), (60.0, 3), (25.0, 1)])
@pytest.mark.parametrize("seconds", [0.3, 1.9, 2.5])
def test_a_stream_gives_the_frames_of_the_whole(fps, steps, seconds):
    network, encoder, waveform = small_diffusion(fps=fps), load_encoder("mel"), noise(seconds)
    emotions = EmotionTrack.of(network.config.emotions, (0.2, {"joy": 1.0}), (1.4, {"anger": 0.5}))
    whole = animate_diffusion(network, encoder, waveform, "ben", emotions, steps=steps)
    assert len(whole) == int(np.ceil(seconds * fps - 1e-9))
    for blocks in ([400, 3000], [64000]):
        parts = streamed(
            DiffusionStream(network, encoder, "ben", emotions, steps=steps), waveform.samples, blocks
        )
        torch.testing.assert_close(torch.cat(parts), whole, atol=2e-5, rtol=0)


def test_frames_come_out_block_by_block_with_bounded_memory(network):
    stream, waveform = DiffusionStream(network, load_encoder("mel")), noise(4.0)
    for first in range(0, 64000, 1600):
        frames = stream.push(waveform.samples[first : first + 1600])
        assert len(frames) in (0, 15)
        # A block is complete 0.25 s after it, with the mel's 12.5 ms and one frame.
        heard = (first + 1600) / 16000
        assert stream.given >= 15 * int((heard - 0.3 - 0.0333) / 0.5)
        assert len(stream.reader.samples) < 16000 + 2 * 8000
        assert len(stream.noise.kept) <= 15 + 8
    assert len(stream.finish()) == 120 - 15 * 7


def test_more_steps_than_the_look_ahead_allows_stay_near(network):
    waveform, encoder = noise(2.5), load_encoder("mel")
    whole = animate_diffusion(network, encoder, waveform, steps=8)
    parts = torch.cat(streamed(DiffusionStream(network, encoder, steps=8), waveform.samples, [8000]))
    error = (parts - whole).abs().mean() / (whole - network.mean).abs().mean()
    assert 1e-6 < error < 0.05


class Whole(SpeechEncoder):
    """An encoder that needs the whole utterance: mel minus its mean."""

    name, dim, rate = "whole", 80, 100.0

    def __call__(self, waveform):
        features = load_encoder("mel")(waveform)
        return features - 0.5 * features.mean(0)


def test_windows_heard_alone(network):
    """Equal but for the last frames of each window, which the next window hears otherwise."""
    encoder, waveform = Whole(), noise(2.5)
    stream = DiffusionStream(network, encoder)
    assert stream.reader.mode == "window"
    parts = torch.cat(streamed(stream, waveform.samples, [1600]))
    same = animate_diffusion(network, encoder, waveform, hear="window")
    size = (same - network.mean).abs().mean()
    assert (parts - same).abs().mean() / size < 0.03
    once = DiffusionStream(network, encoder, steps=1)
    whole = animate_diffusion(network, encoder, waveform, steps=1, hear="window")
    found = torch.cat(streamed(once, waveform.samples, [1600]))
    assert (found - whole).abs().mean() / size < 0.03
    # Heard as a whole it is another thing.
    other = animate_diffusion(network, encoder, waveform)
    assert (other - same).abs().mean() > 2.5 * (parts - same).abs().mean()


def test_bad_input_is_named(network, unchecked):
    with pytest.raises(OptionError, match="at least 1"):
        DiffusionConfig(0)
    with pytest.raises(OptionError, match="neutral"):
        DiffusionConfig(3, emotions=("neutral",))
    with pytest.raises(OptionError, match="sampling"):
        DiffusionConfig(3, sampling=2000)
    with pytest.raises(OptionError, match="1 to 1000"):
        CosineSchedule().sampling(0)
    with pytest.raises(OptionError, match="at least 1"):
        CosineSchedule(0)
    with pytest.raises(ShapeError, match="empty"):
        network.sample(torch.zeros(0, 80), torch.zeros(0, 2))
    with pytest.raises(ShapeError, match="width 81"):
        network.sample(torch.zeros(3, 81), torch.zeros(3, 2))
    with pytest.raises(OptionError, match="53 features"):
        DiffusionStream(network, load_encoder("visemes"))
    with pytest.raises(OptionError, match="no identity 'carl'"):
        DiffusionStream(network, load_encoder("mel"), "carl")
    with pytest.raises(OptionError, match="1 emotions"):
        DiffusionStream(network, load_encoder("mel"), emotions=EmotionTrack.of(("joy",)))
    with pytest.raises(OptionError, match="no identity"):
        network.vertices(torch.zeros(1, network.numbers), "carl")
    stream = DiffusionStream(network, load_encoder("mel"))
    with pytest.raises(ShapeError, match="no samples"):
        stream.finish()


# -- experiments of Sec. 9 --------------------------------------------------------------------------------


def test_experts_are_eqs_16_and_17():
    torch.manual_seed(0)
    layer = IdentityExperts(6, 9, 3).double()
    with torch.no_grad():
        layer.matrices.normal_()
        layer.offsets.normal_()
    steps = torch.randn(2, 4, 6, dtype=torch.float64)
    mixture = torch.tensor([[0.0, 1.0, 0.0], [0.3, 0.0, 0.7]], dtype=torch.float64)
    found = layer(steps, mixture)
    for b in range(2):
        for t in range(4):
            hidden = sum(
                mixture[b, i] * (layer.matrices[i] @ steps[b, t] + layer.offsets[i]) for i in range(3)
            )
            expected = steps[b, t] + layer.second(torch.nn.functional.gelu(hidden))
            torch.testing.assert_close(found[b, t], expected)
    fresh = IdentityExperts(6, 9, 3)
    out = [fresh(torch.ones(1, 1, 6), torch.eye(3)[k][None]) for k in range(3)]
    assert torch.equal(out[0], out[1])


@pytest.mark.parametrize(
    "options", [{"target": "rig", "rig": ("jawOpen", "browInnerUp"), "experts": 12}, {"head_motion": True}]
)
def test_streams_of_rigs_and_heads(options):
    network, encoder, waveform = small_diffusion(**options), load_encoder("mel"), noise(1.9)
    whole = animate_diffusion(network, encoder, waveform, "ben")
    parts = streamed(DiffusionStream(network, encoder, "ben"), waveform.samples, [3000])
    torch.testing.assert_close(torch.cat(parts), whole, atol=2e-5, rtol=0)
    if "rig" in options:
        weights = network.rig_weights(whole)
        assert weights.shape == (57, 2)
        assert weights.min() >= 0
        assert weights.max() <= 1
        assert (animate_diffusion(network, encoder, waveform, "anna") - whole).abs().max() > 1e-4
        with pytest.raises(OptionError, match="not vertices"):
            network.pose(whole)
    else:
        assert network.head_motion(whole).shape == (57, 9)
        assert network.head_motion(whole).abs().max() > 0
        assert network.pose(whole).eyes.shape == (57, 2, 2)
        with pytest.raises(OptionError, match="not rig weights"):
            network.rig_weights(whole)


def test_options_of_the_experiments_are_checked(network):
    assert not network.head_motion(torch.zeros(3, network.numbers)).any()
    with pytest.raises(OptionError, match="rig"):
        DiffusionConfig(3, target="rig")
    with pytest.raises(OptionError, match="not both"):
        DiffusionConfig(3, emotions=("joy",), text=4)
