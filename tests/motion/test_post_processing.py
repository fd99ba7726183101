"""Every control against its formula, frame by frame; streams and files; keyframes; NVIDIA's files."""

import math
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from audio2face_small import small_actors
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import expit

from meshanim.errors import FileFormatError, OptionError
from meshanim.motion.animation_state import FacePose
from meshanim.motion.post_files import load_post_settings, post_track
from meshanim.motion.post_processing import (
    PRESETS,
    Poses,
    PostHearing,
    PostProcessing,
    PostProcessor,
    PostTrack,
)

ACTORS = small_actors()
PARTS, TEMPLATE = ACTORS.basis.parts, ACTORS.templates["anna"].double()
NEUTRAL = PRESETS["neutral"]
FPS = 30.0


def poses(seed=1):
    generator = torch.Generator().manual_seed(seed)
    count = len(PARTS.skin)
    return Poses(*(torch.randn(count, 3, generator=generator).double() * 0.01 for _ in range(2)))


def motion(frames=9, seed=0):
    generator = torch.Generator().manual_seed(seed)

    def draw(*shape):
        return 0.01 * torch.randn(frames, *shape, generator=generator).double()

    face = FacePose(draw(len(PARTS.skin), 3), draw(len(PARTS.tongue), 3), draw(5, 3), draw(2, 2))
    chance = np.random.default_rng(seed)
    return face, chance.uniform(0, 1, frames), 0.05 * chance.normal(size=(frames, 2))


def processed(controls, face, lids, saccades, blocks=(), fps=FPS):
    """In blocks that end at the given frames."""
    processor = PostProcessor(PostTrack.of(controls), PARTS, TEMPLATE, fps, poses())
    times = (np.arange(len(lids)) + 0.5) / fps
    edges = [0, *sorted(blocks), len(lids)]
    parts = [
        processor(FacePose(*(x[a:b] for x in face)), times[a:b], lids[a:b], saccades[a:b])
        for a, b in pairwise(edges)
    ]
    return FacePose(*(torch.cat(arrays) for arrays in zip(*parts)))


def expected_skin(track, skin, lids, fps=FPS):
    """The published formula in plain numbers, one vertex at a time."""
    close, lips = (pose.numpy() for pose in poses())
    y = TEMPLATE.numpy()[PARTS.skin, 1]
    height = (y - y.min()) / (y.max() - y.min())
    out, state = [], {}
    for number, frame in enumerate(skin.numpy()):
        time = (number + 0.5) / fps

        def c(name, time=time):
            return float(track.values(name, np.array([time]))[0])

        raw = c("skin_strength") * frame + c("lip_open_offset") * lips
        raw = raw + close * (-c("eyelid_open_offset") + lids[number] * c("blink_strength"))
        result = np.zeros_like(raw)
        for part in ("upper", "lower"):
            smoothing = c(f"{part}_face_smoothing")
            alpha = 1 - 0.5 ** ((1 / fps) / smoothing) if smoothing > 0 else 1.0
            first, second = state.get(part, (raw, raw))
            first = first + (raw - first) * alpha
            second = second + (first - second) * alpha
            state[part] = (first, second)
            mask = expit((c("face_mask_level") - height) / c("face_mask_softness"))
            share = mask if part == "lower" else 1 - mask
            result += c(f"{part}_face_strength") * second * share[:, None]
        out.append(result)
    return np.stack(out)


def test_defaults_and_ranges_are_the_published_ones():
    published = {
        "skin_strength": (1, 0, 2), "upper_face_strength": (1, 0, 2), "lower_face_strength": (1.3, 0, 2),
        "upper_face_smoothing": (0.001, 0, 0.1), "lower_face_smoothing": (0.0023, 0, 0.1),
        "face_mask_level": (0.6, 0, 1), "face_mask_softness": (0.0085, 0.001, 0.5),
        "lip_open_offset": (-0.03, -0.2, 0.2), "eyelid_open_offset": (0.06, -1, 1),
        "blink_strength": (1, 0, 2), "tongue_strength": (1.5, 0, 3), "tongue_height_offset": (0.2, -3, 3),
        "tongue_depth_offset": (0.13, -3, 3), "eye_saccade_seed": (0, 0, 4999),
        "right_eye_rot_y_offset": (0, -10, 10),
    }  # fmt: skip
    found = {c.name: (c.default, c.low, c.high) for c in PostProcessing.controls()}
    assert published.items() <= found.items()
    assert all(c.description for c in PostProcessing.controls())


@pytest.mark.parametrize("control", PostProcessing.controls(), ids=lambda control: control.name)
def test_ranges_are_kept(control):
    for value in (control.low, control.high):
        replace(NEUTRAL, **{control.name: value})
    for value in (control.low - 0.01, control.high + 0.01, math.nan, math.inf):
        with pytest.raises(OptionError, match=control.name):
            replace(NEUTRAL, **{control.name: value})


