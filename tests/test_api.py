"""Test the public names: one table, lazy imports, documentation, and the page that shows their use."""

import ast
import importlib
import inspect
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import vssm_gym as vg
from vssm_gym.data.sequences import SequenceWriter
from vssm_gym.data.trajectories import read_trajectory

CHECKOUT = Path(__file__).resolve().parents[1]
PAGE = (CHECKOUT / "docs" / "library.md").read_text()
SNIPPETS = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
TITLES = ["map", "prism", "own camera", "own recording", "futures", "agent", "sweep"]
OPENERS = ("Whether", "What", "How", "Of", "Where")  # no sentence that documents something starts so


def functions() -> list[str]:
    return [name for name in vg.PUBLIC if not inspect.isclass(getattr(vg, name))]


def classes() -> list[str]:
    return [name for name in vg.PUBLIC if inspect.isclass(getattr(vg, name))]


def test_a_script_needs_few_names():
    assert 30 <= len(vg.PUBLIC) <= 42


def test_type_checkers_read_the_same_names():
    tree = ast.parse((CHECKOUT / "vssm_gym" / "__init__.py").read_text())
    [block] = [node for node in tree.body if isinstance(node, ast.If)]
    imports = [node for node in block.body if isinstance(node, ast.ImportFrom)]
    read = {alias.asname: node.module for node in imports for alias in node.names if alias.asname == alias.name}
    assert read == vg.PUBLIC


@pytest.mark.parametrize("name", vg.PUBLIC)
def test_a_public_name_is_defined_where_the_table_says(name):
    assert getattr(vg, name).__module__ == vg.PUBLIC[name]
    assert name in dir(vg)
    assert not isinstance(getattr(vg, name), ModuleType)


def test_another_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'VoxelMapp'"):
        vg.VoxelMapp  # noqa: B018
    with pytest.raises(ImportError):
        importlib.import_module("vssm_gym.VoxelMapp")


