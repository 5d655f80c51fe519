from dataclasses import fields

import pytest

from uwb_tdoa_bias.foundation.errors import InputError
from uwb_tdoa_ekf.core.config import LOSSES, ROBUST, FilterConfig, Tuning

SWITCHES = ("use_imu", "adapt_noise", "zero_velocity", "recover")
OTHERS = ("robust", "loss", "initial_yaw", *SWITCHES)
NUMBERS = [field.name for field in fields(FilterConfig) if field.name not in OTHERS]


def write(tmp_path, text):
    path = tmp_path / "ekf_node.yaml"
    path.write_text(text)
    return path


def test_defaults_are_valid_and_reach_the_core_under_the_same_names():
    config, tuning = FilterConfig(), FilterConfig().tuning()
    for name in Tuning._fields:
        if name not in ("robust", "loss"):
            assert getattr(tuning, name) == getattr(config, name), name
    assert set(Tuning._fields) == {field.name for field in fields(FilterConfig)}


@pytest.mark.parametrize("value", [0.0, -1.0, float("nan"), float("inf"), "fast", None])
def test_a_number_must_be_above_zero(value):
    accepted = []
    for name in NUMBERS:
        try:
            FilterConfig(**{name: value})
            accepted.append(name)
        except InputError as error:
            assert name in str(error)
    assert accepted == (["vibration_gain"] if value == 0.0 else [])  # 0: it does not vibrate


@pytest.mark.parametrize("value", [float("nan"), float("inf"), "north"])
def test_yaw_must_be_a_finite_number(value):
    with pytest.raises(InputError, match="initial_yaw"):
        FilterConfig(initial_yaw=value)


@pytest.mark.parametrize("name", SWITCHES)
def test_a_switch_is_true_or_false(name):
    with pytest.raises(InputError, match=name):
        FilterConfig(**{name: 1})


def test_iterations_are_counted_in_whole_numbers():
    with pytest.raises(InputError, match="iterations"):
        FilterConfig(iterations=2.5)


def test_yaw_may_be_negative_or_zero():
    assert FilterConfig(initial_yaw=-1.0).initial_yaw == -1.0


@pytest.mark.parametrize("field, value", [("robust", "median"), ("loss", "tukey"), ("loss", ""), ("robust", None)])
def test_names_must_be_known(field, value):
    with pytest.raises(InputError, match=f"{field}: .* is not one of"):
        FilterConfig(**{field: value})


def test_names_reach_the_core_as_their_places():
    for i, robust in enumerate(ROBUST):
        for k, loss in enumerate(LOSSES):
            tuning = FilterConfig(robust=robust, loss=loss).tuning()
            assert (tuning.robust, tuning.loss) == (i, k)


def test_types_that_reach_the_core_do_not_depend_on_how_a_number_was_written(tmp_path):
    """Every new combination of types compiles the whole core anew, half a minute."""
    path = write(tmp_path, "ekf_node: {ros__parameters: {gate: 3, tdoa_std: 1, odometry_rate: 100, use_imu: true}}")
    written = FilterConfig.from_yaml(path).tuning()
    assert [type(value) for value in written] == [type(value) for value in FilterConfig().tuning()]


def test_from_yaml_takes_what_tunes_the_filter_and_passes_over_the_rest(tmp_path):
    text = "ekf_node:\n  ros__parameters:\n    tdoa_std: 0.5\n    loss: huber\n    use_imu: false\n    frame: map\n"
    assert FilterConfig.from_yaml(write(tmp_path, text)) == FilterConfig(tdoa_std=0.5, loss="huber", use_imu=False)


def test_from_yaml_of_any_namespace(tmp_path):
    text = "/**:\n  ros__parameters:\n    gate: 2.0\n"
    assert FilterConfig.from_yaml(write(tmp_path, text)).gate == 2.0


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


def test_missing_file_is_bad_input(tmp_path):
    with pytest.raises(InputError, match="nowhere.yaml"):
        FilterConfig.from_yaml(tmp_path / "nowhere.yaml")
