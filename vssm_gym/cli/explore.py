"""Run ``vssm-gym explore --scene S --out DIR``: one explorer in one scene, with pictures and a video of the run."""

from pathlib import Path

from vssm_gym.cli.shared.console import say
from vssm_gym.cli.shared.interruption import interruptible

TEST_STARTS = 100  # test tasks of a scene, whose starts can be taken
FILES = "run.mp4", "candidates.png", "run.png", "mesh.png", "map.npz", "run.json"


@interruptible(*FILES)
def explore(
    scene: str,
    out: Path,
    agent: str = "mi_explorer",
    start: int = 0,
    noise: str = "low",
    steps: int = 1500,
    seed: int = 0,
) -> None:
    """Let an explorer map an unknown scene, and show the run.

    OUT gets candidates.png (one choice among candidates, coloured by expected information, for agents that choose so),
    run.png (its path by time), mesh.png (its map from above), map.npz (for `vssm-gym map export`), run.json (the row of
    a sweep) and, with the extra `viz`, run.mp4 (its images, belief and plans).

    Args:
        scene: built-in name (oak), procedural:SEED or path of a scene file.
        out: new or empty folder. Map and pictures are there when the run has ended, the video some minutes later.
        agent: an explorer: mi_explorer, frontier_nearest, frontier_gain, frontier_gain_scan, random_viewpoint or
            random_walk; mi_explorer_estimated_pose, frontier_gain_estimated_pose or frontier_gain_scan_estimated_pose.
        start: number of the scene's test task whose start is taken, 0 to 99.
        noise: execution noise: none, low, mid, high or locobot.
        steps: time limit in steps of 0.2 s.
        seed: seed of the noise and of the agent.
    """
    from vssm_gym.cli.shared.console import print_notices
    from vssm_gym.cli.shared.progress import progress_bars
    from vssm_gym.cli.shared.videos import can_write_videos
    from vssm_gym.errors import InputError
    from vssm_gym.eval.episodes.identity import ExploreSettings
    from vssm_gym.eval.sweep.config import OF_ONE, SweepConfig, check_names
    from vssm_gym.eval.video.explorer_run import explore as run
    from vssm_gym.files.output_folders import check_at_least, check_folder

    for field, value, least in (("start", start, 0), ("steps", steps, 1), ("seed", seed, 0)):
        check_at_least("explore", field, value, least)
    if start >= TEST_STARTS:
        raise InputError("explore", "start", f"at most {TEST_STARTS - 1}, found {start}")
    config = SweepConfig(
        env=("vssm_gym/Explore-v0",),
        scenes=(scene,),
        agents=(agent,),
        noise=(noise,),
        tasks=(start,),
        seeds=(seed,),
        explore=ExploreSettings(steps=steps),
    )
    check_names(config, "explore", OF_ONE)
    check_folder(out)
    video = can_write_videos("explore")
    print_notices([scene])
    with progress_bars() as progress:
        row = run(config, out, video, progress)
    covered = f"{100.0 * row['coverage']:.1f} % covered after {row['path_length']:.1f} m, {row['seconds']:.0f} s"
    say(f"{covered}: {row['status'] if row['stopped'] else 'time limit reached'}")
    say(*(out / name for name in FILES if (out / name).exists()))
    say(f"next: vssm-gym map export {out / 'map.npz'} --out {out}-map")
