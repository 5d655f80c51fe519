"""How effects.yaml is put to use."""

from ... import command_lines


def applying(folder, recordings, survey=None, anchors=None, parameters=False, truth=True):
    """((command line, what it does), ...) of the files in a folder. recordings : paths to judge on; survey, anchors : files of anchors
    that were given, for evaluate and for the nodes, or None; parameters : whether there is an ekf_node.yaml; truth : whether the recordings hold
    ground truth."""
    effects, config = folder / "effects.yaml", folder / "ekf_node.yaml" if parameters else None
    bias, ekf = command_lines.nodes(anchors, effects, config)
    return (
        (command_lines.judging(recordings, survey, effects, config, truth), "judges it"),
        (bias, "in flight: takes it out of TDOAs"),
        (ekf, "in flight: takes it out of the IMU, and assumes the noise that is left"),
    )
