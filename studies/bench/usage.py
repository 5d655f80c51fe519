# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""CPU time and memory of processes on this machine, from Linux's /proc (see man proc_stat,
proc_pid_stat, proc_pid_status).
"""

from __future__ import annotations

import os
from pathlib import Path

TICK = 1.0 / os.sysconf("SC_CLK_TCK")  # s


def cpu_seconds(pid: int) -> float:
    """CPU time of all threads so far, user and system, s; steps of 0.01 s."""
    # its name may hold anything
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return TICK * (int(fields[11]) + int(fields[12]))


def memory(pid: int) -> int:
    """Resident memory, bytes."""
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith("VmRSS:"):
            return 1024 * int(line.split()[1])
    raise ProcessLookupError(f"{pid} has ended")


def used_by_all() -> tuple[float, float, float, float]:
    """(total, idle, stolen, ours) CPU time of all cores so far, s. ours : this process and children
    that have ended.
    """
    user, nice, system, idle, waiting, irq, soft, stolen = map(
        int, Path("/proc/stat").read_text().split()[1:9]
    )
    total = user + nice + system + idle + waiting + irq + soft + stolen
    return TICK * total, TICK * (idle + waiting), TICK * stolen, sum(os.times()[:4])


def used_by_others(before: tuple[float, float, float, float]) -> dict[str, float]:
    """Shares of all CPU time since `before` (used_by_all): {"others": other processes, "stolen":
    this VM's host}.
    """
    total, idle, stolen, ours = (now - then for now, then in zip(used_by_all(), before))
    return {
        "others": max(0.0, total - idle - stolen - ours) / max(total, TICK),
        "stolen": stolen / max(total, TICK),
    }
