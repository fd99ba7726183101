"""Corpora of emotional speech on small trees with the names of the real ones, whole and damaged."""

import pytest

from meshanim.datasets.emotional import EmotionalClip, read_emotional, split_speakers
from meshanim.errors import FileFormatError, OptionError
from meshanim.motion.emotions import HEARD_EMOTIONS

# What each tree holds: file, speaker, emotion (None: left out).
TREES = {
    "ravdess": [
        ("Audio_Speech_Actors_01-24/Actor_01/03-01-01-01-01-01-01.wav", "01", "neutral"),
        ("Audio_Speech_Actors_01-24/Actor_01/03-01-02-01-01-01-01.wav", "01", None),  # calm
        ("Audio_Speech_Actors_01-24/Actor_01/03-01-03-02-02-01-01.wav", "01", "joy"),
        ("Audio_Speech_Actors_01-24/Actor_02/03-01-04-01-01-02-02.wav", "02", "sadness"),
        ("Audio_Speech_Actors_01-24/Actor_02/03-01-05-01-01-02-02.wav", "02", "anger"),
        ("Audio_Speech_Actors_01-24/Actor_24/03-01-06-01-02-01-24.wav", "24", "fear"),
        ("Audio_Speech_Actors_01-24/Actor_24/03-01-07-01-02-01-24.wav", "24", "disgust"),
        ("Audio_Speech_Actors_01-24/Actor_24/03-01-08-01-02-01-24.wav", "24", None),  # surprised
        ("Audio_Song_Actors_01-24/Actor_24/03-02-05-01-02-01-24.wav", "24", None),  # song
    ],
    "crema-d": [
        ("AudioWAV/1001_DFA_ANG_XX.wav", "1001", "anger"),
        ("AudioWAV/1001_IEO_DIS_LO.wav", "1001", "disgust"),
        ("AudioWAV/1002_IEO_FEA_MD.wav", "1002", "fear"),
        ("AudioWAV/1002_IEO_HAP_HI.wav", "1002", "joy"),
        ("AudioWAV/1091_WSI_NEU_XX.wav", "1091", "neutral"),
        ("AudioWAV/1040_ITH_SAD_X.wav", "1040", "sadness"),  # the release's one odd level
    ],
    "jl": [
        ("Raw JL corpus (unchecked and unannotated)/JL(wav+txt)/female1_angry_10a_1.wav", "female1", "anger"),
        ("Raw JL corpus (unchecked and unannotated)/JL(wav+txt)/female2_excited_1b_2.wav", "female2", "joy"),
        ("Raw JL corpus (unchecked and unannotated)/JL(wav+txt)/male1_happy_15a_1.wav", "male1", "joy"),
        ("Raw JL corpus (unchecked and unannotated)/JL(wav+txt)/male2_neutral_3a_2.wav", "male2", "neutral"),
        ("Raw JL corpus (unchecked and unannotated)/JL(wav+txt)/male2_sad_3a_2.wav", "male2", "sadness"),
        ("Raw JL corpus (unchecked and unannotated)/JL(wav+txt)/male2_apologetic_3a_2.wav", "male2", None),
    ],
    "emo-db": [
        ("wav/03a01Fa.wav", "03", "joy"),
        ("wav/03a01Nc.wav", "03", "neutral"),
        ("wav/03a01Wa.wav", "03", "anger"),
        ("wav/08b10Aa.wav", "08", "fear"),
        ("wav/16b10Eb.wav", "16", "disgust"),
        ("wav/16b10Td.wav", "16", "sadness"),
        ("wav/16b10La.wav", "16", None),  # boredom
    ],
    "tess": [
        ("OAF_angry/OAF_back_angry.wav", "OAF", "anger"),
        ("OAF_neutral/OA_bite_neutral.wav", "OAF", "neutral"),
        ("YAF_disgust/YAF_back_disgust.wav", "YAF", "disgust"),
        ("YAF_fear/YAF_back_fear.wav", "YAF", "fear"),
        ("YAF_happy/YAF_back_happy.wav", "YAF", "joy"),
        ("YAF_sad/YAF_back_sad.wav", "YAF", "sadness"),
        ("YAF_pleasant_surprised/YAF_back_ps.wav", "YAF", None),
    ],
    "savee": [
        ("AudioData/DC/a01.wav", "DC", "anger"),
        ("AudioData/DC/d15.wav", "DC", "disgust"),
        ("AudioData/JE/f02.wav", "JE", "fear"),
        ("AudioData/JK/h02.wav", "JK", "joy"),
        ("AudioData/KL/n30.wav", "KL", "neutral"),
        ("AudioData/KL/sa01.wav", "KL", "sadness"),
        ("AudioData/KL/su01.wav", "KL", None),
    ],
    "folders": [
        ("anna/joy/01.wav", "anna", "joy"),
        ("anna/neutral/a.flac", "anna", "neutral"),
        ("ben/anger/x.wav", "ben", "anger"),
        ("ben/bored/x.wav", "ben", None),
    ],
}


