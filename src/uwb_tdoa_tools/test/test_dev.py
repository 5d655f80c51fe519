# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Output of ./dev without side effects, and its messages about missing programs.

No test here installs or builds.
"""

import fcntl
from importlib.util import module_from_spec, spec_from_file_location
import os
from pathlib import Path
import re
import shutil
import subprocess
import sys
import tempfile
import zipfile

import pytest

ROOT = Path(__file__).resolve().parents[3]
PYTHONS = [f"/usr/bin/python3.{minor}" for minor in (12, 11, 10)]
PROGRAMS = ("bash", "cat", "dirname", "readlink")
BASE_PYTHON = os.path.realpath(sys.executable)


@pytest.fixture
def workspace(tmp_path):
    """Return a fresh copy of the scripts, as after `git clone`."""
    shutil.copy(ROOT / "dev", tmp_path)
    shutil.copy(ROOT / "requirements.txt", tmp_path)
    shutil.copytree(ROOT / ".dev", tmp_path / ".dev")
    return tmp_path


@pytest.fixture
def machine(tmp_path):
    """Return a function that makes a minimal PATH. It takes name=target of more programs."""
    path = tmp_path / "bin"
    path.mkdir()

    def install(**programs):
        for name, target in {**{name: shutil.which(name) for name in PROGRAMS}, **programs}.items():
            (path / name).symlink_to(target)
        return {"PATH": str(path)}

    return install


def dev(folder, *arguments, **environment):
    plain = {"PATH": os.environ["PATH"], "HOME": os.environ.get("HOME", "/"), **environment}
    done = subprocess.run(
        [folder / "dev", *arguments], env=plain, capture_output=True, text=True, timeout=60
    )
    return done.returncode, done.stdout, done.stderr


def script(path, *lines):
    path.write_text("\n".join(("#!/usr/bin/env bash", *lines, "")))
    path.chmod(0o755)
    return path


@pytest.mark.parametrize("arguments", [(), ("help",), ("--help",)])
def test_usage_names_every_command(arguments):
    code, out, err = dev(ROOT, *arguments)
    assert (code, err) == (0, "")
    for word in ("demo", "test", "build", "run PKG EXE", "shell", "ros2 ARGS", "examples:"):
        assert word in out


def test_unknown_command(workspace):
    assert dev(workspace, "fly") == (
        2,
        "",
        "dev: error: unknown command 'fly'; './dev help' lists them.\n",
    )


def test_run_needs_package_and_executable(workspace):
    code, _, err = dev(workspace, "run", "uwb_tdoa_tools")
    assert code == 2
    assert err.startswith("dev: error: run needs a package and an executable")


def test_named_python_of_a_wrong_version(workspace):
    old = script(workspace / "python3.9", "exit 1")
    code, out, err = dev(workspace, "build", PYTHON=str(old))
    assert (code, out) == (1, "")
    assert err == (
        f"dev: error: PYTHON={old} is no Python 3.10, 3.11 or 3.12; name one of these, or "
        "unset PYTHON.\n"
    )


def test_no_python_of_a_right_version(workspace, machine):
    code, _, err = dev(workspace, "test", **machine())
    assert code == 1
    assert err.startswith("dev: error: no Python 3.10, 3.11 or 3.12 found; install one, ")
    assert len(err.splitlines()) == 1


def test_no_compiler(workspace, machine):
    code, _, err = dev(workspace, "demo", **machine(python3=BASE_PYTHON))
    assert (code, err) == (
        1,
        (
            "dev: error: no C++ compiler found, which the message package needs; install one, "
            "e.g. sudo apt install g++\n"
        ),
    )
    assert not (workspace / ".venv").exists()


def test_no_venv_module(workspace, machine):
    (workspace / "sitecustomize.py").write_text("import sys; sys.modules['ensurepip'] = None\n")
    code, _, err = dev(workspace, "demo", **machine(python3=BASE_PYTHON), PYTHONPATH=str(workspace))
    version = f"{sys.version_info.major}.{sys.version_info.minor}"
    assert (code, err) == (
        1,
        (
            f"dev: error: Python {version} has no venv module; install it, e.g. sudo apt install "
            f"python{version}-venv\n"
        ),
    )


def test_another_ros_distribution(workspace):
    assert dev(workspace, "build", ROS_DISTRO="humble") == (
        1,
        "",
        "dev: error: ROS humble is sourced, but this needs ROS 2 jazzy; source it, or none.\n",
    )


def test_a_jazzy_without_rclpy(workspace):
    code, _, err = dev(workspace, "build", ROS_DISTRO="jazzy", PYTHON=BASE_PYTHON)
    assert code == 1
    assert err.startswith("dev: error: ROS_DISTRO is jazzy, but ") and "cannot import rclpy" in err


@pytest.mark.slow
def test_what_is_not_what_was_locked_is_not_installed(workspace, machine):
    environment = machine(python3=BASE_PYTHON, **{"c++": script(workspace / "c++", "exit 1")})
    # replaces the locked wheel of the same name and version
    other = workspace / "other-1.0-py3-none-any.whl"
    with zipfile.ZipFile(other, "w") as wheel:
        wheel.writestr(
            "other-1.0.dist-info/METADATA", "Metadata-Version: 2.1\nName: other\nVersion: 1.0\n"
        )
        wheel.writestr(
            "other-1.0.dist-info/WHEEL",
            "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n",
        )
        wheel.writestr("other-1.0.dist-info/RECORD", "")
    (workspace / ".dev" / "requirements.lock").write_text(f"other==1.0 --hash=sha256:{64 * '0'}\n")
    code, _, err = dev(
        workspace, "build", PIP_NO_INDEX="1", PIP_FIND_LINKS=str(workspace), **environment
    )
    assert (
        code == 1 and "DO NOT MATCH THE HASHES" in (workspace / "log" / "dev_pip.log").read_text()
    )
    assert not (workspace / ".venv" / "steps.json").exists()


@pytest.mark.parametrize(
    ("asked", "lock"),
    [
        ("requirements.txt", ".dev/requirements.lock"),
        (".ci/requirements.txt", ".ci/requirements.lock"),
    ],
)
def test_all_that_is_installed_is_locked(asked, lock):
    entry = re.compile(r"^(\S+)==(\S+)((?: \\\n    --hash=sha256:[0-9a-f]{64})*)$", re.MULTILINE)
    locked = {
        (canonical(name), version): hashes
        for name, version, hashes in entry.findall((ROOT / lock).read_text())
    }
    wanted = [line.split("==") for line in (ROOT / asked).read_text().splitlines() if "==" in line]
    assert (
        all(locked.values())
        and {(canonical(name), version) for name, version in wanted} < locked.keys()
    )


def canonical(name):
    """Normalize the name of a distribution as PyPA specifies."""
    return re.sub(r"[-_.]+", "-", name).lower()


@pytest.mark.slow
def test_a_step_that_fails_shows_the_end_of_its_log(workspace, machine):
    compiler = script(workspace / "c++", "exit 1")
    environment = machine(python3=BASE_PYTHON, **{"c++": compiler})
    (workspace / ".dev" / "requirements.lock").write_text("no package is named like this\n")
    code, _, err = dev(workspace, "build", **environment)
    assert code == 1
    assert "  | ERROR: Invalid requirement" in err
    assert err.splitlines()[-1].endswith("all of its output is in log/dev_pip.log.")
    assert not (workspace / ".venv" / "steps.json").exists()


# --- what it says meanwhile ---


@pytest.fixture
def prepare(workspace):
    """Return the module .dev/prepare.py of a fresh copy, with a folder for its logs."""
    for name in ("colcon.meta", "src", "log"):
        (workspace / name).mkdir() if name != "colcon.meta" else shutil.copy(ROOT / name, workspace)
    spec = spec_from_file_location("prepare", workspace / ".dev" / "prepare.py")
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_where_nothing_is_to_be_done_nobody_waits_for_another(prepare, monkeypatch):
    prepare.VENV.mkdir()
    prepare.INSTALL.mkdir()
    (prepare.INSTALL / "setup.bash").touch()
    prepare.write_steps({"environment": prepare.environment(), **prepare.digests()})
    monkeypatch.setattr(prepare, "prepare", lambda compiled: pytest.fail("there was nothing to do"))
    with open(prepare.LOG / "dev.lock", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        prepare.main("run")
    with pytest.raises(
        BaseException, match="nothing to do"
    ):  # the demo also needs the nodes to be compiled
        prepare.main("demo")


@pytest.mark.parametrize(
    ("written", "builds"),
    [
        ("setup.py", True),
        ("uwb_tdoa_bias/new.py", True),
        ("uwb_tdoa_bias/__pycache__/new.pyc", False),
        ("test/test_new.py", False),
        (".hypothesis/constants/0b0ec", False),  # written by tests that run in this folder
        (".pytest_cache/v/cache/nodeids", False),
        ("uwb_tdoa_bias/.new.py.swp", False),
    ],
)
def test_only_sources_that_are_installed_start_a_build(prepare, written, builds):
    before = prepare.digests()
    path = prepare.ROOT / "src" / "uwb_tdoa_bias" / written
    path.parent.mkdir(parents=True)
    path.write_text("new")
    assert (prepare.digests() != before) == builds


@pytest.mark.parametrize(
    ("name", "output", "share"),
    [
        (
            "dev_compile.log",
            "compiling, which is done once: 40%, 20 s\ncompiling, which is done once: 52%, 25 s\n",
            ", 52 %",
        ),
        ("dev_build_messages.log", "[0.1s] Starting\n[12/48] Building CXX object a.o\n", ", 25 %"),
        ("dev_pip.log", "Collecting numpy\nCollecting scipy\n", ", package 2 of 3"),
        (
            "dev_pip.log",
            "Collecting numpy\nInstalling collected packages: numpy, scipy\n",
            ", unpacking",
        ),
        ("dev_venv.log", "", ""),
    ],
)
def test_how_far_a_step_is(prepare, name, output, share):
    prepare.LOCK.write_text("a==1\nb==2\nc==3\n")
    (prepare.LOG / name).write_text(output)
    assert prepare.share(prepare.LOG / name) == share


def test_a_step_that_fails_ends_those_beside_it(prepare):
    long = prepare.start("wait", "wait", ["sleep", "600"])
    with pytest.raises(
        prepare.Failure, match="the step 'fail' failed; all of its output is in log/dev_fail.log."
    ):
        prepare.finish(long, prepare.start("fail", "fail", ["false"]))
    assert long[2].returncode is not None


def test_another_user_than_the_one_who_built_is_told_what_to_do(workspace):
    """Root can write to any file, so root runs the command as the user `nobody`."""
    folder = Path(tempfile.mkdtemp(prefix="checkout of häns "))
    try:
        for name in ("dev", "requirements.txt", ".dev"):
            shutil.move(workspace / name, folder / name)
        for path in (folder, *folder.rglob("*")):
            path.chmod(0o555 if path.is_dir() or path.name == "dev" else 0o444)
        python = next(filter(None, map(shutil.which, PYTHONS)), None)
        if python is None:
            pytest.skip("no Python of the system that every user may run")
        done = subprocess.run(
            [folder / "dev", "run", "uwb_tdoa_tools", "check"],
            env={"PATH": "/usr/bin:/bin", "PYTHON": python, "PYTHONDONTWRITEBYTECODE": "1"},
            user="nobody" if os.geteuid() == 0 else None,
            capture_output=True,
            text=True,
            timeout=60,
        )
    finally:
        for path in (folder, *folder.rglob("*")):
            path.chmod(0o755)
        shutil.rmtree(folder)
    assert done.returncode == 1 and "Traceback" not in done.stderr
    (line,) = done.stderr.splitlines()
    assert line.startswith("dev: error: there is something to set up, and ")
    assert "Permission denied" in line and f"as the user who owns {folder}" in line
