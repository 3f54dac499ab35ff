"""Tests of the environments that wrap the simulation."""

import copy
import json
import pickle
import threading
import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

import qube_hil
from qube_hil import Normal, QubeEnv, QubeVectorEnv, Uniform


def pushing(observations):
    """Returns the actions of a deterministic policy that moves some arms out of the box and holds others."""
    return np.float32(0.6) * np.sign(observations[:, :1]) - np.float32(0.2) * observations[:, 4:5]


def episodes(num_envs, steps, **settings):
    """Returns, by number, the return, length, termination and last observation of each episode that ends within these
    steps."""
    env = QubeVectorEnv(num_envs, **settings)
    observations, info = env.reset(seed=7)
    numbers = info["episode_number"]
    returns, lengths = np.zeros(num_envs), np.zeros(num_envs, int)
    finished = {}
    for _ in range(steps):
        observations, rewards, terminated, truncated, info = env.step(pushing(observations))
        returns += rewards
        lengths += 1
        for index in np.flatnonzero(terminated | truncated):
            assert info["_final_obs"][index]
            finished[int(numbers[index])] = (
                returns[index],
                lengths[index],
                bool(terminated[index]),
                info["final_obs"][index].tobytes(),
            )
            returns[index], lengths[index] = 0.0, 0
        numbers = info.get("episode_number", numbers)
    return finished


@pytest.mark.parametrize("model, settings", [("handcrafted", "thesis"), ("robust", "robust")])
def test_the_same_seed_gives_the_same_episodes_for_any_number_of_qubes(model, settings):
    few = episodes(3, 1300, model=model, settings=settings)
    many = episodes(37, 700, model=model, settings=settings)
    common = few.keys() & many.keys()
    assert len(common) >= 6
    assert all(few[number] == many[number] for number in common)


def test_one_qube_alone_moves_as_it_does_among_others():
    env, single = QubeVectorEnv(5, model="robust"), QubeEnv(model="robust")
    observations, _ = env.reset(seed=3)
    alone, info = single.reset(seed=3)
    assert info == {"episode_number": 0}
    for _ in range(50):
        assert (alone == observations[0]).all()
        action = pushing(observations)
        observations, rewards, terminated, truncated, _ = env.step(action)
        alone, reward, left, over, _ = single.step(action[0])
        assert (reward, left, over) == (rewards[0], terminated[0], truncated[0])
        if left:
            break
        assert (single.state == env.states[0]).all()
    assert left


def test_the_checks_of_gymnasium_pass():
    with warnings.catch_warnings():
        # Velocities have no bounds.
        warnings.filterwarnings("ignore", message=".*Box observation space.*")
        check_env(gymnasium.make("qube_hil/Qube-v0", settings="robust").unwrapped)
    env = gymnasium.make_vec("qube_hil/Qube-v0", num_envs=4, model="robust")
    assert isinstance(env, QubeVectorEnv)
    assert env.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    env = gymnasium.wrappers.vector.RecordEpisodeStatistics(env)
    observations, _ = env.reset(seed=0)
    ended = []
    for _ in range(600):
        observations, _, _, _, info = env.step(0.0 * observations[:, :1])
        ended.extend(info["episode"]["l"][info["_episode"]] if "episode" in info else [])
    assert ended == [600] * 4


def test_an_episode_that_leaves_the_box_is_terminated_and_one_of_600_steps_is_truncated():
    env = QubeEnv()
    env.reset(seed=0)
    steps = [env.step(np.ones(1, np.float32)) for _ in range(20)]
    assert not any(step[2] or step[3] for step in steps)
    while not (last := env.step(np.ones(1, np.float32)))[2]:
        pass
    assert last[3] is False
    with pytest.raises(qube_hil.EpisodeOverError, match="reset"):
        env.step(np.ones(1, np.float32))
    env.reset()
    idle = [env.step(np.zeros(1, np.float32)) for _ in range(qube_hil.MAX_STEPS)]
    assert [step[3] for step in idle] == [False] * 599 + [True]
    assert not any(step[2] for step in idle)
    assert sum(step[1] for step in idle) < 1.0


