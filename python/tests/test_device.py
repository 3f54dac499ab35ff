"""A Qube that Python drives: the emulated one, mostly in virtual time."""

import contextlib
import copy
import gc
import json
import os
import pickle
import shutil
import signal
import subprocess
import sys
import textwrap
import threading

import numpy as np
import pytest
from conftest import PROGRAM, beside, program

import qube_hil
from qube_hil import QubeDeviceEnv


@pytest.fixture
def virtual(tmp_path):
    """Makes environments in virtual time, and closes them."""
    made = []

    def make(**options):
        options = {"clock": "virtual", "recordings": tmp_path / "episodes", **options}
        made.append(QubeDeviceEnv(**options))
        return made[-1]

    yield make
    for env in made:
        env.close()


def episode(env, act, **reset):
    """Runs an episode. Returns its rewards, whether it was terminated, the last info, and the observations."""
    observation, _ = env.reset(**reset)
    rewards, observations = [], [observation]
    while True:
        observation, reward, terminated, truncated, info = env.step(act(observation))
        rewards.append(reward)
        observations.append(observation)
        if terminated or truncated:
            return rewards, terminated, info, observations


def replayed(path):
    """The program's report of the replay of a recording."""
    (report,) = json.loads(program("replay", "--json", path).splitlines()[-1])["recordings"]
    return report


@pytest.fixture(scope="session")
def classical(swing_up):
    return qube_hil.recording(swing_up).policy


def test_the_classical_controller_swings_up_from_python_and_its_recording_replays(
    virtual, classical
):
    env = virtual()
    assert env.deadline_ms is None
    rewards, terminated, info, observations = episode(env, classical.act)
    assert not terminated and info["ending"] == "completed" and len(rewards) == 600
    assert info["return"] > 400.0 and info["late_answers"] == 0 and info["ticks"] == 1
    # No sample is lost here, so every tick requests a voltage from Python.
    assert np.isclose(sum(rewards), info["return"])
    read = qube_hil.recording(info["recording"])
    running = read["phase"] == "running"
    assert read.return_ == info["return"] and running.sum() == 600
    assert np.isclose(info["voltage_v"], read["voltage_v"][running][-1], atol=1e-6)
    seen = np.sin(read["theta_rad"][running]).astype(np.float32)
    assert np.allclose([observation[0] for observation in observations[:-1]], seen, atol=1e-6)
    assert read.policy.kind == "external"
    again = replayed(info["recording"])
    assert again["actions_different"] == 0 and again["actions_compared"] == len(read["tick"])
    with pytest.raises(qube_hil.PolicyError, match="outside"):
        read.policy.act(observations[0])
    # The recording's policy is a name, which cannot be run.
    file = info["recording"].with_suffix(".safetensors")
    file.write_bytes(read.policy.to_bytes())
    program("run", "--clock", "virtual", "--policy", file, code=2)


def test_the_same_actions_give_the_same_bytes(virtual, classical, tmp_path):
    recordings = []
    for folder in ["first", "second"]:
        env = virtual(recordings=tmp_path / folder, seed=4)
        for _ in range(2):
            recordings.append(episode(env, classical.act)[2]["recording"])
    first, other, again, again_other = [path.read_bytes() for path in recordings]
    assert (first, other) == (again, again_other) and first != other
    assert [path.name for path in recordings] == ["episode-0000.mcap", "episode-0001.mcap"] * 2


def test_the_guard_takes_over_and_a_refused_voltage_replays_too(virtual):
    env = virtual()
    _, terminated, info, _ = episode(env, lambda _: np.ones(1, np.float32))
    assert terminated and "brake" in info["ending"]
    outcome = qube_hil.recording(info["recording"]).outcome
    assert outcome["ending"]["kind"] == "left_box" and outcome["last_answer_v"] == 5.0
    assert replayed(info["recording"])["actions_different"] == 0
    env = virtual(guard="box")
    _, terminated, info, _ = episode(env, lambda _: np.ones(1, np.float32))
    assert terminated and "theta" in info["ending"]
    assert replayed(info["recording"])["actions_different"] == 0


