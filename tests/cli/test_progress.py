"""Test what a long command says: progress in a log and in a terminal, and one line when it is interrupted."""

import importlib
import inspect
import os
import re
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from vssm_gym.cli import main as main_module
from vssm_gym.cli.shared import progress as progress_module
from vssm_gym.cli.shared.interruption import Interrupted, advice, interruptible, termination_as_interrupt
from vssm_gym.cli.shared.progress import progress_bars, progress_of
from vssm_gym.errors import InputError


@pytest.fixture
def clock(monkeypatch):
    """Replace the clock of the lines by one that a test sets; no line is printed by time."""
    now = [100.0]
    monkeypatch.setattr(progress_module.time, "monotonic", lambda: now[0])
    monkeypatch.setattr(progress_module, "LOG_SECONDS", 3600.0)
    return now


# lines


def test_a_display_that_was_never_called_is_silent(capsys):
    with pytest.raises(InputError), progress_bars():
        raise InputError("a", "b", "c")
    assert capsys.readouterr().err == ""


def test_a_stage_that_ends_is_a_line(capsys, clock):
    with progress_bars() as on_progress:
        on_progress("map", 1, 2)
        clock[0] += 83.0
        on_progress("map", 2, 2)
    assert capsys.readouterr().err == "progress: building the map: 2 of 2, 0:01:23\n"


def test_the_time_left_counts_what_this_run_has_done(clock):
    """20 of 100 were there; 10 more took a minute, so 70 take seven."""
    stage = progress_module._Stage("episodes", 100.0, 20, 20, 100, "")
    assert stage.line(160.0) == "progress: running episodes: 20 of 100, 0:01:00"
    stage.done = 29  # too few to tell: the first are slower, since they compile
    assert stage.line(160.0) == "progress: running episodes: 29 of 100, 0:01:00"
    stage.done = 30
    assert stage.line(160.0) == "progress: running episodes: 30 of 100, 0:01:00, about 0:07:00 left"


def test_a_share_and_a_note_are_shown(capsys, clock):
    with progress_of() as show:
        show("training", 0.0, 1.0, "compiling")
        clock[0] += 3.0
        show("training", 1.0, 1.0, "64 steps")
    assert capsys.readouterr().err == "progress: training: 100 %, 64 steps, 0:00:03\n"


def test_a_stage_that_begins_again_has_a_time_of_its_own(capsys, clock):
    with progress_bars() as on_progress:
        on_progress("vssm-gym", 9, 10)
        clock[0] += 50.0
        on_progress("vssm-gym", 1, 10)
        clock[0] += 9.0
        on_progress("vssm-gym", 10, 10)
    assert capsys.readouterr().err == "progress: vssm-gym: 10 of 10, 0:00:09\n"


def test_lines_come_while_nothing_is_reported(capsys, monkeypatch):
    """Before the first stage, and during one long item, a line comes at every interval."""
    monkeypatch.setattr(progress_module, "LOG_SECONDS", 0.02)
    heard = ""
    with progress_bars() as on_progress:
        for wanted in (
            "progress: building, compiling or writing, 0:00:00\n",
            "progress: running episodes: 3 of 8, 0:00:00\n",
        ):
            deadline = time.monotonic() + 30.0
            while wanted not in heard:
                assert time.monotonic() < deadline, heard
                time.sleep(0.01)
                heard += capsys.readouterr().err
            on_progress("episodes", 3, 8)
    assert "progress" not in {thread.name for thread in threading.enumerate()}


def test_a_name_from_a_file_moves_no_cursor(capsys, clock):
    with progress_bars() as on_progress:
        on_progress("\x1b[2J\nwalk", 1, 1)
    assert capsys.readouterr().err == r"progress: \x1b[2J\nwalk: 1 of 1, 0:00:00" + "\n"


def test_a_terminal_has_bars(capsys, monkeypatch):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    with progress_bars() as on_progress:
        on_progress("map", 1, 2)
    err = capsys.readouterr().err
    assert "building the map" in err and "1/2" in err and "━" in err
    assert "progress: " not in err


# interruptions


