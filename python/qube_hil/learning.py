"""Training by the program's PPO, and identification."""

import json
import math
import os
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from . import _core
from . import distributions as _distributions
from . import settings as _settings
from .distributions import Distribution
from .errors import SettingsError
from .policies import Policy


@dataclass(frozen=True)
class Trained:
    """The result of a training."""

    policy: Policy
    """The policy with the highest score of all updates."""
    best_return: float
    """Its mean return during training, too high on average because it is the best of many: evaluate the policy afresh."""
    curve: dict[str, npt.NDArray[np.float64]]
    """The learning curve: arrays ``[updates]`` by name."""


def train(
    model: str = "nominal",
    *,
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
        model, distributions: Distribution of the simulated Qubes, as for `QubeEnv`.
        preset: Budget and settings: ``quick`` (seconds), ``robust`` (half a minute) or ``thesis``.
        simulation: Sensors, history, reward and box, as for `QubeEnv`; None stands for the preset's.
        seed: Seed of every random number.
        initial: Policy whose weights the training starts from, as the option `--from`. It must see the same observation
            and have the layers of a trained policy; otherwise `train` raises a `PolicyError`. The command's
            record names the file of this policy; the record of the result here names none.
        callback: Called after each update with its statistics, such as ``mean_return``. An exception ends the training.
        changes: Settings of the training that differ from the preset's, such as ``updates=20``. A policy's record then
            names the preset ``custom``, except after ``voltage_change_weight`` and ``threads``, which are options of the
            command too. ``largest_gradient_norm=math.inf`` limits no gradient.

    Ctrl-C ends the training with a ``KeyboardInterrupt``.
    """

    def on_update(update: str) -> None:
        if callback is not None:
            callback(json.loads(update))

    if initial is not None and not isinstance(initial, Policy):
        raise SettingsError(f"initial = {initial!r}: give a Policy; Policy.load reads a file")
    # JSON has no number for no limit: null stands for it.
    if changes.get("largest_gradient_norm") == math.inf:
        changes["largest_gradient_norm"] = None
    changed = _settings.as_json(changes, "the training's")
    if not isinstance(seed, (int, np.integer)) or not 0 <= seed < 2**64:
        raise SettingsError(f"seed = {seed!r}: give one whole number from 0 to 2^64 - 1")
    core, best_return, curve = _core.train(
        model,
        _distributions.written(distributions),
        preset,
        None if simulation is None else _settings.written(simulation),
        changed,
        int(seed),
        None if initial is None else initial._core,
        on_update,
    )
    points = json.loads(curve)
    columns = {name: np.array([point[name] for point in points], np.float64) for name in points[0]}
    return Trained(Policy(core), best_return, columns)


@dataclass(frozen=True)
class Estimate:
    """The estimate of one quantity of a Qube."""

    value: float
    """Value in its SI unit."""
    standard_error: float
    """Standard error in the same unit."""
    told_by_data: float
    """Share of the prior variance that the data removed; near 0, the value is the prior's."""


@dataclass(frozen=True)
class IncompleteRecording:
    """A recording that holds only a part of its rollout."""

    file: str
    """Path of the file."""
    reason: str
    """Why: its end or ticks are missing, or the rollout ended early."""
    used_s: float
    """Duration of the motion that was fitted, s."""


@dataclass(frozen=True)
class LeftOutRecording:
    """A recording that was not used: it is too short, or too little moves in it."""

    file: str
    """Path of the file."""
    reason: str
    """What it lacks, in a sentence that names the file."""


@dataclass(frozen=True)
class Identified:
    """The result of an identification."""

    estimates: dict[str, Estimate]
    """Estimates by the quantity's name."""
    verdict: str
    """Whether the model describes the Qube: ``fits``, ``fits_but`` or ``does_not_fit``."""
    doubts: list[str]
    """Names of the effects that the model seems to lack."""
    profile: str
    """The profile as TOML, as the program's commands read it."""
    incomplete: list[IncompleteRecording]
    """Recordings that hold only a part of their rollouts; the fit used that part."""
    left_out: list[LeftOutRecording]
    """Recordings that are too short, or in which too little moves; the fit did not use them."""


def identify(
    recordings: Iterable[str | os.PathLike[str]],
    *,
    name: str = "identified",
    fixed: Iterable[str] = (),
) -> Identified:
    """Fits a Qube to recordings by maximum likelihood.

    Args:
        recordings: Files, each named once, of the same plant: MCAP, or CSV with the columns of
            `docs/reference/files.md`. A CSV file is taken to be of the plant of the files before it, else of the Qube.
        name: Name of the profile.
        fixed: Names of the quantities that keep their nominal values.
    """
    if isinstance(recordings, (str, os.PathLike)):
        recordings = [recordings]
    paths = [os.fspath(path) for path in recordings]
    read = json.loads(_core.identify(paths, name, list(fixed)))
    estimates = {it.pop("name"): Estimate(**it) for it in read["estimates"]}
    incomplete = [IncompleteRecording(**it) for it in read["incomplete"]]
    left_out = [LeftOutRecording(**it) for it in read["left_out"]]
    return Identified(
        estimates, read["verdict"], read["doubts"], read["profile"], incomplete, left_out
    )
