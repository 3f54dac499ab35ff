#!/usr/bin/env python3
"""Runs sessions on several emulated Qubes in virtual time and prints a row for each plant. Needs Python 3.11 and a
release build.

usage: scripts/session-study.py [--plants NAME,...] [--seeds N] [--first S] [--method M]
                                [--parallel P] [--out FOLDER]

  lab     profiles/lab.toml, whose delay is 10 ms
  gap     lab with 1.5 times its friction, dead zones, cable and delay, and parameters 1.5 times as far from nominal
  delay   lab with a delay of 16 ms
  drawn   each number of lab within 15 per cent except gravity, with other numbers for each session

The plants of scripts/comparison/beyond.toml, with effects that neither the training simulations nor a fit contains:
  play        lab with a backlash of 1 degree between motor and arm
  presliding  friction that yields over 0.03 rad before it slides, and that is 1.5 times as large near standstill
  cable       a cable that lags by 0.5 mN m and is slack on one side
  warm        a winding whose resistance grows by 30 per cent a watt, and an arm encoder that is off by up to 0.02 rad

The plants of scripts/comparison/other-forms.toml, with further such effects whose form identify does not test for:
  tilt        lab on a base that is tilted by 0.009 rad
  ripple      a motor whose torque changes by 20 per cent twelve times a turn
  bearing     dry friction of 0.1 mN m in the pendulum's bearing
  stiffening  a cable with a cubic term of 0.1 mN m/rad^3

The columns are the number of sessions that ended with a verified policy, of all sessions; then, of these, the number
whose policy balanced in all of its verification rollouts, the mean return, the real rollouts (median and most), the
motion of the Qube from homed to policy chosen (s, median and most: settling, policy and braking of these real
rollouts), the number of sessions whose identification doubted the model or failed, the change of the voltage while the
policy balances (V a tick, median and most), its sign changes (1/s, median and most), and the mean return of the nominal
policy in one rollout. A session whose result is in FOLDER is not run again; one that failed continues.
Defaults: the first five plants, N = 10, S = 3000, M = identified, P = all processors, FOLDER session-study.
"""
import argparse
import csv
import json
import os
import pathlib
import random
import statistics
import subprocess
import tempfile
import tomllib
from concurrent.futures import ThreadPoolExecutor

ROOT = pathlib.Path(__file__).resolve().parent.parent
PROGRAM = os.environ.get("QUBE_HIL", str(ROOT / "target/release/qube-hil"))
LAB = tomllib.loads((ROOT / "profiles/lab.toml").read_text())


def drawn(folder, seed):
    """Writes a profile with each number of lab's, except gravity, changed by up to 15 %."""
    draw = random.Random(seed)
    table = lambda name, values: f"[{name}]\n" + "".join(f"{key} = {value!r}\n" for key, value in values.items())
    parameters = {
        key: value if key == "g" else value * draw.uniform(0.85, 1.15) for key, value in LAB["parameters"].items()
    }
    gap = {key: value * draw.uniform(0.85, 1.15) for key, value in LAB["gap"].items()}
    path = folder / f"drawn-{seed}.toml"
    path.write_text(f'name = "drawn-{seed}"\n' + table("parameters", parameters) + table("gap", gap))
    return path


def plant(name, folder, seed):
    lab = ["--profile", "lab"]
    return {
        "lab": lambda: lab,
        "gap": lambda: [*lab, "--gap", "1.5"],
        "delay": lambda: [*lab, "--delay-ms", "16"],
        "drawn": lambda: ["--profile", str(drawn(folder, seed))],
        "play": lambda: [*lab, "--play-deg", "1"],
        "presliding": lambda: [*lab, "--effect", "presliding_rad=0.03", "--effect", "stribeck=0.5"],
        "cable": lambda: [*lab, "--effect", "hysteresis_n_m=0.0005", "--effect", "slack=1"],
        "warm": lambda: [*lab, "--effect", "warming_per_w=0.3", "--effect", "eccentricity_rad=0.02"],
        "tilt": lambda: [*lab, "--effect", "tilt_rad=0.009"],
        "ripple": lambda: [*lab, "--effect", "ripple=0.2"],
        "bearing": lambda: [*lab, "--effect", "pendulum_friction_n_m=0.0001"],
        "stiffening": lambda: [*lab, "--effect", "cubic_n_m_rad3=0.0001"],
    }[name]()