def test_a_recording_with_a_changed_byte_is_refused(virtual):
    env = virtual()
    _, _, info, _ = episode(env, lambda seen: -seen[:1])
    data = info["recording"].read_bytes()
    assert replayed(info["recording"])["actions_different"] == 0
    middle = len(data) // 2
    info["recording"].write_bytes(data[:middle] + bytes([data[middle] ^ 1]) + data[middle + 1 :])
    program("replay", info["recording"], code=2)


def test_an_exception_or_a_reset_in_the_middle_brakes(virtual):
    env = virtual()
    observation, _ = env.reset()
    for _ in range(10):
        observation, *_ = env.step(np.array([0.2], np.float32))
    first = env._recording
    for wrong, told in [
        (np.array([np.nan], np.float32), "finite"),
        (np.zeros(2, np.float32), "shape"),
        (np.array(["1"]), "type"),
        ([[0.0], [1.0, 2.0]], "array of numbers"),
    ]:
        with pytest.raises(qube_hil.ActionError, match=told):
            env.step(wrong)
        with pytest.raises(qube_hil.EpisodeOverError):
            env.step(np.zeros(1, np.float32))
        read = qube_hil.recording(env._recording)
        assert read.outcome["ending"]["kind"] == "stopped" and read["phase"][-1] == "braking"
        env.reset()
        env.step(np.zeros(1, np.float32))
    assert replayed(first)["actions_different"] == 0
    # A reset ends the running episode.
    running = env._recording
    env.reset()
    assert qube_hil.recording(running).outcome["ending"]["kind"] == "stopped"


def test_a_closed_qube_and_a_forked_process_are_refused(virtual):
    env = virtual()
    with pytest.raises(qube_hil.EpisodeOverError):
        env.step(np.zeros(1, np.float32))
    env.reset()
    env.step(np.zeros(1, np.float32))
    child = os.fork()
    if child == 0:
        # Nothing of pytest may run in the child, and its end must not wait for threads that it does not have.
        try:
            env.step(np.zeros(1, np.float32))
        except qube_hil.ClosedError as error:
            if "forked" in str(error):
                env.close()
                del env
                gc.collect()
                os._exit(7)
        os._exit(1)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 7
    env.step(np.zeros(1, np.float32))
    env.close()
    env.close()
    assert qube_hil.recording(env._recording).outcome["ending"]["kind"] == "stopped"
    for call in [env.reset, lambda: env.step(np.zeros(1, np.float32))]:
        with pytest.raises(qube_hil.ClosedError):
            call()


def driving(env, ended):
    """Starts a thread that drives episodes until a call raises a QubeHilError, which the thread appends to `ended`.
    Returns the thread once the first episode has begun."""
    begun = threading.Event()

    def drive():
        try:
            while True:
                env.reset()
                begun.set()
                over = False
                while not over:
                    _, _, terminated, truncated, _ = env.step(np.zeros(1, np.float32))
                    over = terminated or truncated
        except qube_hil.QubeHilError as error:
            ended.append(error)

    thread = threading.Thread(target=drive, daemon=True)
    thread.start()
    assert begun.wait(120.0)
    return thread


def test_any_thread_may_close_a_qube_and_the_thread_that_drives_it_is_told(virtual):
    for _ in range(3):
        env, ended = virtual(), []
        thread = driving(env, ended)
        env.close()
        thread.join(120.0)
        assert [type(error) for error in ended] == [qube_hil.ClosedError]
        last = qube_hil.recording(env._recording)
        # On a busy computer the episode may have ended before this thread closed the Qube.
        assert last.outcome["ending"]["kind"] in ("stopped", "completed")
        with pytest.raises(qube_hil.ClosedError):
            env.reset()


def test_a_second_thread_that_drives_is_refused_and_disturbs_nothing(virtual):
    env, ended = virtual(), []
    thread = driving(env, ended)
    refused = 0
    while refused < 5 and not ended:
        try:
            env.reset()
        except qube_hil.BusyError as error:
            assert "no effect" in str(error)
            refused += 1
    env.close()
    thread.join(120.0)
    assert refused == 5
    assert [type(error) for error in ended] <= [qube_hil.ClosedError]


def test_a_bad_argument_of_a_second_thread_leaves_the_call_of_the_first_alone(virtual):
    env, resets, ended = virtual(), [], []

    def reset():
        try:
            while len(resets) < 5:
                with contextlib.suppress(qube_hil.BusyError):
                    resets.append(env.reset())
        except qube_hil.QubeHilError as error:
            ended.append(error)

    thread = threading.Thread(target=reset, daemon=True)
    thread.start()
    while thread.is_alive():
        with pytest.raises(qube_hil.ActionError):
            env.step(np.zeros(2, np.float32))
    assert ended == [] and len(resets) == 5


