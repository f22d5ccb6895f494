"""Define one error type for invalid user input, which names the source, the field and the expected value."""


class InputError(ValueError):
    """Report invalid input: ``source`` (a file or argument), ``field`` within it, and what was ``expected``.

    The command line prints its message alone, without a traceback.
    """

    def __init__(self, source: object, field: str, expected: str) -> None:
        self.source, self.field, self.expected = str(source), field, expected
        super().__init__(f"{source}: {field}: expected {expected}")

    def __reduce__(self) -> tuple[type["InputError"], tuple[str, str, str]]:
        """Pickle by the three arguments, not by the message made of them, for errors of worker processes."""
        return type(self), (self.source, self.field, self.expected)
