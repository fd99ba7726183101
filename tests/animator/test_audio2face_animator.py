"""Audio2Face's networks through the animator: offline and streaming, what can be chosen, what is refused."""

from dataclasses import replace

import av
import numpy as np
import pytest
import soundfile
import torch
import trimesh
from audio2face_small import noise, small_regression
from face_networks import head_actors, head_diffusion, head_regression
from hypothesis import given, settings
from hypothesis import strategies as st

from meshanim import Animator
from meshanim.animator import AnimationOptions
from meshanim.audio import load_encoder
from meshanim.cli import main
from meshanim.errors import FileFormatError, OptionError, ShapeError
from meshanim.heads import load_head
from meshanim.models.audio2face import EmotionTrack, FrameNoise, animate_diffusion, animate_regression
from meshanim.motion import MeshSequence
from meshanim.motion.post_processing import PRESETS, PostProcessing, PostTrack
from meshanim.performance import told_emotions

STILL = {"blinks": 0.0, "gaze": 0.0, "sway": 0.0}
MAKERS = {"regression": head_regression, "diffusion": head_diffusion}


@pytest.fixture(scope="module")
def animators():
    head, encoder = load_head("default"), load_encoder("mel")
    return {name: Animator(make(), encoder, head) for name, make in MAKERS.items()}


@pytest.fixture(params=MAKERS)
def animator(request, animators):
    return animators[request.param]


@settings(max_examples=8, deadline=None)
@given(
    cuts=st.lists(st.integers(0, 30000), max_size=5),
    kind=st.sampled_from(sorted(MAKERS)),
    rate=st.sampled_from([16000, 22050]),
)
def test_a_stream_gives_the_frames_of_the_file(animators, cuts, kind, rate):
    animator = animators[kind]
    keys = ("0:joy=1", "0.8:joy=0,anger=1")
    waveform, options = noise(1.7, rate=rate), AnimationOptions(seed=4, emotion_keys=keys)
    whole = animator(waveform, options)
    stream = animator.open(rate, options)
    parts = [stream.push(block) for block in np.split(waveform.samples, sorted(cuts))]
    parts.append(stream.finish())
    np.testing.assert_allclose(np.concatenate([p.vertices for p in parts]), whole.vertices, atol=1e-6)
    np.testing.assert_allclose(np.concatenate([p.pose for p in parts]), whole.pose, atol=1e-6)


def test_frames_come_before_the_speech_ends(animator):
    blocks = np.split(noise(3.0).samples, 30)
    taken = []

    def microphone():
        for block in blocks:
            taken.append(len(block))
            yield block

    stream = animator.stream(microphone())
    first = next(stream)
    assert first.shape[1:] == (5124, 3)
    assert len(taken) <= 12
    np.testing.assert_allclose(np.concatenate([first, *stream]), animator(noise(3.0)).vertices, atol=1e-6)


def test_vertices_are_those_of_the_network():
    """Skin, tongue, lower teeth and eyeballs, whole speech by the models' own functions."""
    head, encoder, waveform = load_head("default"), load_encoder("mel"), noise(1.2)
    still = AnimationOptions(**STILL, emotion="joy", seed=3)
    template = head_actors().templates["anna"]
    parts = head_actors().basis.parts

    network = head_regression()
    emotions = EmotionTrack.of(network.config.emotions, constant="joy")
    expected = network.actors.basis.vertices(
        animate_regression(network, encoder, waveform, emotions=emotions), template
    )
    found = Animator(network, encoder, head)(waveform, still)
    np.testing.assert_allclose(found.vertices, expected.numpy(), atol=1e-6)
    np.testing.assert_allclose(found.mesh.vertices, template, atol=1e-7)
    for name in ("skin", "tongue", "jaw_rigid", "right_eye", "left_eye"):
        assert np.abs(found.vertices - found.mesh.vertices)[:, getattr(parts, name)].max() > 1e-4, name

    network = head_diffusion()
    frames = animate_diffusion(
        network, encoder, waveform, "ben", emotions, FrameNoise(2, network.numbers, seed=3)
    )
    options = AnimationOptions(**STILL, emotion="joy", seed=3, subject="ben")
    found = Animator(network, encoder, head)(waveform, options)
    np.testing.assert_allclose(found.vertices, network.vertices(frames, "ben").numpy(), atol=2e-6)
    np.testing.assert_allclose(found.mesh.vertices, network.actors.templates["ben"], atol=1e-7)


