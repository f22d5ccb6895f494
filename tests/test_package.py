"""Test the package as it is shipped: files of the wheel, declared dependencies, import cost, and checked shapes."""

import ast
import importlib.metadata
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import yaml
from setuptools import find_packages

import vssm_gym
from vssm_gym.compilation_cache import SETTINGS
from vssm_gym.geometry.camera import Camera

CHECKOUT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((CHECKOUT / "pyproject.toml").read_text())
SETUPTOOLS = PROJECT["tool"]["setuptools"]
HEAVY = ["jax", "mujoco", "numba", "embreex", "matplotlib", "scipy", "shapely", "torch", "jinja2"]
MODULE_OF = {"pyyaml": "yaml", "pillow": "PIL", "scikit-image": "skimage"}  # where the import has another name


def package_files() -> list[Path]:
    """Return every file below ``vssm_gym``, through the links, relative to the checkout."""
    found = []
    for directory, subfolders, files in os.walk(CHECKOUT / "vssm_gym", followlinks=True):
        subfolders[:] = [name for name in subfolders if name != "__pycache__"]
        found += [(Path(directory) / file).relative_to(CHECKOUT) for file in files]
    return found


def declared(section: list[str]) -> set[str]:
    return {re.split(r"[^A-Za-z0-9_.-]", requirement)[0].lower() for requirement in section}


