"""Settings of a simulation, which are those of the program's files."""

import json
from collections.abc import Mapping
from typing import Any

import numpy as np

from .errors import SettingsError


def as_json(settings: object, whose: str) -> str:
    """Settings as JSON, in which numbers and arrays of numpy count as Python's own."""

    def plain(value: object) -> object:
        if isinstance(value, (np.generic, np.ndarray)):
            return value.tolist()
        if isinstance(value, Mapping):
            return dict(value)
        raise TypeError(f"{value!r} is no number, text, list or mapping")

    try:
        return json.dumps(settings, allow_nan=False, default=plain)
    except (TypeError, ValueError, RecursionError) as error:
        raise SettingsError(f"{whose} settings cannot be written as JSON: {error}") from error


def written(settings: str | Mapping[str, Any]) -> str:
    """The settings as JSON. A name stands for settings of the program. ``thesis``: true states, and
    a box of 2.3 rad for the arm. ``machine``: encoders, and the velocity filter that runs on the
    machine. ``robust``: as ``machine``, with the last two commands in the observation and a box of
    1.7 rad, for policies that are to run on a Qube."""
    if not isinstance(settings, (str, Mapping)):
        raise SettingsError(f"the simulation's settings are {settings!r}: give a name or a mapping")
    return as_json(settings if isinstance(settings, str) else dict(settings), "the simulation's")
