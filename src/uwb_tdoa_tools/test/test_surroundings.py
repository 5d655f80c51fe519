# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Where programs start: folders with hostile files, no POSIX modules, a home that is read-only.

A folder of recordings may contain any files. Programs started there must not load a library,
module, program or setting from it.
"""

import os
import shutil
import sys

from documented import ROOT
import programs
import pytest
from test_layout import ROS, modules

from uwb_tdoa_bias.common.executable import PATHS, leave_present_folder_out
from uwb_tdoa_tools.bags.bag import write_bag
from uwb_tdoa_tools.simulation import SimulationConfig, simulate

CLEAN = {"HOME": os.environ.get("HOME", "/"), "PATH": "/usr/bin:/bin"}
SHELLS = [shell for shell in ("bash", "zsh") if shutil.which(shell)]
NOWHERE = "/proc/nowhere"  # even root cannot write there
# Modules that are missing on Windows or macOS. They are hidden before any import.
HIDE = """
import os, signal, sys
for name in "fcntl grp pwd pty resource syslog termios tty".split():
    sys.modules[name] = None
for name in "O_DIRECTORY O_NOFOLLOW O_PATH fchdir getuid killpg sched_getaffinity".split():
    vars(os).pop(name, None)
for name in "ITIMER_REAL SIGALRM SIGKILL setitimer".split():
    vars(signal).pop(name, None)
"""
START = """
import sys
from uwb_tdoa_bias.common.executable import executable, node_executable
name, *words = sys.argv[1:]
sys.exit((node_executable if name.endswith("_node") else executable)(name)(words))
"""
# twice: the duplicate name is written to the log
PROFILE = '<participant profile_name="touch x"><rtps></rtps></participant>'
PROFILES = f"""<?xml version="1.0" encoding="UTF-8" ?>
<dds xmlns="http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles">
  <log><use_default>FALSE</use_default><consumer><class>FileConsumer</class>
    <property><name>filename</name><value>victim</value></property><property><name>append</name><value>FALSE</value></property>
  </consumer></log>
  <profiles>{PROFILE}{PROFILE}</profiles>
</dds>"""
STARTS_ROS = """
import os, rclpy
def main(words):
    rclpy.init()
    rclpy.create_node("victim")
    rclpy.shutdown()
    for name, value in os.environ.items():
        print(f"{name}={value}")
    return 0
