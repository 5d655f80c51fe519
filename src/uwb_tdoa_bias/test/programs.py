# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Programs as processes of their own, for tests that are about a process."""

import subprocess
import sys


def run(*command, **options):
    """Run a program to its end, and return its CompletedProcess with the output as text."""
    words = list(map(str, command))
    return subprocess.run(words, **{"capture_output": True, "text": True, **options})


def python(*words, **options):
    """Run Python with arguments."""
    return run(sys.executable, *words, **options)


def start(*words, **options):
    """Start Python with arguments, and return its Popen. The output is piped as text."""
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen([sys.executable, *map(str, words)], **{**pipes, **options})
