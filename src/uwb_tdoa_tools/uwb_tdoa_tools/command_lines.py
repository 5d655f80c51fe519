"""Command lines that are printed to be copied, as they run where the user is.

tool("check", "flight.bag")                          # ./dev run uwb_tdoa_tools check flight.bag, or ros2 run ...
node("ekf_node", {"effects_file": "effects.yaml"})
"""

from __future__ import annotations

import os
import shlex
import shutil
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence
    from pathlib import Path

SALVAGE = "read what is sound of it with --salvage"
RUN = "UWB_TDOA_RUN"  # variable of the environment in which ./dev says how the user started it
PACKAGES = {
    "bias_node": "uwb_tdoa_bias",
    "ekf_node": "uwb_tdoa_ekf",
    "debias_node": "uwb_tdoa_ekf",
    "compile_nodes": "uwb_tdoa_ekf",
}


def tool(name: str, *words: object) -> str:
    """The line that starts an executable with words, which are quoted where a shell needs it."""
    return " ".join([started(name), *([shlex.join(map(str, words))] if words else [])])


def started(name: str) -> str:
    """How an executable is started: the beginning of its line."""
    return f"{os.environ.get(RUN, 'ros2 run')} {PACKAGES.get(name, 'uwb_tdoa_tools')} {name}"


def as_it_runs(line: str) -> str:
    """A line that begins with what ./dev does as ros2 does, as it runs where the user is; any other
    one as it is.
    """
    if (
        line.startswith(("ros2 topic ", "ros2 node ", "ros2 param "))
        and RUN in os.environ
        and not shutil.which("ros2")
    ):
        return f"{os.environ[RUN].removesuffix(' run')} {line}"
    return line


def node(name: str, parameters: Mapping[str, object], files: Iterable[str | Path] = ()) -> str:
    """The line that starts a node. parameters : {name: value}; files : paths of parameter files."""
    words = [word for key, value in parameters.items() for word in ("-p", f"{key}:={value}")]
    return tool(
        name, "--ros-args", *words, *(word for file in files for word in ("--params-file", file))
    )


def judging(
    recordings: Iterable[str | Path],
    survey: str | Path | None = None,
    effects: str | Path | None = None,
    config: str | Path | None = None,
    truth: bool = True,
) -> str:
    """The line that judges an estimate on recordings with the files of a calibration, by ground
    truth, or, where they hold none, by itself; None for files that there are not.
    """
    options = {"--survey": survey, "--effects": effects, "--config": config}
    words = [
        *recordings,
        *(word for option, file in options.items() if file for word in (option, file)),
    ]
    return tool("evaluate", *words) if truth else tool("localize", *words, "--out", "localized/")


def surveying(
    recording: str | Path, survey: str | Path | None = None, effects: str | Path | None = None
) -> str:
    """The line that surveys the anchors with a recording, with the files of a calibration; None for
    those that there are not.
    """
    options = {"--survey": survey, "--effects": effects}
    words = [
        recording,
        *(word for option, file in options.items() if file for word in (option, file)),
    ]
    return tool("survey", *words, "--out", "surveyed/")


def nodes(
    anchors: str | Path | None = None,
    effects: str | Path | None = None,
    config: str | Path | None = None,
) -> tuple[str, str]:
    """The two lines that start the nodes with the files of a calibration; None for those that there
    are not.
    """
    parameters = {
        name: file for name, file in (("anchors_file", anchors), ("effects_file", effects)) if file
    }
    return node("bias_node", parameters), node("ekf_node", parameters, [config] if config else ())


def applying(
    folder: Path,
    recordings: Sequence[str | Path],
    survey: str | Path | None = None,
    anchors: str | Path | None = None,
    parameters: bool = False,
    truth: bool = True,
) -> tuple[tuple[str, str], ...]:
    """((command line, what it does), ...): how the effects.yaml in a folder is put to use.
    recordings : paths to judge on; survey,
    anchors : files of anchors that were given, for evaluate and for the nodes, or None; parameters
        : whether there is an ekf_node.yaml;
    truth : whether the recordings hold ground truth.
    """
    effects, config = folder / "effects.yaml", folder / "ekf_node.yaml" if parameters else None
    bias, ekf = nodes(anchors, effects, config)
    return (
        (judging(recordings, survey, effects, config, truth), "judges it"),
        (bias, "in flight: takes it out of TDOAs"),
        (ekf, "in flight: takes it out of the IMU, and assumes the noise that is left"),
    )
