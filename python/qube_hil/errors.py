"""The exceptions of the package. The text of each names the cause, the place and the remedy."""


class QubeHilError(Exception):
    """Any error of this package."""


class SettingsError(QubeHilError, ValueError):
    """A setting, a distribution or an argument is refused."""


class ActionError(QubeHilError, ValueError):
    """An action or observation has a wrong shape or type, or is not a finite number. A simulation has not advanced; a
    device has braked the arm and switched the motor off."""


class CopyError(QubeHilError, TypeError):
    """An environment cannot be copied or pickled: make another one."""


class EpisodeOverError(QubeHilError, RuntimeError):
    """The episode is over, or none has begun: call ``reset`` first."""


class PolicyError(QubeHilError, ValueError):
    """A policy cannot be read, written, made or used."""


class RecordingError(QubeHilError, ValueError):
    """A recording cannot be read, is cut off, or has a byte that has changed."""


class SessionError(QubeHilError, ValueError):
    """A folder is not a session, a part of it cannot be read, or it has no surrogate."""


class IdentificationError(QubeHilError, ValueError):
    """Recordings cannot be read or fitted, or no Qube explains them."""


class TrainingError(QubeHilError, RuntimeError):
    """A training has failed."""


class DeviceError(QubeHilError, RuntimeError):
    """The Qube cannot be opened, or an episode failed, mostly by a fault. The message says whether the motor is off: after
    a lost link or a restart of the board it may still have its last voltage, and the operator must switch the Qube off."""


class LateError(DeviceError):
    """Too many answers in a row came too late. The arm was braked, and the motor is off."""


class BusyError(QubeHilError, RuntimeError):
    """Another call of the same Qube or simulation is under way. The call that raises this has had no effect."""


class ClosedError(QubeHilError, RuntimeError):
    """The Qube or the environment is closed, or the Qube belongs to another process."""
