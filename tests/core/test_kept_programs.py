"""Programs that a later process reads: the same bits, and no trace."""

from __future__ import annotations

import os
import pickle
import subprocess
import sys

import pytest

from iblf_jax.core import kept_programs

SCRIPT = """
import hashlib
import jax
jax.config.update("jax_enable_x64", True)
traced = set()
def listen(event, seconds, **of):
    if event.endswith("jaxpr_trace_duration"):
        traced.add(of.get("fun_name"))
jax.monitoring.register_event_duration_secs_listener(listen)
import iblf_jax as ij
paper = ij.presets.zhang_yan_2024()
run = ij.simulate(paper, duration=0.05, dt=1e-3)
content = b"".join(jax.numpy.asarray(x).tobytes() for x in jax.tree.leaves(run))
print(hashlib.sha256(content).hexdigest())
print(*sorted({"_initial_values", "_initialize", "_all_steps", "_finalized"} & traced))
"""


def printed(folder, **variables):
    """The digest of a run in a process of its own, and the functions that were traced."""
    environment = os.environ | {"XDG_CACHE_HOME": str(folder), **variables}
    found = subprocess.run(
        [sys.executable, "-c", SCRIPT], capture_output=True, text=True, check=True, env=environment
    )
    digest, traced = found.stdout.splitlines()
    return digest, traced.split()


@pytest.mark.slow
def test_a_second_process_traces_nothing_and_a_damaged_entry_is_made_again(tmp_path):
    kept = {"JAX_ENABLE_COMPILATION_CACHE": "1"}
    everything = ["_all_steps", "_finalized", "_initial_values", "_initialize"]
    digest, traced = printed(tmp_path, **kept)
    assert traced == everything
    entries = sorted((tmp_path / "iblf_jax").glob("*.program"))
    assert len(entries) == 5
    assert printed(tmp_path, **kept) == (digest, [])
    # Other options are another environment.
    assert printed(tmp_path, **kept, IBLF_JAX_THREADS="3") == (digest, everything)
    for entry in entries:
        content = bytearray(entry.read_bytes())
        content[len(content) // 2] ^= 1
        entry.write_bytes(content)
    assert printed(tmp_path, **kept) == (digest, everything)
    # Without its kernels, a program is compiled again.
    for kernel in (tmp_path / "iblf_jax").glob("*.so"):
        kernel.unlink()
    found, traced = printed(tmp_path, **kept)
    assert found == digest
    assert "_all_steps" in traced


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "iblf_jax"


def test_a_value_is_read_under_its_own_key(folder, monkeypatch):
    kept_programs.keep("one", (1, 2.0))
    assert kept_programs.read("one") == (1, 2.0)
    assert kept_programs.read("other") is None
    # Two keys of one file: the entry says whose it is.
    monkeypatch.setattr(
        kept_programs, "cache_path", lambda content, suffix: next(folder.glob(f"*{suffix}"))
    )
    assert kept_programs.read("other") is None
    assert kept_programs.read("one") == (1, 2.0)


def test_a_damaged_value_is_not_read(folder):
    kept_programs.keep("one", (1, 2.0))
    (entry,) = folder.glob("*.program")
    content = entry.read_bytes()
    for damaged in (b"", content[:-1], content[:5] + b"x" + content[6:], pickle.dumps(("one", 3))):
        entry.write_bytes(damaged)
        assert kept_programs.read("one") is None
    kept_programs.keep("one", (1, 2.0))
    assert kept_programs.read("one") == (1, 2.0)