def test_what_can_be_chosen_changes_what_is_seen(animators):
    waveform = noise(1.0)

    def motion(kind, **options):
        animator = animators[kind]
        sequence = animator(waveform, AnimationOptions(**STILL, **options))
        return sequence.vertices - sequence.mesh.vertices.astype(np.float32)

    plain = motion("regression")
    assert np.abs(motion("regression", emotion="joy") - plain).max() > 1e-4
    assert np.abs(motion("regression", implicit="b:3") - plain).max() > 1e-5
    half = motion("regression", emotion="joy", intensity=0.5)
    assert np.abs(half - motion("regression", emotion_keys=("0:joy=0.5",))).max() == 0
    plain = motion("diffusion")
    assert np.abs(motion("diffusion", subject="ben") - plain).max() > 1e-4
    assert np.abs(motion("diffusion", seed=5) - plain).max() > 1e-4
    assert np.abs(motion("diffusion", steps=4) - plain).max() > 1e-5
    network = animators["diffusion"].model
    same = FrameNoise(2, network.numbers, seed=5).frames(0, 30)
    assert np.abs(motion("diffusion", seed=5) - motion("diffusion", noise=same)).max() == 0
    # A row of strengths for each frame.
    rows = np.zeros((30, 2))
    rows[15:, 0] = 1
    track = EmotionTrack((np.arange(30) + 0.5) / 30, rows)
    felt = motion("diffusion", emotions=track)
    np.testing.assert_allclose(felt[:10], plain[:10], atol=1e-6)
    assert np.abs(felt[20:] - plain[20:]).max() > 1e-4


def test_who_speaks_and_idle_motion(animator):
    template = head_actors().templates["ben"].numpy()
    still = AnimationOptions(**STILL)
    ours, theirs = animator(noise(1.0), still), animator(noise(1.0), still, template)
    np.testing.assert_allclose(theirs.mesh.vertices, template, atol=1e-7)
    skin = head_actors().basis.parts.skin
    moves = [(s.vertices - s.mesh.vertices.astype(np.float32))[:, skin] for s in (ours, theirs)]
    np.testing.assert_allclose(*moves, atol=1e-6)
    blinking = animator(noise(6.0), AnimationOptions(blinks=1.0, gaze=0, sway=0, seed=0))
    lids = animator.head.regions["eyelids"]
    assert np.abs(blinking.vertices - animator(noise(6.0), still).vertices)[:, lids].max() > 2e-3
    assert animator(noise(1.0), AnimationOptions(sway=1.0)).pose.any()


def test_short_silent_and_any_rate(animator):
    short = animator(noise(0.05))
    assert len(short) == 2
    assert np.isfinite(short.vertices).all()
    for rate in (8000, 44100, 48000):
        assert len(animator(noise(1.5, rate=rate))) == 45


def test_bad_sound_is_named(animator, tmp_path):
    broken = np.zeros(8000, np.float32)
    broken[100] = np.nan
    soundfile.write(tmp_path / "nan.wav", broken, 16000, subtype="FLOAT")
    with pytest.raises(ShapeError, match=r"nan\.wav"):
        animator(tmp_path / "nan.wav")
    soundfile.write(tmp_path / "empty.wav", np.zeros(0), 16000)
    with pytest.raises(ShapeError, match=r"empty\.wav"):
        animator(tmp_path / "empty.wav")
    with pytest.raises(ShapeError, match="NaN"):
        animator.open().push(broken)
    with pytest.raises(ShapeError, match="no samples"):
        animator.open().finish()
    with pytest.raises(OptionError, match="rate"):
        animator.open(rate=0)
    stream = animator.open()
    stream.push(np.zeros(1600, np.float32))
    stream.finish()
    with pytest.raises(OptionError, match="finished"):
        stream.push(np.zeros(16, np.float32))


