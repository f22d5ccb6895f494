"""Write the files and tasks of the built-in scenes that are made by code.

    python -c "from vssm_gym.envs.tasks.built_in import write_built_in; write_built_in()"

`oak` is not among them: it was drawn box by box before there was a generator, and its hash stands in many results.
"""

from collections.abc import Callable
from pathlib import Path

from vssm_gym.envs.robots import HolonomicRobot
from vssm_gym.envs.scenes.apartment import Apartment
from vssm_gym.envs.scenes.generator.arenas import depot, dock, garage, paddock
from vssm_gym.envs.scenes.generator.plans import HOMES
from vssm_gym.envs.scenes.generator.venues import arena, hall
from vssm_gym.envs.scenes.scene import ASSETS, save_scene
from vssm_gym.envs.tasks.navigation import freeze

MAKERS: dict[str, Callable[[], Apartment]] = {
    **{name: home.apartment for name, home in HOMES.items()},
    "arena": arena,
    "depot": depot,
    "dock": dock,
    "garage": garage,
    "paddock": paddock,
    "hall": hall,
}
"""What makes each scene, by name."""


def write_built_in(folder: Path = ASSETS) -> list[Path]:
    """Write every scene's JSON, and the frozen tasks of the homes under ``tasks``; return the scenes' paths."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for name, make in MAKERS.items():
        apartment = make()
        paths.append(folder / f"{name}.json")
        save_scene(apartment, paths[-1])
        if name in HOMES:
            freeze(apartment, HolonomicRobot(), folder=folder / "tasks")
    return paths
