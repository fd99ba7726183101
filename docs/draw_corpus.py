"""Three subjects of the embedded corpus in turn: python docs/draw_corpus.py writes corpus.mp4, corpus.jpg."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from tqdm import tqdm

from meshanim.audio import Waveform, voices
from meshanim.datasets.synthetic.corpus import CURVE_NAMES, SynthesizeOptions, act, cast, takes
from meshanim.export import contact_sheet, write_video
from meshanim.heads import HeadParameters, load_head
from meshanim.motion import MeshSequence
from meshanim.render import render_sequence
from meshanim.render.look import PEOPLE, look_assets, make_appearance

LOOKS = ("priya", "jun", "lena")
SIZE, FPS, SENTENCE = 320, 30, 3
WAITING = 0.6


def main() -> None:
    """Identity, style and voice are those of subjects S01, S02, S03 for seed 0; skin and hair are lent."""
    head = load_head("default")
    assets = look_assets(head)
    options = SynthesizeOptions(Path(), subjects=3, sentences=SENTENCE, fps=FPS, seed=0, emotional=0)
    members = cast(options, len(head.shape_names), voices())
    spoken = [take for take in takes(options, members) if take.sentence == SENTENCE]
    pictures, sounds = [], []
    for take, look in zip(spoken, LOOKS):
        waveform, _, performance = act(take, FPS)
        shape = torch.tensor([take.member.shape], dtype=torch.float32)
        curves = np.stack(
            [performance.curves[:, CURVE_NAMES.index(name)] for name in head.expression_names], axis=1
        )
        with torch.no_grad():
            vertices = head(HeadParameters(shape=shape, expression=torch.from_numpy(curves))).numpy()
        person = replace(PEOPLE[look], identity="", shape=take.member.shape, rest_expression={})
        appearance = make_appearance(head, person, assets=assets)
        sequence = MeshSequence(vertices, FPS, head.mesh, performance.pose, waveform)
        frames = render_sequence(sequence, head, appearance, SIZE, SIZE, expression=curves)
        pictures.append(list(tqdm(frames, total=len(sequence), desc=take.member.name)))
        sounds.append(_fitted(waveform, len(sequence)))
    folder = Path(__file__).parent
    rate = max(sound.rate for sound in sounds)
    samples = np.concatenate([sound.resampled(rate).samples for sound in sounds])
    write_video(folder / "corpus.mp4", _in_turn(pictures), FPS, Waveform(samples, rate), crf=23)
    columns = 10
    steps = np.linspace(0, 1, columns)
    tiles = [panel[round(step * (len(panel) - 1))] for panel in pictures for step in steps]
    sheet = Image.fromarray(contact_sheet(tiles, columns)).resize((columns * 168, 3 * 168), Image.LANCZOS)
    sheet.save(folder / "corpus.jpg", quality=88)


def _fitted(waveform: Waveform, frames: int) -> Waveform:
    """Sound exactly as long as the frames."""
    count = round(frames * waveform.rate / FPS)
    samples = np.pad(waveform.samples, (0, max(0, count - len(waveform.samples))))[:count]
    return Waveform(samples, waveform.rate)


def _in_turn(pictures: list[list[np.ndarray]]):
    """One speaks, the others wait in dimmer light."""
    for speaker, panel in enumerate(pictures):
        still = [
            (WAITING * (other[0] if index > speaker else other[-1])).astype(np.uint8)
            for index, other in enumerate(pictures)
        ]
        for frame in panel:
            yield np.concatenate([*still[:speaker], frame, *still[speaker + 1 :]], axis=1)


if __name__ == "__main__":
    main()