REFUSED = [
    ("both", {"emotion": "hangry"}, "hangry"),
    ("both", {"subject": "nobody"}, "nobody"),
    ("both", {"emotion_keys": ("joy",)}, "SECONDS:NAME"),
    ("both", {"emotion_keys": ("0:joy=much",)}, "joy=much"),
    ("both", {"emotion_keys": ("0:joy=1",), "intensity": 0.5}, "their own strengths"),
    ("both", {"emotion_keys": ("nan:joy",)}, "SECONDS:NAME"),
    ("both", {"intensity": 2.0}, "intensity"),
    ("regression", {"steps": 3}, "steps"),
    ("regression", {"noise": torch.zeros(2, 30, 3)}, "noise"),
    ("regression", {"implicit": "nowhere"}, "nowhere"),
    ("regression", {"implicit": "a:x"}, "CLIP:FRAME"),
    ("regression", {"fps": 0.0}, "fps"),
    ("diffusion", {"implicit": "a"}, "implicit"),
    ("diffusion", {"fps": 25.0}, "fps"),
    ("diffusion", {"steps": 0}, "denoising"),
]


@pytest.mark.parametrize(("kind", "options", "named"), REFUSED)
def test_options_that_do_not_fit_are_refused(animators, kind, options, named):
    for name in MAKERS if kind == "both" else (kind,):
        with pytest.raises(OptionError, match=named):
            animators[name].open(options=AnimationOptions(**options))


def test_gava_refuses_what_only_audio2face_has():
    animator = Animator.from_pretrained("default")
    for options in ({"steps": 2}, {"implicit": "a"}):
        with pytest.raises(OptionError, match="GAVA"):
            animator.open(options=AnimationOptions(**options))
    with pytest.raises(OptionError, match="2 emotions, the network 7"):
        animator.open(options=AnimationOptions(emotions=EmotionTrack.of(("joy", "anger"))))
    with pytest.raises(ShapeError, match="7 vertices"):
        animator.open(template=np.zeros((7, 3)))


def test_gava_follows_emotions_over_time():
    animator, sound = Animator.from_pretrained("default"), noise(1.5)

    def faces(**options):
        return animator(sound, AnimationOptions(**STILL, seal=False, **options)).vertices

    joy, neutral = faces(emotion="joy"), faces()
    np.testing.assert_array_equal(faces(emotion_keys=("0:joy",)), joy)
    np.testing.assert_array_equal(faces(emotion_keys=("0:neutral",)), neutral)
    assert np.abs(joy - neutral).max() > 1e-3
    changing = faces(emotion_keys=("0.5:neutral", "0.501:joy"))
    # Eyes move against the head, whose pose is smoothed over nine frames.
    np.testing.assert_allclose(changing[:11], neutral[:11], atol=1e-6)
    np.testing.assert_allclose(changing[19:], joy[19:], atol=1e-6)
    mixed = faces(emotion_keys=("0:joy=0.5,anger=0.5",))
    assert min(np.abs(mixed - other).max() for other in (joy, neutral, faces(emotion="anger"))) > 1e-3

    stream = animator.open(sound.rate, AnimationOptions(**STILL, seal=False))
    before = stream.push(sound.samples[:16000]).vertices
    stream.feel(EmotionTrack.of(told_emotions(animator.model), (0.0, {"joy": 1.0})))
    after = np.concatenate([stream.push(sound.samples[16000:]).vertices, stream.finish().vertices])
    np.testing.assert_allclose(before, neutral[: len(before)], atol=1e-6)
    np.testing.assert_allclose(after[16:], joy[len(before) + 16 :], atol=1e-6)


def test_networks_of_rigs_and_of_head_motion():
    head, encoder = load_head("default"), load_encoder("mel")
    rig = head_diffusion(target="rig", rig=("jawOpen", "mouthSmileLeft"))
    still = AnimationOptions(**STILL)
    sequence = Animator(rig, encoder, head)(noise(1.0), still)
    weights = rig.rig_weights(animate_diffusion(rig, encoder, noise(1.0)))
    names = [head.expression_names.index(name) for name in rig.config.rig]
    moved = (weights @ head.expression_directions[names]).unflatten(1, (-1, 3))
    np.testing.assert_allclose(sequence.vertices - sequence.mesh.vertices, moved.numpy(), atol=2e-6)
    unknown = head_diffusion(target="rig", rig=("jawOpen", "wiggle"))
    with pytest.raises(OptionError, match="wiggle"):
        Animator(unknown, encoder, head).open()
    turning = Animator(head_diffusion(head_motion=True), encoder, head)(noise(1.0), still)
    assert np.abs(turning.pose).max() > 0.01


