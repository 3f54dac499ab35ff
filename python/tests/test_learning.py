"""Tests of training, policies and identification."""

import _thread
import copy
import math
import os
import pickle
import threading
import time
from pathlib import Path

import numpy as np
import pandas
import pytest
from conftest import program

import qube_hil
from qube_hil import Normal, Policy, QubeVectorEnv

SMALL = {"updates": 3, "epochs": 1, "num_envs": 16}

#: A profile with correlated errors.
PROFILE = """
name = "mine"

[parameters]
R_m = 9.1
k_m = 0.037

[gap]
coulomb_torque_n_m = 0.0004
command_delay_s = 0.004

[standard_errors]
R_m = 0.5
k_m = 0.002

[correlations]
names = ["R_m", "k_m"]
rows = [[1.0], [0.9, 1.0]]
"""


def test_a_training_gives_the_bytes_of_the_command(tmp_path):
    file = tmp_path / "mine.safetensors"
    program("train", "--model", "robust", "--preset", "quick", "--seed", 3, "--out", file)
    updates = []
    trained = qube_hil.train("robust", seed=3, callback=updates.append)
    assert trained.policy.to_bytes() == file.read_bytes()
    assert [update["update"] for update in updates] == list(range(60))
    assert (trained.curve["mean_return"] == [update["mean_return"] for update in updates]).all()
    assert trained.best_return == trained.curve["mean_return"].max()
    assert trained.policy.training["best_return"] == trained.best_return
    randomisation = trained.policy.randomisation
    resistance = randomisation["R_m"]
    assert (resistance.mean, resistance.standard_deviation) == (8.4, pytest.approx(0.84))
    assert randomisation["g"] == qube_hil.Constant(9.81)
    delay = randomisation["command_delay_s"]
    assert (delay.lower, delay.upper) == pytest.approx((0.0, 0.016))
    again = qube_hil.train("nominal", seed=3, distributions=randomisation, **SMALL).policy
    assert again.randomisation.keys() == randomisation.keys()
    assert again.randomisation["M_p"] == randomisation["M_p"]


def test_a_training_around_a_profile_gives_the_bytes_of_the_command(tmp_path):
    profile = tmp_path / "mine.toml"
    profile.write_text(PROFILE)
    found = qube_hil.Identified({}, "fits", [], profile.read_text(), [], [])
    for given, named in [("lab", {}), (profile, {"spread": 0.2}), (found, {"spread": 0.2})]:
        file = tmp_path / "around.safetensors"
        given_to_command = profile if given is found else given
        options = [it for name, value in named.items() for it in (f"--{name}", value)]
        program(
            "train", "--profile", given_to_command, *options, "--preset", "quick", "--seed", 3, "--out", file, "--force",
        )
        policy = qube_hil.train(profile=given, seed=3, **named).policy
        assert policy.sizes[0] == 8 and policy.randomisation["R_m"].standard_deviation > 0.0
        if given is found:
            assert policy.training["model"] == "around mine"
            observations = np.random.default_rng(0).uniform(-1.0, 1.0, (50, 8)).astype(np.float32)
            assert (policy.act(observations) == Policy.load(file).act(observations)).all()
        else:
            assert policy == Policy.load(file)