def test_foresight_ends_episodes_before_the_box_does_and_does_not_change_calm_ones():
    def driven(guard, action):
        envs = QubeVectorEnv(8, model="robust", settings="robust", guard=guard)
        observations, _ = envs.reset(seed=4)
        ended, seen = [], [observations]
        for _ in range(120):
            before = envs.states
            observations, rewards, terminated, _, info = envs.step(np.full((8, 1), action, np.float32))
            seen.append(observations)
            assert (info["guarded"] == terminated).all() if guard == "foresight" else "guarded" not in info
            if terminated.any():
                ended.extend(np.abs(before[terminated, 0]))
        return ended, np.array(seen)

    # The arm is pushed to the side. Foresight ends the episode while the brake can still stop it.
    by_box, _ = driven("box", 0.8)
    by_guard, _ = driven("foresight", 0.8)
    assert len(by_box) >= 8 and min(by_box) > 1.5
    assert len(by_guard) >= 8 and max(by_guard) < 1.5
    # Pushes that endanger nothing have the same effect with the guard.
    (none, plain), (nothing, guarded) = driven("box", 0.02), driven("foresight", 0.02)
    assert none == nothing == []
    assert (plain == guarded).all()


def test_foresight_guards_one_qube_as_it_does_many():
    env = QubeEnv(model="robust", settings="robust", guard="foresight")
    envs = QubeVectorEnv(3, model="robust", settings="robust", guard="foresight")
    env.reset(seed=4)
    envs.reset(seed=4)
    for _ in range(120):
        observation, reward, terminated, _, info = env.step(np.full(1, 0.8, np.float32))
        _, rewards, ended, _, all_info = envs.step(np.full((3, 1), 0.8, np.float32))
        assert (reward, terminated) == (rewards[0], ended[0])
        assert info == {"guarded": terminated}
        if terminated:
            assert (observation == all_info["final_obs"][0]).all()
            break
    assert terminated


def test_a_seed_determines_the_episode_and_a_reset_without_a_seed_begins_the_next_one():
    env = QubeEnv(seed=5)
    first, info = env.reset()
    second, info = env.reset()
    assert info["episode_number"] == 1
    assert (first != second).any()
    again, info = env.reset(seed=5)
    assert (again == first).all() and info["episode_number"] == 0
    other, _ = env.reset(seed=6)
    assert (other != first).any()


def test_given_distributions_replace_distributions_of_the_model():
    env = QubeVectorEnv(
        16,
        model="robust",
        distributions={"M_p": Normal(0.03, 0.001), "command_delay_s": Uniform(0.01, 0.02), "R_m": 9.0},
    )
    env.reset(seed=1)
    qubes = [env.qube(number) for number in range(300)]
    delays = [qube["command_delay_s"] for qube in qubes]
    masses = [qube["M_p"] for qube in qubes]
    assert 0.01 <= min(delays) < 0.011 and 0.019 < max(delays) <= 0.02
    assert abs(np.mean(masses) - 0.03) < 0.0002 and 0.0008 < np.std(masses) < 0.0012
    assert {qube["R_m"] for qube in qubes} == {9.0}
    assert len({qube["coulomb_torque_n_m"] for qube in qubes}) > 200
    # A number of any kind is a constant.
    for number in [9, np.float32(9), np.int64(9)]:
        env = QubeEnv(distributions={"R_m": number})
        env.reset(seed=1)
        assert env.qube(0)["R_m"] == 9.0


def test_an_arm_that_is_pushed_turns_and_the_last_commands_are_observed():
    env = QubeEnv(settings="robust")
    observation, _ = env.reset(seed=0)
    assert observation.shape == (8,) and (observation[6:] == 0.0).all()
    env.step(np.array([0.3], np.float32))
    observation, *_ = env.step(np.array([-1.7], np.float32))
    # Actions are clipped to the motor's 5 V.
    assert np.allclose(observation[6:], [-1.0, 0.3])
    for push in [0.4, -0.4]:
        env.reset(seed=0)
        start = env.state[0]
        for _ in range(10):
            env.step(np.array([push], np.float32))
        assert np.sign(env.state[0] - start) == np.sign(push)


