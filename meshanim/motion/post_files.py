"""Files with post-processing: NVIDIA's .yml and model_config.json, and the same with keyframes."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import yaml

from meshanim.errors import FileFormatError, OptionError
from meshanim.motion.emotions import EMOTIONS
from meshanim.motion.post_processing import PRESETS, PostProcessing, PostTrack

__all__ = ["PostSettings", "load_post_settings", "post_track"]

LARGEST = 1 << 20
"""Bytes of a file of settings."""
OTHER_NAMES = {
    "saccade_seed": "eye_saccade_seed",
    **{
        f"{side}_eyeball_rotation_offset_{axis}": f"{side}_eye_rot_{axis}_offset"
        for side in ("right", "left")
        for axis in "xy"
    },
}
"""The SDK's names where they are not those of its config files."""
SECTIONS = (
    "face_parameters",
    "keyframes",
    "blendshape_parameters",
    "live_transition_time",
    "beginning_emotion",
    "post_processing_parameters",
    "emotion_with_timecode_list",
)


@dataclass(frozen=True)
class PostSettings:
    """What a file says.

    Parameters
    ----------
    track : PostTrack
        Controls of the face; what the file does not name is as in the SDK.
    multipliers, offsets : mapping of str to float
        Of blendshape weights, by ARKit's names (jawOpen): those of `SolverOptions`.
    emotions : tuple of (float, mapping)
        Strengths by name at times, seconds: what `EmotionTrack.of` takes.
    beginning : mapping
        Strengths at the beginning, before any are heard.
    emotion_controls : mapping
        Post-processing of heard emotions, and `live_transition_time`.
    source : tuple of (str, int), optional
        Shot and frame of the implicit emotion (model_config.json).
    """

    track: PostTrack
    multipliers: Mapping[str, float] = field(default_factory=dict)
    offsets: Mapping[str, float] = field(default_factory=dict)
    emotions: tuple[tuple[float, Mapping[str, float]], ...] = ()
    beginning: Mapping[str, float] = field(default_factory=dict)
    emotion_controls: Mapping[str, float | bool] = field(default_factory=dict)
    source: tuple[str, int] | None = None