def make(folder, names):
    for name in names:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"RIFF")
    return folder


def told(folder, layout="auto"):
    return {
        (clip.path.relative_to(folder).as_posix(), clip.speaker, clip.emotion)
        for clip in read_emotional(folder, layout)
    }


@pytest.mark.parametrize("layout", TREES)
def test_published_names(tmp_path, layout):
    make(tmp_path, [name for name, _, _ in TREES[layout]])
    make(tmp_path, [str((tmp_path / TREES[layout][0][0]).parent / "._hidden.wav"), "README.wav"])
    expected = {(name, f"{layout}:{who}", what) for name, who, what in TREES[layout] if what is not None}
    assert told(tmp_path) == expected
    assert told(tmp_path, layout) == expected


def test_savee_without_folders(tmp_path):
    make(tmp_path, ["ALL/DC_a01.wav", "ALL/KL_sa10.wav"])
    assert told(tmp_path) == {
        ("ALL/DC_a01.wav", "savee:DC", "anger"),
        ("ALL/KL_sa10.wav", "savee:KL", "sadness"),
    }


LABELS = """% [START_TIME - END_TIME] TURN_NAME EMOTION [V, A, D]

[6.2901 - 8.2357]\tSes01F_impro01_F000\tneu\t[2.5000, 2.5000, 2.5000]
C-E2:\tNeutral;\t()
A-M1:\tval 3; act 2; dom  2;\t()

[10.0100 - 11.3925]\tSes01F_impro01_M001\texc\t[2.5000, 2.5000, 2.5000]
[14.8872 - 18.0175]\tSes01F_impro01_F002\tfru\t[2.5000, 2.5000, 2.5000]
[19.2900 - 20.7875]\tSes01F_impro01_F003\txxx\t[2.5000, 3.0000, 2.5000]
[21.3257 - 24.7400]\tSes01F_impro01_M004\tsad\t[2.5000, 3.0000, 2.5000]
"""


def iemocap(folder):
    make(
        folder,
        [
            f"Session1/sentences/wav/Ses01F_impro01/Ses01F_impro01_{who}.wav"
            for who in ("F000", "M001", "F002", "M004")
        ],
    )
    labels = folder / "Session1/dialog/EmoEvaluation/Ses01F_impro01.txt"
    labels.parent.mkdir(parents=True)
    labels.write_text(LABELS)
    other = labels.parent / "Categorical" / "Ses01F_impro01_e2_cat.txt"
    other.parent.mkdir()
    other.write_text("Ses01F_impro01_F000 :Neutral state; ()\n")
    return folder