def test_neutral_changes_nothing_but_adds_blinks_and_saccades():
    face, lids, saccades = motion()
    found = processed(NEUTRAL, face, 0 * lids, 0 * saccades)
    for one, other in zip(found, face):
        torch.testing.assert_close(one, other, atol=1e-15, rtol=0)
    found = processed(NEUTRAL, face, lids, saccades)
    blinks = torch.from_numpy(lids)[:, None, None] * poses().eye_close
    torch.testing.assert_close(found.skin, face.skin + blinks)
    torch.testing.assert_close(found.eyes, face.eyes + torch.from_numpy(saccades)[:, None])


number = st.floats(0, 1)


@settings(max_examples=25, deadline=None)
@given(
    shares=st.lists(st.lists(number, min_size=11, max_size=11), min_size=1, max_size=3),
    blocks=st.lists(st.integers(0, 9), max_size=4),
    fps=st.sampled_from([25.0, 30.0, 60.0]),
)
def test_the_skin_is_the_published_formula_in_any_blocks(shares, blocks, fps):
    names = (
        "skin_strength", "upper_face_strength", "lower_face_strength", "upper_face_smoothing",
        "lower_face_smoothing", "face_mask_level", "face_mask_softness", "lip_open_offset",
        "eyelid_open_offset", "blink_strength", "eyeballs_strength",
    )  # fmt: skip
    bounds = {c.name: (c.low, c.high) for c in PostProcessing.controls()}
    keys = [
        replace(NEUTRAL, **{n: bounds[n][0] + s * (bounds[n][1] - bounds[n][0]) for n, s in zip(names, row)})
        for row in shares
    ]
    track = PostTrack(np.linspace(0, 9 / fps, len(keys)).tolist(), keys)
    face, lids, saccades = motion()
    whole = processed(track, face, lids, saccades, fps=fps)
    np.testing.assert_allclose(whole.skin.numpy(), expected_skin(track, face.skin, lids, fps), atol=1e-12)
    streamed = processed(track, face, lids, saccades, blocks, fps)
    for one, other in zip(streamed, whole):
        assert torch.equal(one, other)


def test_tongue_jaw_and_eyes():
    face, lids, saccades = motion()
    controls = replace(
        NEUTRAL, tongue_strength=2.0, tongue_height_offset=0.5, tongue_depth_offset=-1.0,
        lower_teeth_strength=0.5, lower_teeth_height_offset=-0.25, lower_teeth_depth_offset=0.75,
        eyeballs_strength=0.5, saccade_strength=2.0, right_eye_rot_x_offset=1.0, right_eye_rot_y_offset=2.0,
        left_eye_rot_x_offset=-3.0, left_eye_rot_y_offset=4.0,
    )  # fmt: skip
    found = processed(controls, face, lids, saccades)
    up = torch.tensor([0.0, 0.005, -0.01]).double()
    torch.testing.assert_close(found.tongue, 2 * face.tongue + up)
    torch.testing.assert_close(found.jaw, 0.5 * face.jaw + torch.tensor([0, -0.0025, 0.0075]).double())
    turned = torch.deg2rad(torch.tensor([[1.0, 2.0], [-3.0, 4.0]]).double())
    torch.testing.assert_close(found.eyes, 0.5 * face.eyes + 2 * torch.from_numpy(saccades)[:, None] + turned)


def test_smoothing_halves_a_step_twice_over():
    """After a half-life a step has passed through two smoothers: 1 - (1 - a)(1 + a) of it, a = 1/2: 1/4."""
    face, lids, saccades = motion(2)
    still = FacePose(*(torch.zeros_like(x) for x in face))
    still.skin[1] = 0.01
    controls = replace(NEUTRAL, upper_face_smoothing=1 / FPS, lower_face_smoothing=1 / FPS)
    found = processed(controls, still, 0 * lids, 0 * saccades)
    torch.testing.assert_close(found.skin[1], 0.25 * still.skin[1])


def test_keys_are_linear_between_and_constant_beyond():
    track = PostTrack((1.0, 2.0), (NEUTRAL, replace(NEUTRAL, skin_strength=2.0)))
    found = track.values("skin_strength", np.array([0.0, 1.0, 1.25, 2.0, 9.0]))
    np.testing.assert_allclose(found, [1, 1, 1.25, 2, 2])
    with pytest.raises(OptionError, match="fall"):
        PostTrack((2.0, 1.0), (NEUTRAL, NEUTRAL))
    with pytest.raises(OptionError, match="one for each"):
        PostTrack((), ())
    with pytest.raises(OptionError, match="prediction_delay cannot change"):
        PostTrack((0.0, 1.0), (NEUTRAL, replace(NEUTRAL, prediction_delay=0.1)))


