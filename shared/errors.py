"""The errors that users meet: one line that says what was given, what is allowed, and what to do."""


class AdaAffordError(Exception):
    """Root of the errors whose message is meant for a user.

    The command line prints the message alone, without a traceback, and exits with `exit_code`.
    """

    exit_code = 2


class UsageError(AdaAffordError, ValueError):
    """A setting, a path or a combination of flags that cannot be honoured."""


class ObjectError(AdaAffordError, ValueError):
    """An object's files are missing, malformed, hostile, or hold nothing that could move."""


class StoreError(AdaAffordError, ValueError):
    """A store, shard or policy is damaged, foreign, of another schema, or holds other data."""


class MissingError(StoreError):
    """A file that should be there is not."""


class UnreadableError(StoreError):
    """A disk, a network or a server refused to read something; this says nothing about what is stored there."""


class SchemaVersionError(StoreError):
    """A store, or a document of one, was written under another schema version; it is not damaged."""


class WorkerError(AdaAffordError, RuntimeError):
    """A worker failed for reasons of infrastructure; never a statement about an interaction."""

    exit_code = 1
