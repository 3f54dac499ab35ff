"""Shared by the tests: calls of the program, and a recording and a session that it makes in virtual time."""

import atexit
import os
import shutil
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

# A shell without job control starts its background processes with SIGINT ignored, and Python does not change that: tests
# of Ctrl-C would wait for ever.
signal.signal(signal.SIGINT, signal.default_int_handler)

FOLDER = Path(__file__).resolve().parent.parent


def beside(name):
    """The path of a file or folder of the repository: beside the tests, where `scripts/python-package` copies it, or in
    the repository's root."""
    return next(path for path in (FOLDER / name, FOLDER.parent / name) if path.exists())


SHIPPED = beside("policies")
PROGRAM = Path(sys.executable).parent / "qube-hil"

# The program keeps its doubts about Qubes in this folder, so that the tests leave the user's folder alone.
STATE = tempfile.mkdtemp(prefix="qube-hil-state-")
atexit.register(shutil.rmtree, STATE, ignore_errors=True)
os.environ["XDG_STATE_HOME"] = STATE
os.environ.pop("STATE_DIRECTORY", None)
# The program of this environment comes first, as after its activation.
os.environ["PATH"] = f"{PROGRAM.parent}{os.pathsep}{os.environ['PATH']}"


def run(*arguments):
    """Runs the program to its end."""
    return subprocess.run(
        [PROGRAM, *map(str, arguments)], capture_output=True, text=True, timeout=600
    )


def program(*arguments, code=0):
    """Runs the program, asserts that it ends with this exit code, and returns its standard output."""
    ended = run(*arguments)
    assert ended.returncode == code, ended.stderr
    return ended.stdout


@pytest.fixture(scope="session")
def swing_up(tmp_path_factory):
    """The recording of a swing-up by the classical controller on the emulated Qube."""
    folder = tmp_path_factory.mktemp("swing-up") / "run"
    program("run", "--clock", "virtual", "--policy", "classical", "--out", folder)
    (recording,) = folder.glob("*.mcap")
    return recording


#: Settings of a session around an identified Qube with trainings so short that it tries several candidates.
SMALL_SESSION = """
[extent]
rollouts = 2
verification_rollouts = 1
[training]
updates = 4
num_envs = 32
[identification]
candidates = 4
"""


@pytest.fixture(scope="session")
def session_folder(tmp_path_factory):
    """A session on the emulated Qube, with the report that it ends with."""
    folder = tmp_path_factory.mktemp("session")
    (folder / "small.toml").write_text(SMALL_SESSION)
    program("session", "--clock", "virtual", "--config", folder / "small.toml", "--out", folder / "out")
    return folder / "out"
