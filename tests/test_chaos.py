"""A sample of ``make chaos``."""

from pathlib import Path

import pytest

from tests.chaos.__main__ import main


@pytest.mark.slow
def test_a_recording_that_is_killed_loses_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--only", "record", "--kills", "2", "--disks", "1", "--scratch", str(tmp_path)]) == 0
    assert "0 violations" in capsys.readouterr().out
    assert list(tmp_path.iterdir()) == []
