"""The console script ``vssm-gym COMMAND``: parses the arguments, runs the command, turns bad input into one line.

A command is the function of its file's name. The files import nothing heavy at the top, so ``vssm-gym --help`` answers
at once and a command pays only for what it uses.
"""

import functools
import importlib
import os
import sys
from collections.abc import Callable
from typing import Any

from tyro.conf import FlagCreatePairsOff
from tyro.extras import SubcommandApp

from vssm_gym.cli.shared.cache import use_compilation_cache
from vssm_gym.errors import InputError

# In the order of use: the file of this folder and the function in it; a dictionary holds commands of its own.
COMMANDS: dict[str, Any] = {
    "demo": "demo.demo",
    "play": "play.play",
    "scene": {"preview": "scene.preview", "import": "scene.import_", "generate": "scene.generate"},
    "record": "record.record",
    "map": {"build": "map.build", "export": "map.export"},
    "train": "train.train",
    "curves": "curves.curves",
    "evaluate": "evaluate.evaluate",
    "explore": "explore.explore",
    "sweep": "sweep.sweep",
    "merge": "merge.merge",
    "report": "report.report",
    "slam": "slam.slam",
    "evaluate-trajectory": "evaluate_trajectory.evaluate_trajectory",
    "bench": "bench.bench",
    "study": {
        "map-update": "study.map_update",
        "resolution": "study.resolution",
        "runtime": "study.runtime",
        "calibration": "study.calibration",
        "flight": "study.flight",
    },
    "doctor": "doctor.doctor",
}

DESCRIPTION = "Indoor Gymnasium environments, a spatial world model inferred in real time, and agents that plan in it."
BAD_INPUT = 2  # also what a wrong option exits with
INTERRUPTED = 130  # what shells report for Ctrl-C: 128 + SIGINT


def main() -> int:
    """Run the command that ``sys.argv`` names; returns the exit code."""
    if sys.argv[1:] == ["--version"]:
        from vssm_gym import __version__

        print(f"vssm-gym {__version__}")
        return 0
    use_compilation_cache()
    arguments = sys.argv[1:] or ["--help"]
    run = build_app(COMMANDS, brief=arguments[0] not in COMMANDS).cli(
        prog="vssm-gym", description=DESCRIPTION, args=arguments, config=(FlagCreatePairsOff,)
    )
    try:
        result = run()
        sys.stdout.flush()
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return BAD_INPUT
    except KeyboardInterrupt:
        print("interrupted: what was finished is kept", file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:  # the reader left, as in `vssm-gym doctor | head -1`; say nothing at exit either
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    return result if isinstance(result, int) else 0


def build_app(commands: dict[str, Any], brief: bool = False) -> SubcommandApp:
    """The tree of commands; parsing returns the chosen command with its arguments bound, not yet called.

    With ``brief`` only the first paragraph of each docstring is kept: enough for the list of all commands.
    """
    app = SubcommandApp()
    for name, target in commands.items():
        if isinstance(target, dict):
            app.command(build_app(target, brief), name=name, help=f"Commands: {', '.join(target)}.")
        else:
            app.command(name=name)(_deferred(target, brief))
    return app


def _deferred(target: str, brief: bool) -> Callable[..., Callable[[], Any]]:
    """The function at ``"file.function"``, made to bind its arguments instead of running.

    It then runs outside the parser, which would take a ValueError of a command for a wrong option.
    """
    file, name = target.split(".")
    function = getattr(importlib.import_module(f"vssm_gym.cli.{file}"), name)

    @functools.wraps(function)
    def bind(*args: Any, **kwargs: Any) -> Callable[[], Any]:
        return functools.partial(function, *args, **kwargs)

    if brief:
        bind.__doc__ = (function.__doc__ or "").partition("\n\n")[0]
    return bind