def normal(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def test_every_folder_with_code_is_packaged():
    """Setuptools follows the links, and leaves out a folder without an ``__init__``."""
    folders = {".".join(path.parent.parts) for path in package_files() if path.suffix == ".py"}
    found = SETUPTOOLS["packages"]["find"]
    assert folders == {
        name for where in found["where"] for name in find_packages(str(CHECKOUT / where), (), found["include"])
    }


def test_every_data_file_is_packaged():
    data = SETUPTOOLS["package-data"]
    shipped = {file for package, globs in data.items() for glob in globs for file in folder_of(package).glob(glob)}
    for path in package_files():
        if path.suffix != ".py":
            assert (CHECKOUT / path).resolve() in shipped, f"{path} would be missing from the wheel"


def folder_of(package: str) -> Path:
    return (CHECKOUT / package.replace(".", "/")).resolve()


def test_the_top_folders_are_linked_into_the_package():
    for link, folder in {"agents": "agents", "eval": "eval", "envs/assets": "envs/assets"}.items():
        path = CHECKOUT / "vssm_gym" / link
        assert path.is_symlink()
        assert not path.readlink().is_absolute()
        assert path.resolve() == CHECKOUT / folder


def test_imported_and_declared_dependencies_are_the_same():
    imported = set()
    for path in package_files():
        if path.suffix == ".py":
            for node in ast.walk(ast.parse((CHECKOUT / path).read_text())):
                if isinstance(node, ast.Import):
                    imported |= {alias.name.split(".")[0] for alias in node.names}
                elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
                    imported.add(node.module.split(".")[0])
    foreign = imported - set(sys.stdlib_module_names) - {"vssm_gym"}
    modules = {MODULE_OF.get(name, name) for name in declared(PROJECT["project"]["dependencies"])}
    # Of agents/sb3.py alone, which nothing here imports; the car's second simulator, HDF5 and the writers of data sets,
    # where they are asked for; Ray; and a peer that `bench envs` measures where it is installed.
    assert foreign - modules == {
        "h5py",
        "minari",
        "miniworld",
        "pyarrow",
        "pybullet",
        "ray",
        "stable_baselines3",
        "torch",
    }
    assert modules <= foreign
    assert {"stable-baselines3", "torch"} == declared(PROJECT["project"]["optional-dependencies"]["rl"])
    assert {"pybullet"} == declared(PROJECT["project"]["optional-dependencies"]["bullet"])
    assert {"h5py"} == declared(PROJECT["project"]["optional-dependencies"]["dynamics"])
    assert {"ray"} == declared(PROJECT["project"]["optional-dependencies"]["cluster"])
    assert {"minari", "h5py", "pyarrow"} == declared(PROJECT["project"]["optional-dependencies"]["datasets"])


def test_constraints_pin_every_dependency_and_name_no_address():
    lines = (CHECKOUT / "constraints.txt").read_text().splitlines()
    assert all(re.fullmatch(r"[A-Za-z0-9_.-]+==[A-Za-z0-9_.+!-]+", line) for line in lines)
    pinned = {normal(line.split("==")[0]) for line in lines}
    wanted = declared(PROJECT["project"]["dependencies"]) | declared(PROJECT["project"]["optional-dependencies"]["dev"])
    assert {normal(name) for name in wanted} <= pinned
    assert "vssm-gym" not in pinned


def test_one_version():
    newest = re.search(r"^## (\S+)", (CHECKOUT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert newest is not None
    assert vssm_gym.__version__ == PROJECT["project"]["version"] == newest.group(1)
    assert importlib.metadata.version("vssm-gym") == vssm_gym.__version__


def test_importing_the_package_is_cheap():
    """Registering the environments starts neither the model nor the simulator."""
    code = f"import sys, vssm_gym; print(sorted(set({HEAVY}) & sys.modules.keys()))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_gymnasium_imports_the_package_that_an_id_names():
    """Make an environment by ``gym.make("vssm_gym:vssm_gym/...")`` in a program that imports Gymnasium alone."""
    code = "from gymnasium.envs.registration import _find_spec as find; print(find('vssm_gym:vssm_gym/PointNav-v0').id)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "vssm_gym/PointNav-v0"


def test_compiled_functions_are_kept_between_runs():
    """JAX reads the folder from the environment at its import."""
    assert jax.config.jax_compilation_cache_dir == os.environ["JAX_COMPILATION_CACHE_DIR"]
    assert jax.config.jax_enable_compilation_cache


CACHE = "import jax; print(jax.config.jax_compilation_cache_dir)"
CACHE_VARIABLES = ("JAX_COMPILATION_CACHE_DIR", *SETTINGS)


@pytest.mark.parametrize("code", [f"import vssm_gym; {CACHE}", f"import jax, vssm_gym; {CACHE}"])
def test_importing_the_package_turns_the_compilation_cache_on(code, tmp_path):
    """Whichever is imported first."""
    said = printed(code, XDG_CACHE_HOME=str(tmp_path))
    assert said.startswith(str(tmp_path / "vssm_gym" / "jax"))


def test_a_configured_cache_stays_as_it_is(tmp_path):
    assert printed(f"import vssm_gym; {CACHE}", JAX_COMPILATION_CACHE_DIR=str(tmp_path)) == str(tmp_path)
    configured = f"import jax; jax.config.update('jax_compilation_cache_dir', '/theirs'); import vssm_gym; {CACHE}"
    assert printed(configured) == "/theirs"


def test_there_is_no_cache_where_no_folder_can_be_written(tmp_path):
    (tmp_path / "vssm_gym").write_text("a file where the folder would be")
    assert printed(f"import vssm_gym; {CACHE}", XDG_CACHE_HOME=str(tmp_path)) == "None"


def printed(code: str, **variables: str) -> str:
    """Return what a new process prints, without the variables of the cache of this one."""
    kept = {name: value for name, value in os.environ.items() if name not in CACHE_VARIABLES}
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, check=True, env=kept | variables)
    return done.stdout.strip()


def test_annotated_shapes_are_checked_here():
    """The import hook of conftest.py is active; without it annotations are not checked."""
    camera = Camera.from_hfov(4, 3, 1.5)
    assert camera.backproject(jnp.ones((3, 4))).shape == (3, 4, 3)
    with pytest.raises(Exception, match="type"):
        camera.backproject(jnp.ones((3, 4, 2)))


def test_the_example_of_the_readme_runs():
    example = re.findall(r"```python\n(.*?)```", (CHECKOUT / "README.md").read_text(), re.DOTALL)[0]
    names: dict[str, Any] = {}
    exec(example, names)
    assert names["observation"]["rgb"].shape == (120, 160, 3)
    assert names["observation"]["depth"].dtype == np.float32
    assert names["picture"].std() > 0


def test_the_citation_is_of_this_version():
    with (CHECKOUT / "CITATION.cff").open() as file:
        citation = yaml.safe_load(file)
    project = PROJECT["project"]
    assert f"# {citation['title']}" == (CHECKOUT / "README.md").read_text().partition("\n")[0]
    assert (citation["version"], citation["license"]) == (project["version"], project["license"])
    assert {paper["notes"] for paper in citation["references"]} == {"VSSM-LM", "PRISM", "TNP-SM", "DVBF-LM"}


def test_the_workflow_calls_targets_and_versions_that_exist():
    with (CHECKOUT / ".github" / "workflows" / "test.yml").open() as file:
        jobs = yaml.safe_load(file)["jobs"]
    commands = [step["run"] for job in jobs.values() for step in job["steps"] if "run" in step]
    words = [word for line in commands if line.startswith("make ") for word in line.split()[1:]]
    targets = {word for word in words if re.fullmatch("[a-z-]+", word)}
    makefile = (CHECKOUT / "Makefile").read_text()
    assert targets == {"install", "lint", "test", "test-slow", "docs"}
    assert all(f"\n{target}:" in makefile for target in targets)
    classifiers = PROJECT["project"]["classifiers"]
    for version in jobs["test"]["strategy"]["matrix"]["python"]:
        assert f"Programming Language :: Python :: {version}" in classifiers