def test_importing_loads_the_registration_and_the_settings_of_libraries_alone():
    code = (
        "import sys, vssm_gym\n"
        "print(sorted(m for m in sys.modules if m.startswith('vssm_gym.')))\n"
        "vssm_gym.InputError\n"
        "print('vssm_gym.errors' in sys.modules, 'jax' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded, later = done.stdout.splitlines()
    expected = ["compilation_cache", "envs", "envs.registration", "gpu_defaults", "instruction_set", "version"]
    assert ast.literal_eval(loaded) == [f"vssm_gym.{name}" for name in expected]
    assert later == "True False"


# documentation


@pytest.mark.parametrize("name", vg.PUBLIC)
def test_a_public_name_is_documented(name):
    doc = inspect.getdoc(getattr(vg, name)) or ""
    first = doc.partition("\n")[0]
    assert len(first) > 20
    assert first.partition(" ")[0] not in OPENERS
    assert first.endswith(".")


@pytest.mark.parametrize("name", functions())
def test_a_public_function_documents_and_annotates_every_argument(name):
    function = getattr(vg, name)
    doc, signature = inspect.getdoc(function) or "", inspect.signature(function)
    assert signature.return_annotation is not inspect.Signature.empty
    assert ("Returns:" in doc) == (signature.return_annotation is not None)
    if signature.parameters:
        described = set(re.findall(r"^    (\w+): \S", doc.partition("Args:\n")[2], re.MULTILINE))
        for parameter in signature.parameters.values():
            assert parameter.annotation is not inspect.Parameter.empty, parameter
            assert parameter.name in described, f"{name} does not say what {parameter.name} is"


@pytest.mark.parametrize("name", classes())
def test_the_methods_of_a_public_class_are_documented_and_annotated(name):
    """Inherited and special methods are exempt."""
    cls = getattr(vg, name)
    for key, member in vars(cls).items():
        if key.startswith("_"):
            continue
        member = member.__func__ if isinstance(member, classmethod | staticmethod) else member
        member = member.fget if isinstance(member, property) else member
        if not inspect.isfunction(member):
            continue
        first = (inspect.getdoc(member) or "").partition("\n")[0]
        assert first, f"{name}.{key} has no docstring"
        assert first.partition(" ")[0] not in OPENERS, f"{name}.{key}: {first}"
        signature = inspect.signature(member)
        for parameter in list(signature.parameters.values()):
            assert parameter.name in ("self", "cls") or parameter.annotation is not inspect.Parameter.empty, key
        assert signature.return_annotation is not inspect.Signature.empty, f"{name}.{key}"


def documented_above(cls: type, key: str) -> bool:
    """Return whether a base class documents a method's arguments: a transition's methods are those of the contract."""
    return any("Args:" in (inspect.getdoc(vars(base).get(key)) or "") for base in cls.__mro__[1:])


@pytest.mark.parametrize("name", classes())
def test_the_methods_of_a_public_class_document_every_argument(name):
    cls = getattr(vg, name)
    for key, member in vars(cls).items():
        function = member.__func__ if isinstance(member, classmethod | staticmethod) else member
        if key.startswith("_") or not inspect.isfunction(function) or documented_above(cls, key):
            continue
        doc, signature = inspect.getdoc(function) or "", inspect.signature(function)
        described = set(re.findall(r"^    (\w+): \S", doc.partition("Args:\n")[2], re.MULTILINE))
        assert set(signature.parameters) - {"self", "cls"} <= described, f"{name}.{key}"
        if described and signature.return_annotation is not None:
            assert "Returns:" in doc, f"{name}.{key}"


# the page


def run(title: str) -> dict[str, Any]:
    names: dict[str, Any] = {}
    exec(SNIPPETS[TITLES.index(title)], names)
    return names


def test_the_page_uses_public_names_alone():
    assert len(SNIPPETS) == len(TITLES)
    for snippet in SNIPPETS:
        used = set(re.findall(r"\bvg\.(\w+)", snippet))
        assert used <= vg.PUBLIC.keys()
        assert "from vssm_gym" not in snippet
        assert len([line for line in snippet.splitlines() if line]) <= 40


def test_the_page_lists_every_name():
    rows = [line.split("|")[1] for line in PAGE.partition("## All names")[2].splitlines() if line.startswith("| `")]
    assert sorted(name for row in rows for name in re.findall(r"`(\w+)`", row)) == sorted(vg.PUBLIC)


@pytest.mark.slow
def test_the_page_maps_posed_images_and_plans_in_the_map():
    names = run("map")
    assert names["path"].found
    first, seen = np.asarray(names["frames"][0][0]) / 255.0, np.asarray(names["view"].rgb)
    assert np.median(np.abs(first - seen)) < 0.1  # what the map renders is what the camera saw


@pytest.mark.slow
def test_the_page_runs_prism():
    names = run("prism")
    assert names["how"].status.message == "ok"
    assert names["off"] < 0.03


@pytest.mark.slow
def test_the_page_takes_a_stream_and_a_recording_to_a_trajectory_and_a_map(tmp_path, monkeypatch):
    """Both programs see the same images: once from the generator, once from a folder."""
    monkeypatch.chdir(tmp_path)
    names = run("own camera")
    assert all(how.accepted for how in names["statuses"])
    truth = turning_robot(len(names["times"]))
    assert off(truth, np.array(names["T_world_cam"])) < 0.03
    times, T_world_cam = read_trajectory("trajectory.txt")
    np.testing.assert_allclose(times, names["times"])
    np.testing.assert_allclose(T_world_cam, names["T_world_cam"], atol=1e-5)
    saved = vg.Posterior.load("map.npz")
    np.testing.assert_allclose(saved.belief.mean.T_world_body, T_world_cam[-1], atol=1e-5)
    view = vg.render(vg.VoxelMap.load("map.npz"), np.eye(4, dtype=np.float32), names["camera"])
    first = next(iter(names["stream"]()))[2]
    assert np.median(np.abs(np.asarray(view.depth) - first)[first > 0]) < 0.05  # what the map shows is what was seen

    writer = SequenceWriter("walk", names["camera"], np.eye(4), controls=False)
    for (time, rgb, depth), T in zip(names["stream"](), truth, strict=True):
        writer.append(time, rgb, depth, T)
    writer.close()
    recorded = run("own recording")
    assert not recorded["run"].lost.any()
    assert off(truth, recorded["run"].poses) < 0.03
    assert len(read_trajectory("trajectory.txt")[0]) == len(truth)
    assert vg.Posterior.load("map.npz").map is not None


def turning_robot(steps: int) -> np.ndarray:
    """Return the true poses of the page's stream, in the first camera's frame."""
    world = gym.make("vssm_gym/PointNav-v0", scene="oak", noise="none", camera={"width": 80, "height": 60})
    _, info = world.reset(seed=10)
    T_world_cam = [info["T_world_cam"]]
    for _ in range(steps - 1):
        *_, info = world.step(np.array([0.03, 0.0, 0.02, 0.0], np.float32))
        T_world_cam.append(info["T_world_cam"])
    return np.linalg.inv(T_world_cam[0]) @ np.array(T_world_cam)


def off(truth: np.ndarray, estimate: np.ndarray) -> float:
    """Return the largest distance between two paths, m."""
    return float(np.linalg.norm(truth[:, :3, 3] - estimate[:, :3, 3], axis=1).max())


@pytest.mark.slow
def test_the_page_draws_futures():
    names = run("futures")
    assert names["ends"].shape == (12, 3)
    assert names["spread"].shape == (60, 80, 3)
    assert 0.01 < float(names["spread"].mean()) < 1.0


def test_the_page_drives_an_agent():
    names = run("agent")
    assert names["info"]["success"]
    assert names["picture"].std() > 0


@pytest.mark.slow
def test_the_page_runs_a_sweep_and_shows_it(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    exec(SNIPPETS[TITLES.index("sweep")], {"__name__": "__main__"})
    said = capfd.readouterr()
    assert said.out.splitlines()[-1] == "2 episodes"
    assert re.search(r"random +2 ", said.out)
    assert "progress: running episodes: 2 of 2" in said.err


# what the page needs of its functions


def test_a_filter_is_made_by_name():
    camera = vg.Camera.from_hfov(40, 30, 1.5)
    assert isinstance(vg.make_filter("prism", camera, vg.Rigid()), vg.Prism)
    assert isinstance(vg.make_filter("tracker", camera, vg.Planar(vg.MotionNoise(0.1, 0.1))), vg.MapTracker)
    with pytest.raises(vg.InputError, match="one of prism, "):
        vg.make_filter("slam", camera, vg.Rigid())
    with pytest.raises(vg.InputError, match="a pose"):
        vg.make_filter("frames", camera, vg.Rigid())


def test_a_belief_at_a_pose_exists_for_every_transition():
    planar = vg.Bicycle().belief_at(np.array([1.0, 2.0, 0.5]), translation_std=0.1, rotation_std=0.2)
    np.testing.assert_allclose(planar.mean, [1.0, 2.0, 0.5], atol=1e-6)
    np.testing.assert_allclose(np.diag(planar.covariance), [0.01, 0.01, 0.04], rtol=1e-5)
    T = np.eye(4)
    T[:3, 3] = 1.0, 2.0, 3.0
    rigid = vg.Rigid().belief_at(T, rate_std=2.0)
    np.testing.assert_allclose(rigid.mean.T_world_body, T)
    np.testing.assert_allclose(np.diag(rigid.covariance), [1e-6] * 6 + [0.25] * 3 + [4.0] * 3, rtol=1e-5)


def test_every_frame_needs_a_pose():
    frames = [(np.zeros((30, 40, 3), np.uint8), np.ones((30, 40), np.float32))]
    camera = vg.Camera.from_hfov(40, 30, 1.5)
    with pytest.raises(vg.InputError, match="T_world_cam"):
        vg.map_from_frames(frames, np.zeros((2, 4, 4)), camera)
    with pytest.raises(vg.InputError, match="readings"):
        vg.map_from_frames([(frames[0][0], 0.0 * frames[0][1])], np.eye(4)[None], camera)


@pytest.mark.parametrize("env", ["PointNav-v0", "ImageNav-v0", "Explore-v0", "LidarMaze-v0", "CarNav-v0", "CarNav-v1"])
def test_a_context_holds_the_start_pose_and_no_scene(env):
    world = gym.make(f"vssm_gym/{env}", scene="rooms-v1" if "Maze" in env else "arena" if "Car" in env else "oak")
    observation, info = world.reset(seed=0)
    context = vg.agent_context(world, info)
    assert isinstance(context, vg.AgentContext)
    np.testing.assert_array_equal(context.start_pose, info["start_pose"])
    assert context.map is None
    agent = vg.make_agent({"LidarMaze-v0": "dist_bug"}.get(env, "random"))
    if "Car" not in env:  # ``random`` drives no car
        agent.reset(context, observation, 0)
        assert world.action_space.contains(agent.act(observation).action)
    world.close()