class Busy:
    """A device in a call of another thread."""

    def reset(self, *_):
        raise qube_hil.BusyError("busy")


def test_a_reset_that_is_refused_has_no_effect(virtual):
    env = virtual()
    env.reset(seed=4)
    begun = (env._seed, env._number, env._recording)
    device, env._device = env._device, Busy()
    for seed in [None, 9]:
        with pytest.raises(qube_hil.BusyError):
            env.reset(seed=seed)
    env._device = device
    assert (env._seed, env._number, env._recording) == begun


@pytest.fixture
def signalled():
    """A function that drives episodes until an exception ends it. After a delay a signal comes, again and again until it
    comes during a step; then its handler calls the function `call`, once."""
    before = signal.getsignal(signal.SIGALRM)

    def drive(env, delay_s, call):
        steps = 0

        def handler(_, frame):
            is_in_step = frame.f_code is QubeDeviceEnv.step.__code__
            if is_in_step and frame.f_lineno > frame.f_code.co_firstlineno and steps < 500:
                call()
            else:
                signal.setitimer(signal.ITIMER_REAL, 0.001)

        signal.signal(signal.SIGALRM, handler)
        env.reset()
        signal.setitimer(signal.ITIMER_REAL, delay_s)
        while True:
            _, _, terminated, truncated, _ = env.step(np.zeros(1, np.float32))
            steps += 1
            if terminated or truncated:
                env.reset()
                steps = 0

    yield drive
    signal.setitimer(signal.ITIMER_REAL, 0.0)
    signal.signal(signal.SIGALRM, before)


def test_a_handler_of_a_signal_may_close_the_qube(virtual, signalled):
    env = virtual()
    with pytest.raises(qube_hil.ClosedError):
        signalled(env, 0.01, env.close)
    assert qube_hil.recording(env._recording).outcome["ending"]["kind"] == "stopped"
    with pytest.raises(qube_hil.ClosedError):
        env.reset()


def test_an_exception_that_a_handler_raises_during_a_step_brakes_first(virtual, signalled):
    def raises():
        raise LookupError("in the handler")

    env = virtual()
    for delay_s in [0.001, 0.01, 0.02]:
        with pytest.raises(LookupError):
            signalled(env, delay_s, raises)
        with pytest.raises(qube_hil.EpisodeOverError):
            env.step(np.zeros(1, np.float32))
        read = qube_hil.recording(env._recording)
        assert read.outcome["ending"]["kind"] == "stopped" and read["phase"][-1] == "braking"


def test_a_number_that_is_too_large_for_single_precision_is_clipped(virtual):
    env = virtual(history=1)
    for number, clipped in [(1e300, 1.0), (-1e39, -1.0)]:
        env.reset()
        observation, *_ = env.step(np.array([number]))
        assert observation[6] == clipped


@pytest.mark.parametrize(
    "options, told",
    [
        ({"device": "/dev/missing", "clock": "wall"}, "missing"),
        ({"device": "/dev/missing"}, "virtual"),
        ({"clock": "sundial"}, "sundial"),
        ({"clock": None}, "clock = None: give wall or virtual"),
        ({"unknown_option": 1}, "unknown_option"),
        ({"acknowlege": False}, "acknowlege: did you mean acknowledge"),
        ({"qub": None}, "qub: did you mean qube"),
        ({"acknowledge": "yes"}, "acknowledge = 'yes': give True or False"),
        ({"guard": True}, "guard = True: give a value"),
        ({"profile": 3 + 0j}, "profile = .*: give a text"),
        ({"policy": "classical"}, "policy = 'classical': the controller of this environment is Python"),
        ({"excite": "chirp"}, "excite = 'chirp': the controller"),
        ({"home": "nowhere"}, "'nowhere' for 'home"),
        ({"device": 3}, "device = 3"),
        ({"deadline_ms": "a"}, "deadline_ms = 'a'"),
        ({"deadline_ms": 1e300}, "deadline_ms = 1e300: "),
        ({"recordings": 3}, "recordings = 3"),
        ({"recordings": __file__}, "recordings = .*cannot be made"),
        ({"deadline_ms": 20.0}, "8.5"),
        ({"history": 9}, "history"),
        ({"history": -1}, "history"),
        ({"seed": -1}, "seed"),
        ({"guard": "none"}, "none"),
    ],
)
def test_options_that_open_no_qube_are_named(virtual, options, told):
    with pytest.raises((qube_hil.SettingsError, qube_hil.DeviceError), match=told):
        virtual(**options)