def failure(summary):
    """Returns the reason why a result holds no verified policy; an empty text if it holds one."""
    return str(summary.get("ended_by") or ("" if summary.get("best") else "it has no verified policy"))


def motion_s(session_folder, candidates):
    """Returns the time for which the Qube moved in the recordings of these candidates, s: the sum of their last ticks'
    times."""
    total_s = 0.0
    with tempfile.TemporaryDirectory() as tables:
        for candidate in candidates:
            recordings = sorted((session_folder / "candidates" / f"{candidate['candidate']:03}").glob("*.mcap"))
            for recording in recordings:
                subprocess.run([PROGRAM, "export", str(recording), "--out", tables, "--force"], check=True,
                               capture_output=True)
                with open(pathlib.Path(tables) / f"{recording.stem}.csv", newline="") as table:
                    total_s += float(list(csv.DictReader(table))[-1]["time_s"])
    return total_s


def session(folder, name, method, seed):
    """Runs one session, or reads its result. The result of a session that failed is not stored."""
    result = folder / f"{method}-{name}-{seed}.json"
    summary = json.loads(result.read_text()) if result.exists() else {}
    if failure(summary):
        out = folder / f"{method}-{name}-{seed}"
        arguments = ["--resume", out] if out.exists() else [
            "--method", method, "--seed", str(seed), "--out", out, *plant(name, folder, seed)]
        done = subprocess.run([PROGRAM, "session", "--clock", "virtual", "--json", *map(str, arguments)],
                              capture_output=True, text=True)
        summary = json.loads(done.stdout.splitlines()[-1]) if done.stdout else {"ended_by": done.stderr[-300:]}
        if failure(summary):
            return {"seed": seed, "error": failure(summary)}
        result.write_text(json.dumps(summary))
    best, known = summary["best"], summary["identification"]
    returns = best["returns"]
    return {
        "seed": seed,
        "successes": best["successes"],
        "rollouts": len(returns),
        "mean": statistics.mean(returns),
        "real": summary["real_rollouts"],
        "motion_s": motion_s(folder / f"{method}-{name}-{seed}", summary["excitations"] + summary["candidates"]),
        "change_v": best["balancing"]["change_v"],
        "sign_changes_per_s": best["balancing"]["sign_changes_per_s"],
        "doubted": known is not None and known.get("verdict") != "fits",
        "nominal": (summary["baseline"] or [{"returns": [float("nan")]}])[0]["returns"][0],
    }


def main():
    parser = argparse.ArgumentParser(usage=__doc__)
    parser.add_argument("--plants", default="lab,gap,delay,drawn,play")
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--first", type=int, default=3000)
    parser.add_argument("--method", default="identified")
    parser.add_argument("--parallel", type=int, default=os.cpu_count())
    parser.add_argument("--out", type=pathlib.Path, default=pathlib.Path("session-study"))
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    print("plant      sessions  all balance  mean return  real rollouts: median, most  motion, s: median, most  "
          "doubted  V a tick: median, most  sign changes/s: median, most  nominal", flush=True)
    for name in arguments.plants.split(","):
        seeds = range(arguments.first, arguments.first + arguments.seeds)
        with ThreadPoolExecutor(arguments.parallel) as pool:
            results = list(pool.map(lambda seed: session(arguments.out, name, arguments.method, seed), seeds))
        for failed in [it for it in results if "error" in it]:
            print(f"  {name} {failed['seed']}: {failed['error']}")
        done = [it for it in results if "error" not in it]
        if not done:
            continue
        good = sum(it["successes"] == it["rollouts"] for it in done)
        real, motion, change, signs = ([it[of] for it in done]
                                       for of in ("real", "motion_s", "change_v", "sign_changes_per_s"))
        doubted = sum(it["doubted"] for it in done)
        sessions = f"{len(done)} of {len(results)}"
        print(f"{name:10} {sessions:>8}  {good:11}  {statistics.mean(it['mean'] for it in done):11.1f}  "
              f"{statistics.median(real):21g}, {max(real):4}  {statistics.median(motion):17.1f}, {max(motion):4.1f}  "
              f"{doubted:7}  {statistics.median(change):16.2f}, {max(change):4.2f}  "
              f"{statistics.median(signs):22.1f}, {max(signs):4.1f}  "
              f"{statistics.mean(it['nominal'] for it in done):7.1f}", flush=True)


if __name__ == "__main__":
    main()
