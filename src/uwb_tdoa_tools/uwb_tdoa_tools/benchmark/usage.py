"""What a process of this machine has used, by Linux's /proc (see man proc_pid_stat, proc_pid_status)."""

import os
from pathlib import Path

TICK = 1.0 / os.sysconf("SC_CLK_TCK")  # s


def cpu_seconds(pid):
    """CPU time of all threads so far, user and system, s; steps of 0.01 s."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()  # its name may hold anything
    return TICK * (int(fields[11]) + int(fields[12]))


def memory(pid):
    """Resident memory, bytes."""
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith("VmRSS:"):
            return 1024 * int(line.split()[1])
    raise ProcessLookupError(f"{pid} has ended")
