"""The entry points that setup.py names."""

from .foundation.executable import executable

anchors_node = executable("uwb_tdoa_bias.anchors_node")
bias_node = executable("uwb_tdoa_bias.bias_node")
