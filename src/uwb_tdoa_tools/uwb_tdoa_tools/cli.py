# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Share the look of --help, progress, failures, and the checks of output files, between all executables.

def parser():
    example = "convert flight.log --out flight_bag"
    return cli.parser("convert", "Convert a log to a bag.", example, options=[cli.option("log")])

main = cli.executable(_convert, parser)          # _convert(args) -> exit code, None for 0

with Progress("convert") as progress:            # a thread prints
    progress("reading")
"""

from __future__ import annotations

import argparse
from argparse import Namespace
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager
import errno
import io
import json
import os
from pathlib import Path
import sys
import tempfile
from threading import Event, Thread
import time
from typing import Any, TextIO, TypeVar

import numpy as np

from uwb_tdoa_bias.common.errors import (
    Failure,
    InputError,
    line_of,
    number_of,
    printable,
    written_by,
)
from uwb_tdoa_bias.common.executable import COMPILING
from uwb_tdoa_bias.common.files import protected_inputs, refuse_output, write_text

from . import command_lines

FULL = {
    errno.ENOSPC: "the disk is full",
    errno.EDQUOT: "the disk quota is used up",
    errno.EFBIG: "the file may not become larger",
}


Item = TypeVar("Item")

FIRST, EVERY = 0.5, 10.0  # s until the first line where there is no terminal, and between two
OFTEN = 0.5  # s between two changes of the line on a terminal

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
        with checked(args):
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


def write_json(path: str | Path | None, content: dict[str, Any]) -> None:
    """Write a dict as JSON, with the version of the suite; without a path, write nothing.

    Paths become text. Raises ValueError for NaN.
    """
    if path is None:
        return
    whole = {"written_by": written_by(), **content}
    text = json.dumps(whole, indent=1, allow_nan=False, default=os.fspath)
    write_text(path, text + "\n")


def say(name: str, *sentences: object) -> None:
    """Print `name: sentence` on stderr for each sentence, as a `line_of` text."""
    for sentence in sentences:
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


class Output(type(Path())):  # type: ignore[misc]  # the kind of path of this system: Path itself has no subclasses before Python 3.12
    """Path of an output."""


def positive(text: str) -> float:
    """Return a finite number above 0, for argparse."""
    value = number_of(text)
    if not 0.0 < value < np.inf:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number above 0")
    return value


class OutputFile(Output):
    """A file in an existing folder."""


class OutputFileInFolder(OutputFile):
    """A file in a folder, which the command makes if needed."""


class OutputFolder(Output):
    """A folder, which the command makes if needed."""


class OutputBag(Output):
    """A bag, which `bags.files.check_output` checks too."""


def checked(args: Namespace) -> AbstractContextManager[None]:
    """Check all outputs, and return a context that protects the paths of the other options.

    Raises
    ------
    InputError
        If an output cannot be written, is reached over a link, or would change an input or a bag.
    """
    # ros_arguments hold the whole command line.
    values = list(_flat(value for name, value in vars(args).items() if name != "ros_arguments"))
    outputs = [value for value in values if isinstance(value, Output)]
    inputs = [Path(value) for value in values if not isinstance(value, Output) and _is_there(value)]
    with protected_inputs(inputs):
        for output in outputs:
            refuse_output(output)
            if isinstance(output, OutputFolder):
                _check_folder(output)
            elif isinstance(output, OutputFileInFolder) and not output.absolute().parent.exists():
                _check_folder(output.parent)
            elif isinstance(output, OutputFile):
                _check_file(output)
    return protected_inputs(inputs)


def _flat(values: Any) -> Iterator[Any]:
    for value in values:
        if isinstance(value, (list, tuple)):
            yield from _flat(value)
        else:
            yield value


def _is_there(value: object) -> bool:
    return isinstance(value, (str, Path)) and len(str(value)) < 4096 and os.path.exists(value)


def _check_file(path: Path) -> None:
    folder = path.absolute().parent
    if not folder.is_dir():
        raise InputError(f"{path}: its directory does not exist; make it first.")
    if path.is_dir():
        raise InputError(f"{path}: is a directory; give a file.")
    _refuse_bag(path, folder)
    if not path.exists() or not os.access(path, os.W_OK):
        _check_writable(path, folder)


def _check_folder(out: Path) -> None:
    if out.exists() and not out.is_dir():
        raise InputError(f"{out}: is a file; give a directory.")
    there = out.absolute()
    while not there.exists():
        there = there.parent
    if not there.is_dir():
        raise InputError(f"{out}: cannot be made, as {there} is a file; give another directory.")
    _refuse_bag(out, there)
    for inside in sorted(out.iterdir()) if out.exists() else ():
        if inside.is_symlink() or not inside.is_dir():
            refuse_output(inside)
    _check_writable(out, there)


def _refuse_bag(path: Path, folder: Path) -> None:
    if (folder / "metadata.yaml").exists():
        raise InputError(f"{path}: would change the bag {folder}; give another place.")


def _check_writable(path: Path, folder: Path) -> None:
    """Raise InputError unless a file can be made in the folder. Leaves no file."""
    try:
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise InputError(
            f"{path}: cannot be written ({error.strerror}: {folder}); give another place."
        ) from error


def file_name(name: str) -> str:
    """Return a text as a name of a file: in UTF-8, also in an ASCII locale."""
    return os.fsdecode(name.encode("utf-8", "surrogateescape"))


def as_json(value: Any) -> Any:
    """Convert a value, or nested dicts and sequences, to JSON.

    NaN and infinity become null, arrays become lists.
    """
    if isinstance(value, dict):
        return {str(key): as_json(item) for key, item in value.items()}
    if isinstance(value, (list, tuple, np.ndarray)):
        return [as_json(item) for item in value]
    if isinstance(value, (bool, np.bool_)):
        return bool(value)
    if isinstance(value, (int, np.integer)):
        return int(value)
    if isinstance(value, (float, np.floating)):
        return float(value) if np.isfinite(value) else None
    return value


class Progress:
    """Show the current work, its share and its duration until the context ends.

    On a terminal tqdm updates one line. Elsewhere a line appears every few seconds, which tqdm cannot
    do. Work shorter than FIRST prints nothing. Call it with the current work as often as you like.
    """

    def __init__(
        self,
        name: str = "",
        total: int | None = None,
        unit: str = "",
        stream: TextIO | None = None,
        what: str = "",
    ) -> None:
        """Set the texts.

        Parameters
        ----------
        name : str
            Beginning of each line.
        total : int or None
            Number of units to process.
        unit : str
            Name of a unit.
        stream : file or None
            Default: stderr.
        what : str
            The first work.
        """
        self._name, self._total, self._unit, self._stream = name, total, unit, stream
        self._what, self._done, self._ended = what, 0, Event()

    def __call__(self, what: str) -> None:
        self._what = what

    def update(self) -> None:
        """Count another unit as done."""
        self._done += 1
        if self._bar is not None and self._total is not None:
            self._bar.update()

    def over(self, items: Iterable[Item], what: str) -> Iterator[Item]:
        """Yield the items, and show how many are done."""
        items = list(items)
        for done, item in enumerate(items):
            self(f"{what}, {done} of {len(items)} done")
            yield item
        self(f"{what} done, finishing")

    def __enter__(self) -> Progress:
        stream = self._stream or sys.stderr
        self._start, self._bar = time.monotonic(), None
        if stream.isatty():
            from tqdm import tqdm

            form = (
                {"bar_format": "{desc}"}
                if self._total is None
                else {"desc": self._name or None, "unit": self._unit}
            )
            self._bar = tqdm(total=self._total, file=stream, leave=False, **form)
        self._thread = Thread(target=self._tell, args=(stream,), daemon=True)
        self._thread.start()
        COMPILING.shown = True
        return self

    def __exit__(self, *_: object) -> None:
        COMPILING.shown = False
        self._ended.set()
        self._thread.join()
        if self._bar is not None:
            self._bar.close()

    def _tell(self, stream: TextIO) -> None:
        """Print lines until the end, in a separate thread."""
        pause = FIRST if self._bar is None else OFTEN
        while not self._ended.wait(pause):
            if self._bar is None:
                pause = EVERY
                print(self._line(), file=stream, flush=True)
            elif self._total is None:
                self._bar.set_description_str(self._line())
            else:
                self._bar.set_postfix_str(COMPILING.text)

    def _line(self) -> str:
        share = f"{self._done} of {self._total} {self._unit}s done" if self._total else ""
        took = f"{time.monotonic() - self._start:.0f} s"
        parts = filter(None, (self._what, share, took, COMPILING.text))
        return f"{self._name}: " * bool(self._name) + ", ".join(parts)
