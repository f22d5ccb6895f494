"""Run ``vssm-gym navigate --scene S --goal G --out DIR``: one navigation task, with pictures and a video."""

from pathlib import Path
from typing import Any

from vssm_gym.cli.shared.console import say
from vssm_gym.cli.shared.interruption import interruptible

MAP = "map.npz"  # of an agent that maps
FILES = "run.mp4", "run.png", MAP, "run.json"
DEFAULTS = {  # the default agents: to (an image, in a given map)
    (False, True): "astar",
    (False, False): "slam_nav",
    (True, True): "astar_image",
    (True, False): "slam_image",
}
GOAL, START = "numbers x,y in metres, or the file of an image", "numbers x,y or x,y,heading in metres and radians"


@interruptible(*FILES)
def navigate(
    scene: str,
    out: Path,
    goal: str | None = None,
    map: Path | None = None,
    agent: str | None = None,
    start: str | None = None,
    noise: str = "low",
    sensor_noise: str = "none",
    steps: int = 500,
    seed: int = 0,
    task: int = 0,
) -> None:
    """Drive one navigation task, in a given map or in an unknown scene, and show the run.

    OUT gets run.png (the run on the map), run.json (the row of a sweep), of an agent that maps map.npz (for `vssm-gym
    map export`) and, with the extra `viz`, run.mp4 (its images; the belief with the driven and the planned path, the
    goal and the pose estimate).

    Args:
        scene: built-in name (oak), procedural:SEED or path of a scene file.
        out: new or empty folder. Map, row and picture are there when the run has ended, the video somewhat later.
        goal: x,y in metres, or the file of an image (PNG or JPEG, 160x120 pixels) that the robot's camera took there:
            where that is, nobody knows, so success is not judged; by default the goal of a test task.
        map: file of `vssm-gym map build`, or the name of a map that comes with the package (oak), for an agent that
            needs one.
        agent: a navigation agent; by default astar with a map, slam_nav without one; to an image astar_image
            with a map, slam_image without one.
        start: x,y or x,y,heading in metres and radians; by default the start of a test task.
        noise: execution noise: none, low, mid, high or locobot.
        sensor_noise: noise of the camera: none, kinect or stereo.
        steps: time limit in steps of 0.2 s.
        seed: seed of the noise and of the agent.
        task: number of the scene's test task whose start and goal are taken where none is given.
    """
    from vssm_gym.cli.shared.arguments import parse_numbers
    from vssm_gym.cli.shared.console import print_notices
    from vssm_gym.cli.shared.progress import progress_bars
    from vssm_gym.cli.shared.videos import can_write_videos
    from vssm_gym.errors import InputError
    from vssm_gym.eval.video.navigator_run import Drive, prepare
    from vssm_gym.eval.video.navigator_run import navigate as run
    from vssm_gym.files.output_folders import check_folder

    to, at = None if goal is None else parse_goal(goal), None
    if start is not None:
        at = parse_numbers("navigate", "start", start, float, START)
        if len(at) not in (2, 3):
            raise InputError("navigate", "start", f"{START}, not {start!r}")
    default = DEFAULTS[isinstance(to, Path), map is not None]
    drive = Drive(
        scene=scene,
        goal=to,
        agent=default if agent is None else agent,
        start=None if at is None else (at[0], at[1], at[2] if len(at) > 2 else 0.0),
        map=map,
        noise=noise,
        sensor_noise=sensor_noise,
        seed=seed,
        steps=steps,
        task=task,
    )
    check_folder(out)
    prepared, video = prepare(drive), can_write_videos("navigate")
    print_notices([scene])
    if prepared.notice:
        say(f"warning: {prepared.notice}", error=True)
    with progress_bars() as progress:
        row = run(prepared, out, video, progress)
    say(summary(row))
    say(*(out / name for name in FILES if (out / name).exists()))
    if (out / MAP).exists():
        say(f"next: vssm-gym map export {out / MAP} --out {out}-map")


def parse_goal(text: str) -> tuple[float, float] | Path:
    """Return x, y (m), or the path of the file of an image; raise InputError for anything else."""
    from vssm_gym.cli.shared.arguments import parse_numbers
    from vssm_gym.errors import InputError
    from vssm_gym.files.bounded import is_file

    if is_file(text):
        return Path(text)
    if "," not in text:
        raise InputError("navigate", "goal", f"{GOAL}; there is no file {text!r}")
    numbers = parse_numbers("navigate", "goal", text, float, GOAL)
    if len(numbers) != 2:
        raise InputError("navigate", "goal", f"{GOAL}, not {text!r}")
    return numbers[0], numbers[1]


def summary(row: dict[str, Any]) -> str:
    """Return how a run has ended, in a line."""
    driven = f"{row['path_length']:.1f} m, {row['steps']} steps"
    if row["success"] is None:
        return f"success is not judged, {driven}: {row['status']}"
    if row["success"]:
        return f"arrived after {driven}, SPL {row['spl']:.2f}"
    return f"failed after {driven}: {row['failure']}"
