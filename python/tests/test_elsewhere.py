"""Tests of policies from other libraries. The classes here replace those of torch and Stable-Baselines3, of which the
package reads only names and attributes."""

import importlib
import importlib.util
import re

import gymnasium
import numpy as np
import pytest

from conftest import run

import qube_hil
from qube_hil import Policy

RANDOM = np.random.default_rng(5)


class Array:
    def __init__(self, *shape):
        self.values = RANDOM.normal(scale=0.3, size=shape).astype(np.float32)

    def detach(self):
        return self

    def cpu(self):
        return self

    def numpy(self):
        return self.values


class Linear:
    def __init__(self, inputs, outputs, bias=True):
        self.weight, self.bias = Array(outputs, inputs), Array(outputs) if bias else None


class Tanh:
    pass


class ReLU:
    pass


class ELU:
    alpha = 1.0


class SiLU:
    pass


class Softplus:
    pass


FUNCTIONS = {
    Tanh: np.tanh,
    ReLU: lambda x: np.maximum(x, 0.0),
    ELU: lambda x: np.where(x > 0.0, x, np.expm1(np.minimum(x, 0.0))),
    SiLU: lambda x: x / (1.0 + np.exp(-x)),
}


def computed(modules, observations):
    values = observations.astype(np.float64)
    for module in modules:
        if isinstance(module, Linear):
            values = values @ module.weight.values.T
            values = values if module.bias is None else values + module.bias.values
        else:
            values = FUNCTIONS[type(module)](values)
    return values


@pytest.mark.parametrize("activation", FUNCTIONS)
@pytest.mark.parametrize("last", [[], [Tanh()]])
def test_a_policy_of_a_sequential_module_computes_the_outputs_of_the_module(activation, last, tmp_path):
    modules = [Linear(8, 256), activation(), Linear(256, 30, bias=False), activation(), Linear(30, 1), *last]
    policy = Policy.from_torch(modules, action_scale_v=2.0, history=2)
    observations = RANDOM.uniform(-1.0, 1.0, size=(200, 8)).astype(np.float32)
    expected = np.clip(2.0 * computed(modules, observations), -5.0, 5.0)
    assert np.abs(policy.voltage_v(observations) - expected).max() < 5e-6 * 5.0
    policy.save(tmp_path / "p.safetensors")
    again = Policy.load(tmp_path / "p.safetensors")
    assert (again.voltage_v(observations) == policy.voltage_v(observations)).all()


class Named:
    def __init__(self, **named):
        self.__dict__.update(named)


class FlattenExtractor:
    pass


class CombinedExtractor:
    pass


def test_the_actors_of_ppo_sac_and_td3_are_found():
    hidden = [Linear(6, 12), Tanh(), Linear(12, 12), Tanh()]
    action = Linear(12, 1)
    ppo = Named(
        policy=Named(
            mlp_extractor=Named(policy_net=hidden),
            action_net=action,
            features_extractor=FlattenExtractor(),
            squash_output=False,
        ),
        env=object(),
    )
    observations = RANDOM.uniform(-1.0, 1.0, size=(50, 6)).astype(np.float32)
    expected = computed([*hidden, action], observations)
    assert np.abs(Policy.from_sb3(ppo).act(observations) - np.clip(expected, -1.0, 1.0)).max() < 1e-6
    hidden = [Linear(6, 12), ReLU(), Linear(12, 12), ReLU()]
    flat = FlattenExtractor()
    sac = Named(policy=Named(actor=Named(latent_pi=hidden, mu=action, features_extractor=flat), squash_output=True), env=object())
    expected = np.tanh(computed([*hidden, action], observations))
    assert np.abs(Policy.from_sb3(sac).act(observations) - expected).max() < 1e-6
    # The actor of TD3 has its tanh within its modules.
    modules = [*hidden, action, Tanh()]
    td3 = Named(policy=Named(actor=Named(mu=modules, features_extractor=flat), squash_output=True), env=object())
    assert np.abs(Policy.from_sb3(td3).act(observations) - expected).max() < 1e-6


