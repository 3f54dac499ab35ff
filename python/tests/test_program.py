"""Tests of the program that the package contains."""

from conftest import run

import qube_hil


def test_the_package_contains_the_program_of_its_version():
    shown = run("--version")
    assert (shown.returncode, shown.stdout) == (0, f"qube-hil {qube_hil.__version__}\n")


def test_workers_are_started_by_the_installed_command(tmp_path):
    settings = tmp_path / "small.toml"
    settings.write_text(
        "[extent]\ninitial_candidates = 1\niterations = 0\nrollouts = 1\nverification_rollouts = 1\n"
        "[training]\nupdates = 2\nnum_envs = 16\n"
    )
    ended = run(
        "session", "--clock", "virtual", "--method", "bayrn", "--config", settings, "--out", tmp_path / "session",
        "--executor", "{work}", "--workers", "1",
    )
    assert ended.returncode == 0, ended.stderr
    assert (tmp_path / "session" / "candidates" / "000" / "policy.safetensors").exists()


def test_the_program_refuses_wrong_input_with_exit_code_2():
    refused = run("train", "--model", "none")
    assert refused.returncode == 2
    assert "none" in refused.stderr
    missing = run("replay", "missing.mcap")
    assert missing.returncode == 2
    assert "missing.mcap" in missing.stderr
