"""Where the processor time of the tests goes, by file and by cause.

    TEST_TIMES=out/times python -m pytest -m "not release"
    python tests/time_of_tests.py out/times

The first line writes one file for each worker; the second one reads them and prints tables.
"""

import collections
import json
import os
import resource
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

CAUSES = TRACING, XLA, COMPILER, PROCESSES, REST = ("tracing", "XLA", "C++", "processes", "rest")
"""`rest` is computation, and Python outside of JAX; `processes` are those that a test starts,
except for the compiler."""
EVENTS = {
    "/jax/core/compile/jaxpr_trace_duration": TRACING,
    "/jax/core/compile/jaxpr_to_mlir_module_duration": TRACING,
    "/jax/core/compile/backend_compile_duration": XLA,
}
COMPILERS = ("quick_compiler", "c++", "g++", "clang++")
STARTS = "(start of a worker)"


def children_s() -> float:
    """Seconds of the processes that this one started and that have ended."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def processor_s() -> float:
    """Seconds of this process and of those that it started and that have ended."""
    return time.process_time() + children_s()


class Times:
    """A pytest plugin: one line for each test, {"test": ..., "s": ..., cause: ...}."""

    def __init__(self, folder: Path) -> None:
        import jax

        folder.mkdir(parents=True, exist_ok=True)
        worker = os.environ.get("PYTEST_XDIST_WORKER", "alone")
        self.file = (folder / f"{worker}.jsonl").open("w", buffering=1)
        self.spent: collections.Counter[str] = collections.Counter()
        self.open: list[list[float]] = []
        self.started = False
        jax.monitoring.register_scalar_listener(self.on_begin)
        jax.monitoring.register_event_duration_secs_listener(self.on_end)
        self.watch_processes()

    def on_begin(self, event: str, *_: Any, **__: Any) -> None:
        """Notes the processor time at which an event of JAX begins, and that of events inside."""
        if event in EVENTS:
            self.open.append([time.process_time(), 0.0])

    def on_end(self, event: str, *_: Any, **__: Any) -> None:
        """Counts the processor time of an event without that of the events inside it."""
        if (cause := EVENTS.get(event)) is None or not self.open:
            return
        begin, inner = self.open.pop()
        whole = time.process_time() - begin
        self.spent[cause] += whole - inner
        if self.open:
            self.open[-1][1] += whole

    def watch_processes(self) -> None:
        """Counts the processor time of a process when it is waited for."""
        wait = subprocess.Popen._try_wait  # type: ignore[attr-defined]

        def counted(process: subprocess.Popen[Any], flags: int) -> Any:
            before = children_s()
            result = wait(process, flags)
            command = process.args if isinstance(process.args, (str, bytes)) else process.args[0]
            is_compiler = Path(os.fsdecode(command)).name.startswith(COMPILERS)
            self.spent[COMPILER if is_compiler else PROCESSES] += children_s() - before
            return result

        subprocess.Popen._try_wait = counted  # type: ignore[attr-defined]

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Any:
        if not self.started:
            self.started = True
            self.write(STARTS, processor_s())
        before = processor_s()
        self.spent.clear()
        self.open.clear()
        try:
            return (yield)
        finally:
            self.write(item.nodeid, processor_s() - before)

    def write(self, test: str, total: float) -> None:
        rest = max(0.0, total - sum(self.spent.values()))
        line = {"test": test, "s": total, **self.spent, REST: rest}
        self.file.write(json.dumps(line) + "\n")


def table(title: str, rows: dict[str, collections.Counter[str]], most: int) -> None:
    """Prints the rows that took longest, and their sum."""
    print(f"{title:62} {'s':>7} " + " ".join(f"{cause:>9}" for cause in CAUSES))
    total: collections.Counter[str] = collections.Counter()
    for row in rows.values():
        total.update(row)
    longest = sorted(rows, key=lambda name: -rows[name]["s"])
    for name in [*longest[:most], ""]:
        row = rows[name] if name else total
        causes = " ".join(f"{row[cause]:9.1f}" for cause in CAUSES)
        print(f"{name or 'all':62.62} {row['s']:7.1f} {causes}")


def main(folder: Path) -> None:
    most = {"folder": 40, "file": 60, "function": 80}
    tables: dict[str, Any] = {title: collections.defaultdict(collections.Counter) for title in most}
    for path in sorted(folder.glob("*.jsonl")):
        for line in map(json.loads, path.read_text().splitlines()):
            function = line.pop("test").split("[")[0].removeprefix("tests/")
            file = function.split("::")[0]
            for title, name in zip(most, (str(Path(file).parent), file, function), strict=True):
                tables[title][name].update(line)
    for title, rows in tables.items():
        table(title, rows, most[title])


if __name__ == "__main__":
    main(Path(sys.argv[1]))
