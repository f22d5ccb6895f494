"""Drive every environment once, and write what was seen as a moving picture: ``docs/images/drives/NAME.gif``.

    make pictures                              # all of them; some minutes on two cores
    python docs/site/moving_pictures.py NAME   # that of one id, such as CarNav-v1

Seeds are fixed. The frames of a picture lie at even distances in the episode and share one palette.
"""

import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from PIL import Image

import vssm_gym as vg
from vssm_gym.envs.flight_body import FlightController
from vssm_gym.envs.rendering.topdown import PLAN_GOAL, PLAN_PATH, PLAN_REFERENCE, PLAN_ROBOT
from vssm_gym.geometry.transforms import wrap_angle
from vssm_gym.slam.map_building import ensure_map

FOLDER = Path(__file__).resolve().parents[1] / "images" / "drives"
FRAMES = (60, 50, 40, 32, 26, 20)  # of a picture: the first number whose file is not too large
LARGEST = 400_000  # bytes, of a file
WIDTH = 360  # pixels, of a picture
COLOURS = 32  # of its palette, besides the marks
MARKS = [  # RGB of path, robot, goal and reference on a plan: too few pixels to be common; and thinned by the scaling
    [round(part * share + 245 * (1 - share)) for part in colour]
    for colour in (PLAN_PATH, PLAN_ROBOT, PLAN_GOAL, PLAN_REFERENCE)
    for share in (1.0, 0.75)
]
NEAR = 30.0  # from a mark's colour
LASTS = 6000  # ms, all frames but the last
STAYS = 1500  # ms, the last frame


def frames_of(env: gym.Env, info: dict[str, Any], observation: Any, act: Any) -> Iterator[np.ndarray]:
    """Yield the picture before every step and after the last one."""
    over = False
    while not over:
        yield env.render()
        observation, _, terminated, truncated, info = env.step(act(observation, info))
        over = terminated or truncated
    yield env.render()
    env.close()


def agent_drive(name: str, agent: str, seed: int, voxel_map: Any = None, **keywords: Any) -> Iterator[np.ndarray]:
    """Let an agent of the package drive one episode."""
    env = gym.make(f"vssm_gym/{name}", render_mode="rgb_array", **keywords)
    observation, info = env.reset(seed=seed)
    driver = vg.make_agent(agent)
    driver.reset(vg.agent_context(env, info, voxel_map), observation, seed=0)
    return frames_of(env, info, observation, lambda seen, _: driver.act(seen).action)


def path_drive(name: str, seed: int) -> Iterator[np.ndarray]:
    """Follow the shortest path of the learned map at the true pose, in the actions of a policy."""
    env = gym.make(f"vssm_gym/{name}", scene="oak", noise="low", render_mode="rgb_array")
    observation, info = env.reset(seed=seed)
    floor = vg.ClearanceMap.from_voxel_map(vg.VoxelMap.load("oak"))
    path = vg.plan(info["start_pose"][:2], np.array(info["task"].goal), floor, radius=0.1, margin=0.05).path

    def act(_: Any, info: dict[str, Any]) -> Any:
        T = info["T_world_cam"]
        away = np.linalg.norm(path - T[:2, 3], axis=1)
        ahead = path[min(int(away.argmin()) + 1, len(path) - 1)]
        bearing = float(wrap_angle(np.arctan2(*(ahead - T[:2, 3])[::-1]) - np.arctan2(T[1, 2], T[0, 2])))
        if isinstance(env.action_space, gym.spaces.Discrete):
            return 0 if abs(bearing) < 0.12 else 1 if bearing > 0 else 2
        turn = np.clip(bearing / 0.2, -1.0, 1.0)
        return np.array([turn, 0.0, 1.0 if abs(bearing) < 0.4 else -1.0], np.float32)

    return frames_of(env, info, observation, act)


def flight(name: str, seed: int) -> Iterator[np.ndarray]:
    """Let the controller of recordings follow a reference."""
    env = gym.make(f"vssm_gym/{name}", flight="star", speed=3.0, render_mode="rgb_array")
    observation, info = env.reset(seed=seed)
    body, pilot = env.unwrapped, FlightController()
    return frames_of(env, info, observation, lambda *_: pilot(body.state, body.task, body.time, body.dt))