@settings(max_examples=30, deadline=None)
@given(
    delay=st.sampled_from([-0.9, -0.01, 0.0, 0.02, 0.7]),
    length=st.integers(0, 900),
    cuts=st.lists(st.integers(0, 900), max_size=4),
)
def test_sound_is_shifted_and_amplified(delay, length, cuts):
    rate = 1000
    controls = replace(NEUTRAL, prediction_delay=delay, input_strength=2.0)
    sound = np.random.default_rng(length).normal(size=length).astype(np.float32)
    hearing = PostHearing(PostTrack.of(controls), rate)
    parts = [hearing.push(block) for block in np.split(sound, sorted(min(cut, length) for cut in cuts))]
    parts.append(hearing.push(np.zeros(0, np.float32), last=True))
    shift = round(delay * rate)
    silence = np.zeros(abs(shift), np.float32)
    padded = np.concatenate([sound, silence])[shift:] if shift > 0 else np.concatenate([silence, sound])
    np.testing.assert_allclose(np.concatenate(parts), 2 * padded[:length], atol=1e-6)


def test_what_a_face_cannot_follow_is_named():
    assert PostProcessor(PostTrack.of(NEUTRAL), PARTS, TEMPLATE, FPS, poses()).without_effect == ()
    lacking = PostProcessor(PostTrack.of(NEUTRAL), PARTS, TEMPLATE, FPS).without_effect
    assert lacking == ("eyelid_open_offset", "blink_strength", "lip_open_offset")


# -- files -----------------------------------------------------------------------------------------------

FACE = {
    "upperFaceStrength": 1, "upperFaceSmoothing": 0.001, "lowerFaceStrength": 1.25,
    "lowerFaceSmoothing": 0.006, "faceMaskLevel": 0.6, "faceMaskSoftness": 0.0085, "skinStrength": 1,
    "eyelidOpenOffset": 0.0, "lipOpenOffset": 0.0, "tongueStrength": 1.3, "tongueHeightOffset": 0.0,
    "tongueDepthOffset": 0.0,
}  # fmt: skip


def nvidia_yml():
    """Keys and nesting of the sample clients' files; the values of `claire`."""
    lines = ["# Parameters related to the face", "face_parameters:"]
    lines += [f"  {name}: {value}  # what it does" for name, value in FACE.items()]
    lines += ["blendshape_parameters:", "  enable_clamping_bs_weight: False", "  multipliers:"]
    lines += ["    EyeBlinkLeft: 1.0", "    JawOpen: 0.8", "    TongueTipUp: 1.0"]
    lines += ["  offsets:", "    EyeBlinkLeft: 0.0", "    MouthClose: 0.1"]
    lines += ["live_transition_time: 0.0001", "beginning_emotion:", "  amazement: 1.0", "  # grief: 0.0"]
    lines += ["post_processing_parameters:", "  emotion_contrast: 1.0", "  live_blend_coef: 0.7"]
    lines += ["  enable_preferred_emotion: false", "  preferred_emotion_strength: 0.5"]
    lines += ["  emotion_strength: 0.6", "  max_emotions: 3", "emotion_with_timecode_list:"]
    lines += ["  emotion_with_timecode1:", "    time_code: 0.0", "    emotions:", "      joy: 1.0"]
    lines += ["      fear: 0.0", "  emotion_with_timecode2:", "    time_code: 1.0", "    emotions:"]
    lines += ["      fear: 0.75"]
    return "\n".join(lines) + "\n"


def test_nvidias_yml(tmp_path):
    path = tmp_path / "config_claire.yml"
    path.write_text(nvidia_yml())
    found = load_post_settings(path)
    assert found.track == PostTrack.of(PRESETS["claire"])
    assert found.multipliers == {"eyeBlinkLeft": 1.0, "jawOpen": 0.8, "tongueTipUp": 1.0}
    assert found.offsets == {"eyeBlinkLeft": 0.0, "mouthClose": 0.1}
    assert found.emotions == ((0.0, {"joy": 1.0, "fear": 0.0}), (1.0, {"fear": 0.75}))
    assert found.beginning == {"amazement": 1.0}
    assert found.emotion_controls["max_emotions"] == 3
    assert found.emotion_controls["enable_preferred_emotion"] is False
    assert found.emotion_controls["live_transition_time"] == 0.0001
    assert post_track(str(path)) == found.track
    assert post_track("sdk") == PostTrack.of(PostProcessing())


