"""The two repairs without which the ROS wheels in a virtual environment build no message package. Run by its Python.

1. Their CMake files name the paths of the machine they were built on: put ours in.
2. Their prefix has no local_setup.*: with one, install/setup.bash chains back to it in a clean shell.
"""

import re
import sys
import sysconfig
from pathlib import Path

import numpy

PREFIX = Path(sys.prefix)
BUILD_PYTHON = r"/opt/python/cp3\d+-cp3\d+"
PATHS = {
    rf"{BUILD_PYTHON}/lib/python3\.\d+/site-packages/numpy/_core/include": numpy.get_include(),
    rf"{BUILD_PYTHON}/include/python3\.\d+": sysconfig.get_paths()["include"],
}
LOCAL_SETUP = f"""\
# Puts this virtual environment in front, as a ROS prefix and as the Python to use.
case ":$AMENT_PREFIX_PATH:" in *":{PREFIX}:"*) ;; *)
  export AMENT_PREFIX_PATH="{PREFIX}${{AMENT_PREFIX_PATH:+:$AMENT_PREFIX_PATH}}" ;;
esac
case ":$PATH:" in *":{PREFIX}/bin:"*) ;; *) export PATH="{PREFIX}/bin:$PATH" ;; esac
"""


def repair_cmake_files():
    for file in (PREFIX / "share").rglob("*.cmake"):
        old = file.read_text(encoding="utf-8")
        new = old
        for pattern, path in PATHS.items():
            new = re.sub(pattern, lambda _, path=path: path, new)
        if new != old:
            file.write_text(new, encoding="utf-8")


def write_local_setup():
    for shell in ("sh", "bash", "zsh"):
        (PREFIX / f"local_setup.{shell}").write_text(LOCAL_SETUP, encoding="utf-8")


if __name__ == "__main__":
    repair_cmake_files()
    write_local_setup()
