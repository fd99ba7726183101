"""Subjects, sentences and splits of data sets as their authors and successors publish them."""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

__all__ = ["BIWI", "PUBLISHED", "VOCASET", "Published", "Split", "recognise"]


@dataclass(frozen=True)
class Split:
    """Which sentences of which subjects belong to a split.

    Parameters
    ----------
    subjects : tuple of str
        In the published order, which is the order of one-hot codes.
    sentences : range
        Numbers.
    """

    subjects: tuple[str, ...]
    sentences: range


@dataclass(frozen=True)
class Published:
    """What is known about a data set before its files are opened.

    Parameters
    ----------
    name : str
        Of the data set.
    fps : float
        Frames a second of its files.
    unit : str
        Of its files in FaceFormer's layout.
    vertices : int
        Of its meshes.
    sentence : str
        Regular expression of a sentence's name; its group is the number.
    splits : dict of Split
        By name.
    """

    name: str
    fps: float
    unit: str
    vertices: int
    sentence: str
    splits: Mapping[str, tuple[Split, ...]]

    @property
    def subjects(self) -> tuple[str, ...]:
        """Everybody, in the order of the splits."""
        return tuple(
            dict.fromkeys(name for parts in self.splits.values() for part in parts for name in part.subjects)
        )

    def number(self, sentence: str) -> int | None:
        """The number in a sentence's name; None where it is none of the public splits' kind."""
        found = re.fullmatch(self.sentence, sentence)
        return int(found[1]) if found else None

    def ordered(self, subjects: Iterable[str]) -> list[str]:
        """Subjects in the published order, others after them."""
        names = list(subjects)
        return [name for name in self.subjects if name in names] + sorted(set(names) - set(self.subjects))

    def split(self, sequences: Sequence[tuple[str, str, str]]) -> dict[str, tuple[str, ...]]:
        """The published splits of the sequences that are there.

        `spare` is what no published split has although its subject is a published one: VOCASET's first
        twenty sentences of the held-out subjects, BIWI's neutral half.

        Parameters
        ----------
        sequences : sequence of (name, subject, sentence)
            Everything there is.
        """
        result: dict[str, list[str]] = {name: [] for name in (*self.splits, "spare")}
        for name, subject, sentence in sequences:
            number = self.number(sentence)
            inside = [
                split
                for split, parts in self.splits.items()
                if any(subject in part.subjects and number in part.sentences for part in parts)
            ]
            if not inside and subject in self.subjects:
                inside = ["spare"]
            for split in inside:
                result[split].append(name)
        return {name: tuple(members) for name, members in result.items()}


def _face_talk(*names: str) -> tuple[str, ...]:
    return tuple(f"FaceTalk_{name}_TA" for name in names)


VOCASET = Published(
    name="vocaset",
    fps=60.0,
    unit="m",
    vertices=5023,
    sentence=r"sentence(\d\d)",
    splits={
        "train": (
            Split(
                _face_talk(
                    "170728_03272",
                    "170904_00128",
                    "170725_00137",
                    "170915_00223",
                    "170811_03274",
                    "170913_03279",
                    "170904_03276",
                    "170912_03278",
                ),
                range(1, 41),
            ),
        ),
        "val": (Split(_face_talk("170811_03275", "170908_03277"), range(21, 41)),),
        "test": (Split(_face_talk("170809_00138", "170731_00024"), range(21, 41)),),
    },
)
"""VOCASET (Cudeiro et al. 2019); lists of VOCA's and FaceFormer's configurations."""

_BIWI_SEEN = ("F2", "F3", "F4", "M3", "M4", "M5")
_BIWI_UNSEEN = ("F1", "F5", "F6", "F7", "F8", "M1", "M2", "M6")
BIWI = Published(
    name="biwi",
    fps=25.0,
    unit="biwi",
    vertices=23370,
    sentence=r"e(\d\d)",
    splits={
        "train": (Split(_BIWI_SEEN, range(1, 33)),),
        "val": (Split(_BIWI_SEEN, range(33, 37)),),
        "test_a": (Split(_BIWI_SEEN, range(37, 41)),),
        "test_b": (Split(_BIWI_UNSEEN, range(37, 41)),),
        "test": (Split(_BIWI_SEEN + _BIWI_UNSEEN, range(37, 41)),),
    },
)
"""BIWI B3D(AC)^2 (Fanelli et al. 2010); the splits of FaceFormer and CodeTalker, test A and B."""

PUBLISHED = {published.name: published for published in (VOCASET, BIWI)}


def recognise(subjects: Iterable[str], vertices: int) -> Published | None:
    """The published data set that has these subjects and this topology; None if there is none."""
    names = set(subjects)
    for published in PUBLISHED.values():
        if published.vertices == vertices and names & set(published.subjects):
            return published
    return None
