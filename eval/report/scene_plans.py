"""Draw the plans of a sweep's scenes: behind runs of agents that were given no map."""

from collections.abc import Collection, Sequence
from pathlib import Path

from vssm_gym.envs.rendering.topdown import TopDown
from vssm_gym.envs.scenes.scene import load_scene
from vssm_gym.envs.scenes.specs import scene_name
from vssm_gym.errors import InputError
from vssm_gym.eval.episodes.manifest import MANIFEST
from vssm_gym.eval.metrics.metric import Row
from vssm_gym.files.json_file import read_json
from vssm_gym.viz.pictures import Background

PIXELS = 480  # of a side of a plan


def scene_plans(folder: Path, rows: Sequence[Row], without: Collection[str]) -> dict[str, Background]:
    """Draw each scene of a sweep's rows as it is, seen from above.

    Args:
        folder: of the sweep, whose manifest says where the scenes are.
        rows: of its episodes.
        without: names of scenes that are not drawn.

    Returns:
        Plans by the scene's name; a scene whose file is gone, or has changed since, has none.
    """
    hashes = {row["scene"]: row["scene_hash"] for row in rows if row["scene"] not in without}
    plans = {}
    for spec in read_json(folder / MANIFEST)["config"]["scenes"]:
        if (name := scene_name(spec)) not in hashes:
            continue
        try:
            apartment = load_scene(spec)
        except InputError:
            continue
        if apartment.content_hash() == hashes[name]:
            plan = TopDown(apartment.boxes(), PIXELS, PIXELS)
            plans[name] = Background(plan.background[::-1] / 255.0, plan.extent)
    return plans
