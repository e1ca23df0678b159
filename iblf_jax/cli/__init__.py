"""The command line: `python -m iblf_jax COMMAND`, or `iblf-jax COMMAND`.

Each command is one module with the texts HELP, DESCRIPTION and EPILOG (or None), the function
`add_arguments(parser)` and the function `run(args) -> int`.  A new command is a new module and its
name in `COMMANDS`.  Slow imports are inside `run`, so that `--help` is fast.
The commands compute in float64.

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
from iblf_jax.core.disk_cache import keep_programs

COMMANDS = (
    "new",
    "doctor",
    "reproduce",
    "simulate",
    "compare",
    "montecarlo",
    "failure",
    "sweep",
    "tune",
    "prove",
    "identify",
    "export",
    "ros",
    "presets",
    "parameters",
)


LONGEST_WORD = 400
"""Characters of one word in an error or a warning; longer words are shortened."""


class Parser(argparse.ArgumentParser):
    """An argument parser that reports an error in one line."""

    def _get_values(self, action: argparse.Action, arg_strings: list[str]) -> Any:
        """Rejects `--out=--`, from which Python 3.11 and 3.12 would make an empty list."""
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
      argv: the arguments after the program's name (default: those of the process).

    Returns:
      The exit code (listed at the top of this module).
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
        except BrokenPipeError:  # the reader of the pipe has closed it, as `head` does
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
                f"the computation could not be completed: {error}. A shorter --duration or a larger"
                " --record-every takes less memory."
            )
        except KeyboardInterrupt:
            complain("interrupted")
            return INTERRUPTED
    return 2


def entry() -> NoReturn:
    """Runs `main` and ends the process with its exit code.

    After an interrupt the process ends without the shutdown of JAX, see `end_process`.
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
    """Prints an error or a warning as one line on stderr."""
    text = " ".join(map(_shortened, message.split()))
    print(f"iblf-jax: {kind}: {checks.one_line(text, 'message')}", file=sys.stderr)


def _shortened(word: str) -> str:
    if len(word) <= LONGEST_WORD:
        return word
    return f"{word[: LONGEST_WORD - 23]}...{word[-20:]}"


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
        command = importlib.import_module(f"iblf_jax.cli.{name}")
        of_command = subparsers.add_parser(
            name, help=command.HELP, description=command.DESCRIPTION, epilog=command.EPILOG
        )
        command.add_arguments(of_command)
        of_command.set_defaults(run=command.run)
    return parser


def prepare_jax() -> None:
    """Enables float64 and the persistent cache of compiled programs."""
    jax.config.update("jax_enable_x64", True)
    keep_programs()
