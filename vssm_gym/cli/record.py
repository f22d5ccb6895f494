"""Run ``vssm-gym record --scene S --out DIR``: record a scene as a TUM folder."""

from pathlib import Path
from typing import TYPE_CHECKING, Literal

from vssm_gym.cli.shared.console import say
from vssm_gym.cli.shared.interruption import interruptible

if TYPE_CHECKING:
    from vssm_gym.envs.sensors import CameraConfig

OWNERS = {  # the motions that an option belongs to
    "robot": ("survey", "wander"),
    "noise": ("survey", "wander", "flight"),
    "seconds": ("wander",),
    "metres": ("handheld",),
    "rate": ("handheld", "flight"),
    "colour": ("handheld",),
    "flight": ("flight",),
    "speed": ("flight",),
    "yaw": ("flight",),
}


@interruptible()
def record(
    scene: str,
    out: Path,
    motion: Literal["survey", "wander", "handheld", "flight"] = "survey",
    robot: str | None = None,
    noise: str | None = None,
    sensor_noise: str = "none",
    seconds: float | None = None,
    metres: float | None = None,
    rate: float | None = None,
    flight: str | None = None,
    speed: float | None = None,
    yaw: Literal["forward", "constant"] | None = None,
    size: str = "160x120",
    colour: Literal["registered", "unregistered"] | None = None,
    seed: int = 0,
) -> None:
    """Record colour, depth, commands and true poses of a scene as a TUM folder.

    In a `survey` a robot drives until it has seen the whole floor: the recording for a map. `wander` drives by drawn
    commands of all kinds: the recording from which its motion is learned. `handheld` carries a camera from room to
    room, 1.3 m above the floor, walking at 0.3 to 0.6 m/s between turns: the recording for SLAM. `flight` follows a
    closed reference flight of a multirotor, from hover to hover, with its IMU in imu.txt; it needs a high, wide room.

    Args:
        scene: built-in name (oak) or path of a scene file.
        out: new or empty folder; it appears when the recording is complete.
        motion: the body that carries the camera.
        robot: that surveys or wanders: holonomic (default), or worn, whose drive responds late, too little and to one
            side.
        noise: execution noise of a drive, or gusts of a flight: none, low (default), mid or high. The recorded poses
            are the true ones.
        sensor_noise: none (exact images), kinect or stereo.
        seconds: duration of a wandering drive; 300 by default.
        metres: minimum path length of a handheld recording; 50 by default.
        rate: frames per second of a handheld camera (10 by default) or of a flight (20).
        flight: star, picasso, figure8 (default) or clover.
        speed: peak speed of a flight, m/s; 2 by default.
        yaw: heading of a flight: along its motion (forward, the default) or constant.
        size: WIDTHxHEIGHT of the images.
        colour: of a handheld recording: registered to depth (default), or unregistered, of a camera 2.5 cm beside it
            whose stated calibration is off; the true one is in calibration_truth.json.
        seed: seed of the path and of all noise.
    """
    from vssm_gym.cli.shared.console import print_notices
    from vssm_gym.cli.shared.progress import progress_bars
    from vssm_gym.data import flights, recording
    from vssm_gym.envs.sensors import rgbd_noise
    from vssm_gym.errors import InputError
    from vssm_gym.files.output_folders import check_at_least, check_folder

    check_at_least("record", "seed", seed, 0)
    check_folder(out)
    given = {"robot": robot, "noise": noise, "seconds": seconds, "metres": metres, "rate": rate}
    given |= {"colour": colour, "flight": flight, "speed": speed, "yaw": yaw}
    for name, owners in OWNERS.items():
        if given[name] is not None and motion not in owners:
            raise InputError("record", name, f"none with --motion {motion}: it belongs to {' and '.join(owners)}")
    camera = camera_of("record", size)
    rgbd_noise.sensor_noise(sensor_noise)  # an unknown name is refused before anything starts
    print_notices([scene])
    following = f"vssm-gym slam {out} --out slam"
    with progress_bars() as progress:
        if motion == "survey":
            frames = recording.record(
                scene,
                out,
                robot=robot or "holonomic",
                noise=noise or "low",
                sensor_noise=sensor_noise,
                camera=camera,
                seed=seed,
                on_progress=progress,
            )
            following = f"vssm-gym map build {out} --out map.npz"
            if robot == "worn":
                following = f"vssm-gym train-dynamics {out} --out drive.npz"
        elif motion == "wander":
            frames = recording.record_wandering(
                scene,
                out,
                seconds=300.0 if seconds is None else seconds,
                robot=robot or "holonomic",
                noise=noise or "low",
                sensor_noise=sensor_noise,
                camera=camera,
                seed=seed,
                on_progress=progress,
            )
            following = f"vssm-gym train-dynamics {out} --out drive.npz"
        elif motion == "handheld":
            frames = recording.record_handheld(
                scene,
                out,
                metres=50.0 if metres is None else metres,
                rate=10.0 if rate is None else rate,
                sensor_noise=sensor_noise,
                camera=camera,
                colour=colour or "registered",
                seed=seed,
                on_progress=progress,
            )
            following += " --learn-camera" if colour == "unregistered" else ""
        else:
            frames = flights.record_flight(
                scene,
                out,
                flight=flight or "figure8",
                speed=2.0 if speed is None else speed,
                yaw=yaw or "forward",
                rate=20.0 if rate is None else rate,
                noise=noise or "low",
                sensor_noise=sensor_noise,
                camera=camera,
                seed=seed,
                on_progress=progress,
            )
            following += (
                f" --rate {20.0 if rate is None else rate:g} --voxel 0.125 --extent 25 --max-depth 20 --depth stereo"
            )
    say(f"{frames} frames: {out}", f"next: {following}")


def camera_of(command: str, size: str) -> "CameraConfig":
    """Return the camera of ``--size WIDTHxHEIGHT``; raise InputError naming the command for another form."""
    from vssm_gym.cli.shared.arguments import parse_size
    from vssm_gym.envs.sensors import CameraConfig

    return CameraConfig(*parse_size(command, size))
