# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The parameters of a node, in its parameter file and as it declares them."""

import yaml

GENERAL = "qos_overrides.", "use_sim_time", "start_type_description_service"  # of every node


def written_and_declared(node, config):
    """({name: value} in the parameter file `config`, {name: value} of the node)."""
    (written,) = (entry["ros__parameters"] for entry in yaml.safe_load(config.read_text()).values())
    declared = {
        name: p.value
        for name, p in node.get_parameters_by_prefix("").items()
        if not name.startswith(GENERAL)
    }
    return written, declared
