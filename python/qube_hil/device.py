"""A real or emulated Qube as a Gymnasium environment, at 100 Hz."""

import atexit
import os
import weakref
from pathlib import Path
from typing import Any

import gymnasium

from . import _core
from ._core import MAX_VOLTAGE_V
from .envs import Float32s, _as_actions, _as_seed, _whole, action_space, observation_space
from .errors import BusyError, QubeHilError, SettingsError


class QubeDeviceEnv(gymnasium.Env[Any, Any]):
    """One Qube, real or emulated: the control thread, the guard, the limit on the voltage and the watchdog stay in the
    program, which asks Python for a voltage at each tick.

    Args:
        device: Serial port of a Qube, or ``hil:CARD@ID`` for a Qube with the USB panel. None drives the Qube whose port
            the option ``qube`` names, and the emulated one without that option.
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
            ``profile="lab"``, ``acknowledge=True`` ... Those that choose a controller are refused. Those for the number
            of rollouts, the folder, the screen and the live view have no effect.

    Spaces, rewards, termination and truncation are those of `QubeEnv`. The state is estimated from the encoders, and
    foresight is the guard unless an option says otherwise: an episode is terminated where the guard takes over. The
    constructor examines and homes the Qube, and ``reset`` settles it. ``close``, an exception of ``step`` or ``reset``,
    also that of Ctrl-C, and the end of the interpreter brake the arm and switch the motor off.

    One thread at a time calls ``step`` and ``reset``; a second one gets a `BusyError`, which changes nothing. ``close`` may
    be called from any thread and from the handler of a signal, for example by a stop button: the arm is braked at once, and
    the thread that is in ``step`` or ``reset`` gets a `ClosedError`.

    ``info`` has ``late_answers``, and at the end of an episode ``ending``, ``return`` and ``recording``.
    """

    metadata: dict[str, Any] = {"render_modes": [], "render_fps": 100}

    def __init__(
        self,
        device: str | None = None,
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
            raise SettingsError(f"render_mode = {render_mode!r}: there is none, give None")
        self.render_mode = None
        self._seed = _as_seed(seed) or 0
        self._number = -1
        self._folder = Path(recordings)
        self._recording: Path | None = None
        history = _whole("history", history, 0, 4)
        named = {"device": device, "clock": clock, "seed": self._seed, **options}
        self._device = _core.Device(_as_options(named), deadline_ms, history)
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
        after a second ``reset`` with the same seed differ."""
        try:
            super().reset(seed=seed)
            given = _as_seed(seed)
            if given is not None:
                self._seed, self._number = given, -1
            self._number += 1
            self._folder.mkdir(parents=True, exist_ok=True)
            taken = {path.name for path in self._folder.iterdir()}
            number = 0
            while (name := f"episode-{number:04}.mcap") in taken:
                number += 1
            path = self._folder / name
            observation = self._device.reset(str(path), self._seed, self._number)
            self._recording = path
            return observation, {"late_answers": 0}
        except BaseException as error:
            self._brake(error)
            raise

    def step(self, action: Float32s) -> tuple[Float32s, float, bool, bool, dict[str, Any]]:
        """Answers with a voltage, a fraction of 5 V, and waits for the next state."""
        try:
            voltage_v = MAX_VOLTAGE_V * float(_as_actions(action, (1,))[0])
            observation, reward, terminated, truncated, late, end = self._device.step(voltage_v)
            info: dict[str, Any] = {"late_answers": late}
            if end is not None:
                info |= {"ending": end[0], "return": end[1], "recording": self._recording}
            return observation, reward, terminated, truncated, info
        except BaseException as error:
            self._brake(error)
            raise

    def _brake(self, error: BaseException) -> None:
        """Brakes the arm before an exception leaves a call. A handler of a signal may raise one at any place."""
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


def _as_options(named: dict[str, Any]) -> list[str]:
    """The options as on the command line."""
    options = []
    for name, value in named.items():
        option = "--" + name.replace("_", "-")
        if value is True:
            options.append(option)
        elif isinstance(value, (list, tuple)):
            options.extend(f"{option}={one}" for one in value)
        elif value is not None and value is not False:
            options.append(f"{option}={os.fspath(value) if isinstance(value, os.PathLike) else value}")
    return options


#: Devices that are closed at the end of the interpreter.
_OPEN: "weakref.WeakSet[_core.Device]" = weakref.WeakSet()


@atexit.register
def _close_all() -> None:
    _core.close_all(list(_OPEN))
