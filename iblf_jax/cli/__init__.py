"""The command line: `python -m iblf_jax COMMAND`, or `iblf-jax COMMAND`.

One module a command, each with `add_parser(subparsers)` and `run(args) -> int`; a new command is a
new module and a word in `COMMANDS`.  `run` imports what is slow to import, so that `--help` is
quick.  The commands compute in float64.

Exit codes: 0 done; 1 a run failed (a bound was violated, the state diverged, the step was too
large); 2 bad arguments or files, with one line on stderr; 3 a study did not finish (disk full, a
worker lost) and what it wrote stays valid; 130 interrupted.
"""

from __future__ import annotations

import argparse
import importlib
import os
import signal
import sys
import warnings
from collections.abc import Sequence
from typing import Any, NoReturn

import jax

from iblf_jax._start import INTERRUPTED, end_process
from iblf_jax.core import checks
from iblf_jax.core.cache import keep_programs

COMMANDS = (
    "reproduce",
    "simulate",
    "compare",
    "montecarlo",
    "sweep",
    "tune",
    "identify",
    "export",
    "presets",
    "parameters",
)


LONGEST_WORD = 400
"""Characters of a word that an error or a warning repeats: a user's may be of any length."""


class Parser(argparse.ArgumentParser):
    """An argument parser that says what is wrong in one line."""

    def _get_values(self, action: argparse.Action, arg_strings: list[str]) -> Any:
        """The value of an option; of `--out=--` Python 3.11 and 3.12 make an empty list."""
        if action.option_strings and action.nargs is None and arg_strings == ["--"]:
            self.error(f"argument {'/'.join(action.option_strings)}: expected one argument")
        return super()._get_values(action, arg_strings)

    def error(self, message: str) -> NoReturn:
        """Prints one line and exits with 2."""
        complain(f"{message} (see {self.prog} --help)")
        raise SystemExit(2)


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one command.

    Args:
      argv: the words after the program's name; those of the process if not given.

    Returns:
      The exit code (head of this module).
    """
    try:
        args = build_parser().parse_args(argv)
    except SystemExit as stop:
        return int(stop.code or 0)
    with warnings.catch_warnings():
        warnings.simplefilter("always", UserWarning)
        shown = set[str]()
        warnings.showwarning = lambda message, *_, **__: _warn_once(str(message), shown)
        try:
            prepare_jax()
            code = args.run(args)
            sys.stdout.flush()
            return code
        except BrokenPipeError:  # the reader of a pipe has gone, as `head` does
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return 0
        except ValueError as error:
            complain(str(error))
        except OSError as error:
            text = str(error)
            if error.filename and error.strerror:
                text = f"{error.filename}: {error.strerror}"
            complain(text)
        except (MemoryError, jax.errors.JaxRuntimeError) as error:
            complain(
                f"the machine gave up: {error}. A shorter --duration or a larger --record-every"
                " takes less memory."
            )
        except KeyboardInterrupt:
            complain("interrupted")
            return INTERRUPTED
    return 2


def entry() -> NoReturn:
    """A process of its own for one command: ends with `main`'s exit code.

    An interrupted one ends without taking JAX down, see `end_process`.
    """
    signal.signal(signal.SIGINT, end_process)
    code = main()
    if code == INTERRUPTED:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
    sys.exit(code)


def _warn_once(message: str, shown: set[str]) -> None:
    if message not in shown:
        shown.add(message)
        complain(message, kind="warning")


def complain(message: str, kind: str = "error") -> None:
    """One line on stderr that can be read."""
    words = [
        x if len(x) <= LONGEST_WORD else f"{x[: LONGEST_WORD - 23]}...{x[-20:]}"
        for x in message.split()
    ]
    print(f"iblf-jax: {kind}: {checks.line(' '.join(words), 'message')}", file=sys.stderr)


def build_parser() -> argparse.ArgumentParser:
    """The parser of all commands."""
    import iblf_jax

    parser = Parser(
        prog="iblf-jax",
        description=(
            "Simulate, compare, certify and tune barrier-Lyapunov tracking controllers of"
            " constrained robots."
        ),
        epilog=(
            "Exit codes: 0 done; 1 a run failed; 2 bad arguments or files; 3 a study did not"
            " finish; 130 interrupted."
        ),
    )
    parser.add_argument(
        "--version",
        action="version",
        version=f"iblf_jax {iblf_jax.__version__} (jax {jax.__version__})",
    )
    subparsers = parser.add_subparsers(
        title="commands", metavar="COMMAND", required=True, dest="command"
    )
    for name in COMMANDS:
        importlib.import_module(f"iblf_jax.cli.{name}").add_parser(subparsers)
    return parser


def prepare_jax() -> None:
    """Float64, and compiled programs kept from the first on."""
    jax.config.update("jax_enable_x64", True)
    keep_programs()
