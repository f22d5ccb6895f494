"""Record a reference flight as a TUM folder with IMU readings beside it (``vssm-gym record --motion flight``).

``imu.txt``: ``time wx wy wz fx fy fz``, rad/s and m/s^2 in the body's frame; each reading is the mean over the time
since the previous one. The pilot knows the true state, as from a motion-capture system.
"""

from pathlib import Path

import numpy as np

from vssm_gym.data.recording import folder_for
from vssm_gym.data.sequences import SequenceWriter, imu_line
from vssm_gym.envs.flight import FlightEnv
from vssm_gym.envs.flight_body import FlightController
from vssm_gym.envs.scenes.scene import Apartment
from vssm_gym.envs.sensors import CameraConfig
from vssm_gym.envs.tasks.reference_flights import Yaw
from vssm_gym.errors import InputError
from vssm_gym.files.atomic import atomic_write
from vssm_gym.files.output_folders import check_new_folder
from vssm_gym.progress import OnProgress

FLIGHT_DEPTH_SCALE = 2000.0  # units a metre: 16 bits reach 32 m, in steps of half a millimetre


def record_flight(
    scene: str | Path | Apartment,
    out: Path,
    *,
    flight: str = "figure8",
    speed: float = 2.0,
    yaw: Yaw = "forward",
    rate: float = 20.0,
    seconds: float | None = None,
    noise: str = "low",
    sensor_noise: str = "none",
    camera: CameraConfig | None = None,
    seed: int = 0,
    on_progress: OnProgress | None = None,
) -> int:
    """Fly a reference once, from hover to hover, or the beginning of it; returns the number of frames.

    Args:
        scene: built-in name, path of a scene file, or the scene.
        out: new or empty folder; written atomically.
        flight: a key of ``reference_flights.CURVES``.
        speed: its peak, m/s.
        yaw: heading of the body along the path.
        rate: frames a second.
        seconds: recorded from the start; None: all.
        noise: gusts and actuator errors; the recorded poses are the true ones.
        sensor_noise: what the camera adds to the exact image: a name of ``sensor_noise.PRESETS``.
        camera: size and angle of the images.
        seed: of gusts, camera and IMU.
        on_progress: called with ("recording", frames, total) now and then.

    Raises:
        InputError: an unknown name, a flight that does not fit, or a folder that is not empty.
    """
    if seconds is not None and not seconds > 0.0:
        raise InputError("flight", "seconds", f"above 0; found {seconds!r}")
    check_new_folder(out)
    env = FlightEnv(
        scene=scene,
        noise=noise,
        sensor_noise=sensor_noise,
        camera=camera,
        rate=rate,
        flight=flight,
        speed=speed,
        yaw=yaw,
        reward="sparse",
    )
    about = {"motion": "flight", "flight": flight, "speed": speed, "yaw": yaw, "rate": rate, "noise": noise}
    about |= {"sensor_noise": sensor_noise, "imu_noise": "adis16448", "renderer": env.renderer_name, "seed": seed}
    about |= {} if seconds is None else {"seconds": seconds}
    try:
        with folder_for(out, env.apartment, about) as unfinished:
            return _fly(env, unfinished, seed, seconds, on_progress)
    finally:
        env.close()


def _fly(env: FlightEnv, folder: Path, seed: int, seconds: float | None, on_progress: OnProgress | None) -> int:
    writer = SequenceWriter(folder, env.camera, env.body.T_body_cam, depth_scale=FLIGHT_DEPTH_SCALE)
    pilot = FlightController(env.body)
    observation, info = env.reset(seed=seed)
    assert env.task is not None
    duration = env.task.duration if seconds is None else min(seconds, env.task.duration)
    total, terminated, lines = int(np.ceil(duration / env.dt)) + 1, False, []
    for frame in range(total):
        if frame:
            command = pilot(env.state, env.task, env.time, env.dt)
            observation, _, terminated, _, info = env.step(command)
            if terminated and not info["success"]:
                raise InputError(
                    env.apartment.name, "flight", f"a reference that can be followed; lost at {env.time} s"
                )
        writer.append(env.time, observation["rgb"], observation["depth"], info["T_world_cam"], info["control"])
        ago = env.dt * np.arange(env.substeps - 1, -1, -1) / env.substeps
        lines += [
            imu_line(env.time - s, np.roll(reading, 3)) for s, reading in zip(ago, observation["imu"], strict=True)
        ]
        if on_progress and (frame % 20 == 0 or frame + 1 == total):
            on_progress("recording", frame + 1, total)
    with atomic_write(folder / "imu.txt") as temporary:
        temporary.write_text("# time wx wy wz fx fy fz\n" + "".join(lines))
    writer.close()
    return total
