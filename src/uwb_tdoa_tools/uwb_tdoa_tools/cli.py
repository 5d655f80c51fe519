# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Share the look of --help, and the handling of failures, between all executables.

def parser():
    example = "convert flight.log --out flight_bag"
    return cli.parser("convert", "Convert a log to a bag.", example, options=[cli.option("log")])

main = cli.executable(_convert, parser)          # _convert(args) -> exit code, None for 0
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Sequence
import errno
import io
import json
import os
from pathlib import Path
import sys
from typing import Any

from uwb_tdoa_bias.common.errors import Failure, InputError
from uwb_tdoa_bias.common.files import write_text
from uwb_tdoa_bias.common.text import line_of, printable, written_by

from . import command_lines, outputs

FULL = {
    errno.ENOSPC: "the disk is full",
    errno.EDQUOT: "the disk quota is used up",
    errno.EFBIG: "the file may not become larger",
}


# adds one or several options to a parser, or to a group of options
Option = Callable[[argparse._ActionsContainer], object]


def option(*names: str, **settings: Any) -> Option:
    """Return an Option; names and settings are those of `add_argument`."""
    return lambda parser: parser.add_argument(*names, **settings)


def exclusive(*options: Option) -> Option:
    """Return Options of which a command line has at most one."""
    return lambda parser: add(parser.add_mutually_exclusive_group(), options)


def group(title: str, *options: Option) -> Option:
    """Return Options that --help shows under a title."""
    return lambda parser: add(parser.add_argument_group(title), options)


def add(parser: argparse._ActionsContainer, options: Iterable[Option]) -> None:
    """Add Options to a parser."""
    for each in options:
        each(parser)


def parser(
    name: str, description: str, *examples: str, options: Iterable[Option] = ()
) -> argparse.ArgumentParser:
    """Return an ArgumentParser that keeps line breaks and ends its help with example command lines.

    Examples that begin with `name` are printed as they run where the user is.
    """
    started = command_lines.line_start(name).removesuffix(name)
    lines = [
        f"  {started if example.partition(' ')[0] == name else ''}{example}" for example in examples
    ]
    epilog = "\n".join(["examples:", *lines]) if examples else None
    made = argparse.ArgumentParser(
        prog=command_lines.program(name),
        description=description,
        epilog=epilog,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    made.add_argument("--version", action="version", version=f"{name} of {written_by()}")
    add(made, options)
    return made


def executable(
    command: Callable[[argparse.Namespace], int | None],
    parser: Callable[[], argparse.ArgumentParser],
    ros: bool = False,
) -> Callable[..., int]:
    """Return the function main(argv=None) of an executable: `run` with the result of parser()."""
    return lambda argv=None: run(command, parser(), argv, ros)


def run(
    command: Callable[[argparse.Namespace], int | None],
    parser: argparse.ArgumentParser,
    argv: Sequence[str] | None = None,
    ros: bool = False,
) -> int:
    """Parse a command line, call command(args), and return the exit code of the process.

    Parameters
    ----------
    command : callable
        Takes the parsed arguments, returns the exit code, or None for 0.
    argv : sequence of str or None
        Default: sys.argv[1:].
    ros : bool
        Leave --ros-args to rclpy; args.ros_arguments is then the whole command line.

    Returns
    -------
    int
        The code of `command`; 1 for a Failure; 2 for bad usage, an InputError or an unusable file, each
        reported in one sentence on stderr; 130 after Ctrl-C; 141 if the reader of our output has gone.
    """
    arguments = sys.argv[1:] if argv is None else list(argv)
    os.environ["MPLBACKEND"] = "Agg"  # pictures go to files, also where there is a screen
    if isinstance(sys.stdout, io.TextIOWrapper):
        # The locale may lack a letter of the result.
        sys.stdout.reconfigure(errors="backslashreplace")
    try:
        args = parser.parse_args(without_ros_arguments(arguments) if ros else arguments)
        if ros:
            args.ros_arguments = arguments
        with outputs.checked(args):
            code = command(args) or 0
        sys.stdout.flush()
        return code
    except SystemExit as stop:  # argparse has printed usage and error, or the help
        return stop.code or 0  # type: ignore[return-value]  # argparse ends with a number
    except InputError as error:
        return _fail(parser.prog, error, 2)
    except Failure as failure:
        return _fail(parser.prog, failure, 1)
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:
        # Else the flush at exit fails once more.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141
    except Exception as error:
        full = _full(error)
        if full:
            return _fail(
                parser.prog,
                f"{full}: what was being written is not whole; make room, or write elsewhere.",
                2,
            )
        if not isinstance(error, OSError) or error.filename is None:
            raise
        return _fail(parser.prog, f"{error.filename}: {error.strerror}.", 2)


def _full(error: Exception) -> str | None:
    """Return why the disk has no room, as text, or None if an error has another reason."""
    if isinstance(error, OSError):
        return FULL.get(error.errno) if error.errno is not None else None
    # of sqlite3, which takes long to import
    of_database = type(error).__name__ == "OperationalError" and "disk is full" in str(error)
    return FULL[errno.ENOSPC] if of_database else None


def without_ros_arguments(arguments: Iterable[str]) -> list[str]:
    """Return a command line without the arguments for ROS.

    They reach from each --ros-args to the next -- or the end.
    """
    own, ours = [], True
    for argument in arguments:
        if argument == "--ros-args":
            ours = False
        elif ours:
            own.append(argument)
        elif argument == "--":
            ours = True
    return own


def write_json(path: str | Path, content: dict[str, Any]) -> None:
    """Write a dict as JSON, with the version of the suite. Raises ValueError for NaN."""
    text = json.dumps({"written_by": written_by(), **content}, indent=1, allow_nan=False)
    write_text(path, text + "\n")


def say(name: str, sentence: object) -> None:
    """Print `name: sentence` on stderr, as a `line_of` text."""
    print(f"{name}: {line_of(sentence)}", file=sys.stderr, flush=True)


def show(*lines: str) -> None:
    """Print lines of a result on stdout, each made `printable`.

    A progress bar, if there is one, stays below them.
    """
    from tqdm import tqdm

    tqdm.write("\n".join(printable(line) for text in lines for line in text.split("\n")))
    sys.stdout.flush()


def _fail(name: str, sentence: object, code: int) -> int:
    say(name, f"error: {sentence}")
    return code
