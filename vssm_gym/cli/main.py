"""Parse the arguments of ``vssm-gym COMMAND``, run the command, and report bad input as one line.

A command is a function in a file of this folder. Only the file of the requested command is imported, and the libraries
that it uses are imported inside the function, so that help appears at once.
"""

import atexit
import functools
import importlib
import os
import signal
import sys
from collections.abc import Callable
from typing import Any, NoReturn

from tyro.conf import FlagCreatePairsOff
from tyro.extras import SubcommandApp

from vssm_gym.cli.shared.console import say
from vssm_gym.cli.shared.interruption import termination_as_interrupt
from vssm_gym.errors import InputError, OutputError
from vssm_gym.files.atomic import REFUSALS
from vssm_gym.version import __version__

# In the order of use: "file.function"; a dictionary holds subcommands.
COMMANDS: dict[str, Any] = {
    "demo": "demo.demo",
    "play": "play.play",
    "scene": {"preview": "scene.preview", "import": "scene.import_", "generate": "scene.generate"},
    "record": "record.record",
    "map": {"build": "map.build", "export": "map.export"},
    "dataset": {
        "export": "datasets.export.export",
        "from-habitat": "datasets.habitat.from_habitat",
        "to-habitat": "datasets.habitat.to_habitat",
    },
    "train": "train.train",
    "train-dynamics": "train.train_dynamics",
    "curves": "curves.curves",
    "evaluate": "evaluate.evaluate",
    "navigate": "navigate.navigate",
    "explore": "explore.explore",
    "sweep": "sweep.sweep",
    "merge": "sweeps.merge.merge",
    "benchmark": "sweeps.benchmark.benchmark",
    "reproduce": "sweeps.reproduce.reproduce",
    "report": "report.report",
    "slam": "slam.slam",
    "slam2d": "slam2d.slam2d",
    "evaluate-trajectory": "evaluate_trajectory.evaluate_trajectory",
    "bench": "bench.bench",
    "study": {
        "map-update": "studies.recordings.map_update",
        "resolution": "studies.recordings.resolution",
        "runtime": "studies.recordings.runtime",
        "calibration": "studies.recordings.calibration",
        "map-reliability": "studies.simulated.map_reliability",
        "flight": "studies.simulated.flight",
        "relocalisation": "studies.posteriors.relocalisation",
        "smoothing": "studies.simulated.smoothing",
        "pose-flow": "studies.posteriors.pose_flow",
        "pose-ambiguity": "studies.posteriors.pose_ambiguity",
        "maze-exploration": "studies.mazes.maze_exploration",
        "maze-slam": "studies.mazes.maze_slam",
    },
    "faults": {"slam": "faults.slam", "navigation": "faults.navigation"},
    "doctor": "doctor.doctor",
}

DESCRIPTION = "Indoor Gymnasium environments, a spatial world model inferred in real time, and agents that plan in it."
FAILED = 1  # a file could not be written
BAD_INPUT = 2  # also what a wrong option exits with
INTERRUPTED = (128 + signal.SIGINT, 128 + signal.SIGTERM)  # by Ctrl-C, by a scheduler


def program() -> NoReturn:
    """Run :func:`main` and end the process with its exit code.

    An interrupted one ends without Python's last collection of garbage: it may wait for ever for threads of XLA whose
    computation was left half-way.
    """
    code = main()
    if code in INTERRUPTED:
        atexit._run_exitfuncs()
        sys.stdout.flush()
        os._exit(code)
    sys.exit(code)


def main() -> int:
    """Run the command that ``sys.argv`` names and return the exit code."""
    with termination_as_interrupt() as interrupted:
        return _report(_run, interrupted)


def _run() -> Any:
    """Parse ``sys.argv`` and run the command; ``--help`` and wrong options end in ``SystemExit``."""
    if sys.argv[1:] == ["--version"]:
        say(f"vssm-gym {__version__}")
        return 0
    arguments = sys.argv[1:] or ["--help"]
    name = arguments[0]
    commands = {name: COMMANDS[name]} if name in COMMANDS else COMMANDS
    try:
        run = build_app(commands, brief=name not in COMMANDS).cli(
            prog="vssm-gym", description=DESCRIPTION, args=arguments, config=(FlagCreatePairsOff,)
        )
    finally:
        sys.stdout.flush()  # the help: a pipe that its reader has closed fails here and not at exit
    return run()


def _report(run: Callable[[], Any], interrupted: Callable[[], int]) -> int:
    """Run a command, print the errors that a user can mend as one line each, and return the exit code."""
    try:
        result = run()
        sys.stdout.flush()
    except InputError as error:
        say(f"error: {error}", error=True)
        return BAD_INPUT
    except KeyboardInterrupt as error:
        say(f"interrupted: {str(error) or 'what was finished is kept'}", error=True)
        return interrupted()
    except BrokenPipeError:  # the reader has closed the pipe, as `head -1` does
        _leave_stdout()
        return 0
    except OSError as error:
        if not isinstance(error, OutputError) and error.errno not in REFUSALS:
            raise
        about = f"{error.filename}: " if error.filename else ""
        say(f"error: {error if isinstance(error, OutputError) else about + str(error.strerror)}", error=True)
        _leave_stdout()
        return FAILED
    return result if isinstance(result, int) else 0


def _leave_stdout() -> None:
    """Print what is left to print if that is possible; the flush at exit must not fail."""
    try:
        sys.stdout.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def build_app(commands: dict[str, Any], brief: bool = False) -> SubcommandApp:
    """Build the parser of a tree of commands; it returns the chosen command with its arguments bound, not yet called.

    Args:
        commands: name of each command to ``"file.function"``, or to a dictionary of subcommands.
        brief: keep only the first paragraph of each docstring, which the list of all commands shows.
    """
    app = SubcommandApp()
    for name, target in commands.items():
        if isinstance(target, dict):
            app.command(build_app(target, brief), name=name, help=f"Commands: {', '.join(target)}.")
        else:
            app.command(name=name)(_deferred(target, brief))
    return app


def _deferred(target: str, brief: bool) -> Callable[..., Callable[[], Any]]:
    """Return the function at ``"file.function"``, changed to bind its arguments instead of running.

    The command then runs outside the parser, which would report its ValueError as a wrong option.
    """
    file, name = target.rsplit(".", 1)
    function = getattr(importlib.import_module(f"vssm_gym.cli.{file}"), name)

    @functools.wraps(function)
    def bind(*args: Any, **kwargs: Any) -> Callable[[], Any]:
        return functools.partial(function, *args, **kwargs)

    if brief:
        bind.__doc__ = (function.__doc__ or "").partition("\n\n")[0]
    return bind
