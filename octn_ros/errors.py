"""The errors and warnings of the core: each says what was expected, what was found and what to do."""


class OctnError(Exception):
    """Base of every error that wrong input or a wrong state can cause in this package."""


class ConfigurationError(OctnError):
    """A setting has the wrong type or lies outside its range."""


class VolumeError(OctnError):
    """A C-scan, its file or its geometry cannot be used."""


class CheckpointError(OctnError):
    """A stored or received field cannot be read, or is not one of ours."""


class TrainingError(OctnError):
    """A fit cannot start or has gone wrong."""


class QueryError(OctnError):
    """A query asks for something outside the field or not in it."""


class CalibrationError(OctnError):
    """A calibration is missing, unreadable or not a rigid transform."""


class PlanError(OctnError):
    """A plan cannot be made as asked."""


class ExecutionError(OctnError):
    """The arm refuses a plan or a command."""


class OctnWarning(UserWarning):
    """Base of every warning of this package."""


class BackendWarning(OctnWarning):
    """A fast back end was asked for, or would be worth having, and plain torch does its work instead."""


def in_words(error: Exception) -> str:
    """Return the reason that an error gives, and of one that is none of the package's also its type."""
    return str(error) if isinstance(error, OctnError) else f"{type(error).__name__}: {error}"
