"""Run ``vssm-gym play``: drive a robot by keyboard, in any terminal, also over SSH."""

from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from vssm_gym.cli.shared.console import say


def play(
    env: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="ENV")] = "PointNav-v0",
    scene: str | None = None,
    noise: str = "low",
    sensor_noise: str = "none",
    size: str = "160x120",
    plan: bool = False,
    colours: Literal["true", "256"] = "true",
    record: Path | None = None,
    seed: int = 0,
) -> None:
    """Drive a robot by keyboard in the terminal, which shows its images, its goal and its collisions.

    It needs no X server and works over SSH. One key is one step of the robot; between keys nothing moves.

    Args:
        env: the environment's id: PointNav-v0, ImageNav-v0, Explore-v0 or LidarMaze-v0.
        scene: built-in name (oak; of a maze: rooms-v1) or path of a scene file.
        noise: execution noise: none, low, mid or high.
        sensor_noise: noise of the camera (none, kinect, stereo) or of the maze's scanner (none, low, mid, high).
        size: WIDTHxHEIGHT of the camera's images.
        plan: show the view from above from the start; p toggles it.
        colours: 24-bit (true), or 256 for terminals without them.
        record: new or empty folder, in which each episode is recorded as a TUM folder: 1, 2, ...
        seed: seed of tasks and noise.
    """
    import gymnasium as gym

    import vssm_gym  # noqa: F401  (registers the environments)
    from vssm_gym.cli.record import camera_of
    from vssm_gym.cli.shared.console import print_notices
    from vssm_gym.cli.shared.play_session import PLAYABLE, Session
    from vssm_gym.cli.shared.terminal import check_terminal, whole_terminal
    from vssm_gym.errors import InputError
    from vssm_gym.files.output_folders import check_at_least, check_new_folder

    name = env.removeprefix("vssm_gym/")
    if name not in PLAYABLE:
        expected = f"an environment that one key per step can steer ({', '.join(PLAYABLE)}); found {env!r}"
        raise InputError("play", "ENV", expected)
    keys = PLAYABLE[name]
    scene = keys.scene if scene is None else scene
    if record is not None and not keys.camera:
        raise InputError("play", "--record", f"an environment with a camera: {name} has no images to record")
    check_at_least("play", "seed", seed, 0)
    check_terminal("play")
    if record is not None:
        check_new_folder(record)
    camera = camera_of("play", size)
    seeing: dict[str, Any] = {"camera": camera} if keys.camera else {"render_mode": "rgb_array"}
    if keys.camera:
        print_notices([scene])
    world = gym.make(f"vssm_gym/{name}", scene=scene, noise=noise, sensor_noise=sensor_noise, **seeing)
    about = {"motion": "keyboard", "environment": name, "noise": noise, "sensor_noise": sensor_noise, "seed": seed}
    session = Session(world, keys, " · ".join([name, scene, f"noise {noise}"]), record, about, seed)
    session.plan = plan
    try:
        with whole_terminal() as terminal:
            while not session.left:
                terminal.draw(session.screen(*terminal.size, colours))
                for key in terminal.pressed():
                    session.press(key)
    finally:
        session.close()
        world.close()
    say(*session.summary())
