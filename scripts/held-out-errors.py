#!/usr/bin/env python3
"""Measures the effect of `identify --holdout` on the standard errors of a profile.

Identifies emulated Qubes from a chirp and steps together, once without and once with a held-out rollout of
policies/robust.safetensors. Prints the range of the factor by which the held-out rollout widens the standard errors
(`inflation`), and how many values lie within their 90 % intervals. On the Qube with presliding friction only the values
count that this friction does not change.

    cargo build --release && scripts/held-out-errors.py        takes about three minutes
"""

import argparse
import json
import pathlib
import subprocess
import tempfile
import tomllib

ROOT = pathlib.Path(__file__).resolve().parent.parent
PROGRAM = ROOT / "target/release/qube-hil"
PLANTS = {
    "lab": [],
    "presliding": ["--effect", "presliding_rad=0.03", "--effect", "stribeck=0.5"],
}
#: Values of friction, dead zone and cable, which presliding friction changes.
OF_FRICTION = {
    "coulomb_torque_n_m", "cable_stiffness_n_m_rad", "cable_rest_rad", "positive_dead_zone_v", "negative_dead_zone_v",
}
#: Time from a sample to its command on the emulated Qube's wire, s: it is a part of the fitted delay.
WIRE_S = 0.001


def program(*arguments):
    done = subprocess.run([PROGRAM, *map(str, arguments)], check=True, capture_output=True, text=True)
    return json.loads(done.stdout.splitlines()[-1])


def values(path):
    profile = tomllib.loads(path.read_text())
    return profile["parameters"] | profile["gap"], profile.get("standard_errors", {})


def within(path, truth, leaves_out):
    """Returns how many of a profile's values with a standard error are within their 90 % intervals, and how many have
    one."""
    fitted, errors = values(path)
    names = [name for name, error in errors.items() if error > 0 and name not in leaves_out]
    expected = truth | {"command_delay_s": truth["command_delay_s"] + WIRE_S}
    inside = sum(abs(fitted[name] - expected[name]) <= 1.645 * errors[name] for name in names)
    return inside, len(names)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=8)
    parser.add_argument("--first", type=int, default=1300, help="first seed")
    arguments = parser.parse_args()
    truth, _ = values(ROOT / "profiles/lab.toml")
    for plant, options in PLANTS.items():
        factors, alone, beside, count = [], 0, 0, 0
        for seed in range(arguments.first, arguments.first + arguments.seeds):
            with tempfile.TemporaryDirectory() as name:
                folder = pathlib.Path(name)
                for out, driven in [
                    ("chirp", ["--excite", "chirp", "--volts", 1.5]),
                    ("steps", ["--excite", "steps", "--volts", 0.6]),
                    ("rollout", ["--policy", ROOT / "policies/robust.safetensors"]),
                ]:
                    program("run", *driven, "--profile", "lab", *options, "--clock", "virtual", "--seed", seed,
                            "--out", folder / out, "--json")
                fitted = [folder / "chirp/rollout-0.mcap", folder / "steps/rollout-0.mcap"]
                held_out = ["--holdout", folder / "rollout/rollout-0.mcap"]
                one = program("identify", *fitted, "--out", folder / "alone.toml", "--json")
                other = program("identify", *fitted, *held_out, "--out", folder / "beside.toml", "--json")
                factors.append(other["inflation"] / one["inflation"])
                leaves_out = OF_FRICTION if options else set()
                inside, total = within(folder / "alone.toml", truth, leaves_out)
                alone, count = alone + inside, count + total
                beside += within(folder / "beside.toml", truth, leaves_out)[0]
        print(f"{plant}: factor {min(factors):.2f} to {max(factors):.2f}; of {count} values {alone} are within their "
              f"90 % intervals without the held-out rollout and {beside} with it", flush=True)


if __name__ == "__main__":
    main()
