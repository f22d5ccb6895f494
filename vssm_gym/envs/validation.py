"""Check files and keywords that users pass in: the first error becomes one `InputError`."""

from typing import Any, TypeVar

import numpy as np
from pydantic import BaseModel, ConfigDict, ValidationError

from vssm_gym.errors import InputError

Model = TypeVar("Model", bound=BaseModel)


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
        expected = first["msg"].removeprefix("Input should be ")
        found = repr(first["input"])
        found = found if len(found) <= 80 else f"{found[:77]}..."
        raise InputError(source, where or "content", f"{expected}; found {found}") from error


def choose(source: str, field: str, value: Any, available: tuple[Any, ...]) -> None:
    """Raise `InputError` naming ``source`` and ``field`` unless ``value`` is one of ``available``."""
    if not any(value is one or (isinstance(value, str) and value == one) for one in available):
        raise InputError(source, field, f"one of {', '.join(map(repr, available))}; found {value!r:.80}")


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