def test_messages_about_arguments_name_no_options_of_the_command(virtual, tmp_path):
    for options in [{"home": "nowhere"}, {"plant": tmp_path / "missing.toml"}, {"delay_ms": -1}]:
        with pytest.raises((qube_hil.SettingsError, qube_hil.DeviceError)) as refused:
            virtual(**options)
        assert "--" not in str(refused.value)


def test_a_device_may_be_a_path_and_a_profile_the_result_of_an_identification(virtual, tmp_path):
    with pytest.raises((qube_hil.SettingsError, qube_hil.DeviceError), match="missing"):
        QubeDeviceEnv(device=tmp_path / "missing", recordings=tmp_path / "episodes")
    file = tmp_path / "mine.toml"
    file.write_text('name = "mine"\n\n[parameters]\nR_m = 9.1\n\n[gap]\n\n[standard_errors]\nR_m = 0.5\n')
    found = qube_hil.Identified({}, "fits", [], file.read_text(), [], [])
    returns = [
        episode(virtual(profile=profile, recordings=tmp_path / name), lambda seen: -0.1 * seen[:1])[2]["return"]
        for name, profile in [("path", file), ("result", found)]
    ]
    assert returns[0] == returns[1]
    with pytest.raises(qube_hil.SettingsError, match="^profile: "):
        virtual(profile=qube_hil.Identified({}, "fits", [], "x", [], []))


def test_a_device_is_neither_copied_nor_pickled(virtual):
    env = virtual()
    for duplicate in [copy.copy, copy.deepcopy, pickle.dumps]:
        with pytest.raises(qube_hil.CopyError, match="QubeDeviceEnv cannot be copied"):
            duplicate(env)
    env.reset()


def test_reset_takes_the_same_seeds_as_other_environments(virtual):
    env = virtual()
    env.reset(seed=np.int64(1))
    for seed in [-1, 1.0]:
        with pytest.raises(qube_hil.SettingsError, match=f"seed = {seed}"):
            env.reset(seed=seed)


def test_an_option_of_reset_is_refused(virtual):
    env = virtual()
    env.reset(options={})
    with pytest.raises(qube_hil.SettingsError, match="angle.*constructor"):
        env.reset(options={"angle": 1.0})


#: Code that `in_a_process` puts before the code of a test: `begin` begins an episode, and again, up to 50 times, where
#: a busy computer ends an episode in real time at once.
BEGIN = """
import numpy as np, qube_hil

def is_late(error):
    return isinstance(error, qube_hil.LateError) or "keep this computer busy" in str(error)

def begin(env):
    for _ in range(50):
        try:
            env.reset()
            env.step(np.full(1, 0.01, np.float32))
            return
        except qube_hil.DeviceError as error:
            if not is_late(error):
                raise
            late = error
    raise late
"""

#: Largest number of attempts at a test that a busy computer disturbs.
ATTEMPTS = 6

#: Time after which a process counts as hung, s; on a busy computer a process needs less.
PATIENCE_S = 600.0

#: Names of the faults by which a busy computer ends an episode.
FAULTS_OF_A_BUSY_COMPUTER = ["no_sample", "watchdog_tripped", "device_clock", "too_late"]


def is_ended_by_a_busy_computer(recording):
    ending = recording.outcome["ending"]
    return ending["kind"] == "fault" and ending["detail"] in FAULTS_OF_A_BUSY_COMPUTER


def says_busy(errors):
    """Returns whether code of another interpreter ended with the error of a busy computer."""
    return "LateError" in errors or "keep this computer busy" in errors


def first_line(process):
    """The first line that a process prints; it is killed if it prints none for too long."""
    limit = threading.Timer(PATIENCE_S, process.kill)
    limit.start()
    try:
        return process.stdout.readline()
    finally:
        limit.cancel()