def test_meshes_without_a_head(tmp_path):
    network = small_regression(languages=())
    animator = Animator(network, load_encoder("mel"))
    with pytest.raises(OptionError, match="faces"):
        animator(noise(0.5))
    frames = list(animator.stream(np.split(noise(1.0).samples, 10)))
    assert sum(map(len, frames)) == 30
    assert frames[0].shape[1:] == (85, 3)


@pytest.mark.parametrize(("kind", "output"), [("regression", "a.mp4"), ("diffusion", "a.glb")])
def test_folders_of_training_are_found_and_animated(kind, output, tmp_path):
    MAKERS[kind]().save_pretrained(tmp_path / "run" / "model")
    soundfile.write(tmp_path / "a.wav", noise(0.4).samples, 16000)
    words = ("animate", tmp_path / "a.wav", "--model", tmp_path / "run", "--emotion", "joy", "--size", 64)
    assert main([str(word) for word in (*words, "--quality", "draft", "-o", tmp_path / output)]) == 0
    if kind == "regression":
        with av.open(str(tmp_path / output)) as file:
            assert len(list(file.decode(video=0))) == 12
    else:
        assert len(trimesh.load(tmp_path / output).geometry) == 5
    again = Animator.from_pretrained(tmp_path / "run" / "model")
    np.testing.assert_allclose(
        again(noise(0.4)).vertices,
        Animator(MAKERS[kind](), load_encoder("mel"), load_head("default"))(noise(0.4)).vertices,
        atol=1e-6,
    )
    (tmp_path / "run" / "model" / "model.safetensors").write_bytes(b"damaged")
    with pytest.raises(FileFormatError, match=r"model\.safetensors"):
        Animator.from_pretrained(tmp_path / "run")


def test_another_head_by_correspondence(tmp_path):
    from meshanim.geometry import decimate

    head = load_head("default")
    small = decimate(head.mesh, 2500)
    mesh = small.mesh
    np.savez(
        tmp_path / "rig.npz", neutral=mesh.vertices, faces=mesh.faces,
        deltas=np.zeros((1, mesh.n_vertices, 3)), names=["none"],
    )  # fmt: skip
    animator = Animator(
        head_regression(), load_encoder("mel"), head, load_head(f"rig:{tmp_path / 'rig.npz'}")
    )
    still = AnimationOptions(**STILL)
    sequence = animator(noise(0.6), still)
    own = Animator(head_regression(), load_encoder("mel"), head)(noise(0.6), still)
    expected = np.einsum(
        "ij,tjc->tic", small.operator.toarray(), own.vertices - own.mesh.vertices.astype(np.float32)
    )
    error = sequence.vertices - mesh.vertices - expected
    assert np.sqrt(np.square(error).mean()) < 0.3 * np.sqrt(np.square(expected).mean())
    # Somebody else with the target's topology.
    other = mesh.vertices.astype(np.float32) * np.float32(1.02)
    theirs = animator(noise(0.6), still, other)
    np.testing.assert_allclose(theirs.vertices - other, sequence.vertices - mesh.vertices, atol=1e-5)
    np.testing.assert_allclose(theirs.mesh.vertices, other, atol=1e-7)


# -- post-processing -------------------------------------------------------------------------------------

MOVING = PostTrack(
    (0.2, 1.0),
    (
        PostProcessing(prediction_delay=0.1, lower_face_smoothing=0.05, face_mask_level=0.4),
        PostProcessing(
            prediction_delay=0.1, input_strength=2.0, upper_face_smoothing=0.03, face_mask_level=0.5,
            skin_strength=1.5, right_eye_rot_y_offset=9.0, blink_strength=0.5,
        ),
    ),
)  # fmt: skip


@pytest.fixture(scope="module")
def three(animators):
    return animators | {"gava": Animator.from_pretrained("default")}