def test_wrong_arguments_are_named_in_the_error():
    for wrong in [{"model": 3}, {"preset": 3}, {"simulation": 3}, {"callback": 3}, {"profile": 3}, {"updates": "many"}]:
        (name,) = wrong
        with pytest.raises(qube_hil.SettingsError, match=name):
            qube_hil.train(**wrong)
    found = qube_hil.Identified({}, "fits", [], 5000 * "x", [], [])
    box = {"safety_box": {"theta_rad": -1.0}}
    for wrong, message in [
        ({"learning_rate": math.nan}, "^learning_rate = nan: give a finite number$"),
        ({"learning_rate": None}, "^learning_rate = None: give a number, 0 to 1$"),
        ({"learning_rate": 2.0}, "^learning_rate = 2: give 0 to 1$"),
        ({"updates": -1}, "^updates = -1: give a whole number, 1 to 1 000 000$"),
        ({"updates": 1.5}, r"^updates = 1\.5: give a whole number, 1 to 1 000 000$"),
        ({"updates": 0}, "^updates = 0: give 1 to 1 000 000$"),
        ({"num_envs": 10**9}, "^num_envs = 1000000000: give a whole number, 16 to 4096$"),
        ({"target_return": "a"}, '^target_return = "a": give a number, 0 to 600$'),
        ({"adam_epsilon_beside_root": 3}, "^adam_epsilon_beside_root = 3: give True or False$"),
        ({"rate": 1.0}, '^a training has no setting "rate": give some of .*learning_rate'),
        ({"clip": object()}, "^clip = <object .*: give a number"),
        ({"initial": found}, r"^initial = Identified\(.*\.\.\.: give a Policy"),
        ({"simulation": box}, r"^simulation: safety_box\.theta_rad = -1: give a number above 0"),
        ({"simulation": {"safety_box": {"theta_rad": 3.0}}}, r"theta_rad = 3: .*at most 2\.3$"),
        ({"simulation": {"safety_box": {"guard": "foresight"}}}, 'guard = "foresight": .*no guard but the box'),
    ]:
        with pytest.raises(qube_hil.SettingsError, match=message) as refused:
            qube_hil.train(**wrong)
        assert len(str(refused.value)) < 500
    for wrong, message in [
        ({"recordings": 3}, "recordings = 3"),
        ({"recordings": [3]}, "recordings"),
        ({"recordings": {"tick": np.zeros(9)}}, "^recordings = {'tick'.*give paths of recordings"),
        ({"recordings": b"x"}, "recordings = b'x'"),
        ({"recordings": [], "fixed": 3}, "fixed = 3"),
        ({"recordings": [], "fixed": "R_x"}, '"R_x"'),
        ({"recordings": [], "name": 3}, "name = 3"),
    ]:
        with pytest.raises(qube_hil.SettingsError, match=message):
            qube_hil.identify(**wrong)


def test_policies_with_the_same_bytes_are_equal():
    policy = qube_hil.train(**SMALL).policy
    for data in [policy.to_bytes(), bytearray(policy.to_bytes()), memoryview(policy.to_bytes())]:
        assert Policy.from_bytes(data) == policy and hash(Policy.from_bytes(data)) == hash(policy)
    assert policy != qube_hil.train(**SMALL, seed=1).policy and policy != "policy"
    with pytest.raises(qube_hil.SettingsError, match="data = 3"):
        Policy.from_bytes(3)


def test_an_observation_may_be_a_tensor_with_a_gradient():
    class Tensor:
        def detach(self):
            return self

        def cpu(self):
            return np.zeros(6)

        def __array__(self, *_, **__):
            raise RuntimeError("Can't call numpy() on Tensor that requires grad.")

    policy = qube_hil.train(**SMALL).policy
    assert policy.act(Tensor()) == policy.act(np.zeros(6))


def test_a_training_with_settings_of_the_command_gives_the_bytes_of_the_command(tmp_path):
    file = tmp_path / "quiet.safetensors"
    program("train", "--preset", "quick", "--model", "nominal", "--seed", 3, "--voltage-change-weight", 0.1, "--out", file)
    trained = qube_hil.train("nominal", seed=3, voltage_change_weight=0.1)
    assert trained.policy.training["preset"] == "quick"
    assert trained.policy.to_bytes() == file.read_bytes()


