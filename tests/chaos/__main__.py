"""Kill commands at random moments, fill their disks and start them twice: what they had finished has to stay.

    python -m tests.chaos [--kills 50] [--seed 0] [--only NAME ...] [--scratch DIR]

Each command writes one small output, again and again until as many runs as asked for were killed: half of them at a
random time, half just after a random change in the folder. Most are killed by SIGKILL, some by SIGTERM, and some by
SIGINT as from a terminal. After every kill, all that was finished before must still be there; the last run must end,
with the results of a run that nobody disturbed. Then the disk fills up (a small tmpfs, or where none may be mounted a
limit on the size of files), and two runs start on one folder at once. A table says how often each happened; the exit
code is 1 if a claim was violated.
"""

import argparse
import importlib.util
import random
import sys
import tempfile
import time
from pathlib import Path

from tests.chaos.commands import COMMANDS, CONFIGS, INPUTS
from tests.chaos.disks import may_mount
from tests.chaos.disturb import Chaos, Outcome
from tests.chaos.runs import Process
from tests.helpers.box_rooms import two_rooms
from vssm_gym.envs.scenes.scene import save_scene


def make_inputs(folder: Path, commands: list[str]) -> None:
    """Write a scene and configurations; make the recordings and the map that the commands name, and what they need."""
    folder.mkdir()
    save_scene(two_rooms(), folder / "home.json")
    for name, text in CONFIGS.items():
        (folder / name).write_text(text)
    needed: list[str] = []
    for name, line in reversed(INPUTS.items()):  # the later ones are made from the earlier ones
        if any(f"{{0}}/{name}" in one for one in (*commands, *needed)):
            needed.insert(0, line)
    for line in needed:
        ended = Process(line.format(folder).split(), folder).wait()
        if ended.code:
            raise SystemExit(f"vssm-gym {line}: {ended.errors}")


def main(arguments: list[str]) -> int:
    """Disturb the commands, print the table, and return 1 where a claim was violated."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--kills", type=int, default=50, help="of all commands together")
    parser.add_argument("--disks", type=int, default=2, help="that fill up, for each command")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", nargs="+", choices=list(COMMANDS), default=list(COMMANDS))
    parser.add_argument("--scratch", type=Path, help="folder for the outputs; by default one that is removed")
    options = parser.parse_args(arguments)
    missing = {name: [m for m in COMMANDS[name].needs if not importlib.util.find_spec(m)] for name in options.only}
    chosen = {name: COMMANDS[name] for name in options.only if not missing[name]}
    total, outcomes = sum(command.share for command in chosen.values()), {}
    with tempfile.TemporaryDirectory(prefix="chaos-", dir=options.scratch) as folder:
        scratch = Path(folder)
        mounted = may_mount(scratch)
        say(f"full disks: {'a tmpfs' if mounted else 'a limit on the size of files, for no tmpfs may be mounted'}")
        make_inputs(scratch / "inputs", [command.arguments for command in chosen.values()])
        for name, command in chosen.items():
            began = time.monotonic()
            chaos = Chaos(name, command, scratch / "inputs", scratch / name, random.Random(f"{options.seed} {name}"))
            chaos.kill(max(1, round(options.kills * command.share / total)))
            chaos.fill(options.disks, mounted)
            chaos.pair()
            chaos.outcome.seconds = time.monotonic() - began
            outcomes[name] = chaos.outcome
            say(f"{name}: {len(chaos.outcome.violations)} violations, {chaos.outcome.seconds:.0f} s")
    say(table(outcomes))
    for name, lacking in missing.items():
        if lacking:
            say(f"{name}: left out, for it needs {', '.join(lacking)}")
    for name, outcome in outcomes.items():
        for violation in outcome.violations:
            say(f"{name}: violated: {violation}")
    return int(any(outcome.violations for outcome in outcomes.values()))


def table(outcomes: dict[str, Outcome]) -> str:
    """Return one line for each command, and their sum."""
    head = ("command", "KILL", "TERM", "INT", "ended before", "full disks", "two at once", "violations", "seconds")
    lines = [
        (
            name,
            *(str(one.kills.get(number, 0)) for number in ("KILL", "TERM", "INT")),
            *map(str, (one.undisturbed, one.disks, one.pairs, len(one.violations), round(one.seconds))),
        )
        for name, one in outcomes.items()
    ]
    columns = list(zip(*lines, strict=True))[1:]
    lines.append(("all", *(str(sum(map(int, column))) for column in columns)))
    widths = [max(len(line[i]) for line in (head, *lines)) for i in range(len(head))]
    return "\n".join(
        "  ".join(word.rjust(width) for word, width in zip(line, widths, strict=True)) for line in (head, *lines)
    )


def say(text: str) -> None:
    """Print at once."""
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
