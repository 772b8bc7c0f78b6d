"""The one error a user can cause: its message names the cause, the number and the remedy."""


class CalibrationError(Exception):
    """Bad input or an impossible request. The CLI prints it as one line and exits with 2."""
