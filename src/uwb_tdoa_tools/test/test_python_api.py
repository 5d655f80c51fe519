# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The public module: its names, its arguments, and the code in the examples and on the page."""

import inspect
import json
import re
import runpy
import sys

from documented import ROOT
import numpy as np
import pytest
import uwb_tdoa as uwb

from uwb_tdoa_bias.common.errors import version
from uwb_tdoa_bias.effects import EFFECTS

# A new version may add names and arguments, but not remove them.
SIGNATURES = {
    "calibrate": "flights holdout=() *effects=None *config=None *truth=None *tape=None",
    "check": "flight",
    "diagnose": "flights holdout=() *effects=None *config=None *reference='truth'",
    "effect": "kind",
    "errors": "flight run effects=None",
    "filter": "flight effects=None config=None model=None",
    "flight": "anchors *units=None *name='flight' **tables",
    "plot": "flight run",
    "plot_errors": "flight run effects=None",
    "read": "path survey=None *namespace='' *topics=None *salvage=False *profile=None *tag=''",
    "report": "diagnosis",
    "simulate": "vehicle='quadrotor' **settings",
    "smooth": "flight effects=None config=None model=None",
    "table": "part",
    "write": "flight path *force=False",
}
OTHERS = """Anchors ArrivalEffect EFFECTS Effect EffectSet FilterConfig Flight InputError Row Run
    Tape""".split()
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))


def words_of(function):
    """Return the arguments of a function: name and default; * marks keyword-only arguments."""
    parts = []
    for each in inspect.signature(function).parameters.values():
        before = {each.KEYWORD_ONLY: "*", each.VAR_KEYWORD: "**"}.get(each.kind, "")
        default = "" if each.default is each.empty else f"={each.default!r}"
        parts.append(f"{before}{each.name}{default}")
    return " ".join(parts)


def test_names_and_arguments_are_as_promised():
    assert sorted(uwb.__all__) == sorted([*SIGNATURES, *OTHERS]) and set(uwb.__all__) <= set(
        dir(uwb)
    )
    assert {name: words_of(getattr(uwb, name)) for name in SIGNATURES} == SIGNATURES
    assert uwb.__version__ == version()
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        uwb.nothing  # noqa: B018


@pytest.fixture
def own():
    """Return a function that declares effects. They are removed after the test."""
    known = dict(EFFECTS)

    def make(name, module=__name__):
        row = uwb.Row(name, "m", 1.0, 0.01, 0.1, "x", "an example", "nothing")
        return type("Own", (uwb.ArrivalEffect,), {"row": row, "__module__": module})

    yield make
    EFFECTS.clear()
    EFFECTS.update(known)


def test_an_effect_of_your_own_is_known_everywhere(own, tmp_path):
    kind = uwb.effect(own("warmth"))
    assert uwb.EFFECTS["warmth"] is kind
    # as in a notebook cell that runs again
    assert uwb.effect(own("warmth")) is uwb.EFFECTS["warmth"] is not kind
    with pytest.raises(ValueError, match="an effect of that name exists"):
        uwb.effect(own("anchor_delay"))
    with pytest.raises(ValueError, match="has no `row`"):
        uwb.effect(type("Bare", (uwb.Effect,), {}))


@pytest.fixture(scope="module")
def flight():
    return uwb.simulate(duration=12.0, imu_rate=100.0, start_in_air=True, seed=4)


def columns(table):
    return list(table.columns if hasattr(table, "columns") else table.dtype.names)


@pytest.mark.parametrize("with_pandas", [False, True])
def test_tables_are_of_pandas_or_of_numpy(flight, monkeypatch, with_pandas):
    if with_pandas:
        pytest.importorskip("pandas")
    else:
        monkeypatch.setitem(sys.modules, "pandas", None)
    tdoa, imu, truth = map(uwb.table, (flight.tdoa, flight.imu, flight.truth))
    assert columns(tdoa) == ["t", "a", "b", "d", "variance"]
    assert columns(imu) == ["t", *(f"{one}_{k}" for one in ("gyro", "accel") for k in "xyz")]
    assert columns(truth) == ["t", "p_x", "p_y", "p_z", "q_x", "q_y", "q_z", "q_w"]
    assert isinstance(tdoa, np.ndarray) != with_pandas and len(tdoa) == len(flight.tdoa)
    np.testing.assert_array_equal(tdoa["d"], flight.tdoa.d)
    np.testing.assert_array_equal(truth["p_z"], flight.truth.p[:, 2])


def numbers(pattern, text):
    return [float(found) for found in re.findall(pattern, text)]


@pytest.mark.slow
@pytest.mark.parametrize("program", EXAMPLES, ids=lambda path: path.stem)
def test_an_example_does_what_it_says(program, own, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", [str(program)])
    runpy.run_path(str(program), run_name="__main__")
    told = capsys.readouterr().out
    written = {path.name for path in tmp_path.iterdir()}
    rmse = numbers(r"RMSE ([\d.]+)", told)
    if program.stem == "locate":
        assert "estimates, the first at x =" in told and "circle_bag.png" in written
    elif program.stem in ("compare", "calibrate"):
        assert rmse[1] < rmse[0] and (program.stem == "calibrate" or "errors.png" in written)
    elif program.stem == "find_error":
        assert "anchor_delay" in told and rmse[1] < 0.5 * rmse[0]
        assert {"report.html", "effects.yaml"} <= written
    else:
        (line,) = (line for line in told.splitlines() if "found side_delay" in line)
        hidden, found = (numbers(r"'\w+': (-?[\d.]+)", part) for part in line.split("found"))
        np.testing.assert_allclose(found, hidden, atol=0.005)


@pytest.mark.slow
def test_a_notebook_runs_cell_by_cell(tmp_path, monkeypatch):
    """Magic lines, which choose the display of pictures, are removed."""
    monkeypatch.chdir(tmp_path)
    (path,) = (ROOT / "examples").glob("*.ipynb")
    cells = json.loads(path.read_text())["cells"]
    assert all(cell.get("outputs", []) == [] for cell in cells)
    names = {"__name__": "__main__"}
    for cell in cells:
        if cell["cell_type"] == "code":
            exec(re.sub(r"^%.*$", "", "".join(cell["source"]), flags=re.MULTILINE), names)
