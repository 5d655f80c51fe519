"""How effects.yaml is put to use."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ... import command_lines

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path


def applying(
    folder: Path, recordings: Sequence[str | Path], survey: str | Path | None = None,
    anchors: str | Path | None = None, parameters: bool = False, truth: bool = True,
) -> tuple[tuple[str, str], ...]:  # fmt: skip
    """((command line, what it does), ...) of the files in a folder. recordings : paths to judge on; survey, anchors : files of anchors
    that were given, for evaluate and for the nodes, or None; parameters : whether there is an ekf_node.yaml; truth : whether the recordings
    hold ground truth."""
    effects, config = folder / "effects.yaml", folder / "ekf_node.yaml" if parameters else None
    bias, ekf = command_lines.nodes(anchors, effects, config)
    return (
        (command_lines.judging(recordings, survey, effects, config, truth), "judges it"),
        (bias, "in flight: takes it out of TDOAs"),
        (ekf, "in flight: takes it out of the IMU, and assumes the noise that is left"),
    )