def test_settings_may_be_numbers_of_numpy_and_infinite_where_that_means_no_limit():
    named = {name: np.int64(value) for name, value in SMALL.items()}
    trained = qube_hil.train(
        **named,
        largest_gradient_norm=math.inf,
        learning_rate=np.float32(1e-3),
        simulation={"history": np.int64(1), "sensors": {"type": "encoders"}},
        distributions={"M_p": np.float32(0.03)},
    )
    assert trained.policy.observation_size == 7
    for wrong in [{"learning_rate": math.inf}, {"updates": object()}, {"initial": "policy.safetensors"}]:
        with pytest.raises(qube_hil.SettingsError):
            qube_hil.train(**wrong)
    with pytest.raises(qube_hil.SettingsError, match="Policy.load"):
        qube_hil.train(initial="policy.safetensors")


def test_a_policy_is_pickled_copied_and_shared_by_threads(swing_up):
    network = qube_hil.train(**SMALL).policy
    observations = np.random.default_rng(0).normal(size=(20_000, 6)).astype(np.float32)
    expected = network.act(observations)
    for policy in [network, qube_hil.recording(swing_up).policy]:
        for again in [pickle.loads(pickle.dumps(policy)), copy.deepcopy(policy), copy.copy(policy)]:
            assert again.to_bytes() == policy.to_bytes() and again.kind == policy.kind
    results = [None] * 4

    def act(index):
        results[index] = [network.act(observations) for _ in range(10)]

    threads = [threading.Thread(target=act, args=[index]) for index in range(len(results))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert all((actions == expected).all() for actions_of_one in results for actions in actions_of_one)


def test_a_trained_policy_has_in_the_environment_the_return_that_its_training_reports():
    trained = qube_hil.train(seed=1)
    env = QubeVectorEnv(100)
    observations, _ = env.reset(seed=11)
    returns = np.zeros(100)
    for _ in range(qube_hil.MAX_STEPS):
        observations, rewards, terminated, _, _ = env.step(trained.policy.act(observations))
        assert not terminated.any()
        returns += rewards
    assert trained.best_return > 400.0
    assert abs(returns.mean() - trained.best_return) < 0.1 * trained.best_return


def test_an_exception_of_the_callback_ends_the_training():
    def ends(update):
        raise LookupError(f"in update {update['update']}")

    with pytest.raises(LookupError, match="in update 0"):
        qube_hil.train(callback=ends)


def test_ctrl_c_ends_the_training():
    begun = threading.Event()

    def interrupt():
        begun.wait()
        _thread.interrupt_main()

    interrupter = threading.Thread(target=interrupt, daemon=True)
    interrupter.start()
    with pytest.raises(KeyboardInterrupt):
        qube_hil.train(preset="thesis", updates=1_000_000, callback=lambda _: begun.set())
    interrupter.join()


def test_settings_and_distributions_are_taken_and_recorded():
    trained = qube_hil.train(
        distributions={"M_p": Normal(0.03, 0.001)}, simulation="robust", **SMALL
    )
    assert len(trained.curve["update"]) == 3
    assert trained.policy.sizes == [8, 64, 64, 1]
    assert trained.policy.training["preset"] == "custom"
    assert "M_p" in trained.policy.training["model"]
    for wrong in [{"updates": 0}, {"epoch": 1}, {"updates": "many"}, {"preset": "none"}, {"seed": -1}]:
        with pytest.raises(qube_hil.SettingsError):
            qube_hil.train(**wrong)
    with pytest.raises(qube_hil.SettingsError, match='no setting "epoch": .* epochs, '):
        qube_hil.train(epoch=1)


def test_settings_that_a_record_leaves_out_at_their_defaults_can_be_changed():
    plain = qube_hil.train(**SMALL)
    for change in [{"worst_share": 0.25}, {"adam_epsilon_beside_root": True}]:
        changed = qube_hil.train(**SMALL, **change)
        assert changed.policy.training["preset"] == "custom"
        assert changed.policy.to_bytes() != plain.policy.to_bytes()
    with pytest.raises(qube_hil.SettingsError, match="worst_share"):
        qube_hil.train(worst_share=0.0)


def test_a_training_goes_on_from_a_policy_as_the_command_does(tmp_path):
    first = qube_hil.train(**SMALL)
    first.policy.save(tmp_path / "first.safetensors")
    further = qube_hil.train("handcrafted", initial=first.policy, seed=2)
    program(
        "train", "--model", "handcrafted", "--preset", "quick", "--seed", 2,
        "--from", tmp_path / "first.safetensors", "--out", tmp_path / "further.safetensors",
    )
    command = Policy.load(tmp_path / "further.safetensors")
    observations = np.random.default_rng(0).uniform(-1.0, 1.0, (50, 6)).astype(np.float32)
    assert (command.act(observations) == further.policy.act(observations)).all()
    assert further.policy.training["model"] == "handcrafted from a policy"
    # At a learning rate of almost 0 the result is the initial policy, whose return is higher than the return of
    # `first`.
    still = qube_hil.train("handcrafted", initial=further.policy, seed=3, updates=1, learning_rate=1e-9)
    assert still.best_return > first.best_return
    for wrong, message in [
        (Policy.from_layers([(np.ones((4, 6)), None), (np.ones((1, 4)), None)], action_scale_v=5.0), "starts from"),
        (qube_hil.train("robust", **SMALL).policy, "starts from"),
    ]:
        with pytest.raises(qube_hil.PolicyError, match=message):
            qube_hil.train(initial=wrong, **SMALL)


def a_fit_runs():
    """Returns whether a thread of this process computes a fit."""
    for thread in Path("/proc/self/task").iterdir():
        try:
            if (thread / "comm").read_text() == "identify\n":
                return True
        except OSError:
            # The thread has ended.
            pass
    return False


def test_ctrl_c_ends_an_identification_at_once(tmp_path):
    # The fit of ten recordings takes much longer than the interrupter and the check for Ctrl-C.
    folder = tmp_path / "run"
    program("run", "--clock", "virtual", "--policy", "classical", "--rollouts", 10, "--out", folder)
    recordings = sorted(folder.glob("*.mcap"))
    assert len(recordings) == 10

    def interrupt():
        limit_s = time.monotonic() + 60.0
        while not a_fit_runs() and time.monotonic() < limit_s:
            time.sleep(0.001)
        _thread.interrupt_main()

    interrupter = threading.Thread(target=interrupt, daemon=True)
    with pytest.raises(KeyboardInterrupt):
        interrupter.start()
        qube_hil.identify(recordings)
    assert a_fit_runs(), "the exception has waited for the fit"
    interrupter.join()


def test_a_policy_is_saved_and_read(tmp_path):
    policy = qube_hil.train(**SMALL).policy
    file = tmp_path / "p.safetensors"
    policy.save(file)
    again = Policy.load(file)
    assert again.to_bytes() == policy.to_bytes() == file.read_bytes()
    with pytest.raises(qube_hil.PolicyError, match="exists already"):
        policy.save(file)
    policy.save(file, force=True)
    observations = np.random.default_rng(0).normal(size=(50, 6)).astype(np.float32)
    assert (again.act(observations) == policy.act(observations)).all()
    single = policy.act(observations[7])
    assert single.shape == (1,) and single == policy.act(observations)[7]
    assert np.abs(policy.act(1e3 * observations)).max() <= 1.0


def test_saving_a_policy_replaces_nothing_but_files(tmp_path):
    policy = qube_hil.train(**SMALL).policy
    pipe, folder, link = tmp_path / "pipe", tmp_path / "folder", tmp_path / "link"
    os.mkfifo(pipe)
    folder.mkdir()
    for place in [pipe, folder]:
        for force in [True, False]:
            with pytest.raises(qube_hil.PolicyError, match=f"{place}: it is not a file: give a file"):
                policy.save(place, force=force)
    assert pipe.is_fifo() and folder.is_dir()
    # The link is replaced, and the pipe to which it leads is not.
    link.symlink_to(pipe)
    with pytest.raises(qube_hil.PolicyError, match="exists already"):
        policy.save(link)
    policy.save(link, force=True)
    assert pipe.is_fifo() and link.is_file() and not link.is_symlink()
    assert sorted(tmp_path.iterdir()) == [folder, link, pipe]
    # Nothing can compute the ledger of a session again.
    ledger = tmp_path / "ledger.jsonl"
    ledger.write_text("{}\n")
    with pytest.raises(qube_hil.PolicyError, match="which nothing replaces: give another name"):
        policy.save(ledger, force=True)
    assert ledger.read_text() == "{}\n"


def test_paths_of_a_wrong_type_are_named_in_the_error(tmp_path):
    policy = qube_hil.train(**SMALL).policy
    for wrong in [b"x", None, 1]:
        for name, call in [
            ("path", Policy.load),
            ("path", lambda path: Policy.from_onnx(path, action_scale_v=5.0)),
            ("path", policy.save),
            ("path", qube_hil.recording),
            ("folder", qube_hil.Session),
            ("folder", qube_hil.Surrogate),
        ]:
            with pytest.raises(qube_hil.SettingsError, match=f"{name} = {wrong!r}: give the path of a"):
                call(wrong)
    with pytest.raises(qube_hil.SettingsError, match="force = 'yes'"):
        policy.save(tmp_path / "p.safetensors", force="yes")


def test_a_bad_policy_or_observation_is_refused(tmp_path):
    with pytest.raises(qube_hil.PolicyError, match="missing"):
        Policy.load(tmp_path / "missing")
    with pytest.raises(qube_hil.PolicyError, match="safetensors"):
        Policy.from_bytes(b"nothing")
    policy = qube_hil.train(**SMALL).policy
    for wrong in [np.zeros(5), np.zeros((2, 3, 6)), np.full(6, np.nan), "x", None, np.ones(6) + 1j, ["0"] * 6]:
        with pytest.raises(qube_hil.ActionError):
            policy.act(wrong)


def test_the_classical_controller_swings_up_a_simulated_qube(swing_up):
    policy = qube_hil.recording(swing_up).policy
    assert (policy.kind, policy.sizes, policy.training) == ("classical", None, None)
    assert policy.randomisation is None
    env = qube_hil.QubeEnv(settings="machine")
    observation, _ = env.reset(seed=0)
    total = 0.0
    for _ in range(qube_hil.MAX_STEPS):
        observation, reward, terminated, _, _ = env.step(policy.act(observation))
        assert not terminated
        total += reward
    assert total > 400.0


def test_a_classical_controller_keeps_the_state_of_one_qube_until_start_is_called(swing_up):
    policy = qube_hil.recording(swing_up).policy

    def at(from_upright):
        alpha = np.pi - from_upright
        return np.array([0.0, 1.0, np.sin(alpha), np.cos(alpha), 0.0, 0.0], np.float32)

    # Between the angles at which balancing begins and ends, the voltage depends on the observation before.
    swinging = policy.act(at(0.5))
    policy.act(at(0.1))
    assert policy.act(at(0.5)) != swinging
    policy.start()
    assert policy.act(at(0.5)) == swinging
    assert policy.act(np.stack([at(0.5)])) == swinging
    with pytest.raises(qube_hil.ActionError, match="one observation at a time"):
        policy.act(np.stack([at(0.1), at(0.5)]))


def test_a_qube_is_identified_from_its_recordings(tmp_path):
    program(
        "run", "--clock", "virtual", "--excite", "chirp", "--rollouts", 2, "--profile", "lab",
        "--out", tmp_path / "chirps",
    )
    recordings = sorted((tmp_path / "chirps").glob("*.mcap"))
    found = qube_hil.identify(recordings)
    assert found.verdict in ("fits", "fits_but")
    resistance = found.estimates["R_m"]
    assert resistance.standard_error > 0.0
    assert found.incomplete == []
    cut = tmp_path / "cut.mcap"
    data = recordings[0].read_bytes()
    cut.write_bytes(data[: len(data) * 9 // 10])
    (incomplete,) = qube_hil.identify([recordings[1], cut]).incomplete
    assert incomplete.file == str(cut) and "missing" in incomplete.reason
    assert 2.0 <= incomplete.used_s <= 10.0
    short = tmp_path / "short.mcap"
    short.write_bytes(data[: len(data) // 5])
    found = qube_hil.identify([recordings[1], short])
    assert [it.file for it in found.left_out] == [str(short)] and found.incomplete == []
    with pytest.raises(qube_hil.IdentificationError, match="it lasts"):
        qube_hil.identify([short])
    again = tmp_path / "chirps" / ".." / "chirps" / recordings[0].name
    with pytest.raises(qube_hil.IdentificationError, match="named twice"):
        qube_hil.identify([recordings[0], again])
    file = tmp_path / "found.toml"
    file.write_text(found.profile)
    program("train", "--profile", file, "--preset", "quick", "--out", tmp_path / "around.safetensors")
    with pytest.raises(qube_hil.SettingsError, match="R_x"):
        qube_hil.identify(recordings, fixed=["R_x"])
    held = qube_hil.identify(str(recordings[0]), fixed="R_m")
    assert "R_m" not in held.estimates or held.estimates["R_m"].standard_error == 0.0
    env = QubeVectorEnv(2, profile=found, settings="robust")
    env.reset(seed=1)
    assert env.qube(0)["R_m"] != env.qube(1)["R_m"]
    with pytest.raises(qube_hil.SettingsError, match="recordings = .*give paths of recordings") as refused:
        qube_hil.identify(qube_hil.recording(recordings[0]))
    assert len(str(refused.value)) < 500
    with pytest.raises(qube_hil.IdentificationError):
        qube_hil.identify([])
    with pytest.raises(qube_hil.IdentificationError, match="missing.mcap"):
        qube_hil.identify(tmp_path / "missing.mcap")


def test_a_table_has_phases_as_numbers_or_names_and_the_refusal_of_another_value_gives_its_line(tmp_path):
    program("run", "--clock", "virtual", "--excite", "chirp", "--profile", "lab", "--out", tmp_path / "chirp")
    program("export", tmp_path / "chirp" / "rollout-0.mcap", "--out", tmp_path)
    exported = pandas.read_csv(tmp_path / "rollout-0.csv")
    values = qube_hil.identify(tmp_path / "rollout-0.csv").estimates

    def identified(table):
        table.to_csv(tmp_path / "table.csv", index=False)
        return qube_hil.identify(tmp_path / "table.csv")

    names = exported.assign(phase=exported["phase"].map({0: "settling", 1: "running", 2: "braking"}))
    assert identified(names).estimates == identified(exported.astype({"phase": float})).estimates == values
    # Recording, export and table have the same motion.
    read = identified(pandas.DataFrame(qube_hil.recording(tmp_path / "chirp" / "rollout-0.mcap")))
    assert read.estimates == values == qube_hil.identify(tmp_path / "chirp" / "rollout-0.mcap").estimates
    for column, value, message in [
        ("phase", "abc", "line 302: `abc` in column `phase` is no phase: give 0 or settling, 1 or running"),
        ("phase", "7", "line 302: `7` in column `phase`"),
        ("voltage_v", "1e300", "line 302: `1e300` in column `voltage_v` is no voltage that"),
        ("applied_mv", "abc", "line 302: `abc` in column `applied_mv` is not a finite number"),
    ]:
        wrong = exported.astype({column: object})
        wrong.loc[300, column] = value
        with pytest.raises(qube_hil.IdentificationError, match=message):
            identified(wrong)
