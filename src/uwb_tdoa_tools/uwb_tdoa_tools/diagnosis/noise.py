"""What noise the filter should assume beside a calibration: a parameter file for ekf_node."""

PARAMETERS = """/**:
  ros__parameters:
    tdoa_std: {:.3f}  # m; measured: as many TDOAs count as independent as there are
"""


def write_parameters(path, tdoa_std):
    """Write the parameters of ekf_node. tdoa_std : m."""
    path.write_text(PARAMETERS.format(tdoa_std))
