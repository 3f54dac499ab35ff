"""A real or emulated Qube as a Gymnasium environment, at 100 Hz."""

import atexit
import contextlib
import difflib
import os
import re
import tempfile
import weakref
from numbers import Real
from pathlib import Path
from typing import Any

import gymnasium

from . import _core
from ._core import MAX_VOLTAGE_V
from .envs import Float32s, Uncopied, _as_actions, _whole, action_space, as_seed, observation_space
from .errors import BusyError, DeviceError, QubeHilError, SettingsError
from .identification import Identified
from .settings import as_path, refuse_options, shown


class QubeDeviceEnv(Uncopied, gymnasium.Env[Any, Any]):
    """One Qube, real or emulated: the control thread, the guard, the limit on the voltage and the watchdog stay in the
    program, which requests a voltage from Python in each tick with a sample.

    Args:
        device: Serial port of a Qube, a text or a path, or ``hil:CARD@ID`` for a Qube with the USB panel. None drives the
            Qube whose port the file of the option ``qube`` names, and the emulated one without that option.
        deadline_ms: Time limit of an answer within the tick of 10 ms, 0.1 to 8.5 ms; None takes the time that the measured
            link leaves, at most 5 ms. After a late answer the last voltage is held; ten in a row brake the arm and raise a
            `LateError`.
        clock: ``wall``, or ``virtual`` for the emulated Qube: time waits for Python, and the same actions give the same
            bytes.
        recordings: Folder for the recordings, one for each episode: ``episode-0000.mcap`` and so on. An episode takes the
            lowest number without a file.
        history: Number of last commands in the observation, 0 to 4.
        seed: Seed of the arm's start angles, and of the emulated Qube.
        options: Other options of the command ``run``, with ``_`` for ``-``: ``qube="qube.toml"``, ``guard="box"``,
            ``profile="lab"`` (or a path, or the result of `identify`), ``acknowledge=True`` ... Those that choose a
            controller are refused. Those for the number of rollouts, the folder, the screen and the live view have no
            effect.

    Spaces and the reward of one control period are those of `QubeEnv`; an episode is truncated after 600 control
    periods. The state is estimated from the encoders. Foresight is the guard unless an option selects another one, and
    an episode is terminated where the guard takes over. The constructor examines and homes the Qube, and ``reset``
    settles it. The arm is braked and the motor switched off by ``close``, by an exception of ``step`` or ``reset``
    (also by Ctrl-C), and at the end of the interpreter.

    One thread at a time calls ``step`` and ``reset``; a second one gets a `BusyError`, which changes nothing. ``close`` may
    be called from any thread and from the handler of a signal, for example by a stop button: the arm is braked at once, and
    the thread that is in ``step`` or ``reset`` gets a `ClosedError`.

    Raises:
        SettingsError: An argument or option is refused, or the folder of ``recordings`` cannot be made.
        DeviceError: The Qube cannot be opened.

    ``info`` has ``late_answers``, their number in the episode. After a step it also has ``ticks``, the number of
    requests for a voltage in the step: one, and more after late answers. The reward is the sum over the control periods
    of the step, including those whose sample was lost and up to four skipped ones a tick. ``voltage_v`` is the voltage
    that the motor got in the last of these periods. It is Python's unless a late answer, the guard or a test push
    replaced it; a test push shows whether the arm's encoder counts. At the end of an episode there are ``ending`` in
    words, ``return`` and ``recording``.
    """

    metadata: dict[str, Any] = {"render_modes": [], "render_fps": 100}

    def __init__(
        self,
        device: str | os.PathLike[str] | None = None,
        *,
        deadline_ms: float | None = None,
        clock: str = "wall",
        recordings: str | os.PathLike[str] = "episodes",
        history: int = 0,
        seed: int = 0,
        render_mode: None = None,
        **options: Any,
    ) -> None:
        if render_mode is not None:
            raise SettingsError(f"render_mode = {shown(render_mode)}: there is none, give None")
        self.render_mode = None
        self._seed = as_seed(seed) or 0
        self._number = -1
        self._recording: Path | None = None
        history = _whole("history", history, 0, 4)
        if device is not None:
            device = as_path("device", device, "a text such as /dev/ttyACM0, or None")
        if clock not in ("wall", "virtual"):
            raise SettingsError(f"clock = {shown(clock)}: give wall or virtual")
        if deadline_ms is not None and (isinstance(deadline_ms, bool) or not isinstance(deadline_ms, Real)):
            raise SettingsError(f"deadline_ms = {shown(deadline_ms)}: give a number from 0.1 to 8.5, or None")
        with contextlib.ExitStack() as files:
            profile = options.get("profile")
            if isinstance(profile, Identified):
                folder = files.enter_context(tempfile.TemporaryDirectory(prefix="qube-hil-"))
                options["profile"] = Path(folder) / "identified.toml"
                options["profile"].write_text(profile.profile, "utf-8")
            given = _as_options({"device": device, "clock": clock, "seed": self._seed, **options})
            self._folder = _as_folder(recordings)
            try:
                self._device = _core.Device(given, deadline_ms, history)
            except (SettingsError, DeviceError) as error:
                told = _in_words_of_python(str(error))
                if isinstance(profile, Identified):
                    told = told.replace(str(options["profile"]), "profile")
                raise type(error)(told) from None
        self.observation_space = observation_space(6 + history)
        self.action_space = action_space()
        _OPEN.add(self._device)

    @property
    def deadline_ms(self) -> float | None:
        """Time limit of an answer, ms; None under a virtual clock, which waits."""
        return self._device.deadline_ms

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Float32s, dict[str, Any]]:
        """Brakes a running episode, settles arm and pendulum, and begins the next episode. A seed restarts the sequence
        of start angles, and nothing else: a Qube and its emulation go on from where they are, so that the observations
        after a second ``reset`` with the same seed differ. ``options`` other than None or an empty mapping raise a
        `SettingsError`. An error of the Qube is a `DeviceError`."""
        try:
            refuse_options(options, "Give the options of the Qube to the constructor")
            given = as_seed(seed)
            episode = (self._seed, self._number + 1) if given is None else (given, 0)
            _make(self._folder)
            taken = {path.name for path in self._folder.iterdir()}
            number = 0
            while (name := f"episode-{number:04}.mcap") in taken:
                number += 1
            path = self._folder / name
            observation = self._device.reset(str(path), *episode)
            # Only after the reset above, so that a reset that fails leaves the sequence of seeds as it was.
            super().reset(seed=given)
            (self._seed, self._number), self._recording = episode, path
            return observation, {"late_answers": 0}
        except BaseException as error:
            self._brake(error)
            raise

    def step(self, action: Float32s) -> tuple[Float32s, float, bool, bool, dict[str, Any]]:
        """Answers with a voltage, a fraction of 5 V, and waits for the next state."""
        try:
            voltage_v = MAX_VOLTAGE_V * float(_as_actions(action, (1,))[0])
            observation, reward, terminated, truncated, (late, ticks, sent_v), end = self._device.step(voltage_v)
            info: dict[str, Any] = {"late_answers": late, "ticks": ticks, "voltage_v": sent_v}
            if end is not None:
                info |= {"ending": end[0], "return": end[1], "recording": self._recording}
            return observation, reward, terminated, truncated, info
        except BaseException as error:
            self._brake(error)
            raise

    def _brake(self, error: BaseException) -> None:
        """Brakes the arm before an exception leaves a call, unless a call of another thread is under way. The
        exception may come from a signal's handler, which can interrupt a call anywhere."""
        if isinstance(error, BusyError):
            # The episode of another thread goes on.
            return
        try:
            self._device.halt()
        except QubeHilError as trouble:
            raise error from trouble

    def close(self) -> None:
        """Brakes the arm, switches the motor off and closes the Qube. May be called again, and from any thread."""
        self._device.close()


