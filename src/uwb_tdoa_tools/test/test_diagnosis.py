import json

import numpy as np
import pytest

import undeclared
from uwb_tdoa_bias.effects import EffectSet, SmoothTerm
from uwb_tdoa_bias.foundation.errors import InputError
from uwb_tdoa_tools.bags.bag import write_bag
from uwb_tdoa_tools.commands.diagnose import main
from uwb_tdoa_tools.diagnosis import diagnose
from uwb_tdoa_tools.diagnosis.attribute import attribute
from uwb_tdoa_tools.studies.diagnosis.bank import SIZES, clean_flight, effect_of, names_found
from uwb_tdoa_tools.diagnosis.channels import residuals
from uwb_tdoa_tools.diagnosis.fit import fit
from uwb_tdoa_tools.diagnosis.rows import build, candidates
from uwb_tdoa_tools.diagnosis.select import Candidate, columns_of, select


@pytest.fixture(scope="module")
def flight():
    return clean_flight(100, 40.0)


def quick(flight):
    """The declared effects alone, without the scan: [(effect, values)]."""
    found = [residuals(flight)]
    wanted = candidates(found)
    table = build(found, wanted)
    every = [Candidate(effect.name, tuple((effect.name, key) for key in keys)) for effect, keys in wanted]
    selection = select(table, every, fit(table, columns_of(every)).inflation)
    index = {name: k for k, name in enumerate(selection.fit.names)}
    return [
        (one.effect, {key: selection.fit.beta[index[name]] for name, key in zip(one.columns, one.keys)})
        for one in selection.chosen
    ]


def test_residuals_of_a_clean_flight_are_its_noise(flight):
    found = residuals(flight)
    assert np.std(found.gyro.residual) < 0.002 and np.std(found.accel.residual) < 0.01
    assert 1.4826 * np.median(np.abs(found.tdoa.residual[found.tdoa.airborne])) == pytest.approx(0.06, rel=0.05)


def test_nothing_is_found_where_nothing_is(flight):
    assert quick(flight) == []


@pytest.mark.parametrize(
    "name",
    [
        "anchor_delay",
        "pair_offset",
        "tag_lever_arm",
        "tdoa_time_offset",
        "truth_time_offset",
        "gyro_scale",
        "imu_misalignment",
    ],
)
def test_a_declared_effect_is_found_with_its_size(flight, name):
    effect = effect_of(name, False, 1)
    ((found, values),) = quick(effect.inject(flight))
    assert found == name and set(values) == set(effect.values)
    for key, value in effect.values.items():
        assert values[key] == pytest.approx(value, rel=0.1)


def test_every_declared_effect_is_in_the_bank():
    from uwb_tdoa_bias.effects import EFFECTS

    assert set(SIZES) == set(EFFECTS)


def test_an_interval_of_nlos_is_found_with_its_anchor_and_time(flight):
    effect = effect_of("nlos", True, 2)
    attribution = attribute([effect.inject(flight)], undeclared=False)
    (finding,) = attribution.findings
    for key, value in effect.values.items():
        assert finding.effect.values[key] == pytest.approx(value, abs=0.02 if key.endswith("delay") else 1.0)


@pytest.mark.parametrize("name", ["noise_level", "outlier_rate"])
def test_noise_is_told_from_bias(flight, name):
    rng = np.random.default_rng(0)
    attribution = attribute([effect_of(name, True, 3).inject(flight, rng)], undeclared=False)
    assert names_found(attribution) == [name]


def test_an_undeclared_effect_is_found_by_its_covariate(flight):
    attribution = attribute([undeclared.drag_on_cable(flight)])
    assert names_found(attribution) == ["tdoa/speed"]
    term = attribution.effects[0]
    assert isinstance(term, SmoothTerm) and term.usable
    left = attribution.left[0].tdoa
    assert 1.4826 * np.median(np.abs(left.residual[left.airborne])) == pytest.approx(0.06, rel=0.1)


def test_anchors_of_two_installations_are_refused(flight):
    from dataclasses import replace

    from uwb_tdoa_bias.foundation.anchors import Anchors

    other = replace(
        flight,
        name="elsewhere",
        anchors=Anchors(flight.anchors.ids, flight.anchors.positions + 1.0, flight.anchors.orientations),
    )
    with pytest.raises(InputError, match="elsewhere: its anchors are not those"):
        diagnose([flight, other])


@pytest.mark.slow
def test_the_loop_is_closed(flight, tmp_path, capsys):
    write_bag(effect_of("anchor_delay", True, 4).inject(flight), tmp_path / "late")
    write_bag(effect_of("anchor_delay", True, 4).inject(clean_flight(101, 30.0)), tmp_path / "other")
    out = tmp_path / "out"
    assert main([str(tmp_path / "late"), "--holdout", str(tmp_path / "other"), "--out", str(out)]) == 0
    assert "found     anchor_delay" in capsys.readouterr().out
    content = json.loads((out / "diagnosis.json").read_text())
    (finding,) = content["findings"]
    assert finding["effect"] == "anchor_delay" and finding["channel"] == "tdoa" and finding["added"]
    assert {"parameters", "std", "evidence", "variance_explained", "confounded_with"} <= set(finding)
    before, after = content["before"]["pooled"]["rmse_3d"], content["after"]["pooled"]["rmse_3d"]
    assert after < 0.3 * before and content["unattributed"] == [] and content["ambiguous"] == []
    assert len(EffectSet.from_yaml(out / "effects.yaml")) == 1
    page = (out / "report.html").read_text()
    assert "anchor_delay" in page and "data:image/png" in page and "http" not in page


@pytest.mark.slow
def test_without_truth(flight):
    result = diagnose([effect_of("anchor_delay", True, 4).inject(flight)], truth=False)
    assert [found["effect"] for found in result.findings] == ["anchor_delay"]
    hidden = {item["effect"] for item in result.unobservable}
    assert {"tag_lever_arm", "truth_frame", "tdoa_time_offset"} <= hidden


@pytest.mark.slow
def test_measured_flight(shared_data):
    from uwb_tdoa_tools.readers import read_flight

    survey = shared_data / "surveys" / "anchor_const1.csv"
    one, two = (read_flight(shared_data / "util" / f"const1-trial{k}-tdoa2.csv.gz", survey) for k in (1, 2))
    effects = EffectSet(attribute([one]).effects)
    before, after = (residuals(two, model).tdoa for model in (EffectSet(), effects))  # of a flight that was not fitted
    assert np.median(np.abs(after.residual[after.airborne])) < 0.7 * np.median(np.abs(before.residual[before.airborne]))
