"""The errors that avis_ctrl raises on purpose, with the exit codes of the command line.

A message states what failed, the measured value, the likely cause and the next step.
"""

from __future__ import annotations


class AvisError(Exception):
    """Base of every error that avis_ctrl raises on purpose."""

    exit_code = 1


class InputError(AvisError, ValueError):
    """Invalid input (exit code 2): one line naming file, field, value and what was expected.

    Examples
    --------
    >>> try:
    ...     ac.tf([1.0, 0.0], [1.0])
    ... except ac.InputError as error:
    ...     print(error)
    improper: numerator of degree 1 over denominator of degree 0
    """

    exit_code = 2

    def __init__(self, expected: str, *, file: object = None, field: str | None = None, value: object = None):
        where = [str(file)] if file is not None else []
        if field is not None:
            where.append(field if value is None else f"{field} = {value!r}")
        super().__init__(": ".join([*where, expected]))
        self.file, self.field, self.value, self.expected = file, field, value, expected

    def in_file(self, file: object) -> InputError:
        """The same error with the file named."""
        return InputError(self.expected, file=file, field=self.field, value=self.value)


class ComputationError(AvisError, ArithmeticError):
    """A failed computation (exit code 3). The message has what failed, the measured value, the cause and the next step.

    Examples
    --------
    >>> try:
    ...     ac.mu_peak(ac.tf([1.0], [1.0, -1.0]), [ac.ComplexScalar(1)])
    ... except ac.ComputationError as error:
    ...     print(error.measured, "-", error.failed)
    pole 1+0j - the bounds of mu need a stable system
    """

    exit_code = 3

    def __init__(self, failed: str, *, measured: str = "", cause: str = "", next_step: str = ""):
        parts = [
            failed,
            measured and f"measured: {measured}",
            cause and f"likely cause: {cause}",
            next_step and f"next: {next_step}",
        ]
        super().__init__("; ".join(part for part in parts if part))
        self.failed, self.measured, self.cause, self.next_step = failed, measured, cause, next_step


class UserInterruptError(AvisError):
    """The user ended a command (exit code 130, as shells report it): what is kept."""

    exit_code = 130
