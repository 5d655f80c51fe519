# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""All studies: their list, their options, the commands of the documentation, and a short run of each."""

from collections import defaultdict
import json
from types import SimpleNamespace

from checking_flights import QUICK
from documented import of_pages
import numpy as np
from output_attacks import attack, outputs, place, unknown  # noqa: F401
import pytest

from studies import (
    __main__ as study,
    calibrating,
    crazyflie,
    demo,
    first_map,
    moved_anchors,
    rover,
    streaming,
    surveying,
    table,
    vehicle,
)
from studies.diagnosis import splits
from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_tools.bags.bag import write_bag
from uwb_tdoa_tools.simulation import SimulationConfig, simulate

PARSERS = {name: study.parser(name) for name in study.STUDIES}
OUTPUTS = [(name, action) for name, parser in PARSERS.items() for action in outputs(parser)]


@pytest.fixture(scope="module")
def documented():
    """[(page, words)] of the studies in the documentation."""
    shown = ((page, words) for page, words in of_pages() if words[:2] == ["./dev", "study"])
    return [(page, words[2:]) for page, words in shown if words[2:]]


def test_the_list_has_every_study_and_its_help_its_options(capsys):
    assert study.main([]) == 0
    listed = capsys.readouterr().out
    for name, parser in PARSERS.items():
        assert f"\n  {name} " in listed
        assert study.main([name, "--help"]) == 0
        assert capsys.readouterr().out == parser.format_help()


def test_a_wrong_name_is_one_sentence(capsys):
    assert study.main(["nothing", "--draws", "3"]) == 2
    said = "study: error: nothing: no study has this name; ./dev study lists them.\n"
    assert capsys.readouterr() == ("", said)


def test_the_documentation_shows_every_study_and_every_command_is_a_command_line(documented):
    assert {words[0] for _, words in documented} == set(study.STUDIES)
    for page, (name, *words) in documented:
        assert PARSERS[name].parse_args(words), page


def test_every_option_that_takes_a_path_is_an_output_or_read():
    assert all(unknown(parser) == [] for parser in PARSERS.values()) and len(OUTPUTS) > 15


@pytest.mark.parametrize(("name", "action"), OUTPUTS)
def test_no_study_writes_through_a_link_or_over_what_it_reads(place, capsys, name, action):  # noqa: F811
    attack(study.main, ("study", name), PARSERS[name], action, place, capsys)


def test_trials_are_drawn_by_name_and_seed_and_kept(tmp_path):
    args = SimpleNamespace(draws=2, first=7, jobs=1, json=tmp_path / "kept.json", only=["b", "c"])
    names = table.chosen(args, ["ab", "d", "c"])
    found = list(table.trials(lambda trial: [*trial, np.nan], names, args))
    assert [(name, [seed for _, seed, _ in trials]) for name, trials in found] == [
        ("ab", [7, 8]),
        ("c", [7, 8]),
    ]
    kept = json.loads(args.json.read_text())
    assert kept == [["ab", 7, None], ["ab", 8, None], ["c", 7, None], ["c", 8, None]]
    with pytest.raises(InputError, match="no row has b or c in its name; they are: d."):
        table.chosen(args, ["d"])


