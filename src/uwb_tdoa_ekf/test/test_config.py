# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_ekf.core.config import CHOICES, PARAMETERS, PLANAR_HEIGHT_STD, FilterConfig

# 0 switches the term off
WITHOUT = [
    "vibration_gain",
    "yaw_rate_std",
    "range_offset_std",
    "fixed_height_std",
    "non_holonomic_std",
]
SWITCHES = (
    "use_imu",
    "adapt_noise",
    "zero_velocity",
    "recover",
    "use_height",
    "use_pressure",
    "use_velocity",
    "planar",
)
SIGNED = "initial_yaw", "height_arm", "ground_height", "fixed_height"
OTHERS = (*CHOICES, *SIGNED, *SWITCHES)
NUMBERS = [field.name for field in fields(FilterConfig) if field.name not in OTHERS]


def write(tmp_path, text):
    path = tmp_path / "ekf_node.yaml"
    path.write_text(text)
    return path


def test_defaults_are_valid_and_reach_the_core_under_the_same_names():
    config, (parameters,) = FilterConfig(), FilterConfig().parameters()
    for name in PARAMETERS.names:
        if name not in CHOICES:
            assert parameters[name] == getattr(config, name), name
    assert PARAMETERS.names == tuple(field.name for field in fields(FilterConfig))


def test_the_height_of_a_planar_vehicle_is_known_only_while_it_is_planar():
    planar = FilterConfig(planar=True)
    assert planar.parameters()["fixed_height_std"] == planar.known_height_std == PLANAR_HEIGHT_STD
    flying = replace(planar, planar=False)
    assert flying.parameters()["fixed_height_std"] == flying.known_height_std == 0.0


@pytest.mark.parametrize("value", [0.0, -1.0, float("nan"), float("inf"), "fast", None])
def test_a_number_must_be_above_zero(value):
    accepted = []
    for name in NUMBERS:
        try:
            FilterConfig(**{name: value})
            accepted.append(name)
        except InputError as error:
            assert name in str(error)
    assert accepted == (WITHOUT if value == 0.0 else [])


@pytest.mark.parametrize(
    "name, value, said",
    [
        *(("initial_yaw", value, "number") for value in (float("nan"), float("inf"), "north")),
        *((name, 1, "must be true or false") for name in SWITCHES),
        *(("robust", value, "is not one of") for value in ("median", None)),
        *(("loss", value, "is not one of") for value in ("tukey", "")),
        ("iterations", 2.5, "must be a whole number"),
    ],
)
def test_a_value_of_another_kind_is_refused(name, value, said):
    with pytest.raises(InputError, match=f"{name}: .*{said}"):
        FilterConfig(**{name: value})


def test_choices_are_given_to_the_core_as_their_places():
    for i, robust in enumerate(CHOICES["robust"]):
        for k, loss in enumerate(CHOICES["loss"]):
            (parameters,) = FilterConfig(robust=robust, loss=loss).parameters()
            assert (parameters["robust"], parameters["loss"]) == (i, k)


def test_how_a_number_was_written_changes_nothing(tmp_path):
    path = write(
        tmp_path,
        "ekf_node: {ros__parameters: {gate: 3, tdoa_std: 1, odometry_rate: 100, use_imu: true}}",
    )
    config = FilterConfig.from_yaml(path)
    assert isinstance(config.gate, float)
    expected = FilterConfig(gate=3.0, tdoa_std=1.0, odometry_rate=100.0).parameters()
    np.testing.assert_array_equal(config.parameters(), expected)


def test_from_yaml_takes_what_tunes_the_filter_and_passes_over_the_rest(tmp_path):
    text = (
        "/**:\n  ros__parameters:\n    tdoa_std: 0.5\n    loss: huber\n    use_imu: false\n  "
        "  frame: map\n"
    )
    assert FilterConfig.from_yaml(write(tmp_path, text)) == FilterConfig(
        tdoa_std=0.5, loss="huber", use_imu=False
    )


def test_from_yaml_reads_a_file_of_several_nodes(tmp_path):
    text = (
        "ekf_node: {ros__parameters: {tdoa_std: 0.4}}\nbias_node: {ros__parameters: {tdoa_std: 9.0}}\n"
        "/**: {ros__parameters: {tdoa_std: 0.3, gate: 4.0}}\n"
    )
    path = write(tmp_path, text)
    assert FilterConfig.from_yaml(path) == FilterConfig(tdoa_std=0.4, gate=4.0)
    two = text.replace("bias_node", "/other/ekf_node")
    with pytest.raises(InputError, match="of one ekf_node"):
        FilterConfig.from_yaml(write(tmp_path, two))


def test_from_yaml_names_the_parameter_that_a_mistyped_one_means(tmp_path):
    path = write(tmp_path, "ekf_node: {ros__parameters: {tdoa_sdt: 0.4}}")
    with pytest.raises(InputError, match="tdoa_sdt: is no parameter of the filter; write tdoa_std"):
        FilterConfig.from_yaml(path)


@pytest.mark.parametrize("file", sorted(Path(__file__).parents[2].glob("*/config/*_node.yaml")))
def test_no_parameter_of_a_node_is_taken_for_a_mistyped_one(file):
    assert FilterConfig.from_yaml(file) == FilterConfig()


@pytest.mark.parametrize(
    "text",
    [
        "",
        "ekf_node:",
        "ekf_node: {tdoa_std: 0.5}",
        "ekf_node: {ros__parameters: }",
        "a: {ros__parameters: {}}\nb: {ros__parameters: {}}",
        "- ekf_node",
        "ekf_node: {ros__parameters: {gate: 1.0",
        "ekf_node: {ros__parameters: {tdoa_std: much}}",
        "ekf_node: {ros__parameters: {tdoa_std: 0}}",
        "ekf_node: {ros__parameters: {robust: none}}",
    ],
)
def test_bad_yaml_is_told_in_one_sentence(tmp_path, text):
    with pytest.raises(InputError):
        FilterConfig.from_yaml(write(tmp_path, text))