def test_a_second_thread_is_refused_and_disturbs_nothing():
    env = QubeVectorEnv(5000, model="robust")
    env.reset(seed=1)
    actions, ended = np.zeros((5000, 1), np.float32), threading.Event()
    seen, raised = [], []

    def drive():
        try:
            for _ in range(300):
                seen.append(env.step(actions)[0][0])
        except BaseException as error:
            raised.append(error)
        ended.set()

    thread = threading.Thread(target=drive, daemon=True)
    thread.start()
    refused = 0
    while not ended.is_set():
        try:
            # Between two steps of the other thread the shape is refused, which changes nothing either.
            env.step(np.zeros((5000, 2), np.float32))
        except qube_hil.BusyError:
            refused += 1
        except qube_hil.ActionError:
            pass
    thread.join()
    assert refused > 0 and raised == []
    alone = QubeEnv(model="robust")
    alone.reset(seed=1)
    assert all((alone.step(actions[0])[0] == observation).all() for observation in seen)


class Busy:
    """A simulation that another thread is calling."""

    def reset(self, *_):
        raise qube_hil.BusyError("busy")


@pytest.mark.parametrize("env", [QubeEnv(seed=3), QubeVectorEnv(2, seed=3)])
def test_a_reset_that_is_refused_has_no_effect(env):
    simulation, env._simulation = env._simulation, Busy()
    for seed in [None, 9]:
        with pytest.raises(qube_hil.BusyError):
            env.reset(seed=seed)
    env._simulation = simulation
    observation, _ = env.reset()
    expected, _ = env.reset(seed=3)
    assert (observation == expected).all()


def test_a_uniform_distribution_is_drawn_to_both_ends_or_refused():
    env = QubeEnv(distributions={"M_p": Uniform(0.01, 0.19), "coulomb_torque_n_m": Uniform(0.0, 0.1)})
    env.reset(seed=1)
    masses = [env.qube(number)["M_p"] for number in range(3000)]
    assert 0.01 <= min(masses) < 0.0102 and 0.1898 < max(masses) <= 0.19
    with pytest.raises(qube_hil.SettingsError, match=r"M_p: Uniform\(0, 1\).*between 0.05 and 0.95.*at most 19"):
        QubeEnv(distributions={"M_p": Uniform(0.0, 1.0)})


def test_a_number_that_is_too_large_for_single_precision_is_clipped():
    env = QubeEnv(settings={"history": 1})
    for number, clipped in [(1e300, 1.0), (-1e39, -1.0)]:
        env.reset()
        assert env.step(np.array([number]))[0][6] == clipped
    with pytest.raises(qube_hil.ActionError, match="array of numbers"):
        env.step([[0.0], [1.0, 2.0]])


def test_without_copies_each_step_overwrites_the_returned_arrays():
    env = QubeVectorEnv(4, copy=False)
    first, _ = env.reset(seed=0)
    second, *_ = env.step(np.ones((4, 1), np.float32))
    assert second is first
    env = QubeVectorEnv(4)
    first, _ = env.reset(seed=0)
    kept = first.copy()
    env.step(np.ones((4, 1), np.float32))
    assert (first == kept).all()


@pytest.mark.parametrize(
    "action, message",
    [
        (np.array([np.nan], np.float32), "finite"),
        (np.array([np.inf]), "finite"),
        (np.zeros(2, np.float32), "shape"),
        (np.zeros((1, 1)), "shape"),
        (np.zeros((1, 1), np.float32), "shape"),
        (np.float32(0.0), "shape"),
        (np.array(["1"]), "type"),
        (np.array([True]), "type"),
        (None, "type"),
    ],
)
def test_an_invalid_action_is_refused_and_moves_nothing(action, message):
    env = QubeEnv()
    env.reset(seed=0)
    before = env.state
    alone = "the action is not a finite" if message == "finite" else message
    with pytest.raises(qube_hil.ActionError, match=alone):
        env.step(action)
    assert (env.state == before).all()
    env = QubeVectorEnv(3)
    env.reset(seed=0)
    before = env.states
    actions = None if action is None else np.stack([np.zeros_like(action), action, action])
    message = "environment 1 is not a finite" if message == "finite" else message
    with pytest.raises(qube_hil.ActionError, match=message):
        env.step(actions)
    assert (env.states == before).all()


