"""Read damaged inputs one after the other, as the driver asks on standard input, and answer what came of each.

A question is a line of JSON ``{"seed": int, "case": int, "folder": path}``; the answer is one with the reader, the kind
of outcome ("read", "refused", "traceback"), seconds of CPU time and the megabytes above the process after imports.
"""

import json
import resource
import sys
import time
import traceback
import warnings
from pathlib import Path

import numpy as np

from tests.fuzz.mutations import mutate
from tests.fuzz.readers import READERS, forget
from tests.fuzz.special_cases import SPECIAL
from vssm_gym.errors import LONGEST_MESSAGE, LONGEST_VALUE, InputError

ADDRESS_SPACE = 6 << 30  # bytes above that of the process after imports: protects the machine, the budget is smaller


def main() -> None:
    """Answer until the input ends."""
    warnings.simplefilter("ignore")
    answers = sys.stdout
    sys.stdout = sys.stderr
    _warm_up()
    held = _status("VmSize")
    resource.setrlimit(resource.RLIMIT_AS, (held + ADDRESS_SPACE, resource.RLIM_INFINITY))
    answers.write(json.dumps({"ready": True}) + "\n")
    answers.flush()
    for line in sys.stdin:
        question = json.loads(line)
        answers.write(json.dumps(answer(Path(question["folder"]), question["seed"], question["case"])) + "\n")
        answers.flush()


def answer(folder: Path, seed: int, case: int) -> dict[str, object]:
    """Make the input of a case in an empty folder, read it, and say what happened."""
    rng = np.random.default_rng([seed, case])
    if case < len(SPECIAL):
        name, change = SPECIAL[case]
        READERS[name].make(folder)
        change(folder)
        how = f"special case {case}"
    else:
        name = sorted(READERS)[case % len(READERS)]
        READERS[name].make(folder)
        how = mutate(folder, rng)
    before = _status("VmRSS")
    Path("/proc/self/clear_refs").write_text("5")  # the peak starts anew
    started, said = time.process_time(), ""
    try:
        READERS[name].read(folder)
        kind = "read"
    except InputError as error:
        kind, said = "refused", str(error)
        longest = max(map(len, said.split()), default=0)
        if not said.isprintable() or longest > LONGEST_VALUE + 10 or len(said) > 2 * LONGEST_MESSAGE:
            kind = "traceback"
    except BaseException:
        kind, said = "traceback", traceback.format_exc()
    seconds = time.process_time() - started
    peak = (_status("VmHWM") - before) / 1e6
    if peak > 200.0:
        forget()
    return {"reader": name, "how": how, "kind": kind, "said": said[-2000:], "seconds": seconds, "megabytes": peak}


def _warm_up() -> None:
    """Read one valid input of each kind: what is imported and compiled then does not count."""
    import tempfile

    for name, reader in READERS.items():
        with tempfile.TemporaryDirectory() as folder:
            reader.make(Path(folder))
            try:
                reader.read(Path(folder))
            except InputError as error:
                raise AssertionError(f"the valid input of {name} is refused") from error


def _status(field: str) -> int:
    """Return bytes of a field of ``/proc/self/status``."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return 1024 * int(next(line for line in lines if line.startswith(field + ":")).split()[1])


if __name__ == "__main__":
    main()
