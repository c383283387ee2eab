"""What mampc raises: every message states what was expected and what came."""


class MampcError(ValueError):
    """An argument, file or model that mampc cannot work with."""


class StudyError(MampcError):
    """A study file with a wrong key, type, value or unit; the message names each place."""
