"""The command line: `meshanim VERB`, one file a verb."""

import sys

from meshanim.errors import MeshanimError

__all__ = ["main"]


def main(arguments: list[str] | None = None) -> int:
    """Run one verb; a `MeshanimError` becomes one line on standard error and exit code 2."""
    from meshanim.cli import doctor

    arguments = sys.argv[1:] if arguments is None else arguments
    debug = "--debug" in arguments
    arguments = [argument for argument in arguments if argument != "--debug"]
    try:
        return doctor.run()
    except MeshanimError as error:
        if debug:
            raise
        print(f"meshanim: {error}", file=sys.stderr)
        return 2
