"""Test that configurations in YAML become models, or one clear error."""

from pathlib import Path
from typing import Annotated, Literal

import pytest
from pydantic import BaseModel, ConfigDict, Field

from vssm_gym.errors import InputError
from vssm_gym.files.yaml_file import Names, Seeds, read_yaml


class Config(BaseModel):
    model_config = ConfigDict(extra="forbid")
    agents: Names
    seeds: Seeds = (0,)


def read(tmp_path: Path, text: str | bytes) -> Config:
    path = tmp_path / "config.yaml"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return read_yaml(path, Config)


def test_single_values_become_tuples(tmp_path: Path) -> None:
    assert read(tmp_path, "agents: astar\nseeds: [1, 2]") == Config(agents=("astar",), seeds=(1, 2))


@pytest.mark.parametrize(
    "text",
    [
        "agents: 2001-99-99",  # the parser takes it for a date
        "seeds: 0b_",
        "agents: [a, a]",
        "agents: " + "[" * 100_000,
        "- " * 100_000,
        "a: &a [1]\nb: *a",
        "agents: !!python/object/apply:os.system ['true']",
        "- 1",
        "",
        b"\xff\xfe\x00",
        "agents: a\0b",
        "agent: a",
        "agents: a\nseeds: 1.5",
        "x" * (300 << 10),
    ],
)
def test_invalid_configurations_are_refused(tmp_path: Path, text: str | bytes) -> None:
    with pytest.raises(InputError) as refused:
        read(tmp_path, text)
    assert len(str(refused.value)) < 1000 and str(tmp_path) in str(refused.value)


class Part(BaseModel):
    model_config = ConfigDict(extra="forbid")
    kind: Literal["a"]
    seconds: float
    minutes: float = 0.0


class Other(BaseModel):
    kind: Literal["b"]


class Whole(BaseModel):
    model_config = ConfigDict(extra="forbid")
    parts: dict[str, Annotated[Part | Other, Field(discriminator="kind")]]
    seeds: Seeds = (0,)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (
            "parts: {one: {kind: a, second: 1}}",
            "parts.one.second: expected a field that exists here (did you mean 'seconds'?)",
        ),
        (
            "parts: {one: {kind: a, seconds: 1, minute: 1}}",  # one that may be absent
            "parts.one.minute: expected a field that exists here (did you mean 'minutes'?)",
        ),
        ("parts: {one: {kind: a}}", "parts.one.seconds: expected this field"),
        ("parts: {one: {kind: b}}\nseeds: x", "seeds: expected a valid integer"),
        ("parts: {}\nseed: 1", "seed: expected one of the fields parts, seeds (did you mean 'seeds'?)"),
        ("parts: {}\nseeds: [1, x]", "seeds.1: expected a valid integer"),
    ],
)
def test_an_error_names_the_field_as_the_file_has_it(tmp_path: Path, text: str, expected: str) -> None:
    """Kinds of a union, and the list of one value, are no levels of the file; a misspelt field is no missing one."""
    path = tmp_path / "whole.yaml"
    path.write_text(text)
    with pytest.raises(InputError) as refused:
        read_yaml(path, Whole)
    assert expected in str(refused.value)