#: All weights of the reward; a reward in the settings must give each of them.
REWARD = {"theta": 0.2, "alpha": 1.0, "theta_dot": 0.02, "alpha_dot": 0.005, "voltage": 0.003}


@pytest.mark.parametrize(
    "settings, message",
    [
        ({"num_envs": 0}, "num_envs"),
        ({"num_envs": -1}, "num_envs = -1"),
        ({"num_envs": 2**70}, "num_envs"),
        ({"settings": None}, "None"),
        ({"distributions": [("M_p", 1.0)]}, "mapping"),
        ({"distributions": {"D_r": 1.0}}, "cannot be simulated.*D_r"),
        ({"distributions": {"R_m": 1e-3}}, "cannot be simulated.*R_m"),
        ({"distributions": {"L_p": 1e-6}}, "cannot be simulated.*L_p"),
        ({"distributions": {"command_delay_s": Uniform(-0.1, 0.1)}}, "from 0 to 0.04"),
        ({"distributions": {"M_p": Uniform(-0.1, 0.1)}}, "above 0"),
        ({"model": "none"}, "nominal, handcrafted"),
        ({"settings": "none"}, "thesis, machine, robust"),
        ({"settings": {"histroy": 2}}, "histroy"),
        ({"guard": "envelope"}, "box or foresight"),
        ({"settings": {"history": 5}}, "0 to 4"),
        ({"settings": {"reward": float("nan")}}, "settings: reward = nan: give a finite"),
        ({"settings": {"reward": {**REWARD, "alpha": np.float32("inf")}}}, r"settings: reward\.alpha = inf"),
        ({"settings": {"reward": {"theta": 1.0}}}, "settings: reward has no alpha"),
        ({"settings": {"reward": {**REWARD, "alpha": -1.0}}}, r"reward\.alpha = -1: give a number from 0 to 1 000 000"),
        ({"settings": {"reward": {**REWARD, "voltage": 1e308}}}, r"reward\.voltage = 1e308: give a number from 0"),
        ({"settings": {"safety_box": {"theta_rad": -1.0}}}, r"theta_rad = -1: give a number above 0, at most 2\.3"),
        ({"settings": {"safety_box": {"alpha_dot_rad_s": 1e9}}}, "alpha_dot_rad_s = 1e9: give a number above 0"),
        ({"settings": {"safety_box": {"guard": "foresight"}}}, 'guard = "foresight": leave it out, .*guard="foresight"'),
        ({"settings": {"safety_box": {"guard": 3}}}, "safety_box.guard = 3: leave it out"),
        ({"settings": {"sensors": {"type": "true_state", "estimator": {}}}}, "estimator beside sensors.type"),
        ({"settings": {"plant": {}}}, "settings: plant has no encoders: give all of"),
        ({"settings": {"plant": {"parameters": {}}}}, "settings: plant.parameters has no"),
        (
            {"settings": {"sensors": {"type": "encoders", "estimator": {"observer": {"model": {}}}}}},
            "sensors.estimator.observer.model has no",
        ),
        ({"settings": {"history": object()}}, "settings: history = <object .*: give a number, a text"),
        ({"settings": {"reward": {**REWARD, "alpha": "a"}}}, r'reward\.alpha = "a": give a number'),
        ({"settings": {"sensors": 3}}, "settings: sensors = 3: give a mapping with entries of .*type"),
        ({"settings": {"sensors": {"type": "camera"}}}, "sensors.type = .camera.: give true_state or encoders"),
        ({"settings": {"sensors": {}}}, "sensors has no type: give true_state or encoders"),
        ({"settings": {"sensors": {"type": "encoders", "filter": 1}}}, "no entry sensors.filter: give some of"),
        ({"settings": {"safety_box": {"theta_rad": None}}}, "safety_box.theta_rad = null: give a number"),
        ({"settings": {"safety_box": {"beta_rad": 1.0}}}, "no entry safety_box.beta_rad: .*theta_rad"),
        ({"settings": {"history": 1.5}}, "history = 1.5: give a whole number from 0 to 4"),
        ({"settings": 3}, "settings = 3: give thesis, machine, robust"),
        ({"settings": {"sensors": {"type": "encoders", "estimator": {"corner_rad_s": 1e300}}}}, "= 1e300: "),
        ({"model": 3}, "model = 3: give nominal"),
        ({"model": "profiles/lab.toml"}, "profile='profiles/lab.toml'|profile=\"profiles/lab.toml\""),
        ({"model": "lab"}, 'profile="lab"'),
        ({"model": "robust", "profile": "lab"}, "beside profile"),
        ({"profile": "missing.toml"}, "profile: missing.toml.*identify wrote"),
        ({"profile": 3}, "profile = 3"),
        ({"profile": "lab", "spread": 2.0}, "spread = 2.0: give a number from 0 to 1"),
        ({"profile": "lab", "spread": "a"}, "spread = 'a'"),
        ({"spread": 0.1}, "spread = 0.1 without profile"),
        ({"guard": 3}, "guard = 3"),
        ({"settings": {"sensors": {"type": "encoders", "estimator": {"corner_rad_s": -1.0}}}}, "corner"),
        ({"distributions": {"M_x": 1.0}}, "M_x"),
        ({"distributions": {"M_p": "heavy"}}, "heavy"),
        ({"distributions": {"M_p": -1.0}}, "M_p"),
        ({"distributions": {"M_p": float("nan")}}, "finite"),
        ({"distributions": {"M_p": 10**400}}, "finite"),
        ({"distributions": {"command_delay_s": Uniform(0.0, 0.2)}}, "command_delay_s"),
        ({"distributions": {"command_delay_s": 0.2}}, "mean of command_delay_s is 0.2"),
        ({"distributions": {"coulomb_torque_n_m": Normal(0.001, 0.1)}}, "deviation of coulomb_torque_n_m is 0.1"),
        ({"distributions": {"M_p": 1e300}}, "M_p is 1e300, "),
        ({"seed": -1}, "seed"),
        ({"seed": 1.5}, "seed"),
        ({"render_mode": "human"}, "render_mode"),
    ],
)
def test_impossible_settings_are_named_in_the_error(settings, message):
    with pytest.raises(qube_hil.SettingsError, match=message):
        QubeVectorEnv(**settings)
    with pytest.raises(ValueError):
        QubeVectorEnv(**settings)


