"""`python -m iblf_jax`: the same as the console script `iblf-jax`."""

import sys

from iblf_jax.cli import main

if __name__ == "__main__":
    sys.exit(main())