def test_model_config_json_and_keyframes(tmp_path):
    path = tmp_path / "model_config.json"
    path.write_text(
        '{"config": {"input_strength": 1.3, "upper_face_smoothing": 0.001, "lower_face_smoothing": 0.0023, '
        '"upper_face_strength": 1.0, "lower_face_strength": 1.7, "face_mask_level": 0.6, '
        '"face_mask_softness": 0.0085, "skin_strength": 1.1, "blink_strength": 1.0, '
        '"lower_teeth_strength": 1.3, "lower_teeth_height_offset": -0.1, "lower_teeth_depth_offset": 0.25, '
        '"lip_open_offset": -0.05, "tongue_strength": 1.5, "tongue_height_offset": 0.2, '
        '"tongue_depth_offset": -0.3, "eyeballs_strength": 1.0, "saccade_strength": 0.9, '
        '"right_eye_rot_x_offset": 0.0, "right_eye_rot_y_offset": -2.0, "left_eye_rot_x_offset": 0.0, '
        '"left_eye_rot_y_offset": 2.0, "eyelid_open_offset": 0.06, "eye_saccade_seed": 0, '
        '"source_shot": "cp1_neutral", "source_frame": 12}}'
    )
    found = load_post_settings(path)
    published = replace(PRESETS["framework"], lower_teeth_height_offset=-0.1, lower_teeth_depth_offset=0.25)
    assert found.track == PostTrack.of(published)
    assert found.source == ("cp1_neutral", 12)
    path = tmp_path / "moving.yml"
    path.write_text(
        "face_parameters: {skinStrength: 0.5}\nkeyframes:\n- {time: 2, skinStrength: 1.5}\n"
        "- {time: 0.5, rightEyeballRotationOffsetX: 3}\n"
    )
    track = load_post_settings(path).track
    assert track.times == (0.5, 2.0)
    assert [key.skin_strength for key in track.keys] == [0.5, 1.5]
    assert [key.right_eye_rot_x_offset for key in track.keys] == [3, 3]


BAD = {
    "no yaml": ("face_parameters: [", "YAML"),
    "a list": ("- 1", "mapping"),
    "an object": ("face_parameters: !!python/object/apply:os.system ['true']", "YAML"),
    "an alias": ("a: &x [1]\nb: *x", "aliases"),
    "a key twice": ("face_parameters: {skinStrength: 1, skinStrength: 2}", "twice"),
    "an unknown section": ("faces: {}", "no section faces"),
    "an unknown control": ("face_parameters: {noseStrength: 1}", "noseStrength"),
    "out of range": ("face_parameters: {skinStrength: 3}", "skin_strength is 3"),
    "a word": ("face_parameters: {skinStrength: much}", "skinStrength is 'much'"),
    "a truth": ("face_parameters: {skinStrength: true}", "expected a number"),
    "NaN": ("face_parameters: {skinStrength: .nan}", "skin_strength"),
    "a key without time": ("keyframes: [{skinStrength: 1}]", "time"),
    "an unknown emotion": ("beginning_emotion: {glee: 1}", "glee"),
    "too strong": ("emotion_with_timecode_list: {a: {time_code: 0, emotions: {joy: 2}}}", "joy"),
    "no time code": ("emotion_with_timecode_list: {a: {emotions: {joy: 1}}}", "time_code"),
    "no mapping of shapes": ("blendshape_parameters: {scales: {}}", "scales"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_files_are_named(name, tmp_path):
    path = tmp_path / "bad.yml"
    content, named = BAD[name]
    path.write_text(content)
    with pytest.raises(FileFormatError, match=named) as caught:
        load_post_settings(path)
    assert "bad.yml" in str(caught.value)


def test_missing_binary_and_huge_files(tmp_path):
    with pytest.raises(FileFormatError, match="cannot read"):
        load_post_settings(tmp_path / "none.yml")
    (tmp_path / "binary.yml").write_bytes(b"\xff\xfe\x00\x01")
    with pytest.raises(FileFormatError, match="YAML"):
        load_post_settings(tmp_path / "binary.yml")
    (tmp_path / "huge.yml").write_text("#" * (1 << 20) + "\n\n")
    with pytest.raises(FileFormatError, match="bytes"):
        load_post_settings(tmp_path / "huge.yml")
    (tmp_path / "deep.yml").write_text("[" * 5000)
    with pytest.raises(FileFormatError, match=r"deep\.yml"):
        load_post_settings(tmp_path / "deep.yml")
    with pytest.raises(OptionError, match="claire"):
        post_track("clair")


def test_the_docs_list_every_control():
    page = Path(__file__).parents[2] / "docs" / "post-processing.md"
    rows = [line for line in page.read_text().splitlines() if line.startswith("| `")]
    listed = {row.split("`")[1]: row for row in rows}
    for control in PostProcessing.controls():
        row = listed[control.name]
        unit = f" {control.unit}" if control.unit else ""
        assert f"| {control.default:g}{unit} | {control.low:g} to {control.high:g} |" in row
        assert control.description in row
