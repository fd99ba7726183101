"""`meshanim solve`: the motion of a mesh in, blendshape weights out."""

import sys
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

from tyro.conf import OmitArgPrefixes, Positional, arg

from meshanim.errors import OptionError
from meshanim.export.track import TRACK_ENDINGS, write_track
from meshanim.files import check_writable
from meshanim.heads import load_head
from meshanim.motion import MeshSequence
from meshanim.motion.audio2face_rig import read_solver_config
from meshanim.motion.blendshape_csv import CsvForm
from meshanim.motion.blendshape_solver import SolverOptions
from meshanim.motion.personal_shapes import Method
from meshanim.motion.post_files import load_post_settings
from meshanim.motion.solve_sequence import arkit_only, head_for, solve_sequence
from meshanim.motion.vertex_sampling import sample_vertices

__all__ = ["COMMANDS", "SolveOptions", "solve"]


@dataclass(frozen=True)
class SolveOptions:
    """Find the blendshape weights of a mesh sequence, and say what they leave of its motion in mm.

    Example: meshanim solve talk.npz -o talk.csv
    """

    motion: Positional[Path]
    """A mesh sequence, .npz: `meshanim animate speech.wav -o talk.npz` writes one."""
    output: Annotated[Path, arg(aliases=["-o"])] = Path("weights.csv")
    """The ending chooses: csv, npz (names, weights, fps, pose), or the face with its shapes and weights as
    glb, usda or usdc (extra usd)."""
    csv: CsvForm = "audio2face"
    """Whose columns a csv has: those of Audio2Face-3D, or those of Live Link Face, which has the head's turn
    and ARKit's 52 shapes alone."""
    head: str = "default"
    """Whose shapes: default, rig:/path/face.glb or any other that `load_head` takes. A sequence of another
    topology gets them by correspondence with its template."""
    method: Method = "deformation_transfer"
    """How another topology gets them."""
    samples: int | None = None
    """How many vertices to look at; all that shapes move if not given."""
    config: Path | None = None
    """Options from the JSON of an Audio2Face-3D rig, instead of the ones below; or multipliers and offsets
    from a .yml of its post-processing, beside them."""
    replay: Path | None = None
    """Also write the motion that the weights make, .npz."""
    replay_head: str | None = None
    """Whose motion that is: any head with shapes of these names, such as rig:/path/character.glb that
    `meshanim data personalize` wrote; the sequence's own face if not given."""
    json: Path | None = None
    """Also write the residuals here."""
    terms: OmitArgPrefixes[SolverOptions] = field(default_factory=SolverOptions)


def solve(options: SolveOptions) -> None:
    """Run the verb."""
    for path, endings in ((options.output, TRACK_ENDINGS), (options.replay, (".npz",))):
        if path is not None and path.suffix.lower() not in endings:
            raise OptionError(f"cannot write {path}: the ending must be {' or '.join(endings)}")
        if path is not None:
            check_writable(path)
    if options.replay_head is not None and options.replay is None:
        raise OptionError("--replay-head needs --replay, the file to write")
    sequence = MeshSequence.load(options.motion)
    head = head_for(sequence, load_head(options.head), options.method)
    terms = options.terms
    if options.config is not None and options.config.suffix.lower() in (".yml", ".yaml"):
        settings = load_post_settings(options.config)
        scales, added = (
            {name: by for name, by in values.items() if name in head.expression_names}
            for values in (settings.multipliers, settings.offsets)
        )
        terms = replace(terms, multipliers=scales, offsets=added)
    elif options.config is not None:
        count = len(sample_vertices(head, options.samples).vertices)
        terms = read_solver_config(options.config, head.expression_names, count)
        terms = replace(terms, nvidia_parity=options.terms.nvidia_parity)
    if options.output.suffix.lower() == ".csv" and options.csv == "livelink":
        terms = arkit_only(terms, head)
    solved = solve_sequence(sequence, head, terms, options.samples, sys.stderr.isatty())
    write_track(options.output, solved.track, head, sequence.mesh.vertices, csv=options.csv)
    if options.replay is not None:
        other = options.replay_head
        motion = solved.motion if other is None else solved.track.animate(load_head(other))
        motion.save(options.replay)
    print(solved.residual.table())
    print(f"wrote {options.output}: {len(solved.track)} frames, {len(solved.track.names)} shapes")
    if options.json is not None:
        solved.residual.save(options.json)


COMMANDS = solve