def test_a_model_without_its_environment_warns_of_observations_that_may_be_scaled():
    hidden, action = [Linear(6, 12), Tanh()], Linear(12, 1)
    policy = Named(mlp_extractor=Named(policy_net=hidden), action_net=action)
    loaded = Named(policy=policy, env=None, get_vec_normalize_env=lambda: None)
    with pytest.warns(UserWarning, match="VecNormalize.*normalised=False") as warned:
        known = Policy.from_sb3(loaded)
    assert len(warned) == 1 and warned[0].filename == __file__
    # Warnings are errors here.
    assert Policy.from_sb3(loaded, normalised=False) == known
    for model, named in [
        (loaded, {"normalised": True}),
        (Named(policy=policy, get_vec_normalize_env=lambda: Named(norm_obs=True)), {}),
    ]:
        with pytest.raises(qube_hil.PolicyError, match="VecNormalize"):
            Policy.from_sb3(model, **named)
    only_rewards = Named(policy=policy, env=object(), get_vec_normalize_env=lambda: Named(norm_obs=False))
    assert Policy.from_sb3(only_rewards) == known


class HalfPrecision(Array):
    dtype = "torch.bfloat16"

    def numpy(self):
        raise TypeError("Got unsupported ScalarType BFloat16")


def test_numbers_that_numpy_lacks_are_refused():
    module = [Linear(6, 4), Tanh(), Linear(4, 1)]
    module[2].weight = HalfPrecision(1, 4)
    with pytest.raises(qube_hil.SettingsError, match=r"torch.bfloat16.*give module.float\(\)"):
        Policy.from_torch(module, action_scale_v=5.0)


def test_a_model_takes_the_observation_of_its_environment():
    def model(inputs, env):
        hidden, action = [Linear(inputs, 12), Tanh()], Linear(12, 1)
        return Named(policy=Named(mlp_extractor=Named(policy_net=hidden), action_net=action), env=env)

    robust = {"model": "robust", "settings": "robust"}
    filtered = {"history": 2, "sensors": {"type": "encoders", "estimator": {"corner_rad_s": 60.0}}}
    many = qube_hil.QubeVectorEnv(2, settings=filtered)
    for env, corner_rad_s in [
        (qube_hil.QubeEnv(**robust), 200.0),
        (Named(envs=[gymnasium.make("qube_hil/Qube-v0", **robust)] * 2), 200.0),
        (Named(venv=Named(_envs=many)), 60.0),
        (many, 60.0),
    ]:
        policy = Policy.from_sb3(model(8, env))
        assert policy.observation_size == 8
        assert policy.training["sensors"]["corner_rad_s"] == corner_rad_s
        again = Policy.from_sb3(model(8, env), filter_rad_s=70.0, history=2)
        assert again.training["sensors"]["corner_rad_s"] == 70.0
    # `run` warns of a policy that was trained on true states.
    true_states = Policy.from_sb3(model(6, qube_hil.QubeEnv()))
    assert true_states.training["sensors"] == {"type": "true_state"}
    assert Policy.from_sb3(model(6, object())).training["sensors"]["corner_rad_s"] == 200.0
    names = ["sin_theta", "cos_theta", "sin_alpha", "cos_alpha"]
    assert Policy.from_sb3(model(4, many), observation=names).sizes == [6, 12, 1]
    with pytest.raises(qube_hil.PolicyError, match="8 inputs.*give history=2 if"):
        Policy.from_sb3(model(8, object()))
    with pytest.raises(qube_hil.PolicyError, match="6 inputs"):
        Policy.from_sb3(model(6, many))


#: A pendulum that is larger than a Qube, and whose arm turns less far.
LARGER = {
    "name": "larger",
    "parameters": {
        "g": 9.81, "R_m": 3.8, "k_m": 0.042, "D_r": 1.1e-5, "D_p": 2.2e-6, "M_r": 0.1235, "M_p": 0.0312, "L_r": 0.1105,
        "L_p": 0.1677,
    },
    "encoders": {"theta_counts_per_revolution": 4096, "alpha_counts_per_revolution": 4096},
    "limits": {"hard_stop_rad": 1.8, "largest_voltage_v": 5.0},
    "motor": {"continuous_a": 0.54, "time_constant_s": 30.0},
}


