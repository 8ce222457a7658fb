"""The project's exceptions, with one root."""

__all__ = ["ConfigError", "DataError", "InvalidInputError", "NothingMappedError", "UwDslamError"]


class UwDslamError(Exception):
    """Root of all errors that this package raises on purpose."""


class ConfigError(UwDslamError, ValueError):
    """A setting is unknown, of the wrong type, or out of its range."""


class InvalidInputError(UwDslamError, ValueError):
    """An argument or message is malformed; names the field, its value and what was expected."""


class DataError(UwDslamError, OSError):
    """A file or recording is missing, truncated, or not what it should be."""


class NothingMappedError(DataError):
    """Recordings could be read, but no honest map can be made of them."""
