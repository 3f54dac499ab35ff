"""Training by the program's PPO."""

import json
import math
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from . import _core
from . import distributions as _distributions
from . import settings as _settings
from .distributions import Distribution
from .envs import as_seed
from .errors import SettingsError
from .identification import Identified
from .policies import Policy
from .profiles import around


@dataclass(frozen=True, eq=False)
class Trained:
    """The result of a training; equal to itself only, because it holds arrays."""

    policy: Policy
    """The policy with the highest score of all updates."""
    best_return: float
    """Its mean return during training, too high on average because it is the best of many: evaluate the policy afresh."""
    curve: dict[str, npt.NDArray[np.float64]]
    """The learning curve: arrays ``[updates]`` by name."""


def train(
    model: str | None = None,
    *,
    profile: str | os.PathLike[str] | Identified | None = None,
    spread: float | None = None,
    distributions: Mapping[str, Distribution | float] | None = None,
    preset: str = "quick",
    simulation: str | Mapping[str, Any] | None = None,
    seed: int = 0,
    initial: Policy | None = None,
    callback: Callable[[dict[str, Any]], object] | None = None,
    **changes: Any,
) -> Trained:
    """Trains one policy by PPO, as the command ``train`` does: the same arguments give the same bytes.

    Args:
        model, profile, spread, distributions: Distribution of the simulated Qubes, as for `QubeEnv`. ``profile`` and
            ``spread`` are the options of the command.
        preset: Budget and settings: ``quick`` (seconds), ``robust`` (half a minute) or ``thesis``.
        simulation: Sensors, history, reward and box, as for ``settings`` of `QubeEnv`; None stands for the preset's, with the
            last two commands in the observation if there is a ``profile`` or the model is ``robust``.
        seed: Seed of every random number.
        initial: Policy whose weights the training starts from, as the option `--from`. It must see the same observation
            and have the layers of a trained policy; otherwise `train` raises a `PolicyError`. The command's
            record names the file of this policy; the record of the result here names none.
        callback: Called after each update with its statistics, such as ``mean_return``. An exception ends the training.
        changes: Settings of the training that differ from the preset's, such as ``updates=20``. A policy's record then
            names the preset ``custom``, except after ``voltage_change_weight`` and ``threads``, which are options of the
            command too. ``largest_gradient_norm=math.inf`` limits no gradient.

    Ctrl-C ends the training with a ``KeyboardInterrupt``.

    Raises:
        SettingsError: An argument is refused.
        PolicyError: The training cannot start from ``initial``.
        TrainingError: The training failed.
    """

    def on_update(update: str) -> None:
        if callback is not None:
            callback(json.loads(update))

    if callback is not None and not callable(callback):
        raise SettingsError(f"callback = {_settings.shown(callback)}: give a function of one argument, or None")
    if initial is not None and not isinstance(initial, Policy):
        raise SettingsError(f"initial = {_settings.shown(initial)}: give a Policy; Policy.load reads a file")
    # JSON has no number for no limit: null stands for it.
    if changes.get("largest_gradient_norm") == math.inf:
        changes["largest_gradient_norm"] = None
    changed = _settings.as_json(changes)
    first_seed = as_seed(seed)
    if first_seed is None:
        raise SettingsError("seed = None: give one whole number from 0 to 2^64 - 1")
    core, best_return, curve = _core.train(
        _settings.as_model(model),
        around(profile, spread),
        _distributions.written(distributions),
        _settings.as_text("preset", preset, "quick, robust or thesis"),
        None if simulation is None else _settings.written(simulation, "simulation"),
        changed,
        first_seed,
        None if initial is None else initial._core,
        on_update,
    )
    points = json.loads(curve)
    columns = {name: np.array([point[name] for point in points], np.float64) for name in points[0]}
    return Trained(Policy(core), best_return, columns)
