"""Corpora of emotional speech: their published layouts, one vocabulary of six emotions, split by speakers.

| layout | files | speakers |
| --- | --- | --- |
| ravdess | 03-01-06-01-02-01-12.wav: modality, channel, emotion, level, statement, repetition, actor | 24 |
| crema-d | 1001_DFA_ANG_XX.wav: actor, sentence, emotion, level | 91 |
| jl | female1_angry_10a_1.wav: speaker, emotion, sentence, repetition | 4 |
| emo-db | 03a01Fa.wav: speaker, text, emotion, version | 10 |
| emozionalmente | metadata/samples.csv with file_name, actor, emotion_expressed; audio/ | 431 |
| tess | OAF_back_angry.wav: speaker, word, emotion | 2 |
| savee | DC/sa01.wav or DC_sa01.wav: speaker, emotion and number | 4 |
| iemocap | Session1/sentences/wav/DIALOG/NAME.wav, labels in Session1/dialog/EmoEvaluation/DIALOG.txt | 10 |
| folders | SPEAKER/EMOTION/*.wav: your own, and the embedded corpus's | |

Classes as in Audio2Face-3D, App. A.3: clips of other emotions (calm, boredom, surprise, ...) are left out;
JL's and IEMOCAP's "excited" counts as joy.
"""

import csv
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from meshanim.errors import FileFormatError, OptionError
from meshanim.motion.emotions import HEARD_EMOTIONS

__all__ = ["LAYOUTS", "EmotionalClip", "read_emotional", "split_speakers"]

SOUNDS = (".wav", ".flac", ".ogg", ".mp3")


@dataclass(frozen=True)
class EmotionalClip:
    """One utterance.

    Parameters
    ----------
    path : Path
        Its sound.
    speaker : str
        CORPUS:NAME, so that corpora can be put together.
    emotion : str
        One of `HEARD_EMOTIONS`.
    """

    path: Path
    speaker: str
    emotion: str


Found = Iterator[tuple[Path, str, str | None]]
"""Path, speaker and emotion of every clip of a layout; None is an emotion that is none of the six."""


def _named(
    directory: Path, pattern: str, emotions: dict[str, str]
) -> Iterator[tuple[Path, re.Match, str | None]]:
    """Files whose names fit, with what they say; the group `emotion` is looked up."""
    expression = re.compile(pattern)
    for path in sorted(directory.rglob("*.wav")):
        match = expression.fullmatch(path.stem)
        if match is not None and not path.name.startswith("."):
            yield path, match, emotions.get(match["emotion"].lower())


RAVDESS = {"01": "neutral", "03": "joy", "04": "sadness", "05": "anger", "06": "fear", "07": "disgust"}
CREMA_D = {"ang": "anger", "dis": "disgust", "fea": "fear", "hap": "joy", "neu": "neutral", "sad": "sadness"}
JL = {"angry": "anger", "happy": "joy", "excited": "joy", "neutral": "neutral", "sad": "sadness"}
EMO_DB = {"w": "anger", "e": "disgust", "a": "fear", "f": "joy", "n": "neutral", "t": "sadness"}
TESS = {
    "angry": "anger",
    "disgust": "disgust",
    "fear": "fear",
    "happy": "joy",
    "neutral": "neutral",
    "sad": "sadness",
}
SAVEE = {"a": "anger", "d": "disgust", "f": "fear", "h": "joy", "n": "neutral", "sa": "sadness"}
IEMOCAP = {"ang": "anger", "hap": "joy", "exc": "joy", "neu": "neutral", "sad": "sadness"}
ITALIAN = {name: name for name in HEARD_EMOTIONS} | {"neutrality": "neutral"}


def _ravdess(directory: Path) -> Found:
    pattern = r"(?P<modality>\d\d)-(?P<channel>\d\d)-(?P<emotion>\d\d)-\d\d-\d\d-\d\d-(?P<actor>\d\d)"
    for path, match, emotion in _named(directory, pattern, RAVDESS):
        if match["channel"] == "01":  # 02 is song
            yield path, match["actor"], emotion


def _crema_d(directory: Path) -> Found:
    pattern = r"(?P<actor>1\d{3})_[A-Z]{3}_(?P<emotion>[A-Z]{3})_(LO|MD|HI|XX|X)"
    for path, match, emotion in _named(directory, pattern, CREMA_D):
        yield path, match["actor"], emotion


def _jl(directory: Path) -> Found:
    pattern = r"(?P<speaker>(fe)?male\d)_(?P<emotion>[a-z]+)_\d+[ab]_\d+"
    for path, match, emotion in _named(directory, pattern, JL):
        yield path, match["speaker"], emotion


def _emo_db(directory: Path) -> Found:
    pattern = r"(?P<speaker>\d\d)[ab]\d\d(?P<emotion>[WLEAFTN])[a-z]?"
    for path, match, emotion in _named(directory, pattern, EMO_DB):
        yield path, match["speaker"], emotion


def _tess(directory: Path) -> Found:
    # One file of the release is called OA_bite_neutral.wav.
    pattern = r"(?P<speaker>OAF?|YAF)_[A-Za-z]+_(?P<emotion>[a-z]+)"
    for path, match, emotion in _named(directory, pattern, TESS):
        yield path, match["speaker"].replace("OAF", "OA").replace("OA", "OAF"), emotion