def test_a_table_has_as_many_cells_in_each_line():
    head, rule, line = f"{table.head('a', 'b', 'c', texts=2)}\n{table.line([1, 'x', 2])}".split(
        "\n"
    )
    assert (head, rule, line) == ("| a | b | c |", "|---|---|---:|", "| 1 | x | 2 |")


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """A folder with a simulated flight as a bag, and its survey."""
    folder = tmp_path_factory.mktemp("data")
    flight = simulate(SimulationConfig(seed=0, **QUICK))
    write_bag(flight, folder / "flight.bag")
    rows = zip(flight.anchors.ids, *flight.anchors.positions.T)
    lines = [",".join(map(str, row)) for row in rows]
    (folder / "surveys").mkdir()
    (folder / "surveys" / "anchor_room.csv").write_text("\n".join(["id,x,y,z", *lines, ""]))
    return folder


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "said"),
    [
        (
            "checking FLIGHT --survey SURVEYS --only nothing",
            "| nothing: no error is said |  | 1 | 1 |",
        ),
        ("checking FLIGHT --survey SURVEYS --only in_g order", "| accelerometer in g |  | 1 | 1 |"),
        ("localizing FLIGHT", "| as they are | 1 | "),
        ("first-map --draws 1 --first 3", "mirror image"),
        ("moved-anchors --draws 1 --only nothing --tape", "| nothing | tape | 2 |  | "),
        ("plans --draws 1 --first 101 --places 12", "allowed 3"),
        ("rover --draws 1", "| hall: TDOAs alone | "),
        ("situations --draws 1 --only high", "| at rest, 1 m high | 0."),
        ("fly-faults --draws 1 --only nothing", "| nothing | nothing | 1 | 1 | 1 |"),
        ("warehouse --draws 1 --only blinks", "| room, 5 blinks/s | 1 of 1 | 1 | "),
    ],
)
def test_a_study_of_one_trial(data, capsys, words, said):
    paths = {"FLIGHT": str(data / "flight.bag"), "SURVEYS": str(data / "surveys")}
    name, *words = (paths.get(word, word) for word in words.split())
    assert study.main([name, *words, "--jobs", "1"]) == 0
    assert said in capsys.readouterr().out


@pytest.mark.slow
def test_wheels_decide_between_the_yaws_of_a_start():
    """They contradict the yaw that is best so far, and fit another one: before, 7.3 degrees."""
    flight, _ = rover.drive(8)
    _, yaw, *_ = rover._figures(flight, 8, *rover.ROWS["wheels, IMU"])
    assert yaw < 2.0


def moved(reading, tape, case):
    """As `moved_anchors._rows_of`."""
    kind, seed = case
    of_kind = {"moved before": [[3, 5]], "moved on the way": [[3]], "exchanged on the way": [[3]]}
    named = of_kind.get(kind, [])
    said = {"check": named, "localize": named, "live": [[4]]}
    ids = [3] if kind != "nothing" else []
    row = {"kind": kind, "calibrated": False, "ids": ids, "cost": 0.1, **said}
    if kind == "moved before":
        found = {"from": "a tape", "off": 0.05, "std": 0.1, "others": 0.4, "named": True}
        row["surveyed"] = [found, {**found, "off": 0.2, "std": 0.05, "others": 2.0}]
    return [row]


SURVEYED = {
    "true": 0.1,
    "shaken": 0.2,
    "surveyed": 0.15,
    "applied": True,
    "anchors_shaken": 0.3,
    "anchors_surveyed": 0.2,
    "normalised": 1.0,
}
DEMO = {"seed": 1, "really": "late", "added": ["a"], "without": 0.2, "with": 0.1}
DRAWN = {"offered": True, "before": 0.2, "after": 0.1, "had_it_been": 0.1}
MAP = defaultdict(float, normalized=[1.0], why="")
SPLIT = {"promised": [0.4, 0.2], "judged": [["a", 0.3, 0.15], ["b", 0.1, 0.12]], "seconds": 1.0}
KNOWN = [  # words, module, its function that is replaced, by what, what is printed
    (
        "moved-anchors",
        moved_anchors,
        "_rows_of",
        moved,
        "| moved before | tape | 1 | 1 | 1 | 1 | 1 | 1 | 1 | 0 | 1 | 0 |",
        "| exchanged before | tape | 1 | 1 | 0 | 0 | 1 | 0 | 0 | 0 | 0 | 0 |",
        "| nothing | tape | 2 |  | 0 | 0 | 2 |  |  |  |  |  |",
        "| a tape | 2 | 2 | 1 | 0 of 1 | 0.125 | 1 |",
    ),
    ("demo", demo, "looped", DEMO, "| 1 | late | a | 20.0 | 10.0 | -50 % |"),
    (
        "surveying --data . --only simulated --tape 0.1",
        surveying,
        "drawn",
        SURVEYED,
        "| 1 of 1 | 0.100 | 0.200 | 0.150 | 0.75 (0.75) | 0 of 1 | 0.300 | 0.200 | 1.00 |",
    ),
    (
        "streaming --data . --only const1 --tape 0.1",
        streaming,
        "drawn",
        [
            (0, 0.2, 0.2, False, False),
            (0, 0.2, 0.2, True, False),
            (0, 0.2, 0.1, False, False),
            (1, 0.2, 0.21, True, True),
        ],
        "| const1 | 0.1 | 2 (1 of 1) | 0.200 | 0.100 | 0.200 | 0.210 | 1.05 | 1 |",
    ),
    (
        "streaming --data . --only const1 --tape 0.1 --changed",
        streaming,
        "changed",
        [(0.1, 0.4, 0.11, 1), (0.1, 0.3, 0.13, 0), (0.1, 0.5, 0.12, 1)],
        "| const1 | 0.1 | late | 0.100 | 0.400 | 0.120 | 2 of 3 | 2 |",
    ),
    (
        "calibrating --data . --only simulated",
        calibrating,
        "drawn",
        DRAWN,
        "| 1 | 1 | 0.200 | 0.100 | 0.50 | 0.50 | 0.50 |",
    ),
    ("first-map", first_map, "judged", MAP, "1 of 1 accepted, 0 wrong"),
    (
        "diagnosis rows --data . --out OUT",
        splits,
        "judged",
        SPLIT,
        '"0425: 10": {\n  "before": 0.2,\n  "after": 0.135,',
    ),
    ("diagnosis few --data . --out OUT", splits, "judged", SPLIT, '"flights worse by 5 %": 10,'),
]