def test_an_interrupted_command_says_what_is_kept_and_how_to_resume(tmp_path):
    out = tmp_path / "my out"
    (out / "maps").mkdir(parents=True)
    (out / "episodes.jsonl").write_text("{}\n{}\n")
    (out / "maps" / "oak.npz").write_bytes(b"map")
    kept, arguments = ("episodes.jsonl", "maps/*.npz"), ["sweep", "c.yaml", "--out", str(out)]
    command = f"vssm-gym sweep c.yaml --out '{out}'"
    first = f"{out} keeps episodes.jsonl (2 lines), maps/oak.npz; continue with: {command} --resume"
    assert advice(out, kept, True, arguments) == first
    assert advice(out, kept, True, [*arguments, "--resume"]) == first
    assert advice(out, kept, False, arguments).endswith(f"; start it again with: {command}")
    (out / "maps" / "elm.npz").write_bytes(b"map")
    (out / "maps" / ".oak.npz.7.tmp").write_bytes(b"unfinished")
    assert advice(out, ("maps/*.npz",), True, arguments).startswith(f"{out} keeps 2 of maps/*.npz; ")


def test_an_interruption_that_leaves_nothing_is_said(tmp_path):
    (tmp_path / "episodes.jsonl").touch()
    for out in (tmp_path, tmp_path / "new", tmp_path / "map.npz"):
        said = advice(out, ("episodes.jsonl",), True, ["sweep", "c.yaml"])
        assert said == "no result of this run is kept; start it again with: vssm-gym sweep c.yaml --resume"


def test_the_decorator_finds_the_output_and_keeps_other_errors(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["vssm-gym", "walk"])
    (tmp_path / "steps.txt").write_text("1\n")

    @interruptible("steps.txt")
    def walk(error: type[BaseException] | BaseException, out: Path = tmp_path, resume: bool = False) -> None:
        """Walk."""
        raise error

    with pytest.raises(Interrupted) as found:
        walk(KeyboardInterrupt)
    kept = f"{tmp_path} keeps steps.txt (1 line)"
    assert str(found.value) == f"{kept}; continue with: vssm-gym walk --resume"
    with pytest.raises(ZeroDivisionError):
        walk(ZeroDivisionError)
    with pytest.raises(Interrupted, match=r"^it keeps the best so far$"):  # what the command says itself stays
        walk(Interrupted("it keeps the best so far"))


@pytest.mark.parametrize("handler", [signal.default_int_handler, signal.SIG_IGN], ids=["foreground", "background"])
def test_sigterm_interrupts_and_is_restored(handler):
    outer, before = signal.signal(signal.SIGINT, handler), signal.getsignal(signal.SIGTERM)
    try:
        with termination_as_interrupt() as code:
            assert code() == 130
            with pytest.raises(KeyboardInterrupt):
                os.kill(os.getpid(), signal.SIGTERM)
            assert code() == 143
        assert signal.getsignal(signal.SIGTERM) is before
    finally:
        signal.signal(signal.SIGINT, outer)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_an_interruption_in_a_destructor_comes_again(monkeypatch, number):
    """Python ignores what a destructor raises: a scheduler's signal would be lost in it."""

    class Interrupted:
        def __del__(self):
            os.kill(os.getpid(), number)
            sum(range(10))  # the handler runs here

    outer = signal.signal(signal.SIGINT, signal.default_int_handler)
    ignored = []
    monkeypatch.setattr(sys, "unraisablehook", ignored.append)
    try:
        with termination_as_interrupt() as code, pytest.raises(KeyboardInterrupt):
            Interrupted()
            time.sleep(60.0)
        assert code() == 128 + number
    finally:
        signal.signal(signal.SIGINT, outer)
    assert ignored == []


def test_sigterm_lets_a_training_end_its_update():
    from vssm_gym.training.run import deferred_interrupt

    with termination_as_interrupt(), deferred_interrupt() as interrupted:
        assert not interrupted()
        os.kill(os.getpid(), signal.SIGTERM)
        assert interrupted()


def commands(tree: dict[str, Any]) -> Iterator[Callable[..., Any]]:
    """Yield the function of every command."""
    for target in tree.values():
        if isinstance(target, dict):
            yield from commands(target)
        else:
            file, name = target.rsplit(".", 1)
            yield getattr(importlib.import_module(f"vssm_gym.cli.{file}"), name)


def test_every_command_that_shows_progress_says_how_to_go_on():
    shows = re.compile(r"(progress_bars|progress_of|_live|run_sweep)\(")
    long = [command for command in commands(main_module.COMMANDS) if shows.search(inspect.getsource(command))]
    assert len(long) >= 14
    assert [command.__name__ for command in long if not hasattr(command, "__wrapped__")] == []
