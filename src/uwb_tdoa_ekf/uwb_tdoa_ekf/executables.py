"""The entry points that setup.py names."""

from uwb_tdoa_bias.foundation.executable import executable

debias_node = executable("uwb_tdoa_ekf.debias_node")
ekf_node = executable("uwb_tdoa_ekf.ekf_node")
localization_node = executable("uwb_tdoa_ekf.localization_node")
