"""Settings of a simulation, which are those of the program's files."""

import json
from collections.abc import Mapping
from typing import Any, Final

from .errors import SettingsError

#: Settings by name. ``thesis``: true states, and a box of 2.3 rad for the arm. ``machine``: encoders, and the velocity
#: filter that runs on the machine. ``robust``: as ``machine``, with the last two commands in the observation and a box
#: of 1.7 rad, for policies that are to run on a Qube.
PRESETS: Final[dict[str, dict[str, Any]]] = {
    "thesis": {},
    "machine": {"sensors": {"type": "encoders"}},
    "robust": {
        "sensors": {"type": "encoders"},
        "history": 2,
        "safety_box": {"theta": 1.7},
    },
}


def written(settings: str | Mapping[str, Any]) -> str:
    """The settings as JSON; a name stands for those of `PRESETS`."""
    if isinstance(settings, str):
        if settings not in PRESETS:
            raise SettingsError(
                f"there are no settings {settings!r}: give a mapping or one of {', '.join(PRESETS)}"
            )
        settings = PRESETS[settings]
    try:
        return json.dumps(dict(settings), allow_nan=False)
    except (TypeError, ValueError) as error:
        raise SettingsError(f"the simulation's settings cannot be written as JSON: {error}") from error
