"""Recordings of rollouts."""

import json
import os
from typing import Any

import numpy.typing as npt

from . import _core
from .errors import RecordingError
from .policies import Policy
from .settings import as_path


class Recording(dict[str, npt.NDArray[Any]]):
    """A rollout, one entry a tick: a dictionary of arrays by name, each ``[ticks]``.

    ``pandas.DataFrame(recording)`` and ``polars.DataFrame(recording)`` make tables of it. The columns: ``tick``,
    ``time_s`` (since the first tick), ``phase`` (settling, running or braking), the state that the policy sees
    (``theta_rad``, ``alpha_rad``, ``theta_dot_rad_s``, ``alpha_dot_rad_s``), ``wanted_v`` (given by the policy,
    where no test push replaced its voltage, by settling or by the brake), ``voltage_v`` (sent), ``reward`` (0 outside
    of running), the sample (``has_sample``, ``device_time_s``, ``theta_counts``, ``alpha_counts``,
    ``measured_theta_rad``, ``measured_alpha_rad``, ``tachometer_rad_s``, ``current_a``, ``applied_v``,
    ``sample_to_act_us``), and the timing (``lateness_us``, ``turnaround_us``, ``skipped_periods``). Numbers that a tick
    does not have are NaN.
    """

    header: dict[str, Any]
    """The record before the rollout: device, settings, seed, versions."""
    outcome: dict[str, Any] | None
    """The record after the rollout: ``ending`` (a dictionary with its ``kind``), ``steps``, latencies; None if the
    recording does not say how the rollout ended: it was cut off before."""
    return_: float
    """Sum of the rewards of the ticks that the file has: of a part of the rollout if the recording is not whole."""
    is_whole: bool
    """True if the file is complete; false for a recording that was cut off, even if it was recovered since."""
    _policy: bytes

    @property
    def policy(self) -> Policy:
        """The policy that drove the rollout."""
        return Policy.from_bytes(self._policy)


def recording(path: str | os.PathLike[str], *, partial: bool = False) -> Recording:
    """Reads a recording and checks every byte of it.

    Args:
        path: File of the recording.
        partial: If true, a recording that is cut off gives its whole ticks, and its ``is_whole`` is false.

    Raises:
        RecordingError: The file cannot be read, a byte of it has changed, or it is cut off and ``partial`` is false. A
            recording that ``qube-hil recover`` has saved is not cut off, although ``is_whole`` is false.
        SettingsError: ``path`` is no path.
    """
    file = as_path("path", path, "the path of a recording")
    read = _core.read_recording(file)
    if read["cut"] and not partial:
        ticks = len(read["columns"]["tick"])
        raise RecordingError(
            f"{file}: the recording is cut off, and {ticks} ticks of it are whole ({read['cut']}): give partial=True "
            "to read these, or save them by `qube-hil recover`"
        )
    made = Recording(read["columns"])
    made.header = json.loads(read["header"])
    made.outcome = None if read["outcome"] is None else json.loads(read["outcome"])
    made.return_ = read["return"]
    made.is_whole = read["whole"]
    made._policy = read["policy"]
    return made
