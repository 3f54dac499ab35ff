"""Gymnasium environments over the program's simulation."""

import os
from collections.abc import Mapping
from typing import Any, NoReturn

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from . import distributions as _distributions
from . import settings as _settings
from ._core import Simulation
from .distributions import Distribution
from .errors import ActionError, ClosedError, CopyError, EpisodeOverError, QubeHilError, SettingsError
from .identification import Identified
from .profiles import around
from .settings import is_whole, shown

Float32s = npt.NDArray[np.float32]
Bools = npt.NDArray[np.bool_]

_ENV_ID = "qube_hil/Qube-v0"
_STATE_SIZE = 6
_MAX_ENVS = 1 << 20
_MAX_NUMBER = 2**64 - 1


def register() -> None:
    """Registers ``qube_hil/Qube-v0`` with Gymnasium. Importing the package does this."""
    if _ENV_ID not in gymnasium.registry:
        gymnasium.register(
            _ENV_ID,
            entry_point="qube_hil.envs:QubeEnv",
            vector_entry_point="qube_hil.envs:QubeVectorEnv",
        )


def observation_space(observation_size: int) -> spaces.Box:
    """The space of one observation: sin and cos of the arm's and the pendulum's angle, 0.1 times the arm's and 0.05
    times the pendulum's velocity in rad/s, then the last commands as fractions of 5 V, newest first."""
    bounds = np.ones(observation_size, np.float32)
    bounds[4:_STATE_SIZE] = np.inf
    return spaces.Box(-bounds, bounds, dtype=np.float32)


def action_space() -> spaces.Box:
    """The space of one action: a voltage as a fraction of 5 V, shape ``[1]``."""
    return spaces.Box(-1.0, 1.0, (1,), np.float32)


def _as_actions(actions: npt.ArrayLike, shape: tuple[int, ...]) -> Float32s:
    """The actions as float32 in this shape."""
    try:
        array = np.asarray(actions)
    except (TypeError, ValueError) as error:
        raise ActionError(f"the actions are not an array of numbers: {error}") from error
    if array.dtype != np.float32:
        if array.dtype.kind not in "fiu":
            raise ActionError(
                f"the actions have the type {array.dtype}: give numbers of type float32"
            )
        # A large finite number would become infinite in single precision.
        array = np.where(np.isfinite(array), np.clip(array, -2, 2), array).astype(np.float32)
    if array.shape != shape:
        raise ActionError(f"the actions have the shape {array.shape}: give {shape}")
    return array


def as_seed(seed: object) -> int | None:
    """A seed from 0 to 2^64 - 1, or None."""
    if seed is None:
        return None
    if is_whole(seed) and 0 <= seed < 2**64:
        return int(seed)
    raise SettingsError(f"seed = {shown(seed)}: give one whole number from 0 to 2^64 - 1")


def _whole(name: str, value: object, smallest: int, largest: int) -> int:
    """An argument that is a whole number from ``smallest`` to ``largest``."""
    if is_whole(value) and smallest <= value <= largest:
        return int(value)
    raise SettingsError(f"{name} = {shown(value)}: give a whole number from {smallest} to {largest}")


def _simulation(
    num_envs: int,
    model: str | None,
    profile: str | os.PathLike[str] | Identified | None,
    spread: float | None,
    distributions: Mapping[str, Distribution | float] | None,
    settings: str | Mapping[str, Any],
    guard: str,
) -> Simulation:
    return Simulation(
        num_envs,
        _settings.as_model(model),
        around(profile, spread),
        _distributions.written(distributions),
        _settings.written(settings, "settings"),
        _settings.as_text("guard", guard, "box or foresight"),
    )


def _refuse_options(options: object) -> None:
    _settings.refuse_options(
        options,
        "Give seed for other episodes, and make another environment for other Qubes; all Qubes of a vector environment "
        "are reset together",
    )


def _not_running(is_closed: bool) -> QubeHilError:
    """The error of a step without an episode."""
    if is_closed:
        return _closed()
    return EpisodeOverError("no episode is running: call reset() first")


def _closed() -> ClosedError:
    return ClosedError("the environment is closed: make another one")


class Uncopied:
    """An environment that cannot be copied or pickled, because a copy would drive the same Qubes."""

    def __copy__(self) -> NoReturn:
        self.__reduce__()

    def __deepcopy__(self, memo: Any) -> NoReturn:
        self.__reduce__()

    def __reduce__(self) -> NoReturn:
        raise CopyError(
            f"a {type(self).__name__} cannot be copied or pickled, because the copy would drive the same Qubes: make "
            "another one, in the process that uses it"
        )


