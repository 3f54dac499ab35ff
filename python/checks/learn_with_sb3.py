"""Checks the package with torch and Stable-Baselines3, which are too large for CI; `scripts/python-sb3` installs them.

Exits with an error unless Stable-Baselines3's checks pass, its PPO reaches a mean return of 540 on the nominal Qube, its
policies and torch's become policies of this program, and exporters' files are read or refused as the manual says.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import gymnasium
import numpy as np
import stable_baselines3
import torch
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.vec_env import VecMonitor
from torch import nn

import qube_hil
from qube_hil.sb3 import QubeVecEnv

PROGRAM = Path(sys.executable).parent / "qube-hil"
#: Return on the nominal Qube from which PPO counts as having learnt; the largest possible one is 600.
TARGET_RETURN = 540.0


def program(*arguments):
    return subprocess.run([PROGRAM, *map(str, arguments)], capture_output=True, text=True)


def checked_env():
    check_env(gymnasium.make("qube_hil/Qube-v0").unwrapped)
    check_env(gymnasium.make("qube_hil/Qube-v0", model="robust", settings="robust").unwrapped)
    # The adapter works inside a wrapper of SB3 for VecEnvs.
    envs = VecMonitor(QubeVecEnv(4))
    envs.seed(3)
    observations = envs.reset()
    assert observations.shape == (4, 6)
    for _ in range(qube_hil.MAX_STEPS):
        observations, rewards, ended, infos = envs.step(np.zeros((4, 1), np.float32))
    assert ended.all() and all(info["TimeLimit.truncated"] for info in infos)
    assert [info["episode"]["l"] for info in infos] == [qube_hil.MAX_STEPS] * 4
    assert infos[0]["terminal_observation"].shape == (6,)


class UntilLearnt(BaseCallback):
    """Every five updates, measures the policy's mean return over 100 episodes and keeps the best policy. Ends the
    training once that return is 3 above the target, a margin for the test on other episodes."""

    def __init__(self):
        super().__init__()
        self.best, self.best_return, self.updates = None, 0.0, 0

    def _on_step(self):
        return self.best_return < TARGET_RETURN + 3.0

    def _on_rollout_end(self):
        self.updates += 1
        if self.updates % 5 == 0:
            policy = qube_hil.Policy.from_sb3(self.model)
            reached = mean_return(policy, seed=16)
            print(f"{self.num_timesteps} steps: {reached:.1f}", file=sys.stderr, flush=True)
            if reached > self.best_return:
                self.best, self.best_return = policy, reached


def trained(steps):
    """SB3's PPO with the settings of this program's preset `quick`, on the nominal Qube: the model, and the policy with
    the highest return."""
    torch.set_num_threads(1)
    model = PPO(
        "MlpPolicy",
        QubeVecEnv(16),
        n_steps=600,
        batch_size=600,
        n_epochs=10,
        learning_rate=lambda left: 1e-4 + 4e-4 * left,
        gamma=0.99,
        gae_lambda=0.95,
        clip_range=0.2,
        ent_coef=0.0,
        max_grad_norm=0.5,
        seed=1,
        device="cpu",
        policy_kwargs={"net_arch": [64, 64], "log_std_init": 0.4},
    )
    callback = UntilLearnt()
    model.learn(steps, callback=callback)
    return model, callback.best


def mean_return(policy, seed):
    """Mean return of 100 nominal episodes."""
    envs = qube_hil.QubeVectorEnv(100)
    observations, _ = envs.reset(seed=seed)
    returns, running = np.zeros(100), np.ones(100, bool)
    for _ in range(qube_hil.MAX_STEPS):
        observations, rewards, terminated, _, _ = envs.step(policy.act(observations))
        returns += rewards * running
        running &= ~terminated
    return returns.mean()


def agrees(policy, outputs, observations, scale_v=5.0):
    """Asserts that a policy's voltages are these outputs times the scale, limited to 5 V, within a millionth of the
    range of 10 V; returns the largest difference, V."""
    expected = np.clip(scale_v * outputs.reshape(-1, 1), -5.0, 5.0)
    difference = np.abs(policy.voltage_v(observations) - expected).max()
    assert difference < 1e-6 * 10.0, difference
    return difference


class Deterministic(nn.Module):
    """The module that SB3's manual puts around a policy before the export."""

    def __init__(self, policy):
        super().__init__()
        self.policy = policy

    def forward(self, observation):
        return self.policy(observation, deterministic=True)


