# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Read the parameters of a node from its parameter file and from the node itself."""

import yaml

GENERAL = "qos_overrides.", "use_sim_time", "start_type_description_service"  # every node has these


def written_and_declared(node, config):
    """Return {name: value} of the parameter file `config` and {name: value} of the node."""
    (written,) = (entry["ros__parameters"] for entry in yaml.safe_load(config.read_text()).values())
    declared = {
        name: p.value
        for name, p in node.get_parameters_by_prefix("").items()
        if not name.startswith(GENERAL)
    }
    return written, declared
