# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Run the commands of a documentation page like a user, on files in the format of other tools."""

from importlib import import_module
import re
import subprocess

from documented import ROOT
import numpy as np

MILLI = 1e3
FIGURES = "%.12g"  # stamps of another epoch in ms need all digits


def section(page, heading):
    """Return the text below a heading of a page of docs/."""
    text = (ROOT / "docs" / page).read_text()
    level = re.search(rf"^(#+) {re.escape(heading)}$", text, re.MULTILINE).group(1)
    return re.split(
        rf"^#{{2,{max(2, len(level))}}} ",
        text.partition(f"{level} {heading}\n")[2],
        flags=re.MULTILINE,
    )[0]


def blocks(text, language=""):
    """Return the contents of the fenced blocks of a language."""
    found = re.findall(r"^```(\w*)\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    return [content for name, content in found if name == language]


def commands(script):
    """Return [(name of a tool, [word, ...])] of the lines of a script that run our tools.

    The shell splits the lines.
    """
    stub = "dev() { test $1 = run || return 0; shift 2; printf '%s\\0' \"$@\"; echo; }; "
    told = subprocess.run(
        ["bash", "-ec", stub + script.replace("./dev ", "dev ")],
        capture_output=True,
        text=True,
        check=True,
    )
    return [
        (name, words)
        for name, *words in (line.split("\0")[:-1] for line in told.stdout.splitlines())
    ]


def main(name, words):
    """Run a tool in this process and return its exit code."""
    return import_module(f"uwb_tdoa_tools.commands.{name}").main(words)


def run(script):
    """Run the commands of a script; each must end with exit code 0."""
    for name, words in commands(script):
        assert main(name, words) == 0, (name, words)


def write_tables(flight, stem):
    """Write a Flight as CSV files of another tool, STEM_ranging.csv and so on.

    Units: milliseconds, millimetres, degrees/s and g. The ids are in the opposite order.
    """
    tdoa, imu, truth = flight.tdoa, flight.imu, flight.truth
    tables = {"ranging": ("t_ms,to,from,diff_mm", [MILLI * tdoa.t, tdoa.b, tdoa.a, MILLI * tdoa.d])}
    if imu is not None:
        tables["imu"] = (
            "t_ms,gx,gy,gz,ax,ay,az",
            [MILLI * imu.t, np.rad2deg(imu.gyro), imu.accel / 9.81],
        )
    if truth is not None:
        tables["mocap"] = "t_ms,x,y,z", [MILLI * truth.t, MILLI * truth.p]
    for name, (header, columns) in tables.items():
        np.savetxt(
            f"{stem}_{name}.csv",
            np.column_stack(columns),
            fmt=FIGURES,
            delimiter=",",
            header=header,
            comments="",
        )
