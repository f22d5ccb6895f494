"""Test what the user reads of the first wrong field of a file."""

from typing import Annotated

import pytest
from pydantic import Field

from vssm_gym.envs.validation import StrictModel, validated
from vssm_gym.errors import InputError


class Inner(StrictModel):
    value: int


class Content(StrictModel):
    rooms: Annotated[tuple[int, ...], Field(min_length=1, max_length=3)] = (1,)
    corners: Annotated[list[int], Field(min_length=2, max_length=2, default_factory=lambda: [0, 0])]
    name: Annotated[str, Field(min_length=1, max_length=4, pattern="^[a-z]*$")] = "a"
    size: Annotated[float, Field(gt=0.0)] = 1.0
    inner: tuple[Inner, ...] = ()


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ({"rooms": []}, "rooms: expected a tuple of at least 1 item; found []"),
        ({"rooms": [1, 2, 3, 4]}, "rooms: expected a tuple of at most 3 items; found [1, 2, 3, 4]"),
        ({"corners": [1]}, "corners: expected a list of at least 2 items; found [1]"),
        ({"name": ""}, "name: expected a string of at least 1 character; found ''"),
        ({"name": "abcde"}, "name: expected a string of at most 4 characters; found 'abcde'"),
        ({"name": "A"}, "name: expected a string that matches pattern '^[a-z]*$'; found 'A'"),
        ({"size": 0}, "size: expected greater than 0; found 0"),
        ({"size": float("nan")}, "size: expected a finite number; found nan"),
        ({"inner": [{"value": 1}, {"value": "x" * 200}]}, "inner[1].value: expected a valid integer, "),
        ({"inner": [{}]}, "inner[0].value: expected this field to be present"),
        ({"other": 1}, "other: expected no such field in this format"),
        (3, "content: expected a valid dictionary or instance of Content; found 3"),
    ],
)
def test_the_first_wrong_field_is_named_with_what_was_expected(data, message):
    with pytest.raises(InputError) as refused:
        validated(Content, data, "rooms.json")
    assert str(refused.value).startswith(f"rooms.json: {message}")
    assert len(str(refused.value)) < 300
