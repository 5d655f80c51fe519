"""The entry points that setup.py names."""

from .foundation.executable import executable

bias_node = executable("uwb_tdoa_bias.bias_node")
