# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Messages of ./dev about what is missing, and what starts a build. No test installs or builds."""

from importlib.util import module_from_spec, spec_from_file_location
import os
import shutil
import sys
import zipfile

from documented import ROOT
from programs import run
import pytest

BASE_PYTHON = os.path.realpath(sys.executable)
MISSING = [  # (command, environment, message)
    ("fly", {}, "unknown command 'fly'; './dev help' lists them."),
    ("run uwb_tdoa_tools", {}, "run needs a package and an executable"),
    ("build", {"PYTHON": "/bin/false"}, "PYTHON=/bin/false is no Python 3.10, 3.11 or 3.12; name"),
    ("test", {"PATH": "bin"}, "no Python 3.10, 3.11 or 3.12 found; install one, "),
    ("demo", {"PATH": "bin", "PYTHON": BASE_PYTHON}, "no C++ compiler found, which the message"),
    ("build", {"ROS_DISTRO": "humble"}, "ROS humble is sourced, but this needs ROS 2 jazzy; "),
    ("build", {"ROS_DISTRO": "jazzy", "PYTHON": BASE_PYTHON}, "ROS_DISTRO is jazzy, but "),
]


@pytest.fixture
def workspace(tmp_path):
    """Return a fresh copy of the scripts, as after `git clone`, and a `bin` with few programs."""
    for name in ("dev", "requirements.txt", "colcon.meta"):
        shutil.copy(ROOT / name, tmp_path)
    shutil.copytree(ROOT / ".dev", tmp_path / ".dev")
    for name in ("bin", "src", "log"):
        (tmp_path / name).mkdir()
    for name in ("bash", "cat", "dirname", "readlink"):
        (tmp_path / "bin" / name).symlink_to(shutil.which(name))
    return tmp_path


def dev(folder, words, **environment):
    plain = {"PATH": os.environ["PATH"], "HOME": os.environ.get("HOME", "/"), **environment}
    if plain["PATH"] == "bin":  # a relative entry is left out
        plain["PATH"] = str(folder / "bin")
    done = run(folder / "dev", *words.split(), cwd=folder, env=plain)
    return done.returncode, done.stdout, done.stderr


@pytest.mark.parametrize("words", ["", "help", "--help"])
def test_usage_names_every_command(words):
    code, out, err = dev(ROOT, words)
    assert (code, err) == (0, "") and "  ros2 ARGS " in out and "\nexamples:" in out


@pytest.mark.parametrize("words, environment, message", MISSING)
def test_what_is_missing_is_one_sentence(workspace, words, environment, message):
    code, out, err = dev(workspace, words, **environment)
    assert code in (1, 2) and out == "" and len(err.splitlines()) == 1
    assert err.startswith(f"dev: error: {message}") and not (workspace / ".venv").exists()


@pytest.mark.slow
@pytest.mark.parametrize("lock", [f"other==1.0 --hash=sha256:{64 * '0'}", "no package is so named"])
def test_what_is_not_as_it_was_locked_is_not_installed(workspace, lock):
    """Another wheel has the name and version of the locked one; or the lock cannot be read."""
    parts = {
        "METADATA": "Metadata-Version: 2.1\nName: other\nVersion: 1.0\n",
        "WHEEL": "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n",
        "RECORD": "",
    }
    with zipfile.ZipFile(workspace / "other-1.0-py3-none-any.whl", "w") as wheel:
        for name, text in parts.items():
            wheel.writestr(f"other-1.0.dist-info/{name}", text)
    (workspace / "bin" / "c++").symlink_to("/bin/false")
    (workspace / ".dev" / "requirements.lock").write_text(f"{lock}\n")
    local = {"PIP_NO_INDEX": "1", "PIP_FIND_LINKS": str(workspace)}
    code, _, err = dev(workspace, "build", PATH="bin", PYTHON=BASE_PYTHON, **local)
    log = (workspace / "log" / "dev_pip.log").read_text()
    assert code == 1 and ("DO NOT MATCH THE HASHES" in log or "Invalid requirement" in log)
    assert err.splitlines()[-1].endswith("all of its output is in log/dev_pip.log.")
    assert not (workspace / ".venv" / "steps.json").exists()


@pytest.fixture
def prepare(workspace):
    """Return the module .dev/prepare.py of a fresh copy."""
    spec = spec_from_file_location("prepare", workspace / ".dev" / "prepare.py")
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize(
    ("written", "builds"),
    [
        ("setup.py", True),
        ("uwb_tdoa_bias/new.py", True),
        ("uwb_tdoa_bias/__pycache__/new.pyc", False),
        ("test/test_new.py", False),
        (".hypothesis/constants/0b0ec", False),  # written by tests that run in this folder
        ("uwb_tdoa_bias/.new.py.swp", False),
    ],
)
def test_only_sources_that_are_installed_start_a_build(prepare, written, builds):
    before = prepare.digests()
    path = prepare.ROOT / "src" / "uwb_tdoa_bias" / written
    path.parent.mkdir(parents=True)
    path.write_text("new")
    assert (prepare.digests() != before) == builds


def test_a_step_that_fails_ends_those_beside_it(prepare):
    long = prepare.start("wait", "wait", ["sleep", "600"])
    with pytest.raises(prepare.Failure, match="the step 'fail' failed; all of its output"):
        prepare.finish(long, prepare.start("fail", "fail", ["false"]))
    assert long[2].returncode is not None


def test_a_busy_machine_is_named_before_anything_begins(prepare, monkeypatch, capsys):
    """The demo takes 110 s of processor time: 18 minutes of a tenth of a core."""
    assert 0.0 < prepare.core_share() < 1.1
    for share, said in ((1.0, ""), (0.1, "[dev] the machine is busy: other programs leave 10.0% ")):
        monkeypatch.setattr(prepare, "core_share", lambda share=share: share)
        prepare.check_speed(prepare.DEMO, may_wait=False)
        err = capsys.readouterr().err
        assert err.startswith(said) and ("takes up to 18 min" in err) == bool(said)


def test_the_demo_does_not_begin_if_it_would_take_hours(prepare, monkeypatch):
    """On a fresh copy the set-up counts, too: 210 s of processor time in all."""
    monkeypatch.setattr(prepare, "core_share", lambda: 0.02)
    monkeypatch.setattr(prepare, "check_machine", lambda: None)
    with pytest.raises(prepare.TooSlow, match="machine is too slow: .* up to 175 min; end") as slow:
        prepare.main("demo")
    assert slow.value.code == 75 and not prepare.VENV.exists()
    prepare.check_speed(prepare.SET_UP, may_wait=True)  # of ./dev build, which nothing hurries


def test_a_compilation_says_how_long_it_takes_and_not_the_share_of_a_core(prepare):
    log = prepare.LOG / "dev_compile.log"
    told = "40%, 200 s, about 10 min left; the machine is busy and gives this 8% of a core"
    log.write_text(f"compiling, which is done once: {told}\n")
    assert prepare.share(log) == f", {told}"
