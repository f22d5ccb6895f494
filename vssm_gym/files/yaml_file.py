"""Read YAML files that users write into a pydantic model, with one clear error and lists from single values."""

from pathlib import Path
from typing import Annotated, Any, TypeVar, get_args

import yaml
from pydantic import AfterValidator, BaseModel, BeforeValidator, Field, ValidationError

from vssm_gym.errors import InputError, did_you_mean
from vssm_gym.files.bounded import read_text
from vssm_gym.files.json_file import LARGEST_WHOLE

YAML_BYTES = 256 << 10  # of a configuration; the parser reads 100 kB a second
LONGEST_NAME = 1000  # characters of a name or a path
MOST_VALUES = 100_000  # of a list
YAML_DEPTH = 20  # nested lists and mappings; configurations nest 4 deep
T = TypeVar("T")
M = TypeVar("M", bound=BaseModel)


def as_tuple(value: Any) -> Any:
    """Convert a list to a tuple, and anything else to a tuple of one element."""
    return tuple(value) if isinstance(value, (list, tuple)) else (value,)


def distinct(values: tuple[T, ...]) -> tuple[T, ...]:
    """Return the values; raise ValueError for a repeated one."""
    if len(set(values)) != len(values):
        raise ValueError(f"values that differ from each other, found {list(values)!s:.200}")
    return values


def printable(name: str) -> str:
    """Return the name; raise ValueError for an empty one, a very long one, or control characters in it."""
    if not name.isprintable() or not 0 < len(name) <= LONGEST_NAME:
        raise ValueError(f"a name of 1 to {LONGEST_NAME} printable characters, found {name!r:.100}")
    return name


# Of a field that takes one value or a list.
_LIST = (BeforeValidator(as_tuple), AfterValidator(distinct), Field(min_length=1, max_length=MOST_VALUES))
Names = Annotated[tuple[Annotated[str, AfterValidator(printable)], ...], *_LIST]
Seeds = Annotated[tuple[Annotated[int, Field(ge=0, lt=LARGEST_WHOLE)], ...], *_LIST]


def read_yaml(path: Path, model: type[M]) -> M:
    """Read a file of ``model``.

    Raises:
        InputError: no such file, not YAML, or a field that is unknown, missing or malformed.
    """
    text = read_text(path, YAML_BYTES, "a readable YAML file")
    try:
        _check_structure(path, text)
        data = yaml.safe_load(text)
    except InputError:
        raise
    except (yaml.YAMLError, ValueError) as error:  # ValueError: a date such as 2001-99-99, a number such as 0b_
        raise InputError(path, "file", f"valid YAML ({' '.join(str(error).split())})") from error
    if not isinstance(data, dict):
        raise InputError(path, "file", f"fields {', '.join(model.model_fields)}; found {type(data).__name__}")
    try:
        return model.model_validate(data)
    except ValidationError as error:
        raise first_problem(path, error, model, data) from error


def _check_structure(path: Path, text: str) -> None:
    """Raise InputError for aliases and deep nesting, whose cost is out of proportion to the size of the file."""
    depth = 0
    for event in yaml.parse(text, yaml.SafeLoader):
        if isinstance(event, yaml.AliasEvent):
            raise InputError(path, "file", "YAML without aliases (*name): write the value again")
        depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
        if depth > YAML_DEPTH:
            raise InputError(path, "file", f"YAML nested at most {YAML_DEPTH} deep")


def first_problem(path: Path, error: ValidationError, model: type[BaseModel], data: Any) -> InputError:
    """Convert the first problem of ``data``, from a file of ``model``, to an :class:`InputError`.

    An unknown field comes before a missing one: it may be that one, misspelt.
    """
    problems = error.errors()
    problem = next((one for one in problems if one["type"] == "extra_forbidden"), problems[0])
    parts = _parts(problem["loc"], data)
    field = ".".join(parts) or "file"
    if problem["type"] == "extra_forbidden":
        known = _fields_at(model, problem["loc"][:-1])
        expected = f"one of the fields {', '.join(known)}" if len(parts) == 1 else "a field that exists here"
        return InputError(path, field, f"{expected}{did_you_mean(known, parts[-1])}")
    if problem["type"] == "missing":
        return InputError(path, field, "this field")
    if problem["type"] == "too_short":
        return InputError(path, field, f"at least {problem['ctx']['min_length']} value; found none")
    return InputError(path, field, problem["msg"].removeprefix("Value error, ").removeprefix("Input should be "))


def _fields_at(model: type[BaseModel], place: tuple[int | str, ...]) -> list[str]:
    """Return the names of the fields at a place in a model; of all kinds where there are several."""
    models = [model]
    for part in place:  # an index, a key or the name of a kind is no field
        fields = [one.model_fields[part] for one in models if isinstance(part, str) and part in one.model_fields]
        models = [found for field in fields for found in _models_of(field.annotation)] or models
    return list(dict.fromkeys(name for one in models for name in one.model_fields))


def _models_of(annotation: Any) -> list[type[BaseModel]]:
    """Return the models that an annotation names, in lists, mappings and unions too."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [found for part in get_args(annotation) for found in _models_of(part)]


def _parts(place: tuple[int | str, ...], data: Any) -> list[str]:
    """Return the keys and indices of a place that the file has; pydantic's also names kinds, and items of no list."""
    parts = []
    for k, part in enumerate(place):
        if isinstance(data, dict) and (part in data or k == len(place) - 1):
            data = data.get(part)
        elif isinstance(data, list) and isinstance(part, int) and part < len(data):
            data = data[part]
        else:
            continue
        parts.append(str(part))
    return parts