def imagined(name: str, seed: int) -> Iterator[np.ndarray]:
    """Let the trained policy of the package drive inside the map."""
    env = gym.make(f"vssm_gym/{name}", map="oak", noise="mid", end_on="reach", render_mode="rgb_array")
    observation, info = env.reset(seed=seed)
    policy = vg.make_agent("policy:oak")

    def act(seen: Any, _: Any) -> np.ndarray:
        batch = {key: np.asarray(value)[None] for key, value in seen.items()}
        return np.array([*policy.commands(batch)[0], 0.0], np.float32)

    return frames_of(env, info, observation, act)


def oak() -> vg.VoxelMap:
    """Return the learned map that comes with the package."""
    return vg.VoxelMap.load("oak")


def learned(scene: str) -> vg.VoxelMap:
    """Learn the map of a scene from a recorded drive."""
    with tempfile.TemporaryDirectory() as folder:
        return vg.VoxelMap.load(ensure_map(scene, Path(folder), voxel=0.03, seed=0))


DRIVES = {
    "PointNav-v0": lambda name: agent_drive(name, "astar", 4, oak(), scene="oak", noise="mid"),
    "PointNavGPS-v0": lambda name: path_drive(name, 2),
    "PointNavDiscrete-v0": lambda name: path_drive(name, 9),
    "ImageNav-v0": lambda name: agent_drive(name, "astar_image", 3, oak(), scene="oak", noise="low"),
    "Explore-v0": lambda name: agent_drive(name, "frontier_gain_scan", 0, scene="birch", finish=0.95),
    "LidarMaze-v0": lambda name: agent_drive(name, "dist_bug", 1, scene="spiral-v1", noise="low"),
    "Flight-v0": lambda name: flight(name, 0),
    "CarNav-v0": lambda name: agent_drive(
        name, "hybrid_astar", 1, learned("garage"), scene="garage", observe_pose=True
    ),
    "CarNav-v1": lambda name: agent_drive(name, "slam_car", 0, scene="paddock"),
    "WorldModelNav-v0": lambda name: imagined(name, 1),
}


def write(name: str) -> Path:
    """Drive one environment and write its picture, with as many frames as fit."""
    frames = [Image.fromarray(frame) for frame in DRIVES[name](name)]
    size = (WIDTH, round(frames[0].height * WIDTH / frames[0].width))
    path = FOLDER / f"{name}.gif"
    path.parent.mkdir(exist_ok=True)
    for number in FRAMES:
        chosen = np.unique(np.linspace(0, len(frames) - 1, min(number, len(frames))).round().astype(int))
        save([frames[i].resize(size, Image.Resampling.LANCZOS) for i in chosen], path)
        if path.stat().st_size <= LARGEST:
            break
    print(f"{path.name}: {len(frames) - 1} steps, {len(chosen)} frames, {path.stat().st_size / 1000:.0f} kB")
    return path


def save(pictures: list[Image.Image], path: Path) -> None:
    """Write pictures in one palette: the most common colours of a few of them, and the marks of a plan."""
    some = pictures[:: max(1, len(pictures) // 6)]
    strip = Image.fromarray(np.concatenate([np.asarray(picture) for picture in some]))
    common = strip.quantize(COLOURS, method=Image.Quantize.MEDIANCUT)
    colours = [*(common.getpalette() or [])[: 3 * COLOURS], *np.array(MARKS).ravel().tolist()]
    first, *rest = (in_palette(picture, common, colours) for picture in pictures)
    durations = [LASTS // len(pictures)] * len(rest) + [STAYS]
    first.save(path, save_all=True, append_images=rest, duration=durations, loop=0, optimize=True)


def in_palette(picture: Image.Image, common: Image.Image, colours: list[int]) -> Image.Image:
    """Return a picture in the common colours, but in a mark's where that is nearer."""
    index = np.array(picture.quantize(palette=common, dither=Image.Dither.NONE))
    pixels, palette = np.asarray(picture, float), np.reshape(colours, (-1, 3)).astype(float)
    off = np.linalg.norm(pixels - palette[index], axis=-1)
    away = np.linalg.norm(pixels[:, :, None] - palette[COLOURS:], axis=-1)
    index = np.where(away.min(axis=-1) < np.minimum(off, NEAR), COLOURS + away.argmin(axis=-1), index)
    found = Image.fromarray(index.astype(np.uint8), "P")
    found.putpalette(colours)
    return found


if __name__ == "__main__":
    for name in sys.argv[1:] or DRIVES:
        write(name)
