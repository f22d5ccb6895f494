"""Parse the value of a keyword that takes a configuration: a preset's name, the object itself, or its fields."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, Generic, TypeVar

from vssm_gym.errors import InputError

Config = TypeVar("Config")


@dataclass(frozen=True)
class Presets(Generic[Config]):
    """Parse the values of a keyword that accepts configurations of one class.

    Args:
        source: name of what takes the keyword, such as ``environment``; it opens the error message.
        field: name of the keyword.
        kind: the frozen dataclass of the configurations. It checks its own fields.
        named: presets by name; may be empty.
        default: the configuration that None stands for; without one None is refused.
    """

    source: str
    field: str
    kind: type[Config]
    named: Mapping[str, Config]
    default: Config | None = None

    def __call__(self, value: str | Config | Mapping[str, Any] | None) -> Config:
        """Return the preset of a name, the object itself, or one built from a mapping of its fields.

        Raises :class:`InputError` naming the keyword and what is available for anything else.
        """
        if isinstance(value, self.kind):
            return value
        if isinstance(value, str) and value in self.named:
            return self.named[value]
        if value is None and self.default is not None:
            return self.default
        if isinstance(value, Mapping):
            try:
                return self.kind(**value)
            except TypeError:  # a field is unknown or missing, or is no number where one belongs
                pass
        known = [field.name for field in fields(self.kind)]  # type: ignore[arg-type]
        names = f"one of {', '.join(self.named)}, or " if self.named else ""
        article = "an" if self.kind.__name__[0] in "AEIOU" else "a"
        expected = f"{names}{article} {self.kind.__name__}, or a mapping of {', '.join(known)}; found {value!r:.80}"
        raise InputError(self.source, self.field, expected)