def test_iemocap(tmp_path):
    where = "Session1/sentences/wav/Ses01F_impro01/Ses01F_impro01_"
    assert told(iemocap(tmp_path)) == {
        (f"{where}F000.wav", "iemocap:Ses01F", "neutral"),
        (f"{where}M001.wav", "iemocap:Ses01M", "joy"),
        (f"{where}M004.wav", "iemocap:Ses01M", "sadness"),
    }
    (tmp_path / f"{where}M001.wav").unlink()
    with pytest.raises(FileFormatError, match=r"M001\.wav is missing"):
        read_emotional(tmp_path)


SAMPLES = """timestamp,file_name,actor,sentence,emotion_expressed
2021-01-01,1.wav,anna95,"Vorrei il numero telefonico del Signor Piatti.",joy
2021-01-02,2.wav,anna95,"Bella la tua casa, davvero",neutrality
2021-01-02,3.wav,ugo,"Bella la tua casa, davvero",surprise
2021-01-03,4.wav,ugo,"Bella la tua casa, davvero",disgust
"""


def test_emozionalmente(tmp_path):
    root = make(tmp_path / "emozionalmente_dataset", [f"audio/{k}.wav" for k in (1, 2, 3, 4)])
    table = root / "metadata" / "samples.csv"
    table.parent.mkdir()
    table.write_text(SAMPLES)
    assert told(root) == {
        ("audio/1.wav", "emozionalmente:anna95", "joy"),
        ("audio/2.wav", "emozionalmente:anna95", "neutral"),
        ("audio/4.wav", "emozionalmente:ugo", "disgust"),
    }
    assert len(read_emotional(tmp_path)) == 3
    table.write_text(SAMPLES.replace("actor", "who"))
    with pytest.raises(FileFormatError, match="no columns actor"):
        read_emotional(tmp_path)
    table.write_text(SAMPLES[:-20])
    with pytest.raises(FileFormatError, match="row 4 is cut short"):
        read_emotional(tmp_path)
    table.write_bytes(b"\xff\xfe\xff" + SAMPLES.encode())
    with pytest.raises(FileFormatError, match="cannot read"):
        read_emotional(tmp_path)
    table.write_text(SAMPLES)
    (root / "audio" / "2.wav").write_bytes(b"")
    with pytest.raises(FileFormatError, match=r"2\.wav is empty"):
        read_emotional(tmp_path)


def test_what_is_no_corpus(tmp_path):
    with pytest.raises(FileFormatError, match="not a folder"):
        read_emotional(tmp_path / "none")
    with pytest.raises(FileFormatError, match="any layout"):
        read_emotional(tmp_path)
    with pytest.raises(OptionError, match="no layout 'msp'"):
        read_emotional(tmp_path, "msp")
    make(tmp_path / "a", ["wav/16b10La.wav"])
    with pytest.raises(FileFormatError, match="no clip with one of anger"):
        read_emotional(tmp_path / "a")
    make(tmp_path / "b", ["wav/03a01Fa.wav", "AudioWAV/1001_DFA_ANG_XX.wav"])
    with pytest.raises(OptionError, match="crema-d and emo-db"):
        read_emotional(tmp_path / "b")
    assert len(read_emotional(tmp_path / "b", "emo-db")) == 1


def test_no_speaker_is_in_both_halves(tmp_path):
    clips = [
        EmotionalClip(tmp_path / f"{corpus}{who}{emotion}", f"{corpus}:{who}", emotion)
        for corpus, people in (("a", "qwertzuiop"), ("b", "xy"), ("c", "x"))
        for who in people
        for emotion in HEARD_EMOTIONS
    ]
    train, test = split_speakers(clips, 0.2)
    assert not {clip.speaker for clip in train} & {clip.speaker for clip in test}
    assert sorted(map(str, (clip.path for clip in train + test))) == sorted(str(clip.path) for clip in clips)
    assert {clip.speaker for clip in test} == {"a:w", "a:z", "b:y"}
    assert split_speakers(clips[::-1], 0.2)[1][::-1] == test
    assert split_speakers(clips, 0)[1] == []
    with pytest.raises(OptionError, match="share"):
        split_speakers(clips, 1.0)
