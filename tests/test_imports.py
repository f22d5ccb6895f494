"""Test that imports flow one way (docs/architecture.md), by the syntax tree of every module, lazy imports included.

Ground truth cannot leak into inference because no model, inference, planning or agent code can name the simulator.
"""

import ast
import functools
import graphlib
import os
from collections.abc import Iterator
from pathlib import Path

import pytest

CHECKOUT = Path(__file__).resolve().parents[1]

# Each layer may import those before it; what stands on one line does not import its neighbours.
LAYERS = [
    ["errors", "progress"],
    ["files"],
    ["geometry"],
    ["maps"],
    ["model.emission", "model.transition"],
    ["model"],
    ["inference"],
    ["planning"],
    ["agents"],
    ["slam"],
    ["eval"],
    ["training"],
    ["cli"],
]

BASE = {"errors", "files", "progress", "geometry"}

# Beside the layers: what else may be imported, by whom. The longest name that fits a module decides.
ALLOWED: dict[str, set[str]] = {
    layer: {name for below in LAYERS[:height] for name in below} for height, row in enumerate(LAYERS) for layer in row
}
ALLOWED["version"] = ALLOWED["instruction_set"] = ALLOWED["gpu_defaults"] = set()
ALLOWED["compilation_cache"] = {"instruction_set"}
ALLOWED["envs.registration"] = set()
ALLOWED["envs"] = BASE | {"envs.registration"}
ALLOWED["envs.world_model"] = ALLOWED["inference"] | {"envs"}  # the model, but nothing that infers or plans
for _module in ("data.trajectories", "data.images", "data.distortion"):
    ALLOWED[_module] = set(BASE)
ALLOWED["data.index"] = BASE | {"data.trajectories", "data.images"}
ALLOWED["data.intrinsics"] = BASE | {"data.index"}
ALLOWED["data.registration"] = BASE | {"data.intrinsics", "data.distortion"}
_READ = {"data.trajectories", "data.images", "data.index", "data.intrinsics", "data.distortion", "data.registration"}
ALLOWED["data.sequences"] = BASE | _READ
ALLOWED["data.colour_rig"] = BASE | {"data.intrinsics", "envs"}
ALLOWED["data.dynamics"] = BASE | {"data.trajectories", "data.sequences"}
ALLOWED["data.handheld"] = ALLOWED["data.wandering"] = BASE | {"envs"}
ALLOWED["data.laser_logs"] = set(BASE)
ALLOWED["data.strip_logs"] = BASE | {"data.laser_logs"}
ALLOWED["data.traversals"] = BASE | {"data.laser_logs", "data.strip_logs", "envs"}
ALLOWED["data.recording"] = BASE | {
    "data.handheld",
    "data.wandering",
    "data.sequences",
    "data.colour_rig",
    "data.intrinsics",
    "envs",
    "planning",
}
ALLOWED["data.flights"] = BASE | {"data.recording", "data.sequences", "envs"}
ALLOWED["data.datasets"] = BASE | _READ | {"data.sequences"}
ALLOWED["viz"] = BASE | {"maps", "model.emission"}
# What is measured of learned transitions is measured by `eval` too: this folder knows nothing of policies
ALLOWED["training.dynamics"] = ALLOWED["inference"] | {"data.dynamics"}
ALLOWED["cluster"] = BASE | {"version"}  # Ray, below what runs on it
for _module in ("eval", "training", "cli"):
    ALLOWED[_module] |= {"training.dynamics", "cluster"}
for _module in ("slam", "eval", "training", "cli"):
    ALLOWED[_module] |= {
        "__init__",
        "version",
        "envs.registration",  # the table of environments
        "envs",
        "envs.world_model",
        "data.trajectories",
        "data.images",
        "data.intrinsics",
        "data.sequences",
        "data.laser_logs",
        "data.strip_logs",
        "data.traversals",
        "data.datasets",
        "data.dynamics",
        "data.recording",
        "data.flights",
        "viz",
    }
ALLOWED["cli"] |= {"compilation_cache", "instruction_set"}  # doctor says where it is; reproduce, on which processor
ALLOWED["eval"] |= {"instruction_set"}  # rows say on which processor they were made
ALLOWED["__init__"] = set(ALLOWED)  # it offers the public names, each imported at its first use

ONE_IMPORTER = {
    "mujoco",
    "embreex",
    "casadi",
    "pybullet",
    "torch",
    "ray",
    "open3d",
    "gtsam",
    "rerun",
    "pygame",
    "jinja2",
    "markupsafe",
    "h5py",
    "minari",
    "pyarrow",
}
ONE_PLACE = ("envs.physics", "training.sb3")  # folders that exist for one such library and count as one importer
TESTS_ONLY = {"evo", "pytest", "hypothesis"}  # evo is GPL: an oracle of the tests, never part of the package
FOREIGN_NAMES = {"agents", "eval", "envs"}  # top-level folders of this checkout, not packages of their own

