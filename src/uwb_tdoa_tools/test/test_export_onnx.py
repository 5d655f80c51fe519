# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""A correction in one ONNX file equals effects and network: each effect, and all together."""

from dataclasses import replace
import json
from types import SimpleNamespace

import numpy as np
import pytest

onnx = pytest.importorskip("onnx")

from exported_states import anchors_of, exportable, network_of, rows_of, states  # noqa: E402
from known_effects import SIZES, effect_of  # noqa: E402

from uwb_tdoa_bias.common.anchors import Anchors  # noqa: E402
from uwb_tdoa_bias.common.errors import InputError  # noqa: E402
from uwb_tdoa_bias.correction.corrector import Corrector  # noqa: E402
from uwb_tdoa_bias.correction.model import (  # noqa: E402
    EFFECTS as EFFECTS_ONLY,  # noqa: E402
    INPUTS,
    NETWORK,
    PASSED,
    ExportedCorrection,
    load_network,
)
from uwb_tdoa_bias.correction.session import Session  # noqa: E402
from uwb_tdoa_bias.effects import (
    EFFECTS as DECLARED,  # noqa: E402
    EffectSet,  # noqa: E402
)
from uwb_tdoa_bias.effects.effect_set import REACH  # noqa: E402
from uwb_tdoa_tools.commands import export  # noqa: E402
from uwb_tdoa_tools.estimate import with_antenna  # noqa: E402
from uwb_tdoa_tools.exporting.onnx_file import printed, write_onnx  # noqa: E402
from uwb_tdoa_tools.exporting.tracing import (
    is_traceable,
    left_out,
    samples_of,  # noqa: E402
    trace,
)
from uwb_tdoa_tools.readers import read_flight  # noqa: E402
from uwb_tdoa_tools.scoring.evaluation import evaluate  # noqa: E402
from uwb_tdoa_tools.training.models import FEATURES, WITHOUT  # noqa: E402

EQUAL = 1e-4  # m
ANCHORS = anchors_of()
EFFECTS = exportable(ANCHORS)


def exported(path, effects, network=None):
    """Return the ExportedCorrection of a file written for ANCHORS."""
    path.write_bytes(printed(trace(ANCHORS, effects, network)).SerializeToString())
    return ExportedCorrection(path, Session(path.read_bytes()))


def assert_equal(effects, network, model, samples):
    """Assert that the file equals effects and network within EQUAL."""
    expected = Corrector(ANCHORS, effects, network).prediction(samples)
    found = Corrector(ANCHORS, None, model).prediction(samples)
    scale = {"bias": EQUAL, "std": EQUAL, "slope": EQUAL / REACH, "status": 0.0, "state": 0.0}
    for name, most in scale.items():
        one, other = getattr(found, name), getattr(expected, name)
        np.testing.assert_allclose(one, other, rtol=0.0, atol=most, err_msg=name)


@pytest.mark.parametrize(
    "name",
    [name if name in DECLARED else pytest.param(name, marks=pytest.mark.slow) for name in EFFECTS],
)
def test_each_effect(tmp_path, name):
    effects = EffectSet((EFFECTS[name],))
    model = exported(tmp_path / "bias.onnx", effects)
    samples = states(ANCHORS)
    assert_equal(effects, None, model, samples)
    prediction = Corrector(ANCHORS, effects).prediction(samples)
    # the correction is not zero
    assert max(np.abs(prediction.bias).max(), prediction.std.max()) > 0.01


@pytest.mark.slow
@pytest.mark.parametrize("names", [FEATURES, WITHOUT], ids=["14", "8"])
def test_networks(tmp_path, names):
    """Test a network alone, a network with all limits, and a network with all declared effects."""
    limits = {name: [-4.0, 4.0, 3.0] for name in names[:6]}
    more = {"validity": limits, "fade_std": 0.2, "largest_yaw_std": 1.0, "share": 0.75}
    plain, limited = (network_of(tmp_path, names, k, **extra) for k, extra in enumerate(({}, more)))
    declared = EffectSet(tuple(effect for name, effect in EFFECTS.items() if " " not in name))
    samples = states(ANCHORS)
    for effects, network in ((None, plain), (None, limited), (declared, limited)):
        model = exported(tmp_path / "bias.onnx", effects, network)
        assert_equal(effects, network, model, samples)
        assert np.ptp(network.predict(samples)[0][np.isfinite(samples.q[:, 0])]) > 0.1


