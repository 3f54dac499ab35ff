"""Identification of a Qube from recordings."""

import json
import os
from collections.abc import Iterable
from dataclasses import dataclass

from . import _core
from .settings import as_text, as_texts


@dataclass(frozen=True)
class Estimate:
    """The estimate of one quantity of a Qube."""

    value: float
    """Value in its SI unit."""
    standard_error: float
    """Standard error in the same unit."""
    model_error: float
    """Change of the value by the effect that the model seems to lack, which the standard error includes."""
    told_by_data: float
    """Share of the prior variance that the data removed; near 0, the value is the prior's."""


@dataclass(frozen=True)
class IncompleteRecording:
    """A recording that holds only a part of its rollout."""

    file: str
    """Path of the file."""
    reason: str
    """The reason: its end or ticks are missing, or the rollout ended early."""
    used_s: float
    """Duration of the motion that was fitted, s."""


@dataclass(frozen=True)
class LeftOutRecording:
    """A recording that was not used: it is too short, its voltage is too small, or too little moves in it."""

    file: str
    """Path of the file."""
    reason: str
    """The reason, in a sentence that names the file."""


@dataclass(frozen=True)
class Identified:
    """The result of an identification."""

    estimates: dict[str, Estimate]
    """Estimates by the quantity's name."""
    verdict: str
    """The verdict on the model: ``fits``, ``fits_but`` or ``does_not_fit``."""
    doubts: list[str]
    """Names of the effects that the model seems to lack."""
    profile: str
    """The profile as TOML, as the program's commands read it. The argument ``profile`` of `QubeEnv`, `QubeVectorEnv` and
    `train` takes this result itself."""
    incomplete: list[IncompleteRecording]
    """Recordings that hold only a part of their rollouts; the fit used that part."""
    left_out: list[LeftOutRecording]
    """Recordings that the fit did not use: see `LeftOutRecording`."""


def identify(
    recordings: str | os.PathLike[str] | Iterable[str | os.PathLike[str]],
    *,
    name: str = "identified",
    fixed: str | Iterable[str] = (),
) -> Identified:
    """Fits a Qube to recordings: finds the most likely one by weak priors, with the mean of each damping.

    Args:
        recordings: Files, each named once, of the same plant: MCAP, or CSV with the columns of
            `docs/reference/files.md`. A CSV file is taken to be of the plant of the files before it, else of the Qube.
        name: Name of the profile.
        fixed: Names of the quantities that keep their nominal values; a text is one name.

    Raises:
        IdentificationError: The recordings cannot be read or fitted, or no Qube explains them.
        SettingsError: ``recordings`` are no paths, a name in ``fixed`` is unknown, or every quantity is fixed.
    """
    if isinstance(recordings, (str, os.PathLike)):
        recordings = [recordings]
    paths = as_texts("recordings", recordings, "paths of recordings, which `identify` reads itself")
    fixed = as_texts("fixed", [fixed] if isinstance(fixed, str) else fixed, "names of quantities")
    read = json.loads(_core.identify(paths, as_text("name", name, "a name"), fixed))
    estimates = {it.pop("name"): Estimate(**it) for it in read["estimates"]}
    incomplete = [IncompleteRecording(**it) for it in read["incomplete"]]
    left_out = [LeftOutRecording(**it) for it in read["left_out"]]
    return Identified(
        estimates, read["verdict"], read["doubts"], read["profile"], incomplete, left_out
    )
