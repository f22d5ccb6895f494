"""Pydantic models on files that people bring: the first thing wrong becomes one `InputError`."""

from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from vssm_gym.errors import InputError

Model = TypeVar("Model", bound=BaseModel)


def validated(model: type[Model], data: Any, source: object, at: str = "") -> Model:
    """``model`` built from plain data.

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