class QubeEnv(Uncopied, gymnasium.Env[Any, Any]):
    """One simulated Qube: swing the pendulum up and balance it, 600 steps of 10 ms.

    Args:
        model: Distribution of the simulated Qubes: ``nominal``, ``handcrafted``, ``nominal-handcrafted`` or ``robust``; None
            stands for ``nominal``, or for the Qubes around ``profile``.
        distributions: Distributions of quantities that replace those of the model, by name, such as
            ``{"M_p": Normal(0.024, 0.005), "command_delay_s": Uniform(0.0, 0.016)}``.
        profile: Identified Qube in place of a model: the path of a profile, ``lab``, ``ideal``, or the result of `identify`.
            Each episode's Qube differs from it by the errors of the identification with their correlations, and by
            ``spread``.
        spread: Standard deviation of each quantity around the profile as a fraction of its value, 0 to 1, in addition to
            the errors that the profile names; None stands for 0.1.
        settings: Sensors, history, reward and box: ``thesis``, ``machine``, ``robust``, or a mapping.
        seed: Seed of the episodes until ``reset`` names another.
        guard: ``box``, or ``foresight`` as on a real Qube: before each voltage the guard simulates the brake for many
            Qubes that this one may be; the brake takes over where a later start would be too late. A step then takes
            many times as long.

    An observation is ``float32 [6 + history]``, an action ``float32 [1]``, a fraction of 5 V. The reward of a step is
    in (0, 1]. An episode is terminated where the state leaves the box or the guard takes over, and truncated after 600
    steps. ``info["episode_number"]`` of ``reset`` is the number of the episode under its seed. With foresight,
    ``info["guarded"]`` of ``step`` says whether the guard took over; the voltage of that step is the brake's. A refused
    argument raises a `SettingsError`. An environment cannot be pickled or copied: both raise a `CopyError`.
    """

    metadata: dict[str, Any] = {"render_modes": [], "render_fps": 100}

    def __init__(
        self,
        model: str | None = None,
        distributions: Mapping[str, Distribution | float] | None = None,
        settings: str | Mapping[str, Any] = "thesis",
        seed: int = 0,
        guard: str = "box",
        render_mode: None = None,
        *,
        profile: str | os.PathLike[str] | Identified | None = None,
        spread: float | None = None,
    ) -> None:
        if render_mode is not None:
            raise SettingsError(f"render_mode = {render_mode!r}: there is none, give None")
        self.render_mode = None
        self._simulation = _simulation(1, model, profile, spread, distributions, settings, guard)
        self._is_guarded = guard != "box"
        self._first_seed = as_seed(seed)
        self._was_reset = False
        self._is_running = False
        self._is_closed = False
        size = self._simulation.observation_size
        self._observations: Float32s = np.zeros((1, size), np.float32)
        self.observation_space = observation_space(size)
        self.action_space = action_space()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Float32s, dict[str, Any]]:
        """Begins the next episode; with ``seed``, also the one in use, the first episode of this seed. Returns the
        observation, ``float32 [6 + history]``. ``options`` other than None or an empty mapping raise a `SettingsError`,
        and a closed environment raises a `ClosedError`."""
        _refuse_options(options)
        if self._is_closed:
            raise _closed()
        named = as_seed(seed)
        self._simulation.reset(self._first_seed if named is None else named, self._observations)
        # Only after the reset above, because a call that is refused has no effect.
        super().reset(seed=named)
        self._first_seed = None
        self._was_reset = self._is_running = True
        return self._observations[0].copy(), {"episode_number": int(self._simulation.episodes[0])}

    def step(self, action: Float32s) -> tuple[Float32s, float, bool, bool, dict[str, Any]]:
        """Applies a voltage, a fraction of 5 V, for 10 ms."""
        if not self._is_running:
            raise _not_running(self._is_closed)
        if type(action) is not np.ndarray or action.dtype != np.float32 or action.ndim != 1:
            action = _as_actions(action, (1,))
        observation, reward, terminated, truncated, guarded = self._simulation.step_one(action)
        self._is_running = not (terminated or truncated)
        info = {"guarded": guarded} if self._is_guarded else {}
        return observation, reward, terminated, truncated, info

    def close(self) -> None:
        """Closes the environment: a later ``reset`` or ``step`` raises a `ClosedError`. May be called again."""
        self._is_closed = True
        self._is_running = False

    @property
    def state(self) -> Float32s:
        """The true state: theta, alpha (rad, alpha is 0 where the pendulum hangs), theta_dot, alpha_dot (rad/s). Raises an
        `EpisodeOverError` before the first ``reset``."""
        if not self._was_reset:
            raise _not_running(self._is_closed)
        return np.array(self._simulation.state(0), np.float32)

    def qube(self, episode_number: int) -> dict[str, float]:
        """The parameters and nonidealities of an episode's Qube under the last seed, in SI units."""
        return self._simulation.model(_whole("episode_number", episode_number, 0, _MAX_NUMBER))


