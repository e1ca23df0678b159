"""What a Python that the tests start does first: notebooks, benchmarks and commands trace as much
as the tests do (`conftest.py`)."""

import gc

# Tracing makes millions of objects that live as long as the process: at Python's own setting a
# tenth of its time is a search for garbage.
gc.set_threshold(50_000, 20, 20)
