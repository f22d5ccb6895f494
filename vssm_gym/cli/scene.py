"""Run ``vssm-gym scene preview|import|generate``: draw, import or generate a scene."""

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from vssm_gym.cli.shared.console import say

if TYPE_CHECKING:
    from vssm_gym.envs.scenes.apartment import Apartment


def preview(
    scene: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="SCENE")], out: Path, height: int = 720
) -> None:
    """Draw a scene: its plan and two views from inside; of a maze the plan alone.

    Args:
        scene: built-in name (oak), a maze's (spiral-v1), procedural:SEED or path of a scene file.
        out: the picture to write (.png), a new file.
        height: height of the picture, pixels.
    """
    from vssm_gym.errors import InputError
    from vssm_gym.files.output_folders import check_new_file

    if not 120 <= height <= 4320:
        raise InputError("scene preview", "height", f"120 to 4320 pixels; found {height}")
    check_new_file(out, (".png",))
    apartment = _load(scene)
    _draw(apartment, out, height)
    say(*_summary(apartment), out)


def import_(
    file: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="FILE")],
    out: Path,
    furnish: Annotated[int | None, tyro.conf.arg(metavar="SEED")] = None,
) -> None:
    """Check a scene of another format and write it in ours, with a picture.

    FILE is a ProcTHOR house (JSON, or a line of JSONL as in houses.jsonl.gz#7), a HouseExpo plan (JSON), a ROS map
    (YAML) or an MJCF with a floor (XML).

    Args:
        file: the scene file.
        out: the scene to write (.json), a new file; the picture gets the same name and the ending .png.
        furnish: furnish a plan without furniture, such as HouseExpo's, by this seed.
    """
    from vssm_gym.envs.scenes.generator import furnish_plan

    _write(out, lambda: _load(file) if furnish is None else furnish_plan(_load(file), furnish))


def generate(out: Path, seed: int = 0, size: Literal["small", "medium", "large"] = "medium") -> None:
    """Generate a furnished apartment from a seed, with a picture.

    Args:
        out: the scene to write (.json), a new file; the picture gets the same name and the ending .png.
        seed: seed of the apartment; the same seed gives the same apartment.
        size: size of the apartment: small (1 to 3 rooms), medium or large.
    """
    from vssm_gym.envs.scenes.generator import generate as generated
    from vssm_gym.files.output_folders import check_at_least

    check_at_least("scene generate", "seed", seed, 0)
    _write(out, lambda: generated(seed, size))


def _write(out: Path, make: "Callable[[], Apartment]") -> None:
    from vssm_gym.envs.scenes.scene import save_scene
    from vssm_gym.files.output_folders import check_new_file

    picture = out.with_suffix(".png")
    check_new_file(out, (".json",))
    check_new_file(picture)
    apartment = make()
    summary = _summary(apartment)  # refuses a scene in which the robot fits nowhere, before anything is written
    save_scene(apartment, out)
    _draw(apartment, picture, 720)
    say(*summary, out, picture, f"next: vssm-gym record --scene {out} --out recording")


def _load(scene: str) -> "Apartment":
    """Return the scene of a name or file, mazes included; its warnings are repeated in its notes, which are printed."""
    from vssm_gym.envs.scenes.scene import load_scene
    from vssm_gym.envs.tasks.mazes import FOLDER, MAZES

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        return load_scene(FOLDER / f"{scene}.json" if scene in MAZES else scene)


def _draw(apartment: "Apartment", path: Path, height: int) -> None:
    from PIL import Image

    from vssm_gym.envs.preview import preview as picture
    from vssm_gym.files.atomic import atomic_write

    with atomic_write(path) as temporary:
        Image.fromarray(picture(apartment, height)).save(temporary, format="PNG")


def _summary(apartment: "Apartment") -> list[str]:
    """Describe the contents of a scene and the free space of the robot that drives in it, in lines."""
    from vssm_gym.envs.robots import HolonomicRobot
    from vssm_gym.envs.scenes.free_space import FreeSpace
    from vssm_gym.envs.tasks.mazes import ROBOT, is_maze

    robot = ROBOT if is_maze(apartment) else HolonomicRobot()
    space = FreeSpace.from_apartment(apartment, robot.radius, robot.height)
    counts = ", ".join(
        f"{number} {word if number != 1 else word.removesuffix('s')}"
        for number, word in (
            (len(apartment.rooms), "rooms"),
            (len(apartment.doors), "doors"),
            (len(apartment.windows), "windows"),
            (len(apartment.furniture), "pieces of furniture"),
            (len(apartment.boxes()), "solid boxes"),
        )
    )
    lines = [
        f"{apartment.name}: {counts}; content hash {apartment.content_hash()}",
        f"rooms: {', '.join(room.name for room in apartment.rooms)}",
        f"a robot {2 * robot.radius:g} m across can be on {space.largest.area:.1f} m^2",
    ]
    if names := space.cut_off_rooms():
        lines.append(f"cut off from the rest: {', '.join(names)}")
    return lines + [f"note: {note}" for note in apartment.notes]
