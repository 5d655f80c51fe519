"""What noise the filter should assume beside a calibration: a parameter file for ekf_node."""

from uwb_tdoa_ekf.core.config import FilterConfig

from .self_survey import noise_of

PARAMETERS = """/**:
  ros__parameters:
    tdoa_std: {:.3f}  # m; measured: as many TDOAs count as independent as there are
"""


def write_parameters(path, tdoa_std):
    """Write the parameters of ekf_node. tdoa_std : m."""
    path.write_text(PARAMETERS.format(tdoa_std))


def tdoa_std_of(flights, effects, config=None):
    """m, that the innovations of Flights call for beside the EffectSet; ground truth is not used."""
    return noise_of(flights, effects, config or FilterConfig())
