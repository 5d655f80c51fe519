# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Bring the workspace up to date: environment, message package, Python packages. What is up to date
is not touched.

Called by ./dev with a Python 3.10 - 3.12 of the system; uses nothing but its standard library. Each
step is remembered by a hash of what it depends on, in .venv/steps.json, so that doing nothing takes
milliseconds. Two calls at once wait for each other, if there is anything to do.
"""

import fcntl
import hashlib
import importlib.util
import json
import os
from pathlib import Path
import platform
import re
import shutil
import subprocess
import sys
import sysconfig
import time

ROOT = Path(__file__).resolve().parents[1]
VENV, BUILD, INSTALL, LOG = (ROOT / name for name in (".venv", "build", "install", "log"))
PYTHON = VENV / "bin" / "python"
STEPS = VENV / "steps.json"
# requirements.txt and what they need in turn, with hashes
LOCK = ROOT / ".dev" / "requirements.lock"
# empy has no wheel; of the rest nothing is run
AS_LOCKED = ("--only-binary", ":all:", "--no-binary", "empy", "--require-hashes", "-r")
MESSAGES = ["uwb_tdoa_msgs"]
PACKAGES = ["uwb_tdoa_bias", "uwb_tdoa_ekf", "uwb_tdoa_tools"]
VERSION = f"{sys.version_info.major}.{sys.version_info.minor}"
BASE_PYTHON = os.path.realpath(sys.executable)  # never the one of a virtual environment
# the user has sourced one; else ROS comes from wheels
OWN_ROS = os.environ.get("ROS_DISTRO") == "jazzy"
# What a ROS installation may lack: the name to import, and the one in requirements.txt.
MODULES = {
    name: name
    for name in "hypothesis joblib matplotlib numba onnx onnxruntime rosbags scipy tqdm".split()
}
MODULES |= {"jinja2": "Jinja2", "sklearn": "scikit-learn", "yaml": "PyYAML"}
# s of processor time: of a set-up, and of the demo with its compilation
SET_UP, DEMO = 100.0, 110.0
# s: the demo takes longer than LONGEST where a process gets 3 % of a core. Its nodes would then not
# find each other in time, so it does not begin. BUSY of a core is worth a word.
LONGEST, BUSY = 3600.0, 0.3
# s of processor time that show the share of a core, and at most s for them
PROBE, PATIENCE = 0.1, 10.0
# Jazzy is built for numpy 1.26, and a pytest plugin of its launch_testing breaks newer pytests.
LIMITS = ["numpy<2", "pytest<8"]


class Failure(Exception):
    """The set-up cannot go on.

    The message is one sentence that says what is missing and what to do.
    """

    code = 1


class TooSlow(Failure):
    """Other programs leave too little of the machine."""

    code = os.EX_TEMPFAIL  # 75: the same command works later


def main(command):
    compiled = command in ("build", "demo")
    new = read_steps().get("environment") != environment()
    if new:
        check_machine()
    check_speed(SET_UP * new + DEMO * (command == "demo"), may_wait=command != "demo")
    if is_ready(compiled):
        return
    with opened_lock() as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            say("waiting for another ./dev to finish its set-up")
            fcntl.flock(lock, fcntl.LOCK_EX)
        prepare(compiled)


def opened_lock():
    """The file that one set-up at a time locks."""
    try:
        LOG.mkdir(exist_ok=True)
        return open(LOG / "dev.lock", "w")
    except OSError as error:
        raise Failure(
            f"there is something to set up, and {error.filename} cannot be written "
            f"({error.strerror}); run ./dev build as the user who owns {ROOT}, or clone the "
            "repository into a folder of your own."
        ) from error


def is_ready(compiled):
    """Whether nothing is to be done. compiled : the nodes shall be, too."""
    done, sources = read_steps(), digests()
    wanted = {
        "environment": environment(),
        **sources,
        **({"compiled": sources["packages"]} if compiled else {}),
    }
    return (INSTALL / "setup.bash").exists() and wanted.items() <= done.items()


def prepare(compiled):
    done = read_steps()
    if done.get("environment") != environment():
        make_environment()
        done = {"environment": environment()}
        write_steps(done)
    elif not (INSTALL / "setup.bash").exists():
        done = {"environment": environment()}
    build(done, compiled)


def environment():
    """Digest of all that .venv depends on."""
    files = [
        ROOT / "requirements.txt",
        LOCK,
        *(ROOT / ".dev" / name for name in ("wheels.py", "paths.sh")),
    ]
    return digest(files, str(ROOT), BASE_PYTHON, VERSION, str(OWN_ROS))


def check_machine():
    """Say what is missing before anything is downloaded."""
    if not OWN_ROS and (sys.platform, platform.machine()) != ("linux", "x86_64"):
        raise Failure(
            f"ROS 2 from the Python package index needs Linux on x86_64, this is {sys.platform} on "
            f"{platform.machine()}; source a ROS 2 Jazzy installation."
        )
    if (
        OWN_ROS
        and subprocess.run(
            [BASE_PYTHON, "-c", "import rclpy"], stderr=subprocess.DEVNULL, cwd=ROOT
        ).returncode
        != 0
    ):
        raise Failure(
            f"ROS_DISTRO is jazzy, but {BASE_PYTHON} cannot import rclpy; source "
            "/opt/ros/jazzy/setup.bash in this "
            "shell, or unset ROS_DISTRO to use the wheels."
        )
    if importlib.util.find_spec("ensurepip") is None or importlib.util.find_spec("venv") is None:
        raise Failure(
            f"Python {VERSION} has no venv module; install it, e.g. sudo apt install "
            f"python{VERSION}-venv"
        )
    if not any(map(shutil.which, [os.environ.get("CXX") or "c++", "g++", "clang++"])):
        raise Failure(
            "no C++ compiler found, which the message package needs; install one, e.g. sudo "
            "apt install g++"
        )
    if not (Path(sysconfig.get_paths()["include"]) / "Python.h").exists():
        raise Failure(
            f"Python.h of Python {VERSION} is missing, which the message package needs; "
            f"install it, e.g. sudo apt install python{VERSION}-dev"
        )


def core_share():
    """Share of a core that a busy process gets."""
    began, used = time.monotonic(), time.process_time()
    while time.process_time() < used + PROBE and time.monotonic() < began + PATIENCE:
        pass
    return (time.process_time() - used) / (time.monotonic() - began)


def check_speed(work, may_wait):
    """Say how long `work` s of processor time take on a busy machine, before anything begins.

    may_wait : also begin what takes longer than LONGEST.
    """
    share = core_share() if work else 1.0
    text = (
        f"other programs leave {share:.1%} of a core to this one, so it takes up to "
        f"{work / share / 60.0:.0f} min; end them, or run this without nice"
    )
    if work / share > LONGEST and not may_wait:
        raise TooSlow(f"the machine is too slow: {text}.")
    if share < BUSY:
        say(f"the machine is busy: {text}")


def make_environment():
    old = [folder for folder in (VENV, BUILD, INSTALL) if folder.exists()]
    if old:
        run("remove what was made for another environment", "remove", ["rm", "-rf", *old])
    options = ["--system-site-packages"] if OWN_ROS else []
    run("make .venv", "venv", [BASE_PYTHON, "-m", "venv", *options, VENV])
    try:
        if OWN_ROS:
            missing = missing_requirements()
            install(
                f"install what ROS 2 Jazzy lacks ({len(missing)} packages)", [*missing, *LIMITS]
            )
        else:
            install(
                "install ROS 2 Jazzy and the Python packages", ["--no-compile", *AS_LOCKED, LOCK]
            )
    except Failure as failure:
        output = (LOG / "dev_pip.log").read_text("utf-8", "replace")
        if re.search(
            r"NewConnectionError|NameResolution|Timeout|ProxyError|from versions: none", output
        ):
            raise Failure(
                "pip reaches no package index that has these; check the network, or name a "
                "mirror: PIP_INDEX_URL=..."
            ) from failure
        raise
    if not OWN_ROS:
        run("repair the ROS wheels", "wheels", [PYTHON, ROOT / ".dev" / "wheels.py"])


def install(title, arguments):
    run(title, "pip", [PYTHON, "-m", "pip", "install", "--disable-pip-version-check", *arguments])


def missing_requirements():
    """The pins of those MODULES that the new environment cannot import."""
    code = (
        f"import importlib.util as u; print(*(n for m, n in {MODULES}.items() if u.find_spec(m) "
        "is None))"
    )
    names = subprocess.check_output([PYTHON, "-c", code], text=True, cwd=ROOT).split()
    pins = (ROOT / "requirements.txt").read_text("utf-8").splitlines()
    return [pin for pin in pins if pin.split("==")[0] in names]


def digests():
    """{step: digest of its sources}."""
    return {
        "messages": digest(
            [ROOT / "colcon.meta", ROOT / ".dev" / "tf2_msgs", ROOT / "src" / "uwb_tdoa_msgs"]
        ),
        "packages": digest([ROOT / "src" / name for name in PACKAGES]),
    }


def build(done, compiled):
    """Python packages first, which takes seconds: then the nodes can be compiled, for which they
    need no messages, beside the messages.
    """
    sources, running = digests(), []
    if done.get("packages") != sources["packages"]:
        for name in PACKAGES:  # setuptools would copy what is newer only, and keep what was deleted
            for copy in (
                BUILD / name / "build",
                *INSTALL.glob(f"lib/python3*/site-packages/{name}"),
            ):
                shutil.rmtree(copy, ignore_errors=True)
        finish(colcon(PACKAGES))
        done = {**done, "packages": sources["packages"]}
        write_steps(done)
    if (
        compiled and done.get("compiled") != sources["packages"]
    ):  # or the first start would; and several tests at once
        (site,) = INSTALL.glob("lib/python3*/site-packages")
        path = os.pathsep.join(filter(None, [str(site), os.environ.get("PYTHONPATH")]))
        running.append(
            start(
                "compile the nodes, which is done once and takes about a minute",
                "compile",
                [PYTHON, "-m", "uwb_tdoa_ekf.compile_nodes"],
                PYTHONPATH=path,
            )
        )
    if done.get("messages") != sources["messages"]:
        # the wheels lack tf2_msgs
        running.append(colcon(([] if OWN_ROS else ["tf2_msgs"]) + MESSAGES))
    finish(*running)
    write_steps({**done, **sources, **({"compiled": sources["packages"]} if compiled else {})})


def colcon(selected):
    """The step that builds some packages; it runs."""
    paths = [
        f"src/{name}" for name in selected if (ROOT / "src" / name).exists()
    ]  # of others colcon would ask that they are built
    options, variables = [], {}
    if not OWN_ROS:
        paths, options = (
            [*paths, ".dev/tf2_msgs"] if "tf2_msgs" in selected else paths,
            ["-G", "Ninja"],
        )
        variables = {"AMENT_PREFIX_PATH": str(VENV), "CMAKE_PREFIX_PATH": str(VENV)}
    return start(
        f"build {', '.join(selected)}",
        "build" if selected == PACKAGES else "build_messages",
        [
            PYTHON,
            "-m",
            "colcon",
            "build",
            "--merge-install",
            "--base-paths",
            *paths,
            "--packages-select",
            *selected,
        ]
        + ["--event-handlers", "console_direct+", "console_cohesion-", "console_stderr-"]
        + ["--cmake-args", *options, f"-DPython3_EXECUTABLE={PYTHON}"],
        PATH=f"{VENV / 'bin'}{os.pathsep}{os.environ['PATH']}",
        **variables,
    )


def digest(paths, *words):
    """Hash of the words and of every file under the paths: names and contents.

    Tests are not built. Compiled modules and hidden folders (.hypothesis, .pytest_cache) are
    written where programs run.
    """
    total = hashlib.sha256("\0".join(words).encode())
    for path in paths:
        files = (
            [path] if path.is_file() else sorted(file for file in path.rglob("*") if file.is_file())
        )
        for file in files:
            parts = file.relative_to(path).parts
            if not any(part in ("test", "__pycache__") or part[0] == "." for part in parts):
                total.update(f"\0{file.relative_to(ROOT)}\0".encode())
                total.update(file.read_bytes())
    return total.hexdigest()


def read_steps():
    try:
        return json.loads(STEPS.read_text("utf-8"))
    except (OSError, ValueError):
        return {}


def write_steps(steps):
    STEPS.write_text(json.dumps(steps, indent=2) + "\n", "utf-8")


def run(title, log_name, command, **variables):
    """Run one step."""
    finish(start(title, log_name, command, **variables))


def start(title, log_name, command, **variables):
    """A step that runs, with its output in log/dev_<log_name>.log."""
    say(f"{title} ...")
    log = LOG / f"dev_{log_name}.log"
    with open(log, "wb") as output:
        process = subprocess.Popen(
            list(map(str, command)),
            cwd=ROOT,
            env={**os.environ, **variables},
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=output,
        )
    return title, log, process, time.monotonic()


def finish(*steps):
    """Wait for steps that run, and say how far they are; the first that fails shows the end of its
    output, ends the others, and raises Failure.
    """
    running, live = list(steps), sys.stderr.isatty()
    said = time.monotonic()
    try:
        while running:
            time.sleep(0.1)
            for step in [step for step in running if step[2].poll() is not None]:
                running.remove(step)
                title, log, process, started = step
                if process.returncode != 0:
                    tail = "".join(
                        f"  | {line}\n"
                        for line in log.read_text("utf-8", "replace").splitlines()[-15:]
                    )
                    print(tail, end="", file=sys.stderr)
                    raise Failure(
                        f"the step '{title}' failed; all of its output is in "
                        f"{log.relative_to(ROOT)}."
                    )
                say(f"{title} ... {time.monotonic() - started:.0f} s")
            if running and time.monotonic() - said > (1.0 if live else 10.0):
                said = time.monotonic()
                say(
                    "; ".join(
                        f"{title} ... {said - began:.0f} s{share(log)}"
                        for title, log, _, began in running
                    ),
                    "\r" if live else "\n",
                )
    finally:
        for *_, process, _ in running:
            process.terminate()
            process.wait()


def share(log):
    """How much of a step is done, as far as its output tells: ", 40 %"."""
    text = log.read_text("utf-8", "replace")
    if log.name == "dev_pip.log":
        return (
            f", package {text.count('Collecting ')} of {LOCK.read_text('utf-8').count('==')}"
            if "Installing" not in text
            else ", unpacking"
        )
    if log.name == "dev_compile.log":  # it says more than a share
        return "".join(f", {told}" for told in re.findall("is done once: (.*)", text)[-1:])
    for done, total, percent in re.findall(r"\[(\d+)/(\d+)\]|\b(\d+) ?%", text)[-1:]:
        return f", {percent or round(100 * int(done) / int(total))} %"
    return ""


def say(line, end="\n"):
    clear = "\x1b[K" if sys.stderr.isatty() else ""  # what is left of a longer line
    print(f"[dev] {line}{clear}", end=end, file=sys.stderr, flush=True)


if __name__ == "__main__":
    try:
        main(*sys.argv[1:])
    except Failure as failure:
        print(f"dev: error: {failure}", file=sys.stderr)
        sys.exit(failure.code)
    except KeyboardInterrupt:
        sys.exit(130)