def exporters(model, sequential, observations, folder):
    """Imports the files of torch's exporters. Returns a message or the difference in V for each, by a description."""
    told = {}
    seen = torch.from_numpy(observations[:1])
    outputs = model.predict(observations, deterministic=True)[0]

    file = folder / "sb3-torchscript.onnx"
    torch.onnx.export(Deterministic(model.policy), (seen,), str(file), opset_version=17, dynamo=False)
    imported = program("import", file, "--action-scale", 5, "--out", folder / "torchscript.safetensors")
    assert imported.returncode == 0, imported.stderr
    policy = qube_hil.Policy.load(folder / "torchscript.safetensors")
    told["import of the TorchScript exporter's file, difference V"] = float(agrees(policy, outputs, observations))

    file = folder / "sb3-dynamo.onnx"
    try:
        torch.onnx.export(Deterministic(model.policy), (seen,), str(file), dynamo=True)
        told["dynamo exporter on SB3's wrapper"] = "wrote a file"
    except Exception as error:  # noqa: BLE001 - torch has several classes for it
        told["dynamo exporter on SB3's wrapper"] = f"{type(error).__name__}"
    if not file.exists():
        refused = program("import", file, "--action-scale", 5, "--out", folder / "dynamo.safetensors")
        assert refused.returncode == 2 and "from_sb3" in refused.stderr, refused.stderr

    file = folder / "sequential-dynamo.onnx"
    torch.onnx.export(sequential, (seen,), str(file), dynamo=True, external_data=True)
    refused = program("import", file, "--action-scale", 5, "--out", folder / "two.safetensors")
    told["dynamo exporter with external_data"] = refused.stderr.strip()
    assert refused.returncode == 2 and "external_data=False" in refused.stderr, refused.stderr

    torch.onnx.export(sequential, (seen,), str(file), dynamo=True, external_data=False)
    imported = program("import", file, "--action-scale", 5, "--out", folder / "one.safetensors")
    assert imported.returncode == 0, imported.stderr
    with torch.no_grad():
        outputs = sequential(torch.from_numpy(observations)).numpy()
    policy = qube_hil.Policy.load(folder / "one.safetensors")
    told["import of the dynamo exporter's file, difference V"] = float(agrees(policy, outputs, observations))
    return told


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=2_000_000, help="largest number of control steps of PPO's training")
    steps = parser.parse_args().steps
    result = {"torch": torch.__version__, "stable_baselines3": stable_baselines3.__version__}

    checked_env()
    observations = np.random.default_rng(0).uniform(-1.0, 1.0, (500, 6)).astype(np.float32)

    begun, used = time.perf_counter(), time.process_time()
    model, policy = trained(steps)
    result |= {
        "steps": model.num_timesteps,
        "wall_s": round(time.perf_counter() - begun, 1),
        "cpu_s": round(time.process_time() - used, 1),
    }
    print(json.dumps(result), file=sys.stderr, flush=True)
    result["mean_return"] = round(float(mean_return(policy, seed=17)), 1)
    agrees(qube_hil.Policy.from_sb3(model), model.predict(observations, deterministic=True)[0], observations)

    # The recipe of the manual: the history is that of the environment.
    robust = PPO("MlpPolicy", QubeVecEnv(4, model="robust", settings="robust"), n_steps=8, batch_size=32, device="cpu")
    seen = np.random.default_rng(1).uniform(-1.0, 1.0, (500, 8)).astype(np.float32)
    agrees(qube_hil.Policy.from_sb3(robust), robust.predict(seen, deterministic=True)[0], seen)

    sac = SAC("MlpPolicy", gymnasium.make("qube_hil/Qube-v0"), seed=1, device="cpu", buffer_size=1000)
    agrees(qube_hil.Policy.from_sb3(sac), sac.predict(observations, deterministic=True)[0], observations)

    sequential = nn.Sequential(nn.Linear(6, 64), nn.ELU(), nn.Linear(64, 64), nn.ELU(), nn.Linear(64, 1), nn.Tanh())
    with torch.no_grad():
        outputs = sequential(torch.from_numpy(observations)).numpy()
    agrees(qube_hil.Policy.from_torch(sequential, action_scale_v=5.0), outputs, observations)

    with tempfile.TemporaryDirectory() as folder:
        result |= exporters(model, sequential, observations, Path(folder))
        policy.save(Path(folder) / "sb3.safetensors")
        run = program(
            "run", "--clock", "virtual", "--guard", "box", "--policy", Path(folder) / "sb3.safetensors",
            "--rollouts", 3, "--out", Path(folder) / "rollouts", "--json",
        )
        assert run.returncode == 0, run.stderr
        result["returns of `run`"] = json.loads(run.stdout.splitlines()[-1])["returns"]
    print(json.dumps(result, indent=2))
    assert result["mean_return"] >= TARGET_RETURN, "PPO has not learnt"


if __name__ == "__main__":
    main()
