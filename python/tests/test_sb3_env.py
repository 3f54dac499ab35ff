"""Tests of the simulation in the interface of Stable-Baselines3. A class with the two methods that the adapter uses
replaces the library's base class here; `scripts/python-sb3` trains with the real one."""

import importlib
import sys
import types

import numpy as np
import pytest


class VecEnv:
    def __init__(self, num_envs, observation_space, action_space):
        self.num_envs, self.observation_space, self.action_space = num_envs, observation_space, action_space

    def _get_indices(self, indices):
        if indices is None:
            return range(self.num_envs)
        return [indices] if isinstance(indices, int) else indices


@pytest.fixture
def envs(monkeypatch):
    for name in ["stable_baselines3", "stable_baselines3.common", "stable_baselines3.common.vec_env"]:
        module = types.ModuleType(name)
        module.VecEnv = VecEnv
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.delitem(sys.modules, "qube_hil.sb3", raising=False)
    yield importlib.import_module("qube_hil.sb3").QubeVecEnv(3)
    sys.modules.pop("qube_hil.sb3", None)


def test_each_qube_gets_its_entry_of_an_array_and_the_result_of_one_call(envs):
    envs.seed(5)
    envs.reset()
    states = envs._envs.states
    assert len(states) == 3
    assert all(np.array_equal(one, state) for one, state in zip(envs.get_attr("states"), states, strict=True))
    assert np.array_equal(envs.get_attr("states", indices=[2])[0], states[2])
    assert envs.env_method("qube", 1) == [envs._envs.qube(1)] * 3


def test_a_method_that_concerns_all_qubes_is_not_called_for_one(envs):
    observations = envs.reset()
    for name in ["reset", "step", "close"]:
        with pytest.raises(AttributeError, match=f"own {name}"):
            envs.env_method(name, indices=0)
    envs.step_async(np.zeros((3, 1), np.float32))
    assert envs.step_wait()[0].shape == observations.shape