def test_a_policy_keeps_the_plant_that_it_was_trained_for(tmp_path):
    hidden, action = [Linear(6, 12), Tanh()], Linear(12, 1)
    env = qube_hil.QubeVectorEnv(2, settings={"plant": LARGER, "sensors": {"type": "encoders"}})
    actor = Named(mlp_extractor=Named(policy_net=hidden), action_net=action)
    of_env = Policy.from_sb3(Named(policy=actor, env=env))
    layers = [(np.ones((4, 6), np.float32), None), (np.ones((1, 4), np.float32), None)]
    for policy in [of_env, Policy.from_layers(layers, action_scale_v=5.0, plant=LARGER)]:
        assert policy.training["plant"]["name"] == "larger"
        assert policy.training["sensors"]["counts_per_revolution"] == 4096
    file = tmp_path / "larger.safetensors"
    of_env.save(file)
    refused = run("run", "--clock", "virtual", "--policy", file, "--out", tmp_path / "run")
    assert refused.returncode == 2 and "larger" in refused.stderr
    assert "plant" not in Policy.from_layers(layers, action_scale_v=5.0).training
    with pytest.raises(qube_hil.SettingsError, match="plant has no"):
        Policy.from_layers(layers, action_scale_v=5.0, plant={"name": "half"})


def test_a_wrapper_that_changes_what_a_policy_sees_or_requests_is_refused():
    hidden, action = [Linear(6, 12), Tanh()], Linear(12, 1)
    actor = Named(mlp_extractor=Named(policy_net=hidden), action_net=action)
    for wrapper in [
        gymnasium.wrappers.NormalizeObservation,
        lambda env: gymnasium.wrappers.RescaleAction(env, np.float32(-2.0), np.float32(2.0)),
    ]:
        for env in [wrapper(qube_hil.QubeEnv()), Named(envs=[wrapper(qube_hil.QubeEnv())])]:
            with pytest.raises(qube_hil.PolicyError, match="(NormalizeObservation|RescaleAction) changes"):
                Policy.from_sb3(Named(policy=actor, env=env))
    clipped = gymnasium.wrappers.ClipAction(qube_hil.QubeEnv())
    assert Policy.from_sb3(Named(policy=actor, env=clipped)).observation_size == 6


def test_the_default_layers_of_td3_are_refused_and_the_message_gives_smaller_ones():
    modules = [Linear(6, 400), ReLU(), Linear(400, 300), ReLU(), Linear(300, 1), Tanh()]
    with pytest.raises(qube_hil.PolicyError, match=r"400 neurons.*policy_kwargs=dict\(net_arch=\[256, 256\]\)"):
        Policy.from_sb3(Named(policy=Named(actor=Named(mu=modules)), env=object()))


@pytest.mark.skipif(importlib.util.find_spec("stable_baselines3") is not None, reason="Stable-Baselines3 is installed")
def test_the_adapter_says_how_to_install_the_library_that_it_needs():
    with pytest.raises(ModuleNotFoundError, match="pip install stable-baselines3"):
        importlib.import_module("qube_hil.sb3")


def test_an_actor_with_computations_outside_of_its_modules_is_refused():
    hidden, action = [Linear(6, 12), Tanh()], Linear(12, 1)
    ppo = {"mlp_extractor": Named(policy_net=hidden), "action_net": action}
    Policy.from_sb3(Named(policy=Named(**ppo)), normalised=False)
    with pytest.raises(qube_hil.PolicyError, match="VecNormalize"):
        Policy.from_sb3(Named(policy=Named(**ppo), get_vec_normalize_env=lambda: object()))
    with pytest.raises(qube_hil.PolicyError, match="squash_output"):
        Policy.from_sb3(Named(policy=Named(**ppo, squash_output=True)))
    with pytest.raises(qube_hil.PolicyError, match="has an LSTM"):
        Policy.from_sb3(Named(policy=Named(**ppo, lstm_actor=object())))
    combined = CombinedExtractor()
    for policy in [
        Named(**ppo, features_extractor=combined),
        Named(actor=Named(latent_pi=hidden, mu=action, features_extractor=combined)),
        Named(actor=Named(mu=[*hidden, action, Tanh()], features_extractor=combined)),
    ]:
        with pytest.raises(qube_hil.PolicyError, match="CombinedExtractor"):
            Policy.from_sb3(Named(policy=policy))
    with pytest.raises(qube_hil.PolicyError, match="no known actor"):
        Policy.from_sb3(Named(policy=Named()))


