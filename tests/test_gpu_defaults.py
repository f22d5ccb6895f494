"""Defaults on a GPU: set before JAX reads them or in its configuration, never over a user's choice."""

import os
import subprocess
import sys

import pytest

from vssm_gym.gpu_defaults import PRECISION, SETTINGS

SHOW = "print(jax.config.jax_default_matmul_precision, *(os.environ.get(name) for name in {names!r}))"


@pytest.mark.parametrize("first", ["vssm_gym", "jax"])
@pytest.mark.parametrize(
    ("chosen", "expected"),
    [
        ({}, "highest highest false"),
        ({PRECISION: "tensorfloat32"}, "tensorfloat32 tensorfloat32 false"),
        ({"XLA_PYTHON_CLIENT_PREALLOCATE": "true"}, "highest highest true"),
    ],
)
def test_defaults_hold_whoever_is_imported_first_unless_chosen(
    first: str, chosen: dict[str, str], expected: str
) -> None:
    """Use float32 products and shared memory, in this process and in those that it starts."""
    second = {"vssm_gym": "jax", "jax": "vssm_gym"}[first]
    program = f"import os, {first}\nimport {second}\n{SHOW.format(names=list(SETTINGS))}"
    environment = {name: value for name, value in os.environ.items() if name not in SETTINGS} | chosen
    found = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=True)
    assert found.stdout.split() == expected.split()


def test_configuration_of_a_program_is_kept() -> None:
    """Keep what a program has set in JAX before it imports the package."""
    program = "import jax\njax.config.update('jax_default_matmul_precision', 'bfloat16')\nimport vssm_gym\n"
    program += "print(jax.config.jax_default_matmul_precision)"
    environment = {name: value for name, value in os.environ.items() if name not in SETTINGS}
    found = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "bfloat16"