"""

built = pytest.mark.skipif(
    not (ROOT / ".venv" / "steps.json").exists(), reason="needs a workspace that ./dev has built"
)


def run(*command, folder, **variables):
    return programs.run(*command, cwd=folder, env=variables, timeout=300)


def relative_entries(text):
    """Return the variables in the output of `env` that have an entry below the present folder."""
    found = dict(line.split("=", 1) for line in text.splitlines() if "=" in line)
    return [
        name
        for name in PATHS
        if not all(entry.startswith("/") for entry in found.get(name, "/").split(":"))
    ]


@pytest.fixture
def hostile(tmp_path):
    """Return a folder with files that are no libraries or modules, but have their names."""
    for program in (os.path.realpath(sys.executable), shutil.which("ls")):
        for line in run("ldd", program, folder=tmp_path, **CLEAN).stdout.splitlines():
            if " => /" in line and "libc.so" not in line:
                (tmp_path / line.split()[0]).write_text("no library")
    for name in ("studies", "numpy", "matplotlib", "argparse", "uwb_tdoa_tools"):
        (tmp_path / f"{name}.py").write_text(f"raise SystemExit('{name}.py has run')")
    # the attack
    assert run("ls", folder=tmp_path, **{**CLEAN, "LD_LIBRARY_PATH": "/nowhere:"}).returncode
    return tmp_path


@pytest.mark.parametrize("shell", sorted({"sh", *SHELLS}))
def test_paths_keep_the_entries_that_begin_at_the_root(tmp_path, shell):
    entries = ["", ".", "./", ".//", "./lib", "lib", "../x", "/a b", "", "/usr/bin", "/c*", "."]
    lines = [f"export {name}='{':'.join(entries)}'" for name in PATHS]
    lines += ["export COLCON_PREFIX_PATH=.:./", "unset CMAKE_PREFIX_PATH"]
    lines += [f". {ROOT}/.dev/paths.sh", "/usr/bin/env"]
    done = run(shell, "-c", "; ".join(lines), folder=tmp_path, **CLEAN)
    found = dict(line.split("=", 1) for line in done.stdout.splitlines())
    kept = {name: found.get(name) for name in PATHS}
    gone = dict.fromkeys(("COLCON_PREFIX_PATH", "CMAKE_PREFIX_PATH"))
    assert kept == dict.fromkeys(PATHS, "/a b:/usr/bin:/c*") | gone, done.stderr


def test_an_executable_keeps_the_entries_that_begin_at_the_root(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in PATHS:
        monkeypatch.setenv(name, ":./:.//:lib:/a:../x:/b:.")
    monkeypatch.delenv("CMAKE_PREFIX_PATH")
    # as Python makes of PYTHONPATH when it starts
    below = [str(tmp_path), str(tmp_path / "lib"), str(tmp_path.parent / "x")]
    monkeypatch.setattr(sys, "path", [*below, "/a", "/b", "/usr/lib/python"])
    leave_present_folder_out()
    assert sys.path == ["/a", "/b", "/usr/lib/python"]
    kept = {name: os.environ.get(name) for name in PATHS}
    assert kept == dict.fromkeys(PATHS, "/a:/b") | {"CMAKE_PREFIX_PATH": None}


@built
@pytest.mark.parametrize("shell", SHELLS)
@pytest.mark.parametrize(
    "given", ["unset {}", "export {}=", "export {0}=:/a::/b:.:${0}:./:.//:lib:../x:"]
)
def test_no_entry_is_empty_after_the_setup_was_sourced(hostile, shell, given):
    lines = [given.format(name) for name in PATHS if name != "PATH" or "/a" in given]
    lines += [f"source {ROOT}/install/setup.{shell}", "env", "ls >&2"]
    done = run(shell, "-c", "; ".join(lines), folder=hostile, **CLEAN)
    assert done.returncode == 0 and relative_entries(done.stdout) == [], done.stderr
    assert "SKIP_DEFAULT_XML_FILE=1" in done.stdout and f"{ROOT}/install/lib" in done.stdout


@built
@pytest.mark.parametrize(
    "words", ["shell -c env", "run uwb_tdoa_tools check --help", "study --help", "shell -i -c env"]
)
def test_no_entry_is_empty_after_dev(hostile, words):
    """Also where the start file of the user adds some."""
    (hostile / ".bashrc").write_text(
        "".join(f"export {one}=:${one}:/mine:./:lib\n" for one in PATHS)
    )
    given = {name: f":{CLEAN['PATH'] if name == 'PATH' else ''}:" for name in PATHS}
    given.pop("LD_LIBRARY_PATH")  # bash would load libraries from this path
    home = {"HOME": str(hostile)} if "-i" in words else {}
    done = run(ROOT / "dev", *words.split(), folder=hostile, **{**CLEAN, **given, **home})
    assert done.returncode == 0 and relative_entries(done.stdout) == [], done.stderr
    assert "has run" not in done.stdout + done.stderr


@pytest.mark.parametrize("protected", [False, True])
def test_an_executable_takes_no_module_and_no_profile_there(tmp_path, protected):
    """Without protection, the attack of the profile succeeds: the middleware empties the file."""
    pytest.importorskip("rclpy")
    (tmp_path / "victim").write_text("precious\n")
    (tmp_path / "DEFAULT_FASTRTPS_PROFILES.xml").write_text(PROFILES)
    (tmp_path / "modules").mkdir()
    (tmp_path / "modules" / "starts_ros.py").write_text(STARTS_ROS)
    paths = [str(tmp_path / "modules"), *filter(None, sys.path)]
    if protected:
        (tmp_path / "numpy.py").write_text("print('numpy.py of the present folder')")
        paths = ["", *paths, ".", ""]
    kept = {name: value for name, value in os.environ.items() if name != "SKIP_DEFAULT_XML_FILE"}
    kept.pop("PYTHONSAFEPATH", None)  # a user's shell does not set it
    code = START if protected else "import starts_ros; starts_ros.main([])"
    (tmp_path / "modules" / "start.py").write_text(code)
    command = (sys.executable, tmp_path / "modules" / "start.py", "starts_ros")
    done = run(*command, folder=tmp_path, **{**kept, "PYTHONPATH": ":".join(paths)})
    assert done.returncode == 0 and "of the present folder" not in done.stdout, done.stderr
    assert ((tmp_path / "victim").read_text() == "precious\n") == protected
    assert not protected or relative_entries(done.stdout) == []


@pytest.mark.slow
@pytest.mark.parametrize("homeless", [False, True])
def test_a_command_runs_without_posix_or_without_a_home(tmp_path, homeless):
    """With the usual cache of numba: compilation takes minutes."""
    settings = {"duration": 8.0, "imu_rate": 100.0, "truth_rate": 50.0, "start_in_air": True}
    write_bag(simulate(SimulationConfig(**settings)), tmp_path / "short.bag")
    words = ["uwb_tdoa_tools.commands.localize", "short.bag", "--jobs", "1", "--out", "out"]
    cache = os.environ.get("NUMBA_CACHE_DIR") or os.path.expanduser("~/.cache/uwb_tdoa")
    nowhere = {"HOME": NOWHERE, "XDG_CACHE_HOME": NOWHERE, "NUMBA_CACHE_DIR": cache}
    variables = {**os.environ, **(nowhere if homeless else {})}
    code = START if homeless else HIDE + START
    done = run(sys.executable, "-c", code, *words, folder=tmp_path, **variables)
    assert done.returncode in (0, 1) and "Traceback" not in done.stderr, done.stderr
    assert list((tmp_path / "out").glob("*.png"))


@pytest.mark.slow
def test_all_that_needs_no_ros_is_imported_without_posix(tmp_path):
    names = [name for name in modules() if name not in ROS]
    code = f"{HIDE}\nimport importlib\nfor name in {names}: importlib.import_module(name)"
    done = run(sys.executable, "-c", code, folder=tmp_path, **os.environ)
    assert (done.returncode, done.stdout) == (0, ""), done.stderr


def test_a_node_says_where_its_log_may_go(tmp_path):
    pytest.importorskip("rclpy")
    kept = {name: value for name, value in os.environ.items() if not name.startswith("ROS_LOG")}
    variables = {**kept, "HOME": NOWHERE, "ROS_HOME": NOWHERE}
    command = (sys.executable, "-c", START, "uwb_tdoa_bias.anchors_node")
    done = run(*command, folder=tmp_path, **variables)
    assert done.returncode == 2 and "Traceback" not in done.stderr, done.stderr
    last = done.stderr.splitlines()[-1]
    assert "log directory" in last and last.endswith("export ROS_LOG_DIR=/tmp/ros-log")