@pytest.mark.parametrize("kind", [*MAKERS, "gava"])
def test_post_processing_of_a_stream_is_that_of_the_file(three, kind):
    options = AnimationOptions(controls=MOVING, blinks=1.0, seed=2)
    waveform = noise(1.6)
    whole = three[kind](waveform, options)
    stream = three[kind].open(16000, options)
    assert stream.without_effect == ()
    parts = [stream.push(block) for block in np.split(waveform.samples, [100, 9000, 9001, 20000])]
    parts.append(stream.finish())
    np.testing.assert_allclose(np.concatenate([p.vertices for p in parts]), whole.vertices, atol=2e-6)
    assert np.abs(whole.vertices - three[kind](waveform, AnimationOptions(seed=2)).vertices).max() > 1e-3


@pytest.mark.parametrize("kind", [*MAKERS, "gava"])
def test_neutral_post_processing_leaves_frames_as_they_are(three, kind):
    options = {"blinks": 0.7, "seed": 5}
    plain = three[kind](noise(2.5), AnimationOptions(**options))
    neutral = three[kind](noise(2.5), AnimationOptions(**options, post="neutral"))
    skin = head_actors().basis.parts.skin
    np.testing.assert_allclose(neutral.vertices[:, skin], plain.vertices[:, skin], atol=1e-6)
    # Eyeballs and lower teeth become rigid; GAVA's are so nearly.
    np.testing.assert_allclose(neutral.vertices, plain.vertices, atol=1e-6 if kind in MAKERS else 2e-3)


def test_controls_move_what_they_are_named_after(three):
    parts, waveform = head_actors().basis.parts, noise(0.2)

    def moved(kind, **controls):
        two = (
            three[kind](waveform, AnimationOptions(**STILL, controls=replace(PRESETS["neutral"], **each)))
            for each in ({}, controls)
        )
        plain, other = (sequence.vertices for sequence in two)
        return other - plain

    for kind in three:
        lips = moved(kind, lip_open_offset=0.2)
        upper, lower = np.split(lips[:, parts.lip_pairs, 1].mean((0, 1)), 2)
        assert upper > 1e-4 > -1e-4 > lower
        lids = moved(kind, eyelid_open_offset=-1.0)
        upper, lower = np.split(lids[:, parts.lid_pairs, 1].mean((0, 1)), 2)
        assert upper - lower < -2e-3
        assert not lids[:, parts.tongue].any()
        np.testing.assert_allclose(moved(kind, tongue_height_offset=1.0)[:, parts.tongue, 1], 0.01, atol=1e-6)
        np.testing.assert_allclose(
            moved(kind, lower_teeth_depth_offset=0.5)[:, parts.jaw_rigid, 2], 0.005, atol=1e-5
        )
        right = moved(kind, right_eye_rot_x_offset=10.0)
        front = parts.right_eye[int(head_actors().templates["anna"][parts.right_eye, 2].argmax())]
        assert right[:, front, 1].max() < -1e-3
        assert np.abs(right[:, parts.left_eye]).max() < 1e-6


def test_post_processing_on_the_command_line(tmp_path, capsys):
    soundfile.write(tmp_path / "a.wav", noise(0.3).samples, 16000)
    (tmp_path / "c.yml").write_text(
        "face_parameters: {skinStrength: 1.5}\nemotion_with_timecode_list: {a: {time_code: 0, emotions: "
        "{joy: 1.0, fear: 0.0}}}\n"
    )
    head_regression().save_pretrained(tmp_path / "model")

    def run(*words):
        given = ("animate", tmp_path / "a.wav", "-o", tmp_path / "a.npz", "--blinks", 0, "--head", "own")
        return main([str(word) for word in (*given, *words)])

    post = ("--model", tmp_path / "model", "--post", tmp_path / "c.yml")
    assert run(*post, "--emotion-keys", tmp_path / "c.yml") == 0
    animator = Animator.from_pretrained(tmp_path / "model")
    options = AnimationOptions(blinks=0, controls=PostProcessing(skin_strength=1.5), emotion="joy")
    template = MeshSequence.load(tmp_path / "a.npz").mesh.vertices.astype(np.float32)
    np.testing.assert_allclose(
        MeshSequence.load(tmp_path / "a.npz").vertices,
        animator(tmp_path / "a.wav", options, template).vertices,
        atol=1e-6,
    )
    capsys.readouterr()
    (tmp_path / "c.yml").write_text("face_parameters: {skinStrength: 15}")
    for words, named in ((post, "skin_strength is 15"), (("--post", "clair"), "claire")):
        assert run(*words) == 2
        assert named in capsys.readouterr().err
