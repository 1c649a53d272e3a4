"""Exceptions: a program, configuration or environment at fault. Expected outcomes are values.

TrigpointError
├── ConfigError      a setting, an argument or a file the user named cannot be used
├── SourceError      a camera or recording cannot be read
├── ModelError       a network cannot be loaded or does not keep the contract
├── DatabaseError    a map cannot be opened, read or written
└── RequestError     what a peer asks for over the network cannot be done
"""


class TrigpointError(Exception):
    """Base of every error Trigpoint raises on purpose; its text is one line for the user."""


class ConfigError(TrigpointError):
    """A setting, an argument or a file the user named cannot be used."""


class SourceError(TrigpointError):
    """A camera or recording cannot be read."""


class ModelError(TrigpointError):
    """A network cannot be loaded or does not keep the contract."""


class DatabaseError(TrigpointError):
    """A map cannot be opened, read or written."""


class RequestError(TrigpointError):
    """What a peer asks for over the network cannot be done."""