class QubeVectorEnv(Uncopied, VectorEnv[Any, Any, Any]):
    """Many simulated Qubes, each in an episode of its own, advanced at once.

    Args as for `QubeEnv`; ``num_envs`` is the number of Qubes. With ``copy=False`` each step returns the same arrays
    again, overwritten, which is faster. Actions may be a view of them.

    A Qube whose episode ends begins the next one in the same step (``AutoresetMode.SAME_STEP``). Its last observation
    is then in ``info["final_obs"]``, where ``info["_final_obs"]`` is true; ``info["episode_number"]`` has the numbers
    of the running episodes. With foresight, ``info["guarded"]`` of each step is true for each Qube whose episode the
    guard ended. Episodes are numbered as they begin: the same seed gives the same episodes, whatever ``num_envs``.
    """

    metadata: dict[str, Any] = {
        "render_modes": [],
        "render_fps": 100,
        "autoreset_mode": AutoresetMode.SAME_STEP,
    }

    def __init__(
        self,
        num_envs: int = 1,
        model: str | None = None,
        distributions: Mapping[str, Distribution | float] | None = None,
        settings: str | Mapping[str, Any] = "thesis",
        seed: int = 0,
        guard: str = "box",
        copy: bool = True,
        render_mode: None = None,
        *,
        profile: str | os.PathLike[str] | Identified | None = None,
        spread: float | None = None,
    ) -> None:
        if render_mode is not None:
            raise SettingsError(f"render_mode = {render_mode!r}: there is none, give None")
        self.render_mode = None
        num_envs = _whole("num_envs", num_envs, 1, _MAX_ENVS)
        self._simulation = _simulation(
            num_envs, model, profile, spread, distributions, settings, guard
        )
        self._first_seed = as_seed(seed)
        self._was_reset = False
        self._has_begun = False
        self._is_guarded = guard != "box"
        self._copy = copy
        self.num_envs = num_envs
        size = self._simulation.observation_size
        self.single_observation_space = observation_space(size)
        self.single_action_space = action_space()
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._observations: Float32s = np.zeros((num_envs, size), np.float32)
        self._final: Float32s = np.zeros((num_envs, size), np.float32)
        self._rewards: Float32s = np.zeros(num_envs, np.float32)
        self._terminated: Bools = np.zeros(num_envs, np.bool_)
        self._truncated: Bools = np.zeros(num_envs, np.bool_)
        self._guarded: Bools = np.zeros(num_envs, np.bool_)

    def reset(
        self, *, seed: int | list[int] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Float32s, dict[str, Any]]:
        """Begins the next episode in every Qube; with ``seed``, also the one in use, the first episodes of this seed.
        Returns the observations, ``float32 [num_envs, 6 + history]``. ``options`` other than None or an empty mapping,
        such as Gymnasium's ``reset_mask``, raise a `SettingsError`, and a closed environment raises a `ClosedError`."""
        _refuse_options(options)
        if self.closed:
            raise _closed()
        given = self._first_seed if seed is None else as_seed(seed)
        self._simulation.reset(given, self._observations)
        self._first_seed = None
        self._was_reset = self._has_begun = True
        return self._handed(self._observations), {"episode_number": self._simulation.episodes}

    def step(
        self, actions: Float32s
    ) -> tuple[Float32s, Float32s, Bools, Bools, dict[str, Any]]:
        """Applies voltages, fractions of 5 V of shape ``[num_envs, 1]``, for 10 ms."""
        if not self._has_begun:
            raise _not_running(self.closed)
        if type(actions) is not np.ndarray or actions.dtype != np.float32:
            actions = _as_actions(actions, (self.num_envs, 1))
        elif actions.ndim != 2:
            raise ActionError(
                f"the actions have the shape {actions.shape}: give {(self.num_envs, 1)}"
            )
        if not self._copy and actions.base is not None:
            # They may be a view of an array that this step overwrites.
            actions = actions.copy()
        ended = self._simulation.step(
            actions,
            self._observations,
            self._rewards,
            self._terminated,
            self._truncated,
            self._guarded,
            self._final,
        )
        info: dict[str, Any] = {}
        if self._is_guarded:
            every = np.ones(self.num_envs, np.bool_)
            info = {"guarded": self._guarded.copy(), "_guarded": every}
        if ended:
            mask = self._terminated | self._truncated
            info |= {
                "final_obs": self._final.copy(),
                "_final_obs": mask,
                "episode_number": self._simulation.episodes,
                "_episode_number": mask,
            }
        return (
            self._handed(self._observations),
            self._handed(self._rewards),
            self._handed(self._terminated),
            self._handed(self._truncated),
            info,
        )

    def close_extras(self, **kwargs: Any) -> None:
        """Part of ``close``, after which ``reset`` and ``step`` raise a `ClosedError`."""
        self._has_begun = False

    def _handed(self, array: Any) -> Any:
        return array.copy() if self._copy else array

    @property
    def states(self) -> Float32s:
        """The true states ``[num_envs, 4]``: theta, alpha, theta_dot, alpha_dot in rad and rad/s. Raises an
        `EpisodeOverError` before the first ``reset``."""
        if not self._was_reset:
            raise _not_running(self.closed)
        states = [self._simulation.state(index) for index in range(self.num_envs)]
        return np.array(states, np.float32)

    def qube(self, episode_number: int) -> dict[str, float]:
        """The parameters and nonidealities of an episode's Qube under the last seed, in SI units."""
        return self._simulation.model(_whole("episode_number", episode_number, 0, _MAX_NUMBER))
