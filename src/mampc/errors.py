"""What mampc raises and warns with: every message states what was expected and what came."""


class MampcError(ValueError):
    """An argument, file or model that mampc cannot work with."""


class StudyError(MampcError):
    """A study file with a wrong key, type, value or unit; the message names each place."""


class MampcWarning(UserWarning):
    """Something that works but is probably not what the user wants, such as an unstable closed loop."""
