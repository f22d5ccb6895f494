"""Execute the tutorials as a reader does: block after block, in one empty folder."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.helpers.paths import CHECKOUT
from tests.test_docs import ids

TUTORIALS = sorted(path for path in (CHECKOUT / "docs/tutorials").glob("*.md") if path.name != "index.md")
BLOCK = re.compile(r"(?:Save this as `([^`\n]+)`:\n\n)?^```(\w*)\n(.*?)^```", re.MULTILINE | re.DOTALL)


@pytest.mark.slow
@pytest.mark.parametrize("page", TUTORIALS, ids=ids)
def test_a_tutorial_runs(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    if page.stem == "train_in_the_map":
        pytest.importorskip("stable_baselines3", reason="needs the extra rl")
    names: dict = {"__name__": "tutorial"}
    for file, language, text in BLOCK.findall(page.read_text()):
        if file:
            Path(file).write_text(text)
        elif language == "python":
            exec(compile(text, ids(page), "exec"), names)
        else:
            assert language == "bash", f"{ids(page)}: a block of {language!r} is not executed"
            path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
            done = subprocess.run(
                ["bash", "-euc", text], env=os.environ | {"PATH": path}, capture_output=True, text=True, check=False
            )
            assert done.returncode == 0, done.stderr[-2000:]


def test_the_list_of_tutorials_has_every_one():
    listed = (CHECKOUT / "docs/tutorials/index.md").read_text()
    assert [page.name for page in TUTORIALS if f"({page.name})" not in listed] == []