# Inside a layer: a row imports from the rows before it, never from its own row or a later one. What is not listed
# belongs to "", the files at the folder's top.
FOLDERS = {
    "files": [
        ["atomic", "bounded", "shipped"],
        ["json_file", "line_file", "numbers"],
        ["npz_file", "yaml_file", "output_folders"],
    ],
    "inference": [
        ["alignment", "mapping", "linear_gaussian", "particles", "scan_encoder", "status"],
        ["filter"],
        ["tracking", "planar", "latent"],
        ["relocalisation", "prism"],
        [""],
    ],
    "planning": [
        ["clearance", "result"],
        ["occupancy_grid"],
        ["floor_plan", "pursuit"],
        ["grid_search"],
        ["car", "exploration"],
        ["value_iteration", "scans"],
        ["mpc"],
        [""],
    ],
    "agents": [["base"], ["shared"], ["navigation", "car", "exploration", "policy"], [""]],
    "envs": [
        ["presets", "validation", "streams"],
        ["textures", "robots"],
        ["scenes"],
        ["rendering"],
        ["physics"],
        ["sensors"],
        ["tasks", "conventions"],
        [""],
        ["world_model"],
    ],
    "eval": [
        ["episodes", "foreign_process"],
        ["metrics"],
        ["protocols"],
        ["sweep"],
        ["report"],
        ["video"],
        ["studies", "faults"],
        ["bench", ""],
        ["benchmark"],
        ["reproduction"],
    ],
}
EXCEPTIONS = {("envs.scenes.importers.mjcf", "envs.physics")}  # MuJoCo is imported in one place: its reader uses it

Graph = dict[str, set[str]]


def find_modules(folder: Path) -> dict[str, Path]:
    """Return dotted name -> file of every module of the package in ``folder``, through the committed links."""
    found = {}
    for directory, subfolders, files in os.walk(folder, followlinks=True):
        subfolders[:] = [name for name in subfolders if name != "__pycache__"]
        parts = (folder.name, *Path(directory).relative_to(folder).parts)
        for file in files:
            if file.endswith(".py"):
                name = ".".join(parts if file == "__init__.py" else (*parts, file.removesuffix(".py")))
                found[name] = Path(directory) / file
    return found


