# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""arm64: compare the off-line filter on an emulated 64-bit Arm with this machine, value by value.

The folder gets Debian's arm64 Python (apt-get and the package sources of this machine), the
aarch64 wheels that .dev/requirements.lock pins, and the compiled code: 1 GB, which a second run
uses again. The first run compiles the filter under emulation, which takes about half an hour of
processor time.
"""

from importlib import metadata
import json
import os
from pathlib import Path
import platform
import re
import shutil
import subprocess
import sys

from exported_states import exportable
import numpy as np
from packaging.requirements import Requirement

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.files import write_text
from uwb_tdoa_bias.effects import EffectSet
from uwb_tdoa_tools import choices
from uwb_tdoa_tools.bags.bag import write_bag
from uwb_tdoa_tools.cli import show
from uwb_tdoa_tools.exporting.onnx_file import write_onnx
from uwb_tdoa_tools.outputs import OutputFolder
from uwb_tdoa_tools.readers import inputs
from uwb_tdoa_tools.simulation import SimulationConfig, simulate

from .export_cost import TEN

ROOT = Path(__file__).resolve().parents[1]
ESTIMATES = ROOT / "studies" / "arm64_estimates.py"
SOURCES = [ROOT / "src" / name for name in ("uwb_tdoa_bias", "uwb_tdoa_ekf", "uwb_tdoa_tools")]
PROGRAMS = {  # {program: Debian's package}
    "qemu-aarch64-static": "qemu-user-static",
    "apt-get": "apt",
    "dpkg-deb": "dpkg",
}
DEBIAN = "python3", "libstdc++6"
WHEELS = "numpy", "numba", "scipy", "PyYAML", "onnxruntime", "rosbags", "lz4", "tqdm", "joblib"
WHEELS += ("backports.zstd",)
PLATFORMS = "manylinux_2_28_aarch64", "manylinux_2_27_aarch64", "manylinux2014_aarch64"
FLIGHT = SimulationConfig(seed=1, duration=20.0, imu_rate=500.0)


def add_options(add):
    """add : add_argument of a parser."""
    add("--folder", metavar="DIR", type=OutputFolder, required=True, help="for all of that")
    add("--flights", nargs="+", default=[], metavar="FLIGHT", help=f"further {choices.RECORDINGS}")
    add("--survey", metavar="S", help=choices.SURVEY)
    add("--effects", metavar="FILE", help="effects.yaml to correct these flights with")
    add("--model", metavar="FILE", help="ONNX file to correct these flights with")


def run(args):
    """Install missing packages, run both, and print the table. Returns 1 if a value differs."""
    lacking = [package for name, package in PROGRAMS.items() if shutil.which(name) is None]
    if lacking:
        raise InputError(f"arm64: needs Debian's packages {', '.join(lacking)}; install them.")
    folder = args.folder.absolute()
    folder.mkdir(parents=True, exist_ok=True)
    write_text(folder / "cases.json", json.dumps(cases(folder, args), indent=1))
    install(folder)
    here = made(folder, "here.npz", [sys.executable], environment(SOURCES))
    there = made(folder, "arm64.npz", emulated(folder), environment_of(folder))
    rows = compared(here, there)
    show(
        f"{platform.machine()} beside arm64: Python {platform.python_version()}, {version(folder)}"
    )
    show(*table(rows))
    return int(any(row["differing"] for row in rows))


def cases(folder, args):
    """{case: inputs of its estimates}: a simulated flight in three ways, and the given flights."""
    flight = simulate(FLIGHT)
    known = exportable(flight.anchors)
    effects = EffectSet(tuple(known[name] for name in TEN))
    bag, file, onnx = (folder / name for name in ("flight.bag", "effects.yaml", "bias.onnx"))
    write_bag(flight, bag, force=True)
    effects.to_yaml(file)
    write_onnx(onnx, flight.anchors, effects)
    found = {
        "simulated": case(bag),
        "simulated, ten effects": case(bag, effects=file),
        "simulated, the same as bias.onnx": case(bag, model=onnx),
    }
    for path, survey in inputs.find_flights(args.flights, args.survey, absolute=True):
        found[path.name] = case(path, survey, args.effects, args.model)
    return found


def case(recording, survey=None, effects=None, model=None):
    """The paths of a case, absolute, as JSON holds them."""
    paths = {"recording": recording, "survey": survey, "effects": effects, "model": model}
    return {name: path and str(Path(path).absolute()) for name, path in paths.items()}


def made(folder, name, python, variables):
    """{name: array} of the estimates of all cases, by the command of a Python."""
    words = [*python, str(ESTIMATES), str(folder / "cases.json"), str(folder / name)]
    if subprocess.run(words, env=variables, check=False).returncode:
        raise InputError(f"arm64: {python[-1]} ended early; its message stands above.")
    with np.load(folder / name) as file:
        return dict(file)


def environment(paths):
    """The environment of a Python that imports from some folders."""
    found = {name: value for name, value in os.environ.items() if not name.startswith("OPENBLAS")}
    return {**found, "PYTHONPATH": os.pathsep.join(map(str, paths)), "OMP_NUM_THREADS": "1"}


# --- the emulated machine ---


def emulated(folder):
    """The command of the emulated Python."""
    root = folder / "root"
    return ["qemu-aarch64-static", "-L", str(root), str(root / "usr/bin/python3")]


def environment_of(folder):
    """The environment of the emulated Python, with a separate folder for compiled code."""
    compiled = folder / "numba"
    compiled.mkdir(mode=0o700, exist_ok=True)
    return {**environment([folder / "site", *SOURCES]), "NUMBA_CACHE_DIR": str(compiled)}


def install(folder):
    """Install the emulated Python and its packages where they are missing."""
    if not (folder / "root").exists():
        show("fetching Debian's arm64 Python")
        install_python(folder)
    if not (folder / "site").exists():
        show("fetching the aarch64 wheels")
        install_wheels(folder, version(folder).rpartition(".")[0])


def version(folder):
    """Version of the emulated Python, as "3.11.2"."""
    words = [*emulated(folder), "--version"]
    return subprocess.run(words, capture_output=True, text=True, check=True).stdout.split()[-1]


def install_python(folder):
    """Unpack Debian's Python and the libraries it needs, without installing a package here."""
    state = folder / "apt"
    for part in ("lists/partial", "archives/partial"):
        (state / part).mkdir(parents=True, exist_ok=True)
    write_text(state / "status", "")
    shutil.rmtree(folder / "part", ignore_errors=True)
    settings = {
        "APT::Architecture": "arm64",
        "APT::Architectures": "arm64",
        "APT::Install-Recommends": "false",
        "APT::Sandbox::User": "root",
        "Debug::NoLocking": "true",
        "Dir::State": state,
        "Dir::State::lists": state / "lists",
        "Dir::State::status": state / "status",
        "Dir::Cache": state,
        "Dir::Cache::archives": state / "archives",
    }
    options = [word for name, value in settings.items() for word in ("-o", f"{name}={value}")]
    apt = ["apt-get", "-q", *options]
    do([*apt, "update"], "the package sources of this machine cannot be read")
    fetch = [*apt, "-y", "--download-only", "install", *DEBIAN]
    do(fetch, "this machine's package sources have no arm64 Python; use a Debian machine")
    for archive in sorted((state / "archives").glob("*.deb")):
        do(
            ["dpkg-deb", "-x", str(archive), str(folder / "part")],
            f"{archive.name} cannot be unpacked",
        )
    (folder / "part").rename(folder / "root")  # only once it is whole