def test_nothing_moves_before_a_reset():
    for env in [QubeEnv(), QubeVectorEnv(1)]:
        with pytest.raises(qube_hil.EpisodeOverError):
            env.step(np.zeros(env.action_space.shape, np.float32))
    with pytest.raises(qube_hil.SettingsError, match="seed"):
        QubeVectorEnv(2).reset(seed=[1, 2])
    for number in [-1, 2**64, 1.5]:
        with pytest.raises(qube_hil.SettingsError, match="episode_number"):
            QubeEnv().qube(number)


@pytest.mark.parametrize(
    "kind, numbers, message",
    [
        (qube_hil.Constant, ("x",), "value = 'x'.*number"),
        (qube_hil.Constant, (float("nan"),), "value = nan: give a finite number"),
        (Normal, (float("nan"), 1.0), "nan.*finite"),
        (Normal, (0.0, float("inf")), "inf.*finite"),
        (Normal, (1.0, -1.0), "0 or more"),
        (Uniform, (0.0, float("inf")), "inf.*finite"),
        (Uniform, ("a", "b"), "'a'.*number"),
        (Uniform, (2.0, 1.0), "smaller"),
    ],
)
def test_a_distribution_with_impossible_numbers_cannot_be_made(kind, numbers, message):
    with pytest.raises(qube_hil.SettingsError, match=message):
        kind(*numbers)


def test_an_option_of_reset_is_refused():
    for env in [QubeEnv(), QubeVectorEnv(2)]:
        env.reset(seed=0, options={})
        with pytest.raises(qube_hil.SettingsError, match="reset_mask.*reset takes none"):
            env.reset(options={"reset_mask": np.array([True, False])})


def test_a_closed_simulation_refuses_further_calls():
    for env in [QubeEnv(), QubeVectorEnv(2)]:
        env.reset(seed=0)
        env.close()
        env.close()
        for call in [env.reset, lambda: env.step(np.zeros(env.action_space.shape, np.float32))]:
            with pytest.raises(qube_hil.ClosedError, match="make another"):
                call()


