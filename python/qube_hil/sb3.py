"""The simulation for Stable-Baselines3, which must be installed in addition to this package."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from .envs import QubeVectorEnv, Uncopied

try:
    from stable_baselines3.common.vec_env import VecEnv
except ModuleNotFoundError as error:
    if error.name != "stable_baselines3":
        raise
    raise ModuleNotFoundError(
        "qube_hil.sb3 needs Stable-Baselines3: install it by pip install stable-baselines3", name=error.name
    ) from error


class QubeVecEnv(Uncopied, VecEnv):  # type: ignore[misc, unused-ignore]
    """A `QubeVectorEnv` in the interface of Stable-Baselines3; the arguments are the same.

    The last observation of an episode is in ``infos[i]["terminal_observation"]``, and ``infos[i]["TimeLimit.truncated"]``
    is true where the time limit ended it. ``infos[i]["episode"]`` has the return ``r`` and the length ``l`` of the episode,
    as `VecMonitor` names them. All Qubes are one simulation: `get_attr` gives each its entry of an array, and
    `env_method` calls a method once and gives each the result.
    """

    def __init__(self, num_envs: int = 80, **settings: Any) -> None:
        self._envs = QubeVectorEnv(num_envs, **settings)
        self._next_seed: int | None = None
        self._actions = np.zeros((num_envs, 1), np.float32)
        self._returns = np.zeros(num_envs)
        self._lengths = np.zeros(num_envs, np.int64)
        self.render_mode = None
        super().__init__(
            num_envs, self._envs.single_observation_space, self._envs.single_action_space
        )

    def reset(self) -> Any:
        observations, _ = self._envs.reset(seed=self._next_seed)
        self._next_seed = None
        self._returns[:] = 0.0
        self._lengths[:] = 0
        return observations

    def step_async(self, actions: Any) -> None:
        self._actions = actions

    def step_wait(self) -> Any:
        observations, rewards, terminated, truncated, info = self._envs.step(self._actions)
        self._returns += rewards
        self._lengths += 1
        ended = terminated | truncated
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for index in np.flatnonzero(ended):
            infos[index] = {
                "terminal_observation": info["final_obs"][index],
                "TimeLimit.truncated": bool(truncated[index]),
                "episode": {"r": self._returns[index], "l": int(self._lengths[index])},
            }
        self._returns[ended] = 0.0
        self._lengths[ended] = 0
        return observations, rewards, ended, infos

    def seed(self, seed: int | None = None) -> list[int | None]:
        """Gives the next `reset` this seed, which all episodes share."""
        self._next_seed = seed
        return [seed] * self.num_envs

    def close(self) -> None:
        self._envs.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        value = getattr(self._envs, attr_name)
        has_entries = isinstance(value, np.ndarray) and len(value) == self.num_envs
        return [value[index] if has_entries else value for index in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        raise AttributeError(f"{attr_name}: the simulated Qubes have no attribute that can be set")

    def env_method(
        self, method_name: str, *arguments: Any, indices: Any = None, **named: Any
    ) -> list[Any]:
        if method_name in ("reset", "step", "close"):
            raise AttributeError(f"{method_name}: it concerns all Qubes, so call this environment's own {method_name}")
        result = getattr(self._envs, method_name)(*arguments, **named)
        return [result for _ in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        return [False for _ in self._get_indices(indices)]

    def get_images(self) -> Sequence[Any]:
        return [None] * self.num_envs
