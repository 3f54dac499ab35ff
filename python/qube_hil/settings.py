"""Settings of a simulation, which are those of the program's files."""

import json
from collections.abc import Mapping
from typing import Any

from .errors import SettingsError


def written(settings: str | Mapping[str, Any]) -> str:
    """The settings as JSON. A name stands for settings of the program. ``thesis``: true states, and
    a box of 2.3 rad for the arm. ``machine``: encoders, and the velocity filter that runs on the
    machine. ``robust``: as ``machine``, with the last two commands in the observation and a box of
    1.7 rad, for policies that are to run on a Qube."""
    try:
        return json.dumps(settings if isinstance(settings, str) else dict(settings), allow_nan=False)
    except (TypeError, ValueError) as error:
        raise SettingsError(f"the simulation's settings cannot be written as JSON: {error}") from error