@pytest.mark.parametrize("known", KNOWN, ids=lambda known: known[0])
def test_a_study_prints_known_results(tmp_path, capsys, monkeypatch, known):
    words, module, name, result, *said = known
    monkeypatch.setattr(module, name, result if callable(result) else lambda *_: result)
    words = words.replace("OUT", str(tmp_path / "out")).split()
    assert study.main([*words, "--draws", "1", "--jobs", "1"]) == 0
    printed = capsys.readouterr().out
    assert all(text in printed for text in said)


def test_ways_through_a_radio_link_are_compared(capsys, monkeypatch):
    found = [dict.fromkeys(crazyflie.WAYS, (400.0, 100.0, error)) for error in (0.1, 0.3)]
    monkeypatch.setattr(crazyflie, "_of_recording", lambda reading, number: found[number])
    monkeypatch.setattr(crazyflie.inputs.Reading, "find", lambda *_: [0, 1])
    assert study.main(["crazyflie", "x", "--survey", "y", "--jobs", "1"]) == 0
    assert "| link, converted | 400 | 100 | 0.200 | 0.300 |" in capsys.readouterr().out


def test_a_correction_is_judged_on_the_other_half_of_each_survey(tmp_path, capsys, monkeypatch):
    flights = [(f"flight-{k}", "hall.yaml") for k in range(4)]
    made = SimpleNamespace(anchors=None, name="flown")
    given = {way: (way, None) for way in ("effects", "network")}, SimpleNamespace()
    fitted = []

    def corrections(folder, training, survey):
        fitted.append((folder.name, [path for path, _ in training]))
        return given

    errors = {
        "standard": np.array([[0.4, 0.3, 0.2]] * 2),
        "robust": np.array([[0.4, 0.3, 0.33]] * 2),
    }
    for name, value in (
        ("corrections", corrections),
        ("comparison", lambda *_: errors),
        ("write_crazyflie", lambda *_: None),
        ("trace", lambda *_: None),
        ("stddev_of", lambda _: 0.4),
    ):
        monkeypatch.setattr(vehicle, name, value)
    monkeypatch.setattr(vehicle.inputs.Reading, "find", lambda *_: flights)
    monkeypatch.setattr(vehicle.inputs.Reading, "read", lambda *_: made)
    words = ["vehicle", "x", "--survey", "y", "--firmware", "z", "--out", str(tmp_path)]
    assert study.main(words) == 0
    assert fitted == [
        ("hall-0", ["flight-0", "flight-1"]),
        ("hall-1", ["flight-2", "flight-3"]),
    ]
    printed = capsys.readouterr().out
    assert "| flown | effects | standard | 0.400 | 0.300 | 0.200 |" in printed
    assert "| mean | network | robust | 0.400 | 0.300 | 0.330 |" in printed
    assert "| worst | effects | robust |  |  | +10% |" in printed
    monkeypatch.setattr(vehicle.inputs.Reading, "find", lambda *_: flights[:2])
    assert study.main(words) == 2 and "give three or more" in capsys.readouterr().err
