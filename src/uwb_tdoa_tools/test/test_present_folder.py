# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""A folder of recordings may contain any files.

Programs started there must not load a library, module, program or setting from it.
"""

import os
from pathlib import Path
import shutil
import subprocess
import sys

import pytest

from uwb_tdoa_bias.common.executable import PATHS

ROOT = Path(__file__).resolve().parents[3]
CLEAN = {"HOME": os.environ.get("HOME", "/"), "PATH": "/usr/bin:/bin"}
SHELLS = [shell for shell in ("bash", "zsh") if shutil.which(shell)]
START = (
    "import sys; from uwb_tdoa_bias.common.executable import executable; "
    "sys.exit(executable('{}')())"
)
PROFILES = """<?xml version="1.0" encoding="UTF-8" ?>
<dds xmlns="http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles">
  <log><use_default>FALSE</use_default><consumer><class>FileConsumer</class>
    <property><name>filename</name><value>{file}</value></property><property><name>append</name><value>FALSE</value></property>
  </consumer></log>
  <profiles>{profile}{profile}</profiles>
</dds>"""
# twice: the duplicate name is written to the log
PROFILE = '<participant profile_name="touch x"><rtps></rtps></participant>'
STARTS_ROS = (
    "import rclpy\ndef main():\n    rclpy.init()\n    rclpy.create_node('victim')\n    "
    "rclpy.shutdown()\n    return 0\n"
)

built = pytest.mark.skipif(
    not (ROOT / ".venv" / "steps.json").exists(), reason="needs a workspace that ./dev has built"
)


@pytest.fixture
def libraries(tmp_path):
    """Return a folder with invalid files, named like the libraries of Python and of ls.

    A program that loads such a file ends at once.
    """
    for program in (os.path.realpath(sys.executable), shutil.which("ls")):
        for line in subprocess.run(
            ["ldd", program], capture_output=True, text=True
        ).stdout.splitlines():
            if " => /" in line and "libc.so" not in line:
                (tmp_path / line.split()[0]).write_text("no library")
    assert any(tmp_path.iterdir())
    return tmp_path


def run(command, folder, **variables):
    return subprocess.run(
        command, cwd=folder, env={**CLEAN, **variables}, capture_output=True, text=True, timeout=300
    )


def variables_of(text):
    """Return {variable: value} of the output of `env`."""
    return dict(line.split("=", 1) for line in text.splitlines() if "=" in line)


def empty_entries(variables):
    return [
        f"{name}={variables[name]}"
        for name in PATHS
        if name in variables and {"", "."} & {*variables[name].split(":")}
    ]


def test_libraries_there_would_be_loaded_by_an_empty_entry(libraries):
    assert run(["ls"], libraries, LD_LIBRARY_PATH="/nowhere:").returncode != 0  # the attack


@built
@pytest.mark.parametrize("shell", SHELLS)
@pytest.mark.parametrize("given", ["unset", "empty", "entries"])
def test_no_entry_is_empty_after_the_setup_was_sourced(libraries, shell, given):
    own = {"unset": "unset {}", "empty": "export {}=", "entries": "export {0}=:/a::/b:.:${0}:.:.:"}[
        given
    ]
    lines = [own.format(name) for name in PATHS if name != "PATH" or given == "entries"]
    done = run(
        [shell, "-c", "; ".join([*lines, f"source {ROOT}/install/setup.{shell}", "env", "ls >&2"])],
        libraries,
    )
    after = variables_of(done.stdout)
    assert done.returncode == 0, done.stderr
    assert empty_entries(after) == [] and after["SKIP_DEFAULT_XML_FILE"] == "1"
    assert f"{ROOT}/install/lib" in after["LD_LIBRARY_PATH"].split(":")
    if given == "entries":
        assert all({"/a", "/b"} <= {*after[name].split(":")} for name in PATHS)


@built
@pytest.mark.parametrize(
    "words", [["shell", "-c", "env"], ["run", "uwb_tdoa_tools", "check", "--help"]]
)
def test_no_entry_is_empty_after_dev(libraries, words):
    given = {
        name: f":{'' if name != 'PATH' else CLEAN['PATH']}:"
        for name in PATHS
        if name != "LD_LIBRARY_PATH"
    }  # bash would load libraries from this path
    done = run([ROOT / "dev", *words], libraries, **given)
    assert (
        done.returncode == 0
        and "usage: check" in done.stdout
        or empty_entries(variables_of(done.stdout)) == []
    ), done.stderr


@pytest.mark.parametrize("empty", ["", "."])
def test_no_entry_is_empty_after_an_executable_has_begun(tmp_path, empty):
    (tmp_path / "numpy.py").write_text("print('numpy.py of the present folder')")
    (tmp_path / "tells.py").write_text(
        "import os, subprocess\ndef main(): import numpy; subprocess.run('env')"
    )
    given = {name: f":{os.environ.get(name, '')}::" for name in PATHS} | {
        "PYTHONPATH": ":".join([empty, *sys.path[1:], empty, empty])
    }
    (tmp_path / "modules").mkdir()
    (tmp_path / "tells.py").rename(tmp_path / "modules" / "tells.py")
    (tmp_path / "modules" / "start.py").write_text(START.format("tells"))
    done = run([sys.executable, tmp_path / "modules" / "start.py"], tmp_path, **given)
    after = variables_of(done.stdout)
    assert (
        done.returncode == 0
        and empty_entries(after) == []
        and after["SKIP_DEFAULT_XML_FILE"] == "1"
    ), done.stderr
    assert "of the present folder" not in done.stdout


@pytest.mark.parametrize("protected", [False, True])
def test_the_middleware_obeys_no_profiles_there(tmp_path, protected):
    pytest.importorskip("rclpy")
    victim = tmp_path / "bashrc"
    victim.write_text("precious\n")
    (tmp_path / "DEFAULT_FASTRTPS_PROFILES.xml").write_text(
        PROFILES.format(file=victim, profile=PROFILE)
    )
    (tmp_path / "starts_ros.py").write_text(STARTS_ROS)
    code = START.format("starts_ros") if protected else "import starts_ros; starts_ros.main()"
    (tmp_path / "start.py").write_text(code)
    kept = {name: value for name, value in os.environ.items() if name != "SKIP_DEFAULT_XML_FILE"}
    kept["PYTHONPATH"] = os.pathsep.join(filter(None, sys.path))
    kept.pop("PYTHONSAFEPATH", None)  # a user's shell does not set it
    done = subprocess.run(
        [sys.executable, "start.py"],
        cwd=tmp_path,
        env=kept,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    # without protection, the attack succeeds
    assert (victim.read_text() == "precious\n") == protected


@built
def test_the_start_file_of_the_user_brings_no_empty_entry(tmp_path):
    (tmp_path / ".bashrc").write_text(
        "".join(f"export {name}=:${name}:/mine:.\n" for name in PATHS)
    )
    done = run([ROOT / "dev", "shell", "-i", "-c", "env"], tmp_path, HOME=str(tmp_path))
    after = variables_of(done.stdout)
    assert after["PKG_CONFIG_PATH"] == "/mine" and empty_entries(after) == [], done.stderr


def test_the_entry_point_of_the_container_leaves_no_empty_entry(tmp_path):
    """The setup of ROS leaves one, like colcon. The image is not built here."""
    changed = next(
        line
        for line in (ROOT / "Containerfile").read_text().splitlines()
        if line.startswith("RUN sed")
    )
    (tmp_path / "setup.bash").write_text(
        "export LD_LIBRARY_PATH=/opt/ros/lib: PYTHONPATH=:/opt/ros\n"
    )
    (tmp_path / "ros_entrypoint.sh").write_text(
        f'#!/bin/bash\nset -e\nsource "{tmp_path}/setup.bash" --\nexec "$@"\n'
    )
    words = changed.removeprefix("RUN ").replace(
        "/ros_entrypoint.sh", str(tmp_path / "ros_entrypoint.sh")
    )
    words = words.replace("/opt/uwb_tdoa/install/setup.bash", str(tmp_path / "setup.bash")).replace(
        "/opt/uwb_tdoa", str(ROOT)
    )
    subprocess.run(["bash", "-c", words], check=True)
    done = run(["bash", tmp_path / "ros_entrypoint.sh", "env"], tmp_path)
    after = variables_of(done.stdout)
    assert after["LD_LIBRARY_PATH"] == "/opt/ros/lib" and after["PYTHONPATH"] == "/opt/ros", (
        done.stderr
    )
    assert after["SKIP_DEFAULT_XML_FILE"] == "1" and empty_entries(after) == []


@pytest.mark.slow
@built
def test_a_study_takes_no_module_there(tmp_path):
    for name in ("studies", "numpy", "matplotlib", "argparse", "runpy", "uwb_tdoa_tools"):
        (tmp_path / f"{name}.py").write_text(
            f"open('{tmp_path}/ran', 'w').close(); raise SystemExit('{name}.py has run')"
        )
    done = run([ROOT / "dev", "study", "--help"], tmp_path, PYTHONPATH=":")
    assert done.returncode == 0 and done.stdout.startswith("usage: study"), done.stderr
    assert not (tmp_path / "ran").exists()


@pytest.mark.slow
@built
@pytest.mark.skipif(not shutil.which("cc") and not shutil.which("gcc"), reason="needs a compiler")
def test_a_library_beside_a_recording_is_not_run_by_check(tmp_path):
    (tmp_path / "evil.c").write_text(
        "#include <stdio.h>\n"
        f"__attribute__((constructor)) static void run(void) {{ FILE *file = "
        f'fopen("{tmp_path}/ran", "w"); if (file) fclose(file); }}\n'
    )
    for name in ("libpython3.11.so.1.0", "libselinux.so.1", "libgcc_s.so.1", "libstdc++.so.6"):
        compiler = shutil.which("cc") or shutil.which("gcc")
        subprocess.run(
            [compiler, "-shared", "-fPIC", "evil.c", "-o", name, f"-Wl,-soname,{name}"],
            cwd=tmp_path,
            check=True,
        )
    (tmp_path / "f.csv").write_text("t_tdoa,idA,idB,tdoa_meas\n")
    run([ROOT / "dev", "run", "uwb_tdoa_tools", "check", "f.csv"], tmp_path)
    run(["bash", "-c", f"source {ROOT}/install/setup.bash; ls; check f.csv"], tmp_path)
    assert not (tmp_path / "ran").exists()
