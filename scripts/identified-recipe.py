#!/usr/bin/env python3
"""Trains policies around emulated Qubes that were identified from one chirp, and runs them under the guard:
the recipe that docs/learning.md recommends. Prints a table for each plant. Needs Python 3.11 and a release build.

usage: scripts/identified-recipe.py [--plants lab,gap,delay,drawn] [--policies N] [--seed S] [--threads T] [--out FOLDER]

  lab     profiles/lab.toml, whose delay is 10 ms
  gap     lab with 1.5 times its friction, dead zones, cable and delay, and parameters 1.5 times as far from nominal
  delay   lab with a delay of 16 ms
  drawn   each number of lab within 10 per cent except gravity, with other numbers for each policy

Each plant is excited with one chirp and identified. Training and guard use only the identified profile of the
plant. Work that is finished in FOLDER is not repeated. Defaults: all plants, N = 20, S = 2000, T = all processors, and
FOLDER identified-recipe.
"""
import argparse
import os
import pathlib
import random
import shutil
import subprocess
import tomllib

ROOT = pathlib.Path(__file__).resolve().parent.parent
PROGRAM = os.environ.get("QUBE_HIL", str(ROOT / "target/release/qube-hil"))
LAB = tomllib.loads((ROOT / "profiles/lab.toml").read_text())


def table(name, values):
    return f"[{name}]\n" + "".join(f"{key} = {value!r}\n" for key, value in values.items())


def plant(name, seed):
    parameters, gap = dict(LAB["parameters"]), dict(LAB["gap"])
    if name == "delay":
        gap["command_delay_s"] = 0.016
    elif name == "drawn":
        draw = random.Random(seed)
        parameters = {key: value if key == "g" else value * draw.uniform(0.9, 1.1) for key, value in parameters.items()}
        gap = {key: value * draw.uniform(0.9, 1.1) for key, value in gap.items()}
    return f'name = "{name}"\n' + table("parameters", parameters) + table("gap", gap)


def run(*arguments):
    finished = subprocess.run([PROGRAM, *map(str, arguments)], capture_output=True, text=True)
    if finished.returncode != 0:
        raise SystemExit(finished.stderr.strip().splitlines()[-1])


def study(folder, name, seed, policies, threads):
    folder.mkdir(parents=True, exist_ok=True)
    truth, found, qube, recipe = (folder / file for file in ("plant.toml", "found.toml", "qube.toml", "recipe.toml"))
    truth.write_text(plant(name, seed))
    emulated = ["--profile", truth] + (["--gap", "1.5"] if name == "gap" else [])
    if not found.exists():
        # An earlier run may have left a recording that identifies no Qube, or a part of one.
        shutil.rmtree(folder / "chirp", ignore_errors=True)
        run("run", "--excite", "chirp", "--unidentified", *emulated, "--clock", "virtual", "--seed", seed, "--out",
            folder / "chirp")
        finished = subprocess.run([PROGRAM, "identify", str(folder / "chirp/rollout-0.mcap"), "--out", str(found)],
                                  capture_output=True, text=True)
        if finished.returncode != 0:
            return f"{folder.name}: not identified: {finished.stderr.strip().splitlines()[-1]}\n"
    qube.write_text('profile = "found.toml"\n')
    profile = tomllib.loads(found.read_text())
    recipe.write_text(f'name = "{name}"\nmodel = "profile"\n[settings.profile]\nspread = 0.1\n'
                      + table("settings.profile.model.parameters", profile["parameters"])
                      + table("settings.profile.model.gap", profile["gap"]))
    out = folder / "experiment"
    options = ["--resume", out] if out.exists() else [
        "--out", out, "--recipe", recipe, "--preset", "robust", "--guard", "foresight", *emulated, "--policies",
        policies, "--rollouts", 5, "--seed", seed]
    # An experiment does not store the profile that the guard uses, so a resumed experiment is given the profile again.
    run("experiment", *options, "--device", "emulated", "--qube", qube, "--threads", threads)
    finished = subprocess.run([PROGRAM, "experiment", "--resume", str(out), "--table", "--csv",
                               str(folder / "policies.csv")],
                              check=True, capture_output=True, text=True)
    return finished.stdout


def main():
    parser = argparse.ArgumentParser(usage=__doc__)
    parser.add_argument("--plants", default="lab,gap,delay,drawn")
    parser.add_argument("--policies", type=int, default=20)
    parser.add_argument("--seed", type=int, default=2000)
    parser.add_argument("--threads", type=int, default=os.cpu_count())
    parser.add_argument("--out", type=pathlib.Path, default=pathlib.Path("identified-recipe"))
    arguments = parser.parse_args()
    for name in arguments.plants.split(","):
        if name == "drawn":
            for seed in range(arguments.seed, arguments.seed + arguments.policies):
                print(study(arguments.out / f"drawn-{seed}", name, seed, 1, arguments.threads), flush=True)
        else:
            print(study(arguments.out / name, name, arguments.seed, arguments.policies, arguments.threads), flush=True)


if __name__ == "__main__":
    main()
