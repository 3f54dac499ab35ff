"""Distributions of a simulated Qube's quantities."""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from numbers import Real
from typing import Any

from .errors import SettingsError
from .settings import shown


def _finite(name: str, number: object) -> float:
    """The number of a distribution with this name as a float."""
    if not isinstance(number, Real):
        raise SettingsError(f"{name} = {shown(number)}: give a number")
    try:
        value = float(number)
    except OverflowError:
        value = math.inf
    if not math.isfinite(value):
        raise SettingsError(f"{name} = {shown(number)}: give a finite number")
    return value


@dataclass(frozen=True)
class Constant:
    """A distribution whose draws are all the same value, in the quantity's SI unit. A value that is not a finite number
    raises a `SettingsError`."""

    value: float

    def __post_init__(self) -> None:
        _finite("value", self.value)

    def _fields(self) -> dict[str, object]:
        return {"type": "constant", "value": _finite("value", self.value)}


@dataclass(frozen=True)
class Normal:
    """A normal distribution in the quantity's SI unit. Draws lie between 0.1 and 1.9 times the mean for a parameter such as
    ``M_p``, and as far from the mean on both sides as its range allows for a nonideality such as ``command_delay_s``.
    Numbers that are not finite, and a negative standard deviation, raise a `SettingsError`."""

    mean: float
    standard_deviation: float

    def __post_init__(self) -> None:
        _finite("mean", self.mean)
        if _finite("standard_deviation", self.standard_deviation) < 0.0:
            raise SettingsError(
                f"Normal({self.mean!r}, {self.standard_deviation!r}): give a standard deviation of 0 or more"
            )

    def _fields(self) -> dict[str, object]:
        return {
            "type": "normal",
            "mean": _finite("mean", self.mean),
            "standard_deviation": _finite("standard_deviation", self.standard_deviation),
        }


@dataclass(frozen=True)
class Uniform:
    """A uniform distribution between two values, in the quantity's SI unit. For a parameter such as ``M_p`` the larger value
    is at most 19 times the smaller one, because draws of a parameter lie between 0.1 and 1.9 times the mean; a wider
    distribution is refused where it is used. Ends that are not finite, and a larger one first, raise a `SettingsError`."""

    lower: float
    upper: float

    def __post_init__(self) -> None:
        lower, upper = _finite("lower", self.lower), _finite("upper", self.upper)
        if not lower <= upper:
            raise SettingsError(f"Uniform({self.lower!r}, {self.upper!r}): give the smaller value first")

    def _fields(self) -> dict[str, object]:
        lower, upper = _finite("lower", self.lower), _finite("upper", self.upper)
        half_width = 0.5 * (upper - lower)
        return {
            "type": "uniform",
            "mean": 0.5 * (lower + upper),
            "standard_deviation": half_width / 3.0**0.5,
        }


Distribution = Constant | Normal | Uniform


def read(fields: Mapping[str, Any]) -> Distribution:
    """The distribution that these fields of a file describe."""
    if fields["type"] == "constant":
        return Constant(fields["value"])
    mean, deviation = fields["mean"], fields["standard_deviation"]
    if fields["type"] == "normal":
        return Normal(mean, deviation)
    half_width = 3.0**0.5 * deviation
    return Uniform(mean - half_width, mean + half_width)


def written(distributions: Mapping[str, Distribution | float] | None) -> str:
    """The distributions by quantity as JSON; a number is a constant."""
    if not isinstance(distributions, Mapping | None):
        raise SettingsError(f"distributions = {shown(distributions)}: give a mapping from names of quantities")
    named = {}
    given: Any
    for name, given in (distributions or {}).items():
        distribution = Constant(_finite(name, given)) if isinstance(given, Real) else given
        if not isinstance(distribution, Distribution):
            raise SettingsError(f"{name} = {shown(given)}: give a number, a Constant, Normal or Uniform")
        named[name] = distribution._fields()
    try:
        return json.dumps(named, allow_nan=False)
    except ValueError as error:
        raise SettingsError(f"a distribution has a number that is not finite: {named}") from error
