"""The command line: `meshanim VERB`, one file a verb."""

import importlib
import os
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import tyro

from meshanim.errors import MeshanimError, OptionError
from meshanim.files import check_writable

__all__ = ["main"]

# A verb's module has COMMANDS: its command, or a mapping from the second word to one. A command is a function
# of one frozen dataclass, whose docstring and field comments are the help.
VERBS = {
    "animate": "speech in; a video, glTF, npz or contact sheet of a talking head out",
    "demo": "the same on a recorded sentence that ships with the package",
    "train": "train a network: gava, a2f-regression, a2f-diffusion, audio2emotion, syncnet",
    "evaluate": "score models and motion on held-out data, compare scores: gava, a2f, motion, ...",
    "avatar": "Gaussian avatars: fit to pictures, evaluate on held-out ones, render",
    "data": "data sets: synthesize, info, check, convert, augment-pose, personalize, ...",
    "emotion": "speech in, the emotions that are heard in it out, over time",
    "solve": "the motion of a mesh in, blendshape weights out",
    "export": "networks for other programs: onnx",
    "serve": "speech in, blendshape weights out over a network: grpc",
    "bench": "measurements that anyone can repeat: attention, animate, realtime, solve, splat, ...",
    "doctor": "what is installed, which backends work, how to get what is missing",
}
# Threads that wait by spinning slow each other down many times where other programs want the cores too.
# Read when torch loads, which no verb has done yet.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")
Command = Callable[[Any], object]


def main(arguments: list[str] | None = None) -> int:
    """Run one verb.

    Parameters
    ----------
    arguments : list of str, optional
        The words after `meshanim`; those of the process if not given.

    Returns
    -------
    int
        The exit code: 0, or 2 after one line on standard error if a `MeshanimError` was raised
        (`--debug` lets it through with its traceback).
    """
    words = list(sys.argv[1:] if arguments is None else arguments)
    debug = "--debug" in words
    if debug:
        words.remove("--debug")
    try:
        return _run(words)
    except MeshanimError as error:
        if debug:
            raise
        print(f"meshanim: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    except BrokenPipeError:  # the reader of a pipe has seen enough
        sys.stdout = None
        return 0
    except KeyboardInterrupt:
        return 130


def _run(words: list[str]) -> int:
    if not words or words[0] in ("-h", "--help"):
        print("usage: meshanim VERB [OPTIONS]    (meshanim VERB --help says more)\n")
        print("\n".join(f"  {verb:10s}{what}" for verb, what in VERBS.items()))
        return 0
    if words[0] == "--version":
        from meshanim import __version__

        print(__version__)
        return 0
    verb, rest = words[0], words[1:]
    if verb not in VERBS:
        raise OptionError(f"no verb '{verb}'; there are {', '.join(VERBS)}")
    command = importlib.import_module(f"meshanim.cli.{verb}").COMMANDS
    prog = f"meshanim {verb}"
    if isinstance(command, Mapping):
        if not rest or rest[0] in ("-h", "--help"):
            print(f"usage: {prog} {{{','.join(command)}}} [OPTIONS]\n")
            print("\n".join(f"  {name:16s}{_first_line(one)}" for name, one in command.items()))
            return 0
        if rest[0] not in command:
            raise OptionError(f"no '{prog} {rest[0]}'; there are {', '.join(command)}")
        prog, command, rest = f"{prog} {rest[0]}", command[rest[0]], rest[1:]
    return _call(command, rest, prog)


def _call(command: Command, words: list[str], prog: str) -> int:
    try:
        options: object = tyro.cli(_options_of(command), args=words, prog=prog)
    except SystemExit as stop:  # --help, or words that do not parse; tyro has said which
        return stop.code if isinstance(stop.code, int) else 2
    _check_results(options)
    code = command(options)
    return code if isinstance(code, int) else 0


def _check_results(options: object) -> None:
    """Say before long work whether results can be written; the verb itself may make its output folder."""
    results, output = getattr(options, "json", None), getattr(options, "output", None)
    if isinstance(results, Path) and (output is None or Path(output) not in results.parents):
        check_writable(results)


def _options_of(command: Command) -> type:
    (options,) = (hint for name, hint in command.__annotations__.items() if name != "return")
    return options


def _first_line(command: Command) -> str:
    return (_options_of(command).__doc__ or "").strip().split("\n")[0]
