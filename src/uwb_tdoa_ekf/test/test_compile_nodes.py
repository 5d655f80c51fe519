"""What compile_nodes leaves to be compiled when the nodes start: nothing."""

import os
import subprocess
import sys

import pytest

pytest.importorskip("rclpy")
pytest.importorskip("uwb_tdoa_msgs.msg")

from rig import make_rig  # noqa: E402, F401


@pytest.mark.slow
def test_after_it_no_node_compiles_anything(make_rig, monkeypatch):
    ended = subprocess.run([sys.executable, "-m", "uwb_tdoa_ekf.compile_nodes"], capture_output=True, text=True, timeout=300.0)
    assert ended.returncode == 0 and ended.stdout.startswith("both nodes are compiled; ")
    monkeypatch.setitem(os.environ, "NUMBA_DEBUG_CACHE", "1")
    rig = make_rig()
    processes = rig.start("bias_node", "ekf_node", bias_node=["-p", "model_file:=default"])
    for process in processes:
        said = "".join(process.lines)
        assert "data loaded from" in said and "data saved to" not in said
