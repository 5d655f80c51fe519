# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The study of rules: the tuned copy is the filter, changes while it runs, and changes are judged."""

import json
import os
from pathlib import Path
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest

from studies.rules import figures, listed, pace, tuned, watching, work
from studies.rules.catalogue import RULES, Rule
from studies.rules.worth import noise_of, worth
from uwb_tdoa_bias.common.sensors import SENSORS
from uwb_tdoa_ekf.core import noise, update

# In another process, as the copy takes the place of the filter: a variance, and the noise that is
# learned, as they are; with a constant doubled; without a rule; and as they are again
SCRIPT = """
import json, pickle, sys
from pathlib import Path

import numpy as np

made = pickle.loads(Path(sys.argv[1]).read_bytes())
from studies.rules.tuned import Live
from uwb_tdoa_ekf.core import update

live = Live(made)
P, x = np.eye(15), np.zeros(3)
a, b = np.array([1.0, 0.2, 0.0]), np.array([0.0, 2.0, 1.0])
(smallest,) = [one for one in made.constants if one.name == "update.SMALLEST"]


def now():
    return update.second_order_variance(x, P, a, b)


values = [now()]
live.scale(smallest, 10.0)
values.append(now())
live.restore()
values.append(now())
print(json.dumps([update.__file__, *values]))
"""


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    return tuned.copy_to(tmp_path_factory.mktemp("copy"))


@pytest.mark.slow
def test_every_rule_of_the_catalogue_stands_in_the_core_once_by_name(made):
    assert [entry.name for entry in made.rules] and len({rule.name for rule in RULES}) == len(RULES)
    assert {entry.name for entry in made.rules} == {rule.name for rule in RULES}


def test_the_modules_of_all_sensors_are_known():
    known = {module: name for module, name in work.MODULES.items() if module != "plane"}
    assert tuple(known.values()) == tuple(SENSORS)
    assert known["ranges"] == "range" and known["velocity"] == "velocity"


@pytest.mark.slow
def test_a_rule_that_is_not_there_is_named(tmp_path):
    with pytest.raises(ValueError, match="no such place: wings"):
        tuned.copy_to(tmp_path, (Rule("wings", "noise", "learn", "wings > 2"),))


def test_the_constants_of_compiled_functions_are_in_the_table(made):
    known = {entry.name: entry for entry in made.constants}
    assert known["noise.LARGEST_OUTLIER"].values == (noise.LARGEST_OUTLIER,)
    assert known["stationary_position.LANDING_STD"].values == (0.2, 0.2, 0.5)
    assert known["stationarity.LONG"].is_count and "state.GRAVITY" not in known
    # a constant that is computed from another one has no separate entry
    assert "update.GATE" in known and "hypotheses.LARGEST_NIS" not in known
    copied = (made.folder / "uwb_tdoa_ekf/core/hypotheses.py").read_text()
    assert f"tuned_number({known['update.GATE'].place}) ** 2" in copied
    places = [entry.place + k for entry in made.constants for k in range(len(entry.values))]
    assert len(set(places)) == len(places) and max(places) < tuned.FIRST_RULE


@pytest.mark.slow
def test_the_copy_changes_while_it_runs_and_is_the_filter_otherwise(made, tmp_path):
    import pickle

    job = tmp_path / "made.pickle"
    job.write_bytes(pickle.dumps(made))
    env = os.environ | {"PYTHONPATH": os.pathsep.join([str(made.folder), *filter(None, sys.path)])}
    run = [sys.executable, "-c", SCRIPT, str(job)]
    out = subprocess.run(run, env=env, check=True, capture_output=True, text=True).stdout
    file, before, doubled, after = json.loads(out)
    place = np.array([1.0, 0.2, 0.0]), np.array([0.0, 2.0, 1.0])
    assert file.startswith(str(made.folder))
    assert before == after == update.second_order_variance(np.zeros(3), np.eye(15), *place) > 0.0
    assert doubled == 0.0


def test_each_rule_and_constant_is_a_variant(made):
    variants = work.variants_of(made)
    nudged = [variant for variant in variants if variant.name.startswith(work.NUDGED)]
    assert len(variants) == 1 + len(nudged) + len(made.rules) + 2 * len(made.core)
    assert len(nudged) == len(work.NUDGES)
    assert len({variant.name for variant in variants}) == len(variants)


def test_a_loss_is_told_from_a_gain_and_from_what_does_not_matter():
    base = {"a": {"air": [0.2, 4.0, 0.0, 0.1]}, "b": {"again": [2.0]}}
    alike = {"a": {"air": [0.201, 4.01, 0.0, 0.101]}, "b": {"again": [2.04]}}
    worse = {"a": {"air": [0.3, 2.0, 0.0, 0.1]}, "b": {"again": [None]}}
    same = worth(base, base)
    assert same.same and (same.rows, same.changed) == (2, 0)
    small = worth(base, alike)
    assert not small.same and small.changed == 0
    large = worth(base, worse)
    assert large.changed == 2 and large.worse == (float("inf"), "b")
    assert large.better[1] == "a" and large.mean == pytest.approx(0.5)


def test_what_is_said_less_more_or_later_is_told():
    before = {"gap": [3.0, 9.0, 1.0], "sign": [20.0, 30.0, 0.5], "unit": [4.0, 9.0, 10.0]}
    after = {"gap": [6.0, 9.0, 1.0], "rate": [4.0, 5.0, 2.0], "unit": [4.0, 9.0, 11.0]}
    after["sign"] = [20.0, 27.0, 0.5]
    assert watching.differs(before, before) == {}
    assert watching.differs(before, after) == {
        "gap": "late",
        "rate": "new",
        "sign": "shorter",
        "unit": "size",
    }
    assert watching.differs(after, {}) == dict.fromkeys(after, "lost")


