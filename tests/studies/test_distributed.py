"""Several processes on loopback, two CPU devices each: the same bits as one, and a clear end when
one is killed."""

from __future__ import annotations

import signal
import socket
import subprocess
import sys
import time

import jax
import numpy as np
import pytest
import study_cases as cases

import iblf_jax as ij
from iblf_jax import cli
from iblf_jax.cli._studies import UNFINISHED
from iblf_jax.studies import distributed


def free_address():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"127.0.0.1:{probe.getsockname()[1]}"


def is_free(port):
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) != 0


def job(compiled, tmp_path, words, more=((), ()), devices="2"):
    """Starts two processes."""
    address = free_address()
    return [
        cases.start(
            compiled,
            str(tmp_path / f"{i}.npz"),
            *words,
            "--devices",
            devices,
            "--job",
            address,
            "2",
            str(i),
            *more[i],
        )
        for i in (0, 1)
    ]


@pytest.mark.slow
@pytest.mark.parametrize(("devices", "lost"), [("1", 0), ("2", 1)])
def test_a_killed_process_ends_the_other_and_what_they_had_is_kept(
    compiled, tmp_path, devices, lost
):
    """Whether it is the one at whose address they meet or another: exit code 3.  One process goes
    on with what two had."""
    path = tmp_path / "sweep.zarr"
    how = [("--slow", "1.0"), ("--slow", "1.0")]
    how[lost] = ("--die-after", "2")
    both = job(compiled, tmp_path, ("--store", str(path)), how, devices)
    survivor, victim = both[1 - lost], both[lost]
    victim.communicate(timeout=300)
    assert victim.returncode == -signal.SIGKILL
    begin = time.monotonic()
    _, errors = survivor.communicate(timeout=60)
    assert time.monotonic() - begin < 30
    assert survivor.returncode == distributed.LOST == UNFINISHED, errors
    assert "another process was lost" in errors
    assert "start the same command again" in errors
    assert 0 < ij.load_sweep(path).attrs["computed_cases"] < 6 * cases.RUNS
    assert cases.table(store=path).identical(cases.table())


@pytest.mark.slow
def test_two_processes_agree_with_one(compiled, tmp_path):
    """A sweep with a store, and a study."""
    for process in job(compiled, tmp_path, ("--store", str(tmp_path / "sweep.zarr"), "--study")):
        _, errors = process.communicate(timeout=300)
        assert process.returncode == 0, errors
    one = cases.arrays(cases.table()) | cases.named(cases.study())
    for i in (0, 1):
        assert cases.same(dict(np.load(tmp_path / f"{i}.npz")), one)


@pytest.mark.slow
def test_slurm_says_where_the_processes_meet(tmp_path, compiled):
    """Two processes with the variables that `srun` gives them, and `--distributed` alone."""
    file, path = tmp_path / "sweep.toml", tmp_path / "sweep.zarr"
    file.write_text(cases.SWEEP)
    one = cases.arrays(cases.from_file(cases.SWEEP))
    last = 2**16 - 2**12  # JAX takes the port from the number of the job
    port = next(last + i for i in range(2**12) if is_free(last + i))
    common = {
        "SLURM_JOB_ID": str(port - last),
        "SLURM_STEP_NODELIST": "localhost",
        "SLURM_NTASKS": "2",
    }
    words = ("-m", "iblf_jax", "sweep", str(file), "--store", str(path), "--distributed", "--quiet")
    both = [
        cases.start_python(compiled, *words, **common, SLURM_PROCID=i, SLURM_LOCALID=i)
        for i in "01"
    ]
    for rank, process in enumerate(both):
        out, errors = process.communicate(timeout=300)
        assert process.returncode == 1, errors  # some runs leave their bounds
        assert ("1800 runs" in out) == (rank == 0)
    found = ij.load_sweep(path)
    assert found.attrs["computed_cases"] == 1800
    assert cases.same(cases.arrays(found), one)


def test_a_job_that_srun_did_not_start_is_told_so(monkeypatch):
    monkeypatch.setenv("SLURM_JOB_ID", "1")

    def initialize(*_, **__):
        raise ValueError("coordinator_address should be defined.")

    monkeypatch.setattr(jax.distributed, "initialize", initialize)
    with pytest.raises(ValueError, match="Start the processes with srun"):
        distributed.initialize()