def test_a_file_goes_through_the_trial_of_all_models_and_through_the_checker_of_onnx(tmp_path):
    """Each row gives the same bits in every batch."""
    declared = EffectSet((EFFECTS["anchor_delay"], EFFECTS["range_bias"], EFFECTS["nlos"]))
    path = tmp_path / "made" / "bias.onnx"
    traced = write_onnx(path, ANCHORS, declared, network_of(tmp_path))
    graph = onnx.load(path).graph
    onnx.checker.check_model(onnx.load(path), full_check=True)
    used = {name for node in graph.node for name in node.input}
    assert {one.name for one in graph.initializer} <= used  # else onnxruntime warns of each
    model = load_network(path)
    assert isinstance(model, ExportedCorrection) and not model._model.alone
    assert model.meta.keys() == traced.meta().keys()
    assert model.name == f"{declared.name}+random" and model.of_effects == declared.name
    corrector = Corrector(ANCHORS, None, model)
    assert corrector.name_of_status[EFFECTS_ONLY] == declared.name
    assert corrector.name_of_status[NETWORK] == corrector.model_name == model.name
    samples = states(ANCHORS, 300)
    together = corrector.prediction(samples)
    one = corrector.prediction(rows_of(samples, slice(7, 8)))
    for name, values in together._asdict().items():
        np.testing.assert_array_equal(getattr(one, name), values[7:8])


