"""Policies: files, and their voltages."""

import json
import os
from typing import Any

import numpy as np
import numpy.typing as npt

from . import _core
from ._core import MAX_VOLTAGE_V
from .envs import Float32s
from .errors import ActionError


class Policy:
    """A policy: a trained network, or the classical controller. Files are those of the program."""

    def __init__(self, core: _core.Policy) -> None:
        """Use `Policy.load`, `Policy.from_bytes` or `qube_hil.train`."""
        self._core = core

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> "Policy":
        """Reads a policy file."""
        return cls(_core.Policy.load(os.fspath(path)))

    @classmethod
    def from_bytes(cls, data: bytes) -> "Policy":
        """Reads the bytes of a policy file, such as `Recording.policy`."""
        return cls(_core.Policy.from_bytes(data))

    def to_bytes(self) -> bytes:
        """The bytes of the policy's file; equal policies give equal bytes."""
        return self._core.to_bytes()

    def save(self, path: str | os.PathLike[str], force: bool = False) -> None:
        """Writes the policy file, which appears whole or not at all. A file of that name is replaced with ``force``
        alone."""
        self._core.save(os.fspath(path), force)

    def act(self, observation: npt.ArrayLike) -> Float32s:
        """The action of an environment for an observation: a fraction of 5 V from -1 to 1.

        Takes ``[observation_size]`` and returns ``[1]``, or takes ``[n, observation_size]`` and returns ``[n, 1]``.
        """
        return self.voltage_v(observation) / np.float32(MAX_VOLTAGE_V)

    def voltage_v(self, observation: npt.ArrayLike) -> Float32s:
        """The voltage for an observation, V, within 5 V. The shapes are those of `act`."""
        try:
            observations = np.asarray(observation, np.float32)
        except (TypeError, ValueError) as error:
            raise ActionError(f"the observation is not an array of numbers: {error}") from error
        if observations.ndim not in (1, 2):
            raise ActionError(
                f"the observation has the shape {observations.shape}: give {(self.observation_size,)} "
                f"or (n, {self.observation_size})"
            )
        rows = np.ascontiguousarray(np.atleast_2d(observations))
        voltages: Float32s = np.zeros((rows.shape[0], 1), np.float32)
        self._core.voltages(rows, voltages)
        return voltages[0] if observations.ndim == 1 else voltages

    @property
    def kind(self) -> str:
        """The kind: ``network``, ``classical``, ``excitation``, or ``external`` (a program of its own)."""
        return self._core.kind

    @property
    def observation_size(self) -> int:
        """Length of the observation."""
        return self._core.observation_size

    @property
    def sizes(self) -> list[int] | None:
        """Sizes of the network's layers from the observation to the output; None without a network."""
        return self._core.sizes

    @property
    def training(self) -> dict[str, Any] | None:
        """The record of the training; None without a network."""
        training = self._core.training
        return None if training is None else json.loads(training)

    def __repr__(self) -> str:
        sizes = "" if self.sizes is None else f" {self.sizes}"
        return f"<qube_hil.Policy: {self.kind}{sizes}>"