def test_qubes_around_a_profile_differ_by_its_errors_with_their_correlations():
    env = QubeEnv(profile="lab", spread=0.0)
    distribution = json.loads(env._simulation.distribution)
    directions = distribution["directions"]
    assert len(directions) > 3
    env.reset(seed=1)
    drawn = [env.qube(number) for number in range(4000)]

    def covariance(one, other):
        return sum(direction.get(one, 0.0) * direction.get(other, 0.0) for direction in directions)

    one, other = "R_m", "k_m"
    expected = covariance(one, other) / np.sqrt(covariance(one, one) * covariance(other, other))
    assert abs(expected) > 0.2
    found = np.corrcoef([qube[one] for qube in drawn], [qube[other] for qube in drawn])[0, 1]
    assert abs(found - expected) < 0.05
    # A Qube out of its range, such as one with a negative dead zone, is drawn anew, which moves the means by less than
    # their standard errors.
    mean, error = distribution[one]["mean"], np.sqrt(covariance(one, one))
    assert abs(np.mean([qube[one] for qube in drawn]) - mean) < error
    assert all(qube[name] >= 0.0 for qube in drawn for name in ("D_r", "D_p", "positive_dead_zone_v"))
    # The spread widens the distribution beyond the profile's errors, and a distribution that the caller gives replaces
    # the profile's.
    wide = QubeVectorEnv(2, profile="lab", distributions={"command_delay_s": 0.01})
    wide.reset(seed=1)
    assert np.std([wide.qube(number)[one] for number in range(1000)]) > np.std([qube[one] for qube in drawn])
    assert json.loads(wide._simulation.distribution)["command_delay_s"] == {"type": "constant", "value": 0.01}
    assert QubeEnv(profile="ideal", spread=0.0).qube(0) == QubeEnv().qube(0)


def test_an_environment_is_neither_copied_nor_pickled():
    for env in [QubeEnv(), QubeVectorEnv(2)]:
        for duplicate in [copy.copy, copy.deepcopy, pickle.dumps]:
            for kind in [qube_hil.CopyError, qube_hil.QubeHilError, TypeError]:
                with pytest.raises(kind, match=f"{type(env).__name__} cannot be copied or pickled.*make another"):
                    duplicate(env)


def test_every_environment_takes_the_same_seeds():
    for env in [QubeEnv(), QubeVectorEnv(1)]:
        first, _ = env.reset(seed=1)
        for seed in [np.int64(1), np.uint8(1)]:
            assert (env.reset(seed=seed)[0] == first).all()
        env.reset(seed=2**64 - 1)
        for seed in [-1, 2**64, 1.0, "1", True]:
            with pytest.raises(qube_hil.SettingsError, match=f"seed = {seed!r}"):
                env.reset(seed=seed)


def test_there_is_no_state_before_a_reset():
    one, many = QubeEnv(), QubeVectorEnv(2)
    for read in [lambda: one.state, lambda: many.states]:
        with pytest.raises(qube_hil.EpisodeOverError, match="call reset"):
            read()
    one.reset(seed=1)
    many.reset(seed=1)
    assert (one.state == many.states[0]).all() and np.abs(one.state[:2]).max() > 0.0
    # The last state can be read after the environment is closed.
    many.close()
    assert many.states.shape == (2, 4)


def test_an_action_may_be_a_view_of_the_last_observations():
    fast, slow = QubeVectorEnv(3, copy=False), QubeVectorEnv(3)
    observations, expected = fast.reset(seed=1)[0], slow.reset(seed=1)[0]
    for _ in range(5):
        observations, rewards, *_ = fast.step(observations[:, :1])
        expected, same_rewards, *_ = slow.step(expected[:, :1])
        assert (observations == expected).all() and (rewards == same_rewards).all()
    fast.step(rewards.reshape(3, 1))


def test_a_simulated_box_may_name_the_guard_that_it_has():
    boxes = {"theta_rad": 1.7, "guard": "box"}, {"theta_rad": 1.7}
    named, unnamed = (QubeEnv(settings={"safety_box": box}).reset(seed=1)[0] for box in boxes)
    assert (named == unnamed).all()