@pytest.mark.parametrize(
    "modules, message",
    [
        ([Linear(6, 4), Softplus(), Linear(4, 1)], "Softplus"),
        ([Linear(6, 4), Linear(4, 1)], "follow each other"),
        ([Linear(6, 4), Tanh(), Linear(4, 1), ReLU()], "no Tanh"),
        ([Linear(6, 4), Tanh(), Linear(4, 4), ReLU(), Linear(4, 1)], "several"),
        ([Linear(6, 4), Tanh(), Linear(4, 2)], "2 outputs"),
        ([Linear(6, 300), Tanh(), Linear(300, 1)], "256"),
        ([Linear(7, 4), Tanh(), Linear(4, 1)], "7 inputs"),
        ([], "no layers"),
    ],
)
def test_a_module_that_is_no_policy_is_refused_with_a_reason(modules, message):
    with pytest.raises(qube_hil.PolicyError, match=message):
        Policy.from_torch(modules, action_scale_v=5.0)


def test_impossible_arrays_and_names_are_refused_with_a_reason():
    layers = [(np.ones((4, 6)), None), (np.ones((1, 4)), np.zeros(1))]
    Policy.from_layers(layers, action_scale_v=-5.0)
    for wrong, message in [
        ({"action_scale_v": 0.0}, "action_scale_v"),
        ({"activation": "gelu"}, "gelu"),
        ({"output": "clip"}, "clip"),
        ({"observation": ["sin_beta"]}, "sin_beta"),
        ({"history": 2}, "6 inputs"),
        ({"history": -1}, "history"),
        ({"history": 2**70}, "history"),
        ({"layers": 3}, "layers"),
        ({"layers": [3]}, "arrays"),
        ({"observation": ["sin_theta"], "history": 1}, "beside observation"),
        ({"filter_rad_s": 0.0}, "filter"),
        ({"layers": []}, "no layers"),
        ({"layers": [(np.full((4, 6), np.nan), None), layers[1]]}, "weight of layer 1.*finite"),
        ({"layers": [layers[0], (np.ones((1, 4)), [np.inf])]}, "bias of layer 2.*finite"),
        ({"layers": [(np.full((4, 6), 1e300), None), layers[1]]}, "weight of layer 1.*single precision"),
        ({"layers": [(np.ones((4, 6)), np.zeros(5)), layers[1]]}, "layer 1 has a bias of 5 entries.*4 outputs"),
        ({"layers": [(np.ones((6, 4)), None), (np.ones((4, 1)), None)]}, r"transposed, give \[outputs, inputs\]"),
        ({"layers": [layers[0], (np.ones((4, 1)), None)]}, r"layer 2.*layer 1 has 4 outputs.*transposed"),
        ({"layers": [layers[0], (np.ones((1, 5)), None)]}, r"layer 2.*5 inputs.*layer 1 has 4 outputs"),
        ({"observation": "sin_theta, 2*sin_theta"}, "sin_theta twice"),
        ({"action_scale_v": 1e300}, r"action_scale_v = 1e300: "),
        ({"layers": [(np.ones(6), None)]}, "shapes"),
        ({"layers": [("x", None)]}, "numbers"),
    ]:
        with pytest.raises(qube_hil.PolicyError, match=message):
            Policy.from_layers(**{"layers": layers, "action_scale_v": 5.0, **wrong})
    for wrong in [
        {"action_scale_v": "5"}, {"activation": None}, {"output": 3}, {"filter_rad_s": "a"}, {"clip_observation": "a"},
        {"observation": [1]}, {"observation": 3}, {"history": "2"},
    ]:
        ((name, value),) = wrong.items()
        with pytest.raises(qube_hil.SettingsError, match=re.escape(f"{name} = {value!r}: give")):
            Policy.from_layers(**{"layers": layers, "action_scale_v": 5.0, **wrong})
    for call in [lambda: Policy.from_torch(3, action_scale_v=5.0), lambda: Policy.from_sb3(3)]:
        with pytest.raises(qube_hil.PolicyError, match="give a"):
            call()


def test_an_observation_is_a_list_of_names_or_the_text_of_the_option():
    layers = [(RANDOM.normal(size=(4, 6)), None), (RANDOM.normal(size=(1, 4)), None)]
    names = ["theta_dot", "-1*cos_alpha", "-1*sin_alpha", "cos_theta", "sin_theta", "alpha_dot"]
    listed, as_text = [
        Policy.from_layers(layers, action_scale_v=5.0, observation=it).to_bytes() for it in [names, ",".join(names)]
    ]
    assert listed == as_text
