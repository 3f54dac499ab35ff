"""Profiles of identified Qubes, as the arguments ``profile`` and ``spread`` name them."""

import math
import os
from numbers import Real
from typing import Any

from .errors import SettingsError
from .identification import Identified
from .settings import as_path, shown

#: Default of the argument ``spread``, the same as of the command ``train``.
_SPREAD = 0.1


def around(
    profile: str | os.PathLike[str] | Identified | None, spread: float | None
) -> dict[str, Any] | None:
    """The arguments ``profile`` and ``spread`` for the compiled part; None without a profile."""
    if profile is None:
        if spread is not None:
            raise SettingsError(f"spread = {shown(spread)} without profile: give profile too, or no spread")
        return None
    width = float(spread) if isinstance(spread, Real) else _SPREAD if spread is None else math.nan
    if not 0.0 <= width <= 1.0:
        raise SettingsError(f"spread = {shown(spread)}: give a number from 0 to 1")
    if isinstance(profile, Identified):
        return {"path": None, "text": profile.profile, "spread": width}
    if isinstance(profile, (str, os.PathLike)):
        return {"path": as_path("profile", profile, "the path of a profile"), "text": None, "spread": width}
    raise SettingsError(
        f"profile = {shown(profile)}: give the path of a profile, lab, ideal, or the result of identify"
    )