def test_unknown_anchors_are_not_corrected_whatever_else_comes(tmp_path):
    declared = EffectSet(tuple(effect for name, effect in EFFECTS.items() if " " not in name))
    model = exported(tmp_path / "bias.onnx", declared, network_of(tmp_path))
    rng = np.random.default_rng(0)
    table = rng.normal(0.0, 3.0, (1000, len(INPUTS)))
    table[rng.random(table.shape) < 0.1] = np.nan
    table[rng.random(table.shape) < 0.05] = np.inf
    known = ANCHORS.ids.tolist()
    strange = [-1, 8, 65535, 0.5, np.nan, np.inf]
    a, b = rng.choice([*known, *strange], (2, len(table)))
    a[: len(a) // 2], b[: len(b) // 2] = rng.choice(known, (2, len(a) // 2))
    table[:, 0], table[:, 1] = a, b
    out = model._model.run(table)
    valid = np.isin(a, known) & np.isin(b, known) & (a != b)
    assert (out[~valid] == 0.0).all() and np.isfinite(out).all()
    given = np.isfinite(table[:, :9]).all(axis=1)
    assert (out[valid & given & ~np.isinf(table).any(axis=1), -1] == 2.0).all()


def test_an_anchor_that_was_moved_since_is_not_corrected_and_is_named(tmp_path):
    """The corrections in a file hold only for the anchor positions at export."""
    model = exported(tmp_path / "bias.onnx", EffectSet((EFFECTS["anchor_delay"],)))
    assert model.trouble(ANCHORS) is None
    elsewhere = ANCHORS.positions.copy()
    elsewhere[3, 0] += 0.5
    moved = ANCHORS.at(elsewhere)
    assert "without anchor 3, or for another place" in model.trouble(moved)
    with pytest.raises(InputError, match="bias.onnx was exported without anchor 3"):
        model.require(moved)
    samples = replace(states(ANCHORS, 500), anchors=moved)
    found = Corrector(moved, None, model).prediction(samples)
    of_moved = (samples.a == 3) | (samples.b == 3)
    assert (found.bias[of_moved] == 0.0).all() and (found.status[of_moved] == PASSED).all()
    assert (found.status[~of_moved] == EFFECTS_ONLY).all()


def test_nothing_is_corrected_twice(tmp_path):
    delay, arm = (EffectSet((EFFECTS[name],)) for name in ("anchor_delay", "tag_lever_arm"))
    model = exported(tmp_path / "bias.onnx", delay)
    with pytest.raises(InputError, match="anchor_delay is in the model too"):
        Corrector(ANCHORS, delay, model)
    samples = states(ANCHORS, 500)
    both = Corrector(ANCHORS, arm, model).prediction(samples)
    expected = Corrector(ANCHORS, EffectSet((*delay, *arm))).prediction(samples)
    np.testing.assert_allclose(both.bias, expected.bias, atol=EQUAL)
    flight = SimpleNamespace(meta={"antenna": [0.0, 0.0, 0.1]})
    of_arm = exported(tmp_path / "arm.onnx", arm)
    assert with_antenna(None, flight, of_arm) is None
    assert len(with_antenna(None, flight, model)) == 1


# Expected worth of each effect that a file cannot hold, m, from its size in known_effects.SIZES
LEFT_OUT = {
    "tdoa_time_offset": (0.05, "at 1 m/s", "it changes the stamps of TDOAs"),
    "gyro_bias": (0.05 * 9.81 / 6.0, "after 1 s without TDOAs", "it acts on gyro"),
    "accel_bias": (0.5 * 0.3, "after 1 s without TDOAs", "it acts on accel"),
    "height_offset": (0.1, "", "it acts on height"),
    "velocity_delay": (0.15, "at 1 m/s", "it acts on velocity"),
    "gyro_scale": (0.1 * 9.81 / 6.0, "after 1 s without TDOAs at 1 rad/s", "it acts on gyro"),
    "velocity_misalignment": (0.3, "after 1 s at 1 m/s", "it acts on velocity"),
    "floor_step": (0.5, "", "it acts on height"),
    "floor_multipath": (3.6, "", "the filter weighs it"),
}


@pytest.mark.parametrize("name", LEFT_OUT)
def test_what_is_left_out_is_named_with_its_worth(tmp_path, name):
    effect = effect_of(name, True, 1)
    traced = write_onnx(tmp_path / "bias.onnx", ANCHORS, EffectSet((effect, EFFECTS["nlos"])))
    (omitted,) = traced.left_out
    worth, when, why = LEFT_OUT[name]
    assert omitted.label == name and omitted.when == when and omitted.why.startswith(why)
    assert omitted.worth == pytest.approx(worth)
    assert traced.meta()["left_out"] == [str(omitted)] and f"{worth:.2g} m" in str(omitted)


def test_every_declared_effect_is_exported_or_left_out():
    for name in DECLARED:
        labels = {"anchor_ids": {"1": 4}, "pair_sign": {"0-1": -1}}
        values = effect_of(name, True, 1).values if name in SIZES else labels[name]
        effect = DECLARED[name](values)
        if not is_traceable(effect):
            omitted = left_out(effect, ANCHORS)
            assert omitted.why and np.isfinite(omitted.worth), name


def test_a_file_that_no_node_would_load_is_not_written(tmp_path, monkeypatch):
    monkeypatch.setattr("uwb_tdoa_tools.exporting.onnx_file.MODEL_BYTES", 1000)
    with pytest.raises(InputError, match="bytes, more than 1000.*; export fewer effects"):
        write_onnx(tmp_path / "bias.onnx", ANCHORS, EffectSet((EFFECTS["anchor_delay"],)))
    assert not (tmp_path / "bias.onnx").exists()


@pytest.mark.slow
def test_a_measured_flight_has_the_same_figures_by_the_file_and_by_effects(shared_data, tmp_path):
    """The filter is in the loop.

    The file cannot hold gyro_bias, so the filter gets it as an effect.
    """
    log, survey = shared_data / "flights/0426/0426-traj3", shared_data / "surveys/anchor_0426.txt"
    flight, path = read_flight(log, survey), tmp_path / "bias.onnx"
    kinds = "anchor_delay", "antenna_pattern", "gyro_bias"
    values = {"3": 0.1, "5": -0.08}, {"tag": 0.1}, {"z": 0.01}
    effects = EffectSet(tuple(DECLARED[kind](value) for kind, value in zip(kinds, values)))
    traced = write_onnx(path, flight.anchors, effects)
    rest = effects.where(lambda effect: effect.name == "gyro_bias")
    assert [one.label for one in traced.left_out] == ["gyro_bias"]
    expected, by_effects = evaluate(flight, effects=effects)
    found, by_file = evaluate(flight, effects=rest, network=load_network(path))
    assert found.row()["rmse_3d"] == pytest.approx(expected.row()["rmse_3d"], abs=1e-6)
    np.testing.assert_allclose(by_file.bias, by_effects.bias, rtol=0.0, atol=EQUAL)
    assert np.ptp(by_effects.bias) > 0.2


# --- the command ---


@pytest.fixture
def desk(tmp_path, monkeypatch):
    """A working directory with anchors, effects and a network.

    The export leaves out two of the three effects.
    """
    monkeypatch.chdir(tmp_path)
    ANCHORS.to_yaml("anchors.yaml")
    kinds = "anchor_delay", "tdoa_time_offset", "gyro_bias"
    EffectSet(tuple(effect_of(name, True, 1) for name in kinds)).to_yaml("effects.yaml")
    network_of(tmp_path)  # network14-0.onnx
    return tmp_path


def test_the_command_writes_the_file_and_says_what_it_left_out(desk, capsys):
    line = "--survey anchors.yaml --effects effects.yaml --model network14-0.onnx --onnx bias.onnx"
    assert export.main(line.split()) == 0
    out, err = capsys.readouterr()
    assert out == "anchor_delay+random for 8 anchors in frame map -> bias.onnx\n"
    assert "tdoa_time_offset is left out: it changes the stamps" in err
    assert "gyro_bias is left out: it acts on gyro, not on TDOAs. It is worth 0.082 m" in err
    model = load_network("bias.onnx")
    assert model.holds == ("anchor_delay",) and len(json.loads(model.meta["left_out"])) == 2


@pytest.mark.parametrize(
    "options, said",
    [
        ("--onnx bias.onnx", "--effects: is missing, and so is --model"),
        ("--effects effects.yaml", "--onnx, --c, --crazyflie: all are missing"),
        ("--effects inert.yaml --onnx bias.onnx", "effects: nothing can be exported. gyro_bias"),
        ("--model other.onnx --onnx bias.onnx", "is an exported correction already"),
    ],
)
def test_what_cannot_be_exported_is_refused(desk, capsys, options, said):
    EffectSet((effect_of("gyro_bias", True, 1),)).to_yaml("inert.yaml")
    write_onnx("other.onnx", ANCHORS, EffectSet((EFFECTS["anchor_delay"],)))
    assert export.main(["--survey", "anchors.yaml", *options.split()]) == 2
    assert said in capsys.readouterr().err and not (desk / "bias.onnx").exists()


def test_anchors_that_single_precision_or_one_file_cannot_hold_are_refused(tmp_path):
    far = ANCHORS.at(ANCHORS.positions + [4e5, 5e6, 0.0])
    many = Anchors.from_positions(np.random.default_rng(0).uniform(0, 50, (129, 3)))
    for anchors, said in ((far, "give positions in a frame that begins nearby"), (many, "129")):
        with pytest.raises(InputError, match=said):
            write_onnx(tmp_path / "bias.onnx", anchors, EffectSet((EFFECTS["anchor_delay"],)))


@pytest.mark.parametrize("rows", [0, slice(0, 3), slice(None, None, 2), np.zeros(3, dtype=bool)])
@pytest.mark.parametrize("others", [(), (0,)])
def test_an_effect_that_selects_single_rows_is_refused(rows, others):
    place = samples_of(ANCHORS, motion=False).p
    with pytest.raises(TypeError, match="an effect may not select single rows .*; write the"):
        place[(rows, *others)]


def test_an_effect_may_index_all_rows_as_numpy_does():
    place = samples_of(ANCHORS, motion=False).p
    for key in (slice(None), np.s_[:, 0], np.s_[..., 0], np.s_[..., None], np.s_[..., None, 1:]):
        assert place[key].shape == np.zeros(place.shape)[key].shape
