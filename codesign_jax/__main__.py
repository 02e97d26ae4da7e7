"""`python -m codesign_jax` is the command `codesign`, for a PATH without the environment's bin."""

import sys

from codesign_jax.cli import main

if __name__ == "__main__":
    sys.exit(main())