def imported_names(tree: ast.AST, module: str, is_package: bool, known: set[str]) -> Iterator[str]:
    """Return every dotted name that ``tree`` imports, relative ones resolved, ``import_module("...")`` included."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                above = module.split(".")[: None if is_package and node.level == 1 else int(is_package) - node.level]
                base = ".".join([*above, *filter(None, [node.module])])
            for alias in node.names:
                yield f"{base}.{alias.name}" if f"{base}.{alias.name}" in known else base
        elif isinstance(node, ast.Call) and node.args and isinstance(node.args[0], ast.Constant):
            called = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
            if called in ("import_module", "__import__") and isinstance(node.args[0].value, str):
                yield node.args[0].value


def import_graph(modules: dict[str, Path]) -> Graph:
    """Return module -> names it imports, those that only a type checker reads included."""
    graph = {}
    for name, path in modules.items():
        tree = ast.parse(path.read_text())
        graph[name] = set(imported_names(tree, name, path.name == "__init__.py", set(modules)))
    return graph


def component(module: str, package: str = "vssm_gym") -> str | None:
    """Return the longest entry of ``ALLOWED`` that holds ``module``; None if no entry does."""
    inside = module.removeprefix(package).strip(".") or "__init__"
    fits = [entry for entry in ALLOWED if inside == entry or inside.startswith(f"{entry}.")]
    return max(fits, key=len, default=None)


def place(module: str, package: str = "vssm_gym") -> str:
    """Return the module, or the folder of ``ONE_PLACE`` that it lies in."""
    folders = (f"{package}.{folder}" for folder in ONE_PLACE)
    return next((folder for folder in folders if f"{module}.".startswith(f"{folder}.")), module)


def violations(graph: Graph, package: str = "vssm_gym") -> list[str]:
    """Return one readable line for each import that breaks a rule."""
    bare = {"", "data"}  # a package file that only documents its folder belongs to no layer
    found = []
    for module, names in sorted(graph.items()):
        mine = component(module, package)
        if mine is None and module.removeprefix(package).strip(".") not in bare:
            found.append(f"{module}: belongs to no layer; give it a line in tests/test_imports.py")
        for name in sorted(names):
            top = name.split(".")[0]
            if top in FOREIGN_NAMES:
                found.append(f"{module}: imports {name}; write {package}.{name}")
            elif top in TESTS_ONLY:
                found.append(f"{module}: imports {name}, which is for tests only")
            elif top == package:
                theirs = component(name, package)
                if theirs != mine and theirs not in ALLOWED.get(mine or "", set()):
                    found.append(f"{module}: must not import {name}")
    for library in sorted(ONE_IMPORTER):
        users = {module for module, names in graph.items() if any(name.split(".")[0] == library for name in names)}
        importers = sorted({place(module, package) for module in users})
        if len(importers) > 1:
            found.append(f"{library} is imported by more than one module: {', '.join(importers)}")
    return found


def row(module: str, package: str = "vssm_gym") -> tuple[str, int, str] | None:
    """Return the layer of ``FOLDERS`` that ``module`` lies in, its row there and its folder; None outside of them."""
    layer, _, inside = module.removeprefix(f"{package}.").partition(".")
    if layer not in FOLDERS or not inside:
        return None
    rows = {folder: height for height, folders in enumerate(FOLDERS[layer]) for folder in folders}
    folder = inside.split(".")[0]
    return (layer, rows[folder], folder) if folder in rows else (layer, rows[""], "")


def upward(graph: Graph, package: str = "vssm_gym") -> list[str]:
    """Return one line for each import inside a layer that leads to a later folder, or to a neighbour in its row."""
    found = []
    for module, names in sorted(graph.items()):
        mine = row(module, package)
        for name in sorted(names):
            theirs = row(name, package)
            if mine is None or theirs is None or mine[0] != theirs[0] or mine[2] == theirs[2]:
                continue
            if theirs[1] >= mine[1] and not any(
                f"{package}.{a}" == module and f"{name}.".startswith(f"{package}.{b}.") for a, b in EXCEPTIONS
            ):
                found.append(f"{module}: must not import {name}, whose folder comes after its own")
    return found


def cycle(graph: Graph) -> list[str]:
    """Return the modules of one import cycle, in order; empty if there is none."""
    try:
        graphlib.TopologicalSorter({m: (names & graph.keys()) - {m} for m, names in graph.items()}).prepare()
    except graphlib.CycleError as error:
        return error.args[1]
    return []


MODULES = find_modules(CHECKOUT / "vssm_gym")


@functools.cache
def whole_graph() -> Graph:
    """Return the import graph of the package; a worker that runs none of these tests never parses it."""
    return import_graph(MODULES)


def test_every_folder_is_read():
    """Links are followed, since a check of an empty folder would always pass."""
    folders = {"agents": "agents", "eval.sweep": "eval/sweep", "envs": "vssm_gym/envs", "cli": "vssm_gym/cli"}
    for name, folder in folders.items():
        on_disk = {f"vssm_gym.{name}.{path.stem}" for path in (CHECKOUT / folder).glob("*.py")}
        assert len(on_disk) > 1
        assert on_disk - {f"vssm_gym.{name}.__init__"} <= MODULES.keys()
    assert "vssm_gym.geometry.transforms" in set().union(*whole_graph().values())


def test_imports_flow_one_way():
    assert violations(whole_graph()) == []


def test_folders_of_a_layer_import_downward():
    assert upward(whole_graph()) == []
    listed = {f"vssm_gym.{layer}.{name}" for layer, rows in FOLDERS.items() for names in rows for name in names if name}
    assert listed <= MODULES.keys()


def test_every_exception_is_needed():
    for module, folder in EXCEPTIONS:
        assert any(f"{name}.".startswith(f"vssm_gym.{folder}.") for name in whole_graph()[f"vssm_gym.{module}"])


def test_no_import_cycle():
    assert cycle(whole_graph()) == []


def test_tests_import_the_package_by_its_name():
    for path in CHECKOUT.glob("tests/**/*.py"):
        names = imported_names(ast.parse(path.read_text()), path.stem, False, set(MODULES))
        assert {name.split(".")[0] for name in names}.isdisjoint(FOREIGN_NAMES), path.name


@pytest.mark.parametrize(
    ("file", "source", "complaint"),
    [
        ("inference/leak.py", "def f():\n    from vssm_gym.envs import pointnav", "must not import vssm_gym.envs"),
        (
            "planning/leak.py",
            "import vssm_gym.envs.scenes.scene as scene",
            "must not import vssm_gym.envs.scenes.scene",
        ),
        ("planning/leak.py", "from ..envs import scene", "must not import vssm_gym.envs"),
        ("agents/leak.py", "from vssm_gym.envs import robots", "must not import vssm_gym.envs"),
        ("model/leak.py", "import importlib\nimportlib.import_module('vssm_gym.envs.scenes.scene')", "must not import"),
        ("geometry/leak.py", "from ..maps.voxel_map import VoxelMap", "must not import vssm_gym.maps.voxel_map"),
        ("model/emission.py", "import vssm_gym.model.transition", "must not import vssm_gym.model.transition"),
        ("envs/leak.py", "from vssm_gym.planning import astar", "must not import vssm_gym.planning"),
        ("envs/leak.py", "from vssm_gym.maps import voxel_map", "must not import vssm_gym.maps"),
        ("envs/world_model/leak.py", "from vssm_gym.planning import astar", "must not import vssm_gym.planning"),
        (
            "inference/typed.py",
            "if TYPE_CHECKING:\n    from vssm_gym.envs import scene",
            "must not import vssm_gym.envs",
        ),
        (
            "data/sequences.py",
            "import vssm_gym.inference.tracking.map_tracker",
            "must not import vssm_gym.inference.tracking.map_tracker",
        ),
        ("eval/wrong.py", "from agents import base", "write vssm_gym.agents"),
        ("eval/wrong.py", "import evo", "for tests only"),
        ("newcomer.py", "", "belongs to no layer"),
        ("envs/second.py", "import mujoco", "mujoco is imported by more than one module"),
        ("envs/physics_too.py", "import mujoco", "mujoco is imported by more than one module"),
    ],
)
def test_a_bad_module_is_found(tmp_path, file, source, complaint):
    """A package with one bad module fails, and the same package without it passes."""
    good = {"envs/physics/a.py": "import mujoco", "envs/physics/b.py": "import mujoco"}
    good |= {"maps/voxel_map.py": "from vssm_gym.geometry.camera import Camera", "geometry/camera.py": ""}
    package = tmp_path / "vssm_gym"
    for name, text in good.items():
        (package / name).parent.mkdir(parents=True, exist_ok=True)
        (package / name).write_text(text)
    assert violations(import_graph(find_modules(package))) == []
    (package / file).parent.mkdir(parents=True, exist_ok=True)
    (package / file).write_text(source)
    complaints = violations(import_graph(find_modules(package)))
    assert len(complaints) == 1
    assert complaint in complaints[0]


@pytest.mark.parametrize(
    ("file", "source", "complaint"),
    [
        ("eval/metrics/leak.py", "from vssm_gym.eval.report import tables", "must not import vssm_gym.eval.report"),
        ("eval/studies/leak.py", "import vssm_gym.eval.bench.speed", "must not import vssm_gym.eval.bench.speed"),
        (
            "envs/rendering/leak.py",
            "def f():\n    from ..sensors import lidar",
            "must not import vssm_gym.envs.sensors",
        ),
        ("envs/textures/leak.py", "import vssm_gym.envs.carnav", "must not import vssm_gym.envs.carnav"),
        ("envs/scenes/leak.py", "import vssm_gym.envs.physics.planar", "must not import vssm_gym.envs.physics.planar"),
    ],
)
def test_an_import_upward_is_found(tmp_path, file, source, complaint):
    package = tmp_path / "vssm_gym"
    for name, text in {
        "envs/carnav.py": "import vssm_gym.envs.physics.a",
        "envs/physics/a.py": "from ..scenes.importers import mjcf",
        "envs/scenes/importers/mjcf.py": "from vssm_gym.envs.physics import a",
        "eval/report/tables.py": "from ..metrics import registry",
    }.items():
        (package / name).parent.mkdir(parents=True, exist_ok=True)
        (package / name).write_text(text)
    assert upward(import_graph(find_modules(package))) == []
    (package / file).parent.mkdir(parents=True, exist_ok=True)
    (package / file).write_text(source)
    [found] = upward(import_graph(find_modules(package)))
    assert complaint in found


def test_a_cycle_is_found(tmp_path):
    """Lazy imports close a cycle too, and so do imports for the type checker alone."""
    package = tmp_path / "pkg"
    package.mkdir()
    (package / "a.py").write_text("from pkg import b")
    (package / "b.py").write_text("def later():\n    from pkg.c import x")
    (package / "c.py").write_text("from . import a")
    assert set(cycle(import_graph(find_modules(package)))) == {"pkg.a", "pkg.b", "pkg.c"}
    (package / "c.py").write_text("from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from . import a")
    assert set(cycle(import_graph(find_modules(package)))) == {"pkg.a", "pkg.b", "pkg.c"}
    (package / "c.py").write_text("")
    assert cycle(import_graph(find_modules(package))) == []