class _PlainLoader(yaml.SafeLoader):
    """Plain values only: no tags, no aliases (which can make a small file huge), no key twice."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            raise yaml.composer.ComposerError(
                None, None, "aliases are not read", self.peek_event().start_mark
            )
        return super().compose_node(parent, index)

    def construct_mapping(self, node: Any, deep: bool = False) -> dict:
        keys = [self.construct_object(key, deep=True) for key, _ in node.value]
        for key in keys:
            if keys.count(key) > 1:
                raise yaml.constructor.ConstructorError(None, None, f"{key!r} twice", node.start_mark)
        return super().construct_mapping(node, deep)


def load_post_settings(path: str | Path) -> PostSettings:
    """Read NVIDIA's config_claire.yml and the like, a model_config.json, or a file with `keyframes`.

    Keyframes are a list of mappings with `time` in seconds and controls; a control that a key does not name
    has the value of the key before. Names are as in `PostProcessing` or as NVIDIA spells them
    (`lowerFaceStrength`).

    Raises
    ------
    FileFormatError
        If the file is missing, no YAML or JSON of plain values, or holds a name or value that is not known.
    """
    try:
        content = Path(path).read_bytes()
        if len(content) > LARGEST:
            raise FileFormatError(f"{path} has {len(content)} bytes; settings have fewer than {LARGEST}")
        values = yaml.load(content.decode("utf-8"), _PlainLoader)  # a SafeLoader
        return _settings(values)
    except OSError as error:
        raise FileFormatError(f"cannot read {path}: {error.strerror or error}") from error
    except (yaml.YAMLError, UnicodeDecodeError, RecursionError) as error:
        raise FileFormatError(f"{path} is no YAML of plain values: {error}") from error
    except (OptionError, ValueError, TypeError) as error:
        raise FileFormatError(f"{path}: {error}") from error


def post_track(what: str) -> PostTrack:
    """Controls by the name of a preset, or of a file.

    Raises
    ------
    OptionError
        If it is neither.
    FileFormatError
        If the file cannot be read.
    """
    if what in PRESETS:
        return PostTrack.of(PRESETS[what])
    if Path(what).suffix.lower() not in (".yml", ".yaml", ".json"):
        raise OptionError(f"no post-processing {what!r}; there are {', '.join(PRESETS)}, or a .yml or .json")
    return load_post_settings(what).track


def _settings(values: Any) -> PostSettings:
    if not isinstance(values, dict):
        raise ValueError("expected a mapping")
    if "config" in values:  # model_config.json
        config = dict(_mapping(values["config"], "config"))
        shot, frame = config.pop("source_shot", None), config.pop("source_frame", None)
        source = None if shot is None or frame is None else (str(shot), int(frame))
        return PostSettings(PostTrack.of(controls_of(config, PostProcessing())), source=source)
    unknown = set(values) - set(SECTIONS)
    if unknown:
        raise ValueError(f"no section {', '.join(sorted(map(str, unknown)))}; known: {', '.join(SECTIONS)}")
    base = controls_of(_mapping(values.get("face_parameters"), "face_parameters"), PostProcessing())
    shapes = _mapping(values.get("blendshape_parameters"), "blendshape_parameters")
    heard = dict(_mapping(values.get("post_processing_parameters"), "post_processing_parameters"))
    if "live_transition_time" in values:
        heard["live_transition_time"] = values["live_transition_time"]
    return PostSettings(
        _keyframes(values.get("keyframes"), base),
        _weights(shapes, "multipliers"),
        _weights(shapes, "offsets"),
        _emotions(values.get("emotion_with_timecode_list")),
        _strengths(values.get("beginning_emotion"), "beginning_emotion"),
        {
            str(name): value if isinstance(value, bool) else _number(value, name)
            for name, value in heard.items()
        },
    )


def _mapping(value: Any, name: str) -> Mapping[str, Any]:
    if value is None:
        return {}
    if not isinstance(value, dict) or not all(isinstance(key, str) for key in value):
        raise ValueError(f"{name} must be a mapping of names")
    return value


def _number(value: Any, name: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(f"{name} is {value!r}, expected a number")
    return float(value)


def controls_of(values: Mapping[str, Any], base: PostProcessing) -> PostProcessing:
    """Controls by name, the rest as in `base`; names as here, in the SDK, or in the service (skinStrength).

    Raises
    ------
    ValueError
        If there is no such control, or a value is no number.
    OptionError
        If a number is outside its range.
    """
    known = {control.name for control in PostProcessing.controls()}
    found = {}
    for name, value in values.items():
        plain = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name).lower()
        plain = OTHER_NAMES.get(plain, plain)
        if plain not in known:
            raise ValueError(f"no control {name}; there are {', '.join(sorted(known))}")
        found[plain] = _number(value, name)
    return replace(base, **found)


def _keyframes(values: Any, base: PostProcessing) -> PostTrack:
    if values is None:
        return PostTrack.of(base)
    if not isinstance(values, list):
        raise ValueError("keyframes must be a list")
    timed = []
    for entry in values:
        entry = dict(_mapping(entry, "a keyframe"))
        if "time" not in entry:
            raise ValueError("a keyframe needs its time")
        timed.append((_number(entry.pop("time"), "time"), entry))
    times, keys = [], []
    for time, entry in sorted(timed, key=lambda one: one[0]):
        base = controls_of(entry, base)
        times.append(time)
        keys.append(base)
    return PostTrack(times, keys)


def _weights(shapes: Mapping[str, Any], name: str) -> dict[str, float]:
    unknown = set(shapes) - {"multipliers", "offsets", "enable_clamping_bs_weight"}
    if unknown:
        raise ValueError(f"blendshape_parameters has no {', '.join(sorted(unknown))}")
    values = _mapping(shapes.get(name), name)
    return {key[:1].lower() + key[1:]: _number(value, key) for key, value in values.items()}


def _strengths(values: Any, name: str) -> dict[str, float]:
    found = {key: _number(value, key) for key, value in _mapping(values, name).items()}
    for key, value in found.items():
        if key not in ("neutral", *EMOTIONS) or not 0 <= value <= 1:
            raise ValueError(f"{name}: {key} {value:g}; expected one of {', '.join(EMOTIONS)}, 0 to 1")
    return found


def _emotions(values: Any) -> tuple[tuple[float, Mapping[str, float]], ...]:
    keys = []
    for name, entry in _mapping(values, "emotion_with_timecode_list").items():
        entry = _mapping(entry, name)
        time = _number(entry.get("time_code"), f"time_code of {name}")
        keys.append((time, _strengths(entry.get("emotions"), name)))
    return tuple(sorted(keys, key=lambda key: key[0]))