def _savee(directory: Path) -> Found:
    pattern = r"((?P<speaker>[A-Z]{2})_)?(?P<emotion>sa|su|[adfhn])\d\d"
    for path, match, emotion in _named(directory, pattern, SAVEE):
        speaker = match["speaker"] or path.parent.name
        if speaker in ("DC", "JE", "JK", "KL"):
            yield path, speaker, emotion


def _iemocap(directory: Path) -> Found:
    line = re.compile(
        r"\[\d+\.\d+ - \d+\.\d+\]\t(?P<name>(?P<dialog>Ses\d\d\w+)_(?P<who>[MF])\d+)\t(?P<emotion>\w+)\t.*"
    )
    for labels in sorted(directory.rglob("EmoEvaluation/Ses*.txt")):
        session = labels.parents[2]
        for match in map(line.fullmatch, _text(labels).splitlines()):
            if match is not None:
                path = session / "sentences" / "wav" / match["dialog"] / f"{match['name']}.wav"
                yield path, match["name"][:5] + match["who"], IEMOCAP.get(match["emotion"])


def _emozionalmente(directory: Path) -> Found:
    for table in sorted(directory.rglob("metadata/samples.csv")):
        rows = list(csv.DictReader(_text(table).splitlines()))
        needed = {"file_name", "actor", "emotion_expressed"}
        if rows and not needed <= set(rows[0]):
            raise FileFormatError(f"{table} has no columns {', '.join(sorted(needed - set(rows[0])))}")
        for number, row in enumerate(rows, start=1):
            if not all(row[name] for name in needed):
                raise FileFormatError(f"{table}: row {number} is cut short")
            path = table.parents[1] / "audio" / row["file_name"]
            yield path, row["actor"], ITALIAN.get(row["emotion_expressed"])


def _folders(directory: Path) -> Found:
    for path in sorted(directory.glob("*/*/*")):
        if path.suffix.lower() in SOUNDS and not path.name.startswith("."):
            yield path, path.parents[1].name, ITALIAN.get(path.parent.name.lower())


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise FileFormatError(f"cannot read {path}: {error}") from error


LAYOUTS: dict[str, Callable[[Path], Found]] = {
    "ravdess": _ravdess,
    "crema-d": _crema_d,
    "jl": _jl,
    "emo-db": _emo_db,
    "emozionalmente": _emozionalmente,
    "tess": _tess,
    "savee": _savee,
    "iemocap": _iemocap,
    "folders": _folders,
}


def read_emotional(directory: str | Path, layout: str = "auto") -> list[EmotionalClip]:
    """The clips of a corpus that have one of the six emotions, by path.

    Parameters
    ----------
    directory : str or Path
        Where it was unpacked; files may lie deeper.
    layout : str
        One of `LAYOUTS`; "auto" takes the one that knows files there.

    Raises
    ------
    OptionError
        If there is no such layout, or the files fit several.
    FileFormatError
        If the folder is missing or holds no clip of a layout, a label names a sound that is not there, a
        sound is empty, or a table is damaged.
    """
    directory = Path(directory)
    if not directory.is_dir():
        raise FileFormatError(f"{directory} is not a folder; expected a corpus of emotional speech")
    if layout not in (*LAYOUTS, "auto"):
        raise OptionError(f"no layout {layout!r}; there are auto, {', '.join(LAYOUTS)}")
    tried = [name for name in LAYOUTS if name != "folders"] if layout == "auto" else [layout]
    found = {name: clips for name in tried if (clips := list(LAYOUTS[name](directory)))}
    if layout == "auto" and not found and (clips := list(_folders(directory))):
        found = {"folders": clips}
    if len(found) > 1:
        raise OptionError(f"{directory} holds {' and '.join(found)}: give one folder each, or the layout")
    if not found:
        raise FileFormatError(
            f"{directory} holds no clip of {'any layout known' if layout == 'auto' else layout}"
        )
    ((name, clips),) = found.items()
    known = [
        EmotionalClip(path, f"{name}:{speaker}", emotion)
        for path, speaker, emotion in clips
        if emotion is not None
    ]
    if not known:
        raise FileFormatError(f"{directory} holds no clip with one of {', '.join(HEARD_EMOTIONS)}")
    for clip in known:
        if not clip.path.is_file():
            raise FileFormatError(f"{clip.path} is missing; {name}'s labels name it")
        if clip.path.stat().st_size == 0:
            raise FileFormatError(f"{clip.path} is empty: unpack the corpus again")
    return known


def split_speakers(
    clips: Sequence[EmotionalClip], share: float = 0.2
) -> tuple[list[EmotionalClip], list[EmotionalClip]]:
    """Clips to train on and to test on, with no speaker in both.

    Of each corpus the last speakers by name are held out: `share` of them, at least one where there are two.
    Corpora of one speaker are trained on.

    Parameters
    ----------
    clips : sequence of EmotionalClip
        Of any corpora.
    share : float
        Of the speakers, 0 to 1.

    Raises
    ------
    OptionError
        If the share is out of range.
    """
    if not 0 <= share < 1:
        raise OptionError(f"the share of held-out speakers must be within 0 to 1, not {share}")
    people: dict[str, list[str]] = {}
    for speaker in sorted({clip.speaker for clip in clips}):
        people.setdefault(speaker.partition(":")[0], []).append(speaker)
    held: set[str] = set()
    for speakers in people.values():
        count = max(1, round(share * len(speakers))) if share > 0 and len(speakers) > 1 else 0
        held.update(speakers[len(speakers) - count :])
    return [clip for clip in clips if clip.speaker not in held], [
        clip for clip in clips if clip.speaker in held
    ]
