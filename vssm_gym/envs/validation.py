"""Check files and keywords that users pass in: the first error becomes one `InputError`."""

import re
from typing import Any, TypeVar

import numpy as np
from pydantic import BaseModel, ConfigDict, ValidationError

from vssm_gym.errors import InputError, did_you_mean

Model = TypeVar("Model", bound=BaseModel)
# What pydantic says of a list or a text that is too short or too long.
LENGTH = re.compile(r"^(\w+) should have (at (?:least|most) \d+ \w+).*")


class StrictModel(BaseModel):
    """Refuse unknown fields, NaN and infinities; instances are immutable."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


def validated(model: type[Model], data: Any, source: object, at: str = "") -> Model:
    """Build ``model`` from plain data.

    Raises InputError naming ``source``, the first bad field (below the field ``at``) and what was expected of it.
    """
    try:
        return model.model_validate(data)
    except ValidationError as error:
        first = error.errors()[0]
        path = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in first["loc"])
        where = (at + path).lstrip(".")
        where = where if len(where) <= 200 else f"{where[:160]}...{where[-37:]}"  # nested deeply
        inner = first.get("ctx", {}).get("error")
        if isinstance(inner, InputError):  # a rule across fields names its own field
            raise InputError(source, f"{where}.{inner.field}".lstrip("."), inner.expected) from error
        if first["type"] == "missing":
            raise InputError(source, where, "this field to be present") from error
        if first["type"] == "extra_forbidden":
            raise InputError(source, where, "no such field in this format") from error
        expected = re.sub(LENGTH, lambda found: f"a {found[1].lower()} of {found[2]}", first["msg"])
        expected = expected.removeprefix("Input should be ").replace("String should match", "a string that matches")
        found = repr(first["input"])
        found = found if len(found) <= 80 else f"{found[:77]}..."
        raise InputError(source, where or "content", f"{expected}; found {found}") from error


def choose(source: str, field: str, value: Any, available: tuple[Any, ...]) -> None:
    """Raise `InputError` naming ``source`` and ``field`` unless ``value`` is one of ``available``."""
    if not any(value is one or (isinstance(value, str) and value == one) for one in available):
        names = [one for one in available if isinstance(one, str)]
        expected = f"one of {', '.join(map(repr, available))}; found {value!r:.80}{did_you_mean(names, value)}"
        raise InputError(source, field, expected)


def check_options(options: Any, *known: str) -> dict[str, Any]:
    """Return the options of a reset; raise InputError for what is no dictionary, or for a key that is not ``known``."""
    if options is None:
        return {}
    if not isinstance(options, dict):
        raise InputError("reset", "options", f"a dictionary or None; found {options!r:.80}")
    if unknown := [key for key in options if key not in known]:
        names = " and ".join(filter(None, [", ".join(map(repr, known[:-1])), repr(known[-1])]))
        keys = f"key{'s' * (len(known) > 1)} than {names}"
        raise InputError("reset", "options", f"no other {keys}; found {sorted(map(repr, unknown))!s:.100}")
    return dict(options)


def vector_seeds(seed: Any, n: int) -> list[int | None]:
    """Return ``n`` seeds of one for each environment, of the first of consecutive ones, or of None.

    Raises:
        InputError: another number of them, or one that is no whole number >= 0.
    """
    if seed is None:
        return [None] * n
    single = isinstance(seed, int | np.integer)
    seeds = [seed] if single else list(seed) if isinstance(seed, list | tuple | np.ndarray) else ["no list"]
    for one in seeds:
        if one is not None and (isinstance(one, bool) or not isinstance(one, int | np.integer) or one < 0):
            expected = f"a whole number >= 0, or {n} of them or of None"
            raise InputError("reset", "seed", f"{expected}; found {seed!r:.80}")
    if single:
        return [int(seed) + i for i in range(n)]
    if len(seeds) != n:
        raise InputError("reset", "seed", f"{n} seeds; found {len(seeds)}")
    return [None if one is None else int(one) for one in seeds]


def parse_action(action: Any, names: tuple[str, ...]) -> np.ndarray:
    """Return ``action`` as float64, one number for each of ``names``.

    Raise `InputError` for anything but finite numbers.
    """
    wanted = f"{len(names)} numbers ({', '.join(names)})"
    try:
        values = np.asarray(action)
    except ValueError:  # a ragged list
        raise InputError("step", "action", f"{wanted}; found {action!r:.80}") from None
    if values.shape != (len(names),) or values.dtype.kind not in "fiu":
        raise InputError("step", "action", f"{wanted}; found shape {values.shape}, type {values.dtype}")
    if not np.isfinite(values).all():
        raise InputError("step", "action", f"finite numbers; found {values.tolist()}")
    return values.astype(np.float64)
