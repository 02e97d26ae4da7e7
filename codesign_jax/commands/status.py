"""Exit statuses.  Nothing heavy is imported here: `--help` is to be quick."""

import sys
from collections.abc import Callable


def of(run: Callable[[], int]) -> int:
    """Runs a parsed command and returns its exit status.

    Wrong input, and files that can no longer be written or read, are said on stderr.
    """
    from codesign_jax.scene.schema import SceneError

    try:
        return run()
    except SceneError as error:
        for problem in error.problems:
            print(f"error: {problem}", file=sys.stderr)
        return 2
    except OSError as error:
        if error.filename is None:
            raise
        print(f"error: {error.filename}: {error.strerror}", file=sys.stderr)
        return 1
