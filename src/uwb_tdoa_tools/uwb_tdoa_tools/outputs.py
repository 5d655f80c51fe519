# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Check the outputs of a command before the work. An output must not change an input or a bag.

The types below mark options that name outputs. No output follows a link.

    add("--json", metavar="FILE", type=OutputFile)
    add("--out", metavar="DIR", type=OutputFolder)
    add("--out", metavar="BAG", type=OutputBag)
    with checked(args):             # as `cli.run` does
        ...
"""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Iterator
from contextlib import AbstractContextManager
import os
from pathlib import Path
import tempfile
from typing import Any

import numpy as np

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.files import protected_inputs, refuse_output


class Output(type(Path())):  # type: ignore[misc]  # the kind of path of this system: Path itself has no subclasses before Python 3.12
    """Path of an output."""


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