def test_a_stalled_process_is_not_waited_for_for_ever(monkeypatch):
    monkeypatch.setattr(distributed, "LEAST_PATIENCE", 0.2)
    with pytest.raises(distributed.ProcessLostError, match=r"x has 3 of 5 units, which are valid"):
        distributed.wait_for(lambda: 3, 5, 0.0, "x")
    with pytest.raises(distributed.ProcessLostError, match="did not answer"):
        distributed.bounded(lambda: time.sleep(2), 0.1)
    assert distributed.bounded(lambda: 3, 5.0) == 3


def test_progress_of_others_keeps_the_patience(monkeypatch):
    monkeypatch.setattr(distributed, "LEAST_PATIENCE", 0.5)
    begin = time.monotonic()
    distributed.wait_for(lambda: int(4 * (time.monotonic() - begin)), 5, 0.0, "x")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("localhost:1", None, None), "all three"),
        (("localhost", 2, 0), "port"),
        (("localhost:1", 0, 0), "num_processes"),
        (("localhost:1", 2, 2), "from 0 to 1"),
        (("localhost:0", 2, 0), "1 to 65535"),
        (("localhost:99999", 2, 0), "1 to 65535"),
        (("localhost:-1", 2, 0), "1 to 65535"),
        (("localhost:²", 2, 0), "1 to 65535"),
        (("localhost:" + "9" * 5000, 2, 0), "1 to 65535"),
        ((":1234", 2, 0), "address"),
        (("local host:1234", 2, 0), "address"),
    ],
)
def test_bad_jobs_are_refused(words, message):
    with pytest.raises(ValueError, match=message):
        distributed.initialize(*words)


@pytest.mark.parametrize("seconds", [0, -5, 86401, 99999999999, 1.5, True, "10", None])
@pytest.mark.parametrize("name", ["heartbeat", "start"])
def test_seconds_that_the_runtime_cannot_take_are_refused(name, seconds):
    with pytest.raises(
        ValueError, match=f"{name}: got .*, expected a whole number of seconds from 1 to 86400"
    ):
        distributed.initialize("localhost:1", 1, 0, **{name: seconds})


def test_a_port_in_use_is_refused():
    """JAX's runtime would end process 0 with a segmentation fault."""
    in_use = pytest.raises(
        ValueError, match=r"coordinator: .*a port that is free on process 0 \(.*in use"
    )
    with socket.create_server(("", 0)) as taken, in_use:
        distributed.initialize(f"localhost:{taken.getsockname()[1]}", 1, 0)


@pytest.mark.parametrize(
    "words",
    [
        ("--heartbeat", "0"),
        ("--heartbeat", "-3"),
        ("--heartbeat", "99999999999"),
        ("--coordinator", "localhost:99999", "--num-processes", "2", "--process-id", "0"),
    ],
)
def test_the_command_line_refuses_them_too(tmp_path, capsys, words):
    (tmp_path / "sweep.toml").write_text(cases.SWEEP)
    assert cli.main(["sweep", str(tmp_path / "sweep.toml"), "--quiet", *words]) == 2
    assert capsys.readouterr().err.count("\n") == 1


START = "import sys, iblf_jax as ij; ij.distributed.initialize(sys.argv[1], 2, 1, start=1)"


def test_nobody_at_the_address_is_a_line_and_an_exit_code(compiled):
    process = cases.start_python(compiled, "-c", START, free_address())
    _, errors = process.communicate(timeout=60)
    assert process.returncode == distributed.LOST
    assert (
        errors.rstrip()
        .splitlines()[-1]
        .startswith("iblf_jax: not all processes of the job came within 1 s")
    )


def test_importing_the_package_starts_no_device(compiled):
    """Else neither `jax.distributed.initialize` nor the number of CPU devices could come after the
    import."""
    code = (
        "import jax, iblf_jax as ij; ij.monte_carlo, ij.sweep;"
        " jax.config.update('jax_num_cpu_devices', 3); print(len(jax.devices()))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        env=cases.environment(compiled),
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.stdout.strip() == "3", done.stderr
