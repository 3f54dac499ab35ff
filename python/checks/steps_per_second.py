"""Measures the simulation's speed through the package's interface: control steps a second of CPU time, on one core.

    python python/checks/steps_per_second.py [--json]

Four figures: 4096 Qubes with true states, once with new arrays in each step (the default) and once with the same arrays
written over; 4096 with nonidealities (delay, friction, dead zone and cable differ from Qube to Qube, sensors are
encoders); and the single environment. Each figure is the median of seven rounds.
"""

import argparse
import json
import statistics
import time
from collections.abc import Callable

import numpy as np

import qube_hil

ROUNDS = 7


def rate(step: Callable[[], object], steps_a_call: int, calls: int) -> float:
    """Control steps a second of CPU time."""
    rates = []
    for _ in range(ROUNDS):
        begun = time.process_time()
        for _ in range(calls):
            step()
        rates.append(calls * steps_a_call / (time.process_time() - begun))
    return statistics.median(rates)


def many(calls: int, copy: bool = True, **named: str) -> float:
    envs = qube_hil.QubeVectorEnv(4096, copy=copy, **named)
    envs.reset(seed=1)
    # Small pushes, so that hardly any Qube leaves its box.
    actions = np.random.default_rng(1).uniform(-0.1, 0.1, (4096, 1)).astype(np.float32)
    return rate(lambda: envs.step(actions), 4096, calls)


def single(calls: int) -> float:
    env = qube_hil.QubeEnv()
    env.reset(seed=1)
    action = np.zeros(1, np.float32)

    def step() -> None:
        *_, truncated, _ = env.step(action)
        if truncated:
            env.reset()

    return rate(step, 1, calls)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    as_json = parser.parse_args().json
    measured = {
        "4096 Qubes, true states": many(600),
        "4096 Qubes, true states, arrays written over": many(600, copy=False),
        "4096 Qubes, nonidealities": many(100, model="robust", settings="robust"),
        "one Qube": single(60_000),
    }
    if as_json:
        print(json.dumps({name: round(value) for name, value in measured.items()}))
        return
    for name, value in measured.items():
        print(f"{name:45} {value / 1e6:8.2f} million steps/s")


if __name__ == "__main__":
    main()
