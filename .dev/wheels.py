# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Three repairs of the ROS wheels in a virtual environment. Run by its Python.

1. Their CMake files name the paths of the machine they were built on: put ours in.
2. Their prefix has no local_setup.*: with one, install/setup.bash chains back to it in a clean
   shell.
3. Their bootstrap sets LD_LIBRARY_PATH in the Python of colcon that writes the setup. Then colcon
   leaves a `:` at its end, and the loader
   takes libraries of the present folder.
"""

from pathlib import Path
import re
import sys
import sysconfig

import numpy

PREFIX = Path(sys.prefix)
BUILD_PYTHON = r"/opt/python/cp3\d+-cp3\d+"
PATHS = {
    rf"{BUILD_PYTHON}/lib/python3\.\d+/site-packages/numpy/_core/include": numpy.get_include(),
    rf"{BUILD_PYTHON}/include/python3\.\d+": sysconfig.get_paths()["include"],
}
LOCAL_SETUP = f"""\
{(Path(__file__).parent / "paths.sh").read_text(encoding="utf-8")}
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


def repair_bootstrap():
    file = Path(sysconfig.get_paths()["purelib"]) / "ros_wheels_bootstrapper" / "__init__.py"
    old = "if not os.environ.get('_ROS_WHEELS_BOOTSTRAP_COMPLETE'):"
    text = file.read_text(encoding="utf-8")
    if text.count(old) != 1:
        raise SystemExit(f"{file} is another than it was: see repair 3 of .dev/wheels.py")
    new = old.replace(
        ":", " and not any(word.endswith('_local_setup_util_sh.py') for word in sys.orig_argv):"
    )
    file.write_text(text.replace(old, new), encoding="utf-8")


if __name__ == "__main__":
    repair_cmake_files()
    write_local_setup()
    repair_bootstrap()
