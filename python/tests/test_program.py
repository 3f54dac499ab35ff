"""The program that the package brings."""

import subprocess
import sys
from pathlib import Path

import qube_hil

PROGRAM = Path(sys.executable).parent / "qube-hil"


def run(*arguments):
    return subprocess.run([PROGRAM, *arguments], capture_output=True, text=True, timeout=300)


def test_the_package_brings_the_program_of_its_version():
    shown = run("--version")
    assert (shown.returncode, shown.stdout) == (0, f"qube-hil {qube_hil.__version__}\n")


def test_the_program_has_its_exit_codes():
    refused = run("train", "--model", "none")
    assert refused.returncode == 2
    assert "none" in refused.stderr
    missing = run("replay", "missing.mcap")
    assert missing.returncode == 2
    assert "missing.mcap" in missing.stderr
