"""Recordings and a session that the program makes in virtual time."""

import subprocess
import sys
from pathlib import Path

import pytest

PROGRAM = Path(sys.executable).parent / "qube-hil"


def program(*arguments, code=0):
    """Runs the program, which ends with this exit code, and returns what it prints."""
    ended = subprocess.run(
        [PROGRAM, *map(str, arguments)], capture_output=True, text=True, timeout=600
    )
    assert ended.returncode == code, ended.stderr
    return ended.stdout


@pytest.fixture(scope="session")
def swing_up(tmp_path_factory):
    """The recording of a swing-up by the classical controller on the emulated Qube."""
    folder = tmp_path_factory.mktemp("swing-up") / "run"
    program("run", "--clock", "virtual", "--policy", "classical", "--out", folder)
    (recording,) = folder.glob("*.mcap")
    return recording
