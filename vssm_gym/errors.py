"""One error type for input that people bring: it names the source, the field and what was expected."""


class InputError(ValueError):
    """Bad input: ``source`` (a file or argument), ``field`` within it, and what was ``expected``.

    The command line prints its message alone, without a traceback.
    """

    def __init__(self, source: object, field: str, expected: str) -> None:
        self.source, self.field, self.expected = str(source), field, expected
        super().__init__(f"{source}: {field}: expected {expected}")

    def __reduce__(self) -> tuple[type["InputError"], tuple[str, str, str]]:
        """For workers, whose errors come back pickled: by the three arguments, not by the sentence made of them."""
        return type(self), (self.source, self.field, self.expected)
