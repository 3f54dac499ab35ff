"""Tests of the program that the package contains."""

from conftest import run

import qube_hil


def test_the_package_contains_the_program_of_its_version():
    shown = run("--version")
    assert (shown.returncode, shown.stdout) == (0, f"qube-hil {qube_hil.__version__}\n")


def test_the_program_refuses_wrong_input_with_exit_code_2():
    refused = run("train", "--model", "none")
    assert refused.returncode == 2
    assert "none" in refused.stderr
    missing = run("replay", "missing.mcap")
    assert missing.returncode == 2
    assert "missing.mcap" in missing.stderr
