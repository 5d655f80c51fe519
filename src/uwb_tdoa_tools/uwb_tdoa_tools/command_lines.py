# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Make command lines to copy, as they run where the user is.

tool("check", "flight_bag")          # ./dev run uwb_tdoa_tools check flight_bag, or ros2 run ...,
                                     # or uwb-tdoa check flight_bag
node("ekf_node", {"effects_file": "effects.yaml"})
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
import os
from pathlib import Path
import shlex
import shutil

SALVAGE = "read what is sound of it with --salvage"
RUN = "UWB_TDOA_RUN"  # environment variable in which ./dev and COMMAND pass how the user started it
COMMAND = "uwb-tdoa"  # of an installation without ROS
PACKAGES = {
    "anchors_node": "uwb_tdoa_bias",
    "bias_node": "uwb_tdoa_bias",
    "ekf_node": "uwb_tdoa_ekf",
    "debias_node": "uwb_tdoa_ekf",
    "compile_nodes": "uwb_tdoa_ekf",
    "localization_node": "uwb_tdoa_ekf",
    "vehicle_node": "uwb_tdoa_tools",
}


def tool(name: str, *words: object) -> str:
    """Return the line that starts an executable with words, quoted for a shell."""
    return " ".join([line_start(name), *([shlex.join(map(str, words))] if words else [])])


def suggest_line(*recordings: str | Path) -> str:
    """Return the line that writes a first profile of recordings of others, or names one that fits."""
    return tool("convert", *recordings, "--suggest", "profile.yaml")


def line_start(name: str) -> str:
    """Return the beginning of the line that starts an executable."""
    run = os.environ.get(RUN, "ros2 run")
    if run == COMMAND and name not in PACKAGES:
        return f"{COMMAND} {name}"
    if run == COMMAND:  # nodes need ROS
        run = "ros2 run"
    return f"{run} {PACKAGES.get(name, 'uwb_tdoa_tools')} {name}"


def program(name: str) -> str:
    """Return the name that an executable has in its usage and messages."""
    return f"{COMMAND} {name}" if os.environ.get(RUN) == COMMAND else name


def as_it_runs(line: str) -> str:
    """Return a line as it runs where the user is: ./dev replaces ros2 where only ./dev exists."""
    run = os.environ.get(RUN, "")
    if (
        line.startswith(("ros2 topic ", "ros2 node ", "ros2 param "))
        and run.endswith(" run")
        and not shutil.which("ros2")
    ):
        return f"{run.removesuffix(' run')} {line}"
    return line


def node(name: str, parameters: Mapping[str, object], files: Iterable[str | Path] = ()) -> str:
    """Return the line that starts a node.

    Parameters
    ----------
    parameters : mapping
        {name: value}.
    files : iterable of paths
        Parameter files.
    """
    words = [word for key, value in parameters.items() for word in ("-p", f"{key}:={value}")]
    return tool(
        name, "--ros-args", *words, *(word for file in files for word in ("--params-file", file))
    )


def _given(**files: str | Path | None) -> list[str | Path]:
    """Return the options of the files that are not None, e.g. --survey and its path."""
    return [word for name, file in files.items() if file for word in (f"--{name}", file)]


def evaluate_line(
    recordings: Iterable[str | Path],
    survey: str | Path | None = None,
    effects: str | Path | None = None,
    config: str | Path | None = None,
    truth: bool = True,
    more: Iterable[str] = (),
) -> str:
    """Return the line that evaluates recordings with the files of a calibration; None for no file.

    Without ground truth (`truth`), `localize` states how far the estimate can be trusted. `more`
    are further options, such as those of reading.
    """
    words = [*recordings, *_given(survey=survey, effects=effects, config=config), *more]
    return tool("evaluate", *words) if truth else tool("localize", *words, "--out", "localized/")


def survey_line(
    recording: str | Path, survey: str | Path | None = None, effects: str | Path | None = None
) -> str:
    """Return the line that surveys anchors with a recording; None for a missing file."""
    given = _given(survey=survey, effects=effects)
    return tool("survey", recording, *given, "--out", "surveyed/")


def lines_without_use(
    recordings: Iterable[str | Path],
    survey: str | Path | None = None,
    effects: str | Path | None = None,
    truth: bool = True,
    more: Iterable[str] = (),
) -> tuple[str, str]:
    """Return what to do after a calibration that is not used, and the line for it.

    The parameters are those of `evaluate_line`.
    """
    words = [*recordings, *_given(survey=survey, effects=effects), *more]
    if truth:
        return (
            "next: add flights, or read which effects were found, and why they are not applied:",
            tool("diagnose", *words, "--out", "diagnosis/"),
        )
    return (
        "next: write the places where the tag stood to marks.yaml (docs/calibration.md), then:",
        tool("survey", *words, "--marks", "marks.yaml", "--out", "surveyed/"),
    )


def node_lines(
    anchors: str | Path | None = None,
    effects: str | Path | None = None,
    config: str | Path | None = None,
) -> tuple[str, str]:
    """Return the two lines that start the nodes with the files of a calibration, or None."""
    parameters = {
        name: file for name, file in (("anchors_file", anchors), ("effects_file", effects)) if file
    }
    return node("bias_node", parameters), node("ekf_node", parameters, [config] if config else ())


def lines_of_use(
    folder: Path,
    recordings: Sequence[str | Path],
    survey: str | Path | None = None,
    anchors: str | Path | None = None,
    truth: bool = True,
    more: Iterable[str] = (),
) -> tuple[tuple[str, str], ...]:
    """Return ((command line, purpose), ...) for the use of effects.yaml and ekf_node.yaml.

    Parameters
    ----------
    folder : Path
        Folder with both files.
    recordings : sequence of paths
        Recordings to evaluate.
    survey, anchors : path or None
        Files of anchors for evaluate and for the nodes.
    truth : bool
        Whether the recordings hold ground truth.
    more : iterable of str
        Further options of the line that evaluates.
    """
    effects, config = folder / "effects.yaml", folder / "ekf_node.yaml"
    bias, ekf = node_lines(anchors, effects, config)
    return (
        (
            evaluate_line(recordings, survey, effects, config, truth, more),
            "judges it; flights that it was fitted to would flatter it",
        ),
        (bias, "in flight, the first node: corrects TDOAs"),
        (ekf, "in flight, the second node: takes these TDOAs, and corrects its other sensors"),
    )