def install_wheels(folder, python):
    """Install the aarch64 wheels of the pinned versions. python : as "3.11"."""
    shutil.rmtree(folder / "part", ignore_errors=True)
    write_text(folder / "wheels.lock", pinned((ROOT / ".dev/requirements.lock").read_text()))
    platforms = [word for name in PLATFORMS for word in ("--platform", name)]
    words = [sys.executable, "-m", "pip", "install", "--quiet", "--target", str(folder / "part")]
    words += [*platforms, "--python-version", python, "--only-binary", ":all:", "--no-deps"]
    words += ["--require-hashes", "-r", str(folder / "wheels.lock")]
    do(words, "the wheels cannot be fetched")
    (folder / "part").rename(folder / "site")


def do(words, trouble):
    """Run a command. Raises InputError with `trouble`, the meaning of a failure, if it fails."""
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    if done.returncode:
        last = (done.stderr.strip() or done.stdout.strip()).rpartition("\n")[2]
        raise InputError(f"arm64: {trouble}: {last}")


def pinned(lock, names=WHEELS):
    """The lines of a lock file for some packages and for all that they need."""
    wanted, left = set(), list(names)
    while left:
        name = normal(left.pop())
        if name in wanted:
            continue
        wanted.add(name)
        needed = map(Requirement, metadata.requires(name) or ())
        left += [one.name for one in needed if not one.marker or one.marker.evaluate({"extra": ""})]
    blocks = re.split(r"(?m)^(?=\w)", lock)
    return "".join(block for block in blocks if normal(re.split(r"[\[=]", block)[0]) in wanted)


def normal(name):
    """The name of a package as PyPI compares it."""
    return re.sub(r"[-_.]+", "-", name).lower()


# --- the comparison ---


def compared(here, there):
    """A row for each array: its name, number of values, of differing ones, and the largest difference.

    Values are compared by their bits; two NaN are equal.
    """
    rows = []
    for name in dict.fromkeys([*here, *there]):
        one, other = here.get(name), there.get(name)
        row = {"name": name, "values": 0, "differing": 0, "largest": 0.0}
        if one is None or other is None or one.shape != other.shape or one.dtype != other.dtype:
            row |= {"differing": max(0 if x is None else x.size for x in (one, other)) or 1}
            row |= {"values": row["differing"], "largest": np.inf}
        else:
            row["values"] = one.size
            differs = ~same_bits(one, other)
            row["differing"] = int(differs.sum())
            if differs.any():
                away = np.abs(one[differs].astype(float) - other[differs].astype(float))
                row["largest"] = float(np.nan_to_num(away, nan=np.inf).max())
        rows.append(row)
    return rows


def same_bits(one, other):
    """Which values of two arrays of one type have the same bits, or are both NaN."""
    both_nan = np.isnan(one) & np.isnan(other) if one.dtype.kind == "f" else np.False_
    signs = np.signbit(one) == np.signbit(other) if one.dtype.kind == "f" else np.True_
    return both_nan | ((one == other) & signs)


def table(rows):
    """Lines of Markdown: each case, and each of its arrays that differs."""
    yield "| case | arrays | values | differing values | largest difference |"
    yield "|---|---:|---:|---:|---:|"
    for name in dict.fromkeys(row["name"].partition(": ")[0] for row in rows):
        some = [row for row in rows if row["name"].partition(": ")[0] == name]
        values, differing = (sum(row[key] for row in some) for key in ("values", "differing"))
        largest = max(row["largest"] for row in some)
        yield f"| {name} | {len(some)} | {values} | {differing} | {largest:.2g} |"
        for row in some:
            if row["differing"]:
                label = row["name"].partition(": ")[2]
                yield f"| ... {label} | | {row['values']} | {row['differing']} | {row['largest']:.2g} |"
