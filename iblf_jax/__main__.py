"""`python -m iblf_jax`: the same as the console script `iblf-jax`."""

from iblf_jax.cli import entry

if __name__ == "__main__":
    entry()