@pytest.mark.slow
def test_patches_change_modules_only_while_they_are_applied(made):
    named = {patch.name: patch for patch in watching.patches(made)}
    from uwb_tdoa_ekf.monitoring import monitor, ranging_rules

    rules = ranging_rules.RULES
    with named["monitoring.monitor.LIMIT x 2"].applied():
        assert monitor.LIMIT == 2 * 16.3
    with named["without: ranging_rules.rounded"].applied():
        assert len(ranging_rules.RULES) == len(rules) - 1
    assert monitor.LIMIT == 16.3 and ranging_rules.RULES is rules
    # a constant that Python and compiled code use changes in both; a size does not change
    both = named["monitoring.slices.DELAY_STD x 2"]
    assert both.changed and both.entry.name == "monitoring.slices.DELAY_STD"
    assert "monitoring.windows.NO_TDOA x 2" not in named


@pytest.mark.slow
def test_every_switch_of_a_rule_over_streams_and_residuals_is_there(made):
    """Each changes something that is there, and puts it back."""
    made = {patch.name.removeprefix("without: "): patch for patch in watching.patches(made)}
    for name in watching.SWITCHES:
        with made[name].applied():
            pass
        assert made[name].of, name


def test_a_constant_is_decided_by_one_row_and_a_rule_by_its_losses():
    base = {name: {"air": [0.2, 1.0, 0.0, 0.1]} for name in "abcd"}
    worse = {name: {"air": [0.3, 1.0, 0.0, 0.1]} for name in "a"}
    entry = tuned.Entry("noise.SHARE", 0, (0.5,))
    constant, rule = (work.Variant("", entry, factor) for factor in (0.5, 0.0))
    assert not work.Variant("", None).is_decided(worth(base, worse))
    assert constant.is_decided(worth(base, worse)) and not rule.is_decided(worth(base, worse))
    worse |= {name: worse["a"] for name in "bc"}
    assert rule.is_decided(worth(base, worse)) and not rule.is_decided(worth(base, base))


def test_a_row_that_changes_by_anything_shows_little():
    base = {"steady": {"air": [0.2, 1.0, 0.0, 0.1]}, "unsteady": {"air": [0.2, 1.0, 0.0, 0.1]}}
    nudged = {"steady": base["steady"], "unsteady": {"air": [0.3, 1.0, 0.0, 0.1]}}
    noise = noise_of(base, [base, nudged])
    assert noise == {"unsteady": pytest.approx(0.5)}
    changed = {"steady": {"air": [0.22, 1.0, 0.0, 0.1]}, "unsteady": {"air": [0.39, 1.0, 0.0, 0.1]}}
    assert worth(base, changed, noise).changes == {"steady": pytest.approx(0.1)}
    changed["unsteady"] = {"air": [0.41, 1.0, 0.0, 0.1]}
    assert set(worth(base, changed, noise).changes) == {"steady", "unsteady"}


def test_the_table_says_what_half_and_double_of_a_constant_change():
    base = {"a": {"air": [0.2, 1.0, 0.0, 0.1]}, "b": {"again": [2.0]}}
    doubled = {"a": {"air": [0.3, 1.0, 0.0, 0.1]}, "b": {"again": [None]}}
    found = {work.BASE: base, "noise.SHARE x 0.5": base, "noise.SHARE x 2": doubled}
    assert figures.table(found).splitlines()[-1] == "| `noise.SHARE` | - (2) | lost: b (2 of 2) |"
    said = {"gap": [3.0, 9.0, 1.0]}
    found = {work.BASE: {"a": said}, "monitoring.monitor.LIMIT x 0.5": {"a": {}}}
    last = figures.table_of_watch(found).splitlines()[-1]
    assert last == "| `monitoring.monitor.LIMIT` | a: `gap` lost (1 of 1) |  |"


def test_each_number_of_the_core_and_of_monitoring_is_in_a_table_of_the_notebook():
    """Run the study for a new constant, and list in the notebook what it is worth."""
    page = Path(__file__).parents[2] / "docs/notebook/constants.md"
    text = page.read_text()
    assert listed.unlisted(text) == []
    without = text.replace("| `monitoring.status.SILENT` |", "| - |")
    assert listed.unlisted(without) == ["monitoring.status.SILENT"]


def test_numbers_in_a_dict_are_scaled_and_its_words_stay():
    limits = {"gyroscope": (0.03, "rad/s"), "accelerometer": (0.6, "m/s^2")}
    assert watching.is_number(limits) and not watching.is_number({"imu/data": "uwb/tdoa"})
    assert watching._scaled(limits, 2.0)["gyroscope"] == (0.06, "rad/s")
    low, high = watching._wider({"g": (9.81, 0.5, 2.0)}, 2.0)["g"][1:]
    assert (low, high) == (pytest.approx(0.25), pytest.approx(4.0))


def test_a_vehicle_waits_for_a_filter_that_hangs_and_not_for_one_that_is_dead():
    def flown(delay):
        return pace._flown(turns, delay)["s of the clock"][2]

    turns = []
    for turn in range(1, 301):
        now = 0.01 * turn
        part = SimpleNamespace(t=np.array([now]))
        turns.append((now, part, part, np.array([now - 0.006, now - 0.001])))
    quick = flown(lambda now, rng: 0.001)
    assert flown(lambda now, rng: 2.0 if now == turns[250][0] else 0.001) - quick > 1.9
    assert 5.0 < flown(lambda now, rng: np.inf if now > 2.5 else 0.001) - quick < 10.0
