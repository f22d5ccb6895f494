"""Define a mutant: one plausible error, as a replacement in one file, and the tests that must fail with it."""

from dataclasses import dataclass
from pathlib import Path


class StaleMutantError(Exception):
    """Report a mutant that does not apply to the source any more."""


@dataclass(frozen=True)
class Mutant:
    """Describe one error that an expert could make, and that still runs.

    Attributes:
        name: of the error, unique in the catalogue.
        file: path in the checkout.
        before: text that occurs exactly once in the file.
        after: text that replaces it.
        tests: test files or node ids, one of which must fail.
    """

    name: str
    file: str
    before: str
    after: str
    tests: tuple[str, ...]

    def mutated(self, checkout: Path) -> str:
        """Return the file's text with the error in it.

        Raises:
            StaleMutantError: the file is gone, or the text does not occur exactly once, or nothing would change.
        """
        path = checkout / self.file
        if not path.is_file():
            raise StaleMutantError(f"{self.name}: no file {self.file}")
        text = path.read_text()
        if text.count(self.before) != 1 or self.before == self.after:
            raise StaleMutantError(f"{self.name}: {text.count(self.before)} places in {self.file} with {self.before!r}")
        return text.replace(self.before, self.after)
