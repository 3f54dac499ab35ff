"""The compiled part of the package."""

from collections.abc import Callable
from typing import Any, Final, final

import numpy as np
import numpy.typing as npt

__all__ = [
    "MAX_STEPS",
    "MAX_VOLTAGE_V",
    "VERSION",
    "Device",
    "Policy",
    "Simulation",
    "Surrogate",
    "close_all",
    "device_options",
    "identify",
    "main",
    "read_recording",
    "read_session",
    "train",
]
VERSION: Final[str]
MAX_VOLTAGE_V: Final[float]
MAX_STEPS: Final[int]

@final
class Simulation:
    def __new__(
        cls,
        num_envs: int,
        model: str | None,
        profile: dict[str, Any] | None,
        distributions: str,
        settings: str,
        guard: str,
    ) -> Simulation: ...
    @property
    def observation_size(self) -> int: ...
    @property
    def episodes(self) -> npt.NDArray[np.uint64]: ...
    @property
    def distribution(self) -> str: ...
    def reset(self, seed: int | None, observations: npt.NDArray[np.float32]) -> None: ...
    def step(
        self,
        actions: npt.NDArray[np.float32],
        observations: npt.NDArray[np.float32],
        rewards: npt.NDArray[np.float32],
        terminated: npt.NDArray[np.bool_],
        truncated: npt.NDArray[np.bool_],
        took_over: npt.NDArray[np.bool_],
        final_observations: npt.NDArray[np.float32],
    ) -> bool: ...
    def step_one(
        self, action: npt.NDArray[np.float32]
    ) -> tuple[npt.NDArray[np.float32], float, bool, bool, bool]: ...
    def state(self, index: int) -> list[float]: ...
    def model(self, episode: int) -> dict[str, float]: ...

@final
class Policy:
    @staticmethod
    def load(path: str) -> Policy: ...
    @staticmethod
    def from_bytes(bytes: bytes) -> Policy: ...
    @staticmethod
    def from_layers(
        layers: list[tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]],
        activation: str,
        output: str,
        action_scale_v: float,
        observation: str | None,
        history: int | None,
        corner_rad_s: float | None,
        clip_observation: float | None,
        plant: str | None,
    ) -> Policy: ...
    @staticmethod
    def from_onnx(
        path: str,
        action_scale_v: float | None,
        observation: str | None,
        history: int | None,
        corner_rad_s: float | None,
        clip_observation: float | None,
        plant: str | None,
    ) -> Policy: ...
    def seen_through(self, simulation: Simulation) -> Policy: ...
    def to_onnx(self) -> bytes: ...
    def to_bytes(self) -> bytes: ...
    def save(self, path: str, force: bool) -> None: ...
    @property
    def kind(self) -> str: ...
    @property
    def observation_size(self) -> int: ...
    @property
    def sizes(self) -> list[int] | None: ...
    @property
    def training(self) -> str | None: ...
    @property
    def randomisation(self) -> str | None: ...
    def start(self) -> None: ...
    def voltages(
        self, observations: npt.NDArray[np.float32], voltages_v: npt.NDArray[np.float32]
    ) -> None: ...

@final
class Device:
    def __new__(cls, options: list[str], deadline_ms: float | None, history: int) -> Device: ...
    @property
    def deadline_ms(self) -> float | None: ...
    def reset(self, path: str, seed: int, number: int) -> npt.NDArray[np.float32]: ...
    def step(
        self, voltage_v: float
    ) -> tuple[npt.NDArray[np.float32], float, bool, bool, tuple[int, int, float], tuple[str, float] | None]: ...
    def halt(self) -> None: ...
    def close(self) -> None: ...

@final
class Surrogate:
    def __new__(cls, folder: str) -> Surrogate: ...
    @property
    def ranges(self) -> list[tuple[str, float, float]]: ...
    @property
    def best(self) -> list[float]: ...
    def posterior(self, points: npt.NDArray[np.float64]) -> list[npt.NDArray[np.float64]]: ...

def close_all(devices: list[Device]) -> None: ...
def device_options() -> list[tuple[str, bool]]: ...
def identify(paths: list[str], name: str, fixed: list[str]) -> str: ...
def read_recording(path: str) -> dict[str, Any]: ...
def read_session(folder: str) -> str: ...
def train(
    model: str | None,
    profile: dict[str, Any] | None,
    distributions: str,
    preset: str,
    simulation: str | None,
    changes: str,
    seed: int,
    initial: Policy | None,
    on_update: Callable[[str], None],
) -> tuple[Policy, float, str]: ...
def main(program: str, arguments: list[str]) -> int: ...
