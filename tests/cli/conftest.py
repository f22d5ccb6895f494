"""Offer the command line to the tests of commands."""

import sys

import pytest

from vssm_gym.cli import main as main_module


@pytest.fixture
def vssm(monkeypatch, capsys):
    """Run the console script in this process: ``vssm("doctor", "--help") -> (exit code, stdout, stderr)``."""

    def run(*arguments: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["vssm-gym", *map(str, arguments)])
        try:
            code = main_module.main()
        except SystemExit as stop:
            code = stop.code or 0
        captured = capsys.readouterr()
        return code, captured.out, captured.err

    return run