def in_a_process(code, folder, send=None):
    """Runs code in another interpreter; with a signal, sends it once the code prints a line. Code that ends with the
    error of a busy computer is run again, without the recordings of the last attempt in `episodes`. Returns the exit
    code, standard output (without the line before a signal) and standard error."""
    code = BEGIN + textwrap.dedent(code)
    for _ in range(ATTEMPTS):
        shutil.rmtree(folder / "episodes", ignore_errors=True)
        process = subprocess.Popen(
            [sys.executable, "-c", code], cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        if send is not None:
            first_line(process)
            process.send_signal(send)
        out, errors = process.communicate(timeout=PATIENCE_S)
        if process.returncode != 1 or not says_busy(errors):
            break
    return process.returncode, out, errors


def test_an_interpreter_that_ends_brakes(tmp_path):
    code, _, errors = in_a_process(
        """
        import numpy as np, qube_hil
        env = qube_hil.QubeDeviceEnv(clock="virtual")
        env.reset()
        env.step(np.zeros(1, np.float32))
        raise SystemExit(5)
        """,
        tmp_path,
    )
    assert code == 5, errors
    read = qube_hil.recording(tmp_path / "episodes/episode-0000.mcap")
    assert read.outcome["ending"]["kind"] == "stopped" and read["phase"][-1] == "braking"


@pytest.mark.real_time
def test_sigterm_brakes_with_the_handler_that_the_page_names(tmp_path):
    handler = "signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))"
    assert handler in (beside("docs") / "python.md").read_text()
    for _ in range(ATTEMPTS):
        code, _, errors = in_a_process(
            f"""
            import signal, sys
            {handler}
            env = qube_hil.QubeDeviceEnv()
            begin(env)
            print("drives", flush=True)
            while True:
                env.step(np.zeros(1, np.float32))
            """,
            tmp_path,
            send=signal.SIGTERM,
        )
        assert code == 143, errors
        last = qube_hil.recording(sorted((tmp_path / "episodes").glob("*.mcap"))[-1])
        # A fault may end the episode just before the signal does.
        if not is_ended_by_a_busy_computer(last):
            break
    assert last.outcome["ending"]["kind"] == "stopped" and last["phase"][-1] == "braking"


def test_at_the_end_of_the_interpreter_every_qube_brakes_also_one_that_a_thread_uses(tmp_path):
    code, _, errors = in_a_process(
        """
        import threading
        envs = [qube_hil.QubeDeviceEnv(clock="virtual", recordings=name) for name in ["a", "used", "b"]]
        begun = threading.Event()

        def drive():
            while True:
                envs[1].reset()
                begun.set()
                over = False
                while not over:
                    _, _, terminated, truncated, _ = envs[1].step(np.zeros(1, np.float32))
                    over = terminated or truncated

        for env in [envs[0], envs[2]]:
            env.reset()
            env.step(np.zeros(1, np.float32))
        threading.Thread(target=drive, daemon=True).start()
        begun.wait()
        """,
        tmp_path,
    )
    assert code == 0 and "ignored" not in errors and "Borrow" not in errors, errors
    for name in ["a", "used", "b"]:
        last = qube_hil.recording(sorted((tmp_path / name).glob("*.mcap"))[-1])
        assert last.outcome["ending"]["kind"] == "stopped" and last["phase"][-1] != "running", name


@pytest.mark.real_time
def test_an_episode_begins_after_ctrl_c_in_a_reset_and_a_lost_link_does_not_count_as_a_motor_that_is_off(tmp_path):
    code, out, errors = in_a_process(
        f"""
        import os, signal, subprocess, threading
        emulated = subprocess.Popen([{str(PROGRAM)!r}, "emulate"], stdout=subprocess.PIPE, text=True)
        try:
            env = qube_hil.QubeDeviceEnv(device=emulated.stdout.readline().strip())
            begin(env)
            try:
                env.step(np.full(1, np.nan, np.float32))
            except qube_hil.ActionError:
                # The arm was not at rest when the motor went off, so the next reset homes it for many seconds.
                threading.Timer(3.0, os.kill, [os.getpid(), signal.SIGINT]).start()
            try:
                env.reset()
            except KeyboardInterrupt:
                print("interrupted")
            begin(env)
            print("drove")
        finally:
            emulated.kill()
        try:
            while True:
                env.step(np.zeros(1, np.float32))
        except qube_hil.DeviceError as error:
            if is_late(error):
                raise
            print(error)
        """,
        tmp_path,
    )
    assert code == 0, errors
    interrupted, drove, told = out.splitlines()
    assert (interrupted, drove) == ("interrupted", "drove")
    assert "Switch the Qube off: its motor may still have its last voltage" in told
    assert "The motor is off" not in told


def test_a_qube_that_is_collected_or_whose_loop_raises_brakes(tmp_path):
    code, out, errors = in_a_process(
        """
        import gc, numpy as np, qube_hil
        def drive(folder):
            env = qube_hil.QubeDeviceEnv(clock="virtual", recordings=folder)
            env.reset()
            env.step(np.full(1, 0.1, np.float32))
            return env
        env = drive("collected")
        del env
        gc.collect()
        print(qube_hil.recording("collected/episode-0000.mcap").outcome["ending"]["kind"])
        env = drive("raised")
        raise LookupError("in the loop of a user")
        """,
        tmp_path,
    )
    assert code == 1 and "LookupError" in errors and out == "stopped\n", errors
    read = qube_hil.recording(tmp_path / "raised/episode-0000.mcap")
    assert read.outcome["ending"]["kind"] == "stopped" and read["phase"][-1] == "braking"


def drive_beside_a_refused_process(folder):
    """Opens a Qube in another process, is refused in this one, and lets the other one drive. Returns the last recording;
    None if a busy computer kept the other process from driving."""
    emulated = subprocess.Popen(
        [PROGRAM, "emulate"], cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    try:
        port = first_line(emulated).strip()
        holding = f"""
            import sys
            env = qube_hil.QubeDeviceEnv(device={port!r})
            print("open", flush=True)
            sys.stdin.readline()
            begin(env)
            env.close()
            print("drove")
            """
        first = subprocess.Popen(
            [sys.executable, "-c", BEGIN + textwrap.dedent(holding)],
            cwd=folder, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )
        if first_line(first) == "open\n":
            with pytest.raises(qube_hil.DeviceError, match="is in use"):
                QubeDeviceEnv(device=port, recordings=folder / "second")
        out, errors = first.communicate("go\n", timeout=PATIENCE_S)
        if first.returncode == 1 and says_busy(errors):
            return None
        assert (first.returncode, out) == (0, "drove\n"), errors
    finally:
        emulated.terminate()
        emulated.communicate(timeout=PATIENCE_S)
    return qube_hil.recording(sorted((folder / "episodes").glob("*.mcap"))[-1])


@pytest.mark.real_time
def test_a_second_process_is_refused_and_the_first_one_goes_on(tmp_path):
    for attempt in range(ATTEMPTS):
        folder = tmp_path / str(attempt)
        folder.mkdir()
        last = drive_beside_a_refused_process(folder)
        if last is not None and not is_ended_by_a_busy_computer(last):
            break
    assert last is not None and last.outcome["ending"]["kind"] == "stopped"


@pytest.mark.real_time
def test_in_real_time_late_answers_brake_and_so_does_ctrl_c(tmp_path):
    code, out, errors = in_a_process(
        """
        import time
        env = qube_hil.QubeDeviceEnv(deadline_ms=5.0)
        begin(env)
        time.sleep(1.0)
        try:
            for _ in range(100):
                env.step(np.zeros(1, np.float32))
        except qube_hil.LateError as error:
            late = error
        begin(env)
        try:
            print("running", flush=True)
            while True:
                try:
                    env.step(np.zeros(1, np.float32))
                except qube_hil.DeviceError as error:
                    if not is_late(error):
                        raise
                    # On a busy computer; the next episode goes on.
                    begin(env)
        except KeyboardInterrupt:
            print(late)
        """,
        tmp_path,
        signal.SIGINT,
    )
    assert code == 0, errors
    assert "too late" in out and "5.0 ms" in out
    recordings = sorted((tmp_path / "episodes").glob("*.mcap"))
    stopped = 0
    for recording in recordings:
        read = qube_hil.recording(recording)
        if not is_ended_by_a_busy_computer(read):
            assert read.outcome["ending"]["kind"] == "stopped"
            stopped += 1
        assert replayed(recording)["actions_different"] == 0
    assert stopped >= 2
