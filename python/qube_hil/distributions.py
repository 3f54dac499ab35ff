"""Distributions of a simulated Qube's quantities."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from .errors import SettingsError


@dataclass(frozen=True)
class Constant:
    """Always the same value, in the quantity's SI unit."""

    value: float

    def _fields(self) -> dict[str, object]:
        return {"type": "constant", "value": float(self.value)}


@dataclass(frozen=True)
class Normal:
    """A normal distribution in the quantity's SI unit. A draw of a parameter lies between 0.1 and 1.9 times the mean."""

    mean: float
    standard_deviation: float

    def _fields(self) -> dict[str, object]:
        return {
            "type": "normal",
            "mean": float(self.mean),
            "standard_deviation": float(self.standard_deviation),
        }


@dataclass(frozen=True)
class Uniform:
    """A uniform distribution between two values, in the quantity's SI unit."""

    lower: float
    upper: float

    def _fields(self) -> dict[str, object]:
        if not self.lower <= self.upper:
            raise SettingsError(f"Uniform({self.lower}, {self.upper}): give the smaller value first")
        half_width = 0.5 * (self.upper - self.lower)
        return {
            "type": "uniform",
            "mean": 0.5 * (self.lower + self.upper),
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
    named = {}
    for name, distribution in (distributions or {}).items():
        if isinstance(distribution, (int, float)):
            distribution = Constant(distribution)
        if not isinstance(distribution, Distribution):
            raise SettingsError(
                f"{name} is {distribution!r}: give a number, Constant, Normal or Uniform"
            )
        named[name] = distribution._fields()
    try:
        return json.dumps(named, allow_nan=False)
    except ValueError as error:
        raise SettingsError(f"a distribution has a number that is not finite: {named}") from error