#: Options of the command ``run`` that choose a controller, which is Python here.
_CONTROLLERS = ("policy", "excite", "volts")


def _as_options(named: dict[str, Any]) -> list[str]:
    """The options as on the command line."""
    known = dict(_core.device_options())
    options = []
    for name, value in named.items():
        if name in _CONTROLLERS:
            raise SettingsError(
                f"{name} = {shown(value)}: the controller of this environment is Python, which gives the voltages to step: leave "
                f"{name} out"
            )
        if name not in known:
            near = difflib.get_close_matches(name, known, 1)
            hint = f"did you mean {near[0]}?" if near else f"there are {', '.join(sorted(known))}"
            raise SettingsError(f"there is no option {name}: {hint}")
        option = "--" + name.replace("_", "-")
        if not known[name]:
            if value is not None and not isinstance(value, bool):
                raise SettingsError(f"{name} = {shown(value)}: give True or False")
            options += [option] if value else []
        elif isinstance(value, bool):
            raise SettingsError(f"{name} = {shown(value)}: give a value, or leave it out")
        elif value is not None:
            values = value if isinstance(value, (list, tuple)) else [value]
            options.extend(f"{option}={_as_word(name, one)}" for one in values)
    return options


def _as_word(name: str, value: object) -> str:
    """The value of an option as on the command line."""
    if isinstance(value, os.PathLike):
        return str(os.fspath(value))
    if isinstance(value, (str, Real)):
        return str(value)
    raise SettingsError(f"{name} = {shown(value)}: give a text, a path or a number")


def _in_words_of_python(message: str) -> str:
    """A message of the command ``run`` with Python's arguments in place of options, except in a command that it cites."""
    parts = message.split("`")
    for index, part in enumerate(parts):
        if not part.startswith("qube-hil"):
            parts[index] = re.sub(
                r"(?<![\w-])--([a-z][a-z-]*)", lambda option: option[1].replace("-", "_"), part
            )
    return "`".join(parts)


def _as_folder(recordings: object) -> Path:
    """The folder for recordings, which is made where it does not exist."""
    if not isinstance(recordings, (str, os.PathLike)):
        raise SettingsError(f"recordings = {shown(recordings)}: give the path of a folder")
    folder = Path(recordings)
    _make(folder)
    return folder


def _make(folder: Path) -> None:
    """Makes a folder for recordings, and checks that files can be made in it."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise SettingsError(
            f"recordings = {str(folder)!r}: the folder cannot be made: {error.strerror}. Name another folder"
        ) from error
    if not os.access(folder, os.W_OK | os.X_OK):
        raise SettingsError(f"recordings = {str(folder)!r}: no file can be made there. Name another folder")


#: Devices that are closed at the end of the interpreter.
_OPEN: "weakref.WeakSet[_core.Device]" = weakref.WeakSet()


@atexit.register
def _close_all() -> None:
    _core.close_all(list(_OPEN))
