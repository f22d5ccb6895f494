"""Run ``vssm-gym dataset export SOURCE``: episodes or a recording in Minari's or LeRobot's format."""

from pathlib import Path
from typing import Annotated, Literal

import tyro

from vssm_gym.cli.shared.console import say
from vssm_gym.cli.shared.interruption import interruptible

READ_WITH = {  # what reads a data set of each format
    "minari": "minari.MinariDataset({folder!r})",
    "lerobot": "LeRobotDataset(NAME, root={folder!r})",
}


@interruptible()
def export(
    source: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SOURCE")],
    out: Path,
    format: Literal["minari", "lerobot"] = "minari",
    map: Path | None = None,
    scenes: Annotated[tuple[str, ...], tyro.conf.arg(metavar="SCENE")] = (),
    agents: Annotated[tuple[str, ...], tyro.conf.arg(metavar="AGENT")] = (),
    seed: int = 0,
) -> None:
    """Export the episodes of a configuration, or a recording, as a data set of Minari or LeRobot.

    Of a configuration of `vssm-gym sweep` the episodes are driven here, one after the other, and every observation,
    action, reward, end and info is kept. Nothing is rounded: images are stored without loss, depth of the simulator as
    the floating-point metres that were observed, depth of a recording as the whole numbers in its files.

    Args:
        source: YAML file of a sweep with one environment, or a TUM folder of `vssm-gym record`.
        out: new or empty folder; it appears when the data set is complete. Of Minari its name is the data set's id,
            with a version at its end, as demo-v0.
        format: of Minari, or of LeRobot (version 3.0).
        map: of a configuration of one scene: a map of it for the agents in place of a learned one; oak comes along.
        scenes: of a configuration: in place of its scenes.
        agents: of a configuration: in place of its agents. All of a data set observe the true pose, or none.
        seed: of a configuration: seed of the recorded drives from which maps are learned.
    """
    from vssm_gym.cli.shared.console import print_notices
    from vssm_gym.cli.shared.progress import progress_bars
    from vssm_gym.data.datasets.formats import check_export, write_dataset
    from vssm_gym.data.datasets.recordings import read_recording
    from vssm_gym.errors import InputError
    from vssm_gym.files.output_folders import check_at_least
    from vssm_gym.version import package_version

    check_at_least("dataset", "seed", seed, 0)
    check_export("dataset", format, out)
    if source.is_dir():
        for name, value in (
            ("map", map),
            ("scenes", scenes or None),
            ("agents", agents or None),
            ("seed", seed or None),
        ):
            if value is not None:
                raise InputError("dataset", name, "none with a recording: it belongs to a configuration")
        description, episode = read_recording(source, package_version())
        for notice in episode.metadata["notices"]:
            say(f"warning: {notice}", error=True)
        episodes, steps = write_dataset(format, lambda _: (description, [episode]), out)
    else:
        from vssm_gym.cli.datasets.given_map import check_given_map
        from vssm_gym.eval.sweep.config import load_config
        from vssm_gym.eval.sweep.recorded import recorded_episodes

        config = load_config(source, scenes, agents)
        notice = None if map is None else check_given_map(config, map)
        print_notices(config.scenes)
        if notice:
            say(f"warning: {notice}", error=True)
        with progress_bars() as progress:
            episodes, steps = write_dataset(
                format, lambda scratch: recorded_episodes(config, scratch, seed, map, progress), out
            )
    folder = str(out / "data" if format == "minari" else out)
    say(f"{episodes} episode{'s' * (episodes != 1)}, {steps} steps: {out}")
    say(f"read it with: {READ_WITH[format].format(folder=folder)}")
