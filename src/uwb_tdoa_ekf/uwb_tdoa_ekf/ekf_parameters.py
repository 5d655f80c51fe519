# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Declare the parameters of ekf_node: FilterConfig, and the node's own."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace
from typing import Any

from rcl_interfaces.msg import SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.ros.anchors import ANCHORS_FILE
from uwb_tdoa_bias.ros.node import FROZEN, Parameter, ParameterNode, declare, declare_all

from .core.config import CHOICES, FilterConfig

PUBLISH_TF = NONE, BASE, ODOM = "none", "base", "odom"
PARAMETERS = {  # in the order of config/ekf_node.yaml
    "anchors_file": ANCHORS_FILE,
    "world_frame": Parameter(
        "", 'frame of the odometry and the parent on /tf; "" for the frame of the anchors'
    ),
    "body_frame": Parameter(
        "base_link",
        (
            "frame whose pose is estimated; sensors in other frames are placed in it by "
            "/tf_static; one per tag"
        ),
    ),
    "publish_tf": Parameter(
        BASE,
        "on /tf: none, base (world -> body) or odom (world -> odom_frame, REP 105)",
        choices=PUBLISH_TF,
    ),
    "odom_frame": Parameter(
        "odom", "for publish_tf odom: the frame in which somebody else publishes the body on /tf"
    ),
    "flyable_volume": Parameter(
        "", 'flyable.npz of plan; a warning on /diagnostics while the tag is outside; "" for none'
    ),
    "effects_file": Parameter(
        "",
        (
            "effects.yaml, the same as bias_node's: what it says of gyroscope, accelerometer, "
            "height and velocity is taken out"
        ),
    ),
    "reorder": Parameter(
        0.003,
        (
            "s of stamps; how long messages wait for older ones that are still on their way, "
            "until 2 s of their stream were in order"
        ),
        0.0,
        10.0,
    ),
    "lag": Parameter(
        0.25,
        (
            "s of stamps; how long a silent stream is waited for (height, pressure, velocity: "
            "half of that); what comes later is late"
        ),
        0.0,
        100.0,
    ),
    "frozen": FROZEN,
}


def names_of_parameters() -> set[str]:
    """Return the names of all parameters."""
    return {field.name for field in fields(FilterConfig)} | {*PARAMETERS}


def declare_parameters(node: ParameterNode) -> tuple[FilterConfig, dict[str, Any]]:
    """Declare all parameters and return (FilterConfig, {name: value} of the node's own)."""
    values = {}
    for field in fields(FilterConfig):
        limits = field.metadata
        parameter = Parameter(
            field.default,
            limits["text"],
            limits["low"],
            limits["high"],
            CHOICES.get(field.name, ()),
            settable=not limits["fixed"],
        )
        values[field.name] = declare(node, field.name, parameter)
    return FilterConfig(**values), declare_all(node, PARAMETERS)


def follow_changes(
    node: Node, config: Callable[[], FilterConfig], on_change: Callable[[FilterConfig], None]
) -> None:
    """Let the user change the parameters of FilterConfig that are not fixed while the node runs.

    Parameters
    ----------
    node : Node
        Node that declared the parameters.
    config : callable
        `config()` returns the current FilterConfig.
    on_change : callable
        `on_change(config)` receives the new FilterConfig.
    """

    def changed(parameters: list[RosParameter]) -> FilterConfig:
        names = {field.name for field in fields(FilterConfig)}
        return replace(config(), **{p.name: p.value for p in parameters if p.name in names})

    def validate(parameters: list[RosParameter]) -> SetParametersResult:
        try:
            changed(parameters)
        except InputError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    node.add_on_set_parameters_callback(validate)
    node.add_post_set_parameters_callback(lambda parameters: on_change(changed(parameters)))
