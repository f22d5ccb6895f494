"""Test the pages against the code: paths, equation labels, citations, links, Python and commands must resolve."""

import ast
import builtins
import functools
import importlib
import inspect
import math
import re
import shlex
from pathlib import Path

import pytest

from tests.helpers.paths import CHECKOUT
from vssm_gym.cli.main import COMMANDS, build_app
from vssm_gym.envs.robots.holonomic import NOISE_LEVELS
from vssm_gym.inference.alignment import reference_view, surface_error
from vssm_gym.inference.alignment.adam import AdamConfig
from vssm_gym.inference.alignment.aliasing import APART, COLOUR_MARGIN, CORRELATION_MARGIN, FARTHEST_SHIFT
from vssm_gym.inference.alignment.depth_scale import DEPTH_SCALES
from vssm_gym.inference.alignment.residuals import AlignConfig
from vssm_gym.inference.alignment.surface_error import SurfaceErrorConfig
from vssm_gym.inference.mapping.observation import MapUpdateConfig
from vssm_gym.inference.prism.config import PrismConfig
from vssm_gym.inference.prism.filter import FIRST_SHARE
from vssm_gym.inference.tracking import start_poses
from vssm_gym.inference.tracking.config import COMMANDED, TrackingConfig
from vssm_gym.inference.tracking.confirmation import ConfirmationConfig
from vssm_gym.inference.tracking.emission_tracking import TRACKER_ADAM
from vssm_gym.inference.tracking.keyframes import KeyframeConfig
from vssm_gym.inference.tracking.process_noise import ProcessNoiseConfig
from vssm_gym.inference.tracking.recovery import RecoveryConfig
from vssm_gym.maps import surface_std, voxel_map
from vssm_gym.model import emission, emission_density, emission_uncertainty, map_samples
from vssm_gym.model.emission_density import EmissionScales
from vssm_gym.model.transition.imu import ImuNoise
from vssm_gym.model.transition.rigid import RigidNoise

PAGES = sorted([CHECKOUT / "README.md", CHECKOUT / "CONTRIBUTING.md", *CHECKOUT.glob("docs/**/*.md")])
SCIENCE = [CHECKOUT / "docs/science" / f"{name}.md" for name in ("model", "inference", "planning", "tasks")]
CODE = sorted(
    path
    for folder in ("vssm_gym", "agents", "eval", "envs", "tests")
    for path in (CHECKOUT / folder).rglob("*")
    if path.suffix in {".py", ".yaml", ".md", ".toml"} and not any(part.is_symlink() for part in path.parents)
)
# The folders that dotted names in the pages start with: `envs.` stands for `vssm_gym.envs.`. Not `model.`: pages also
# call a model of stable-baselines3 so.
LAYERS = sorted(
    {path.name for path in (CHECKOUT / "vssm_gym").iterdir() if (path / "__init__.py").is_file()} - {"model"}
)
PLACEHOLDER = re.compile(r"^[A-Z]+(?:\.|$)|NAME|\*|\{|<")
# Private documents that a reader does not have. The path helper of the tests and one configuration name the folder of
# recordings and houses that may lie beside the checkout.
PRIVATE = re.compile(
    r"\bSPEC(?:\.md| \d|'s)|\bDESIGN\b|\bMEASURED\b|\bSTYLE(?:\.md| \d)|(?<![\w/])shared/(?:data|hooks)|\.\./shared\b"
    r"|(?i:\bissue #?\d)"
)
KEEPS_THE_PATH = {"tests/helpers/paths.py", "tests/test_docs.py"}
LABEL = r"[MIPT]\d+"
CITED = re.compile(rf"\b(?:[Ee]qs?\.|Equations?)\s+({LABEL}(?:(?:,| and| to|, and)\s+{LABEL})*)")


def ids(path: Path) -> str:
    """Return a file's path from the checkout: names of parametrised tests and messages."""
    return str(path.relative_to(CHECKOUT))


def text_of(page: Path) -> str:
    """Return a page without its fenced blocks."""
    return re.sub(r"^```.*?^```", "", page.read_text(), flags=re.MULTILINE | re.DOTALL)


def spans(page: Path) -> list[str]:
    """List the text in backticks outside of fenced blocks."""
    return re.findall(r"`([^`\n]+)`", text_of(page))


def fences(page: Path) -> list[str]:
    """List the Python blocks of a page."""
    return re.findall(r"^```python\n(.*?)^```", page.read_text(), flags=re.MULTILINE | re.DOTALL)


@functools.cache
def resolves(name: str) -> bool:
    """Return True for the dotted name of a module, or of a name that one defines, imports or annotates."""
    parts = name.split(".")
    for length in range(len(parts), 0, -1):
        try:
            found = importlib.import_module(".".join(parts[:length]))
        except ModuleNotFoundError as error:
            if not (error.name or "").startswith("vssm_gym"):
                return defined(name)  # an optional dependency is missing here
            continue
        for part in parts[length:]:
            if not hasattr(found, part):
                return part in inspect.get_annotations(found) if inspect.isclass(found) else False
            found = getattr(found, part)
        return True
    return False


def defined(name: str) -> bool:
    """Return whether a module's text defines a dotted name; nothing is imported."""
    parts = name.split(".")
    for length in range(len(parts), 0, -1):
        folder = CHECKOUT.joinpath(*parts[:length])
        path = folder.with_suffix(".py") if folder.with_suffix(".py").is_file() else folder / "__init__.py"
        if path.is_file():
            body: list[ast.stmt] = ast.parse(path.read_text()).body
            for part in parts[length:]:
                found = [node for node in body if part in names_of(node)]
                if not found:
                    return False
                body = getattr(found[0], "body", [])
            return True
    return False


def names_of(node: ast.stmt) -> set[str]:
    """Return the names that a statement defines."""
    if isinstance(node, ast.ClassDef | ast.FunctionDef):
        return {node.name}
    targets = node.targets if isinstance(node, ast.Assign) else [node.target] if isinstance(node, ast.AnnAssign) else []
    return {target.id for target in targets if isinstance(target, ast.Name)}


@pytest.mark.parametrize("page", PAGES, ids=ids)
def test_dotted_names_resolve(page):
    names = {span for span in spans(page) if re.fullmatch(r"[a-z]\w*(\.\w+)+", span)}
    ours = {f"vssm_gym.{name}": name for name in names if name.partition(".")[0] in LAYERS}
    ours |= {name: name for name in names if name.startswith("vssm_gym.")}
    files = re.compile(r"\.(py|md|yaml|json|html|txt|npz|toml|ply|svg|jsonl|mp4|png|csv)$")
    missing = [name for full, name in ours.items() if not files.search(full) and not resolves(full)]
    assert sorted(missing) == []


@pytest.mark.parametrize("page", PAGES, ids=ids)
def test_files_in_backticks_exist(page):
    paths = {span for span in spans(page) if re.fullmatch(r"[\w.-]+(/[\w.-]+)+\.(py|md|yaml|toml|xml)", span)}
    paths |= set(re.findall(r"(?<![\w/])tests/[\w/]+\.py", page.read_text()))  # in commands too
    paths -= set(re.findall(r"Save it as `([^`]+)`", page.read_text()))  # an example that the reader writes
    roots = (CHECKOUT, CHECKOUT / "vssm_gym", page.parent)
    missing = [
        path
        for path in paths
        if not any(PLACEHOLDER.search(part) for part in path.split("/"))
        and not any((root / path).exists() for root in roots)
    ]
    assert sorted(missing) == []


@functools.cache
def labels() -> list[str]:
    """List the labels of all equations in the order of the pages."""
    return [
        label
        for page in SCIENCE
        for label in re.findall(rf'^<a id="\w+"></a>\*\*({LABEL})\*\*', page.read_text(), re.M)
    ]


@pytest.mark.parametrize(("page", "letter"), list(zip(SCIENCE, "MIPT", strict=True)), ids="MIPT")
def test_equations_are_numbered_and_name_their_functions(page, letter):
    """Each label has an anchor of its name, an equation, and a function that computes it."""
    entries = re.split(r"^(?=<a id=)", page.read_text(), flags=re.MULTILINE)[1:]
    for number, entry in enumerate(entries, start=1):
        anchor, label = re.match(rf'<a id="(\w+)"></a>\*\*({LABEL})\*\*', entry).groups()
        assert (anchor, label) == (f"{letter}{number}".lower(), f"{letter}{number}")
        assert re.search(r"\n\n {4}\S.*\n\n", entry, re.DOTALL), f"{label} has no equation"
        assert re.search(r"^`vssm_gym\.[\w.]+`", entry, re.MULTILINE), f"{label} names no function"


@pytest.mark.parametrize("page", PAGES, ids=ids)
def test_no_equation_holds_a_link(page):
    """An indented block is shown as it is written."""
    blocks = re.findall(r"(?<=\n\n)(?: {4}.*\n)+", text_of(page))
    assert [block for block in blocks if re.search(r"\]\([^)\s]*[#/.][^)\s]*\)", block)] == []


def entries() -> dict[str, str]:
    """Return the text of every equation, from its label to the next label or heading, by label."""
    found = {}
    for page in SCIENCE:
        for entry in re.split(r"^(?=<a id=)|^(?=#)", page.read_text(), flags=re.MULTILINE):
            if label := re.match(rf'<a id="\w+"></a>\*\*({LABEL})\*\*', entry):
                found[label.group(1)] = entry
    return found


SHARES = tuple(
    getattr(EmissionScales(), name)
    for name in ("outlier", "rgb_outlier", "miss", "guess_outlier", "guess_rgb_outlier", "guess_miss", "empty_miss")
)
# What an equation states, and the value in the code that it states
STATED = [
    ("M3", "(10 m)^2", voxel_map.PRIOR_OCCUPANCY_STD, 10.0),
    ("M3", "-0.001 m", voxel_map.PRIOR_OCCUPANCY_MEAN, -0.001),
    ("M8", "e = 0.4 voxel", emission.STEP, 0.4),
    ("M8", "tau = 0,", emission.TAU, 0.0),
    ("M11", "s = 0.1", emission_density.PUBLISHED_DEPTH_SCALE, 0.1),
    ("M11", "s_c = s / 10", emission_density.PUBLISHED_DEPTH_SCALE / emission_density.PUBLISHED_RGB_SCALE, 10.0),
    ("M11", "s_0 = 0.006", EmissionScales().depth, 0.006),
    ("M11", "s_2 = 0.0008", EmissionScales().growth, 0.0008),
    ("M11", "d_o = 0.9", EmissionScales().outlier_depth, 0.9),
    ("M11", "s_c = 0.02", EmissionScales().rgb, 0.02),
    ("M11", "`s_w = 0.078`, `w = 0.53`", (EmissionScales().textured_rgb, EmissionScales().textured), (0.078, 0.53)),
    ("M11", "| an observed surface | 0.025 | 0.03 | 0.11 |", SHARES[:3], (0.025, 0.03, 0.11)),
    ("M11", "was not observed | 0.89 | 0.9 | 0.2 |", SHARES[3:6], (0.89, 0.9, 0.2)),
    ("M11", "| no surface | 1 | 1 | 0.09 |", SHARES[6], 0.09),
    ("M12", "s = 0.006 m", surface_std.READING_STD, 0.006),
    ("M12", "a = 0.02,", surface_std.CELL_SHARE, 0.02),
    ("M12", "b = 0.41,", surface_std.BEND_SHARE, 0.41),
    ("M12", "c = 0.38", surface_std.LARGEST_BEND, 0.38),
    ("M12", "s_c = 0.1", voxel_map.OBSERVATION_COLOUR_STD, 0.1),
    ("M13", "at least 0.1", emission_uncertainty.MIN_COSINE, 0.1),
    ("M14", "l_1 = 2 h", map_samples.NEAR_LENGTH, 2.0),
    ("M14", "l_2 = 0.5 m", map_samples.FAR_LENGTH, 0.5),
    ("M14", "F = 64", map_samples.FREQUENCIES, 64),
    ("M21", "std 0.03 and 0.05 m", (RigidNoise().vel_translation, RigidNoise().pose_translation), (0.03, 0.05)),
    ("M21", "0.03 and 0.02 for rotation", (RigidNoise().vel_rotation, RigidNoise().pose_rotation), (0.03, 0.02)),
    ("M22", "0.01 m, 0.001 rad", (ImuNoise().location, ImuNoise().orientation), (0.01, 0.001)),
    ("I10", "h = 1.345", AlignConfig().huber, 1.345),
    ("I10", "r_rgb / 0.04", AlignConfig().rgb_sigma, 0.04),
    ("I10", "30 pixels", AlignConfig().pixels_per_datum, 30.0),
    ("I9", "0.3 m and 0.3 here", (AlignConfig().geo_gate, AlignConfig().rgb_gate), (0.3, 0.3)),
    ("I9", "0.45 m and 0.15", (AdamConfig().geo_gate, AdamConfig().rgb_gate), (0.45, 0.15)),
    ("I12", "200 pixels", AdamConfig().pixels, 200),
    ("I12", "1000 steps", AdamConfig().steps, 1000),
    ("I12", "0.001 m and 0.00036 rad", (AdamConfig().translation_step, AdamConfig().rotation_step), (0.001, 0.00036)),
    ("I12", "0.02 and 0.1", (AdamConfig().geo_scale, AdamConfig().rgb_scale), (0.02, 0.1)),
    ("I14", "0.075 rad", TrackingConfig().search_reach, 0.075),
    ("I14", "more than 4 stds", TrackingConfig().max_unconfirmed, 4.0),
    ("I14", "-3, -2, -1, 1, 2 and 3 stds", COMMANDED.heading_starts, (-3.0, -2.0, -1.0, 1.0, 2.0, 3.0)),
    ("I14", "on about 300 pixels", start_poses.SEARCHED_PIXELS, 300),
    ("I14", "over about 1250 pixels", start_poses.COMPARED_PIXELS, 1250),
    ("I14", "on nothing known costs 2", AlignConfig().unseen_cost, 2.0),
    ("I15", "0.8 Sigma_t-1", TrackingConfig().smoothing, 0.8),
    ("I15", "in [1, 10]", COMMANDED.most_correlated, 10.0),
    ("I15", "`kappa`\nis 1", TrackingConfig().most_correlated, 1.0),
    ("I16", "0.25))^2", SurfaceErrorConfig().least_residual, 0.25),
    ("I16", "of 1 m", SurfaceErrorConfig().patch, 1.0),
    ("I16", "1250 pixels", SurfaceErrorConfig().pixels, 1250),
    ("I16", "slot of 256", surface_error.SLOTS, 256),
    ("I16", "slot of 1024", surface_error.PIECES, 1024),
    ("I16", "cube of 0.3 m", SurfaceErrorConfig().piece, 0.3),
    ("I16", "0.12 cells in a learned map", reference_view.LEARNED, 0.12),
    ("I16", "0.05 cells in one just written", reference_view.JUST_WRITTEN, 0.05),
    ("I16", "0.0006 m in a camera image", reference_view.TAKEN, 0.0006),
    ("I17", "exp(-d / 1 m)", SurfaceErrorConfig().patch, 1.0),
    ("I18", "tau = 1 s,  c = 1.5", (ProcessNoiseConfig().time_constant, ProcessNoiseConfig().caution), (1.0, 1.5)),
    ("I18", "0.2^2 <= s^2", ProcessNoiseConfig().floor, 0.2),
    ("I19", "trunc = 2 voxels", MapUpdateConfig().truncation, 2.0),
    ("I20", "w = 1", MapUpdateConfig().std, 1.0),
    ("I23", "writes 0.99", FIRST_SHARE, 0.99),
    ("I24", "s_t = 0.01 s,  s_c = 0.003", (PrismConfig().stamp_std, PrismConfig().calibration_std), (0.01, 0.003)),
    ("I24", "s_d = 0.005", PrismConfig().scale_std, 0.005),
    ("I25", "0.15 m", PrismConfig().reference_distance, 0.15),
    ("I25", "0.15 rad", PrismConfig().reference_angle, 0.15),
    ("I26", "a quarter of the edge", PrismConfig().window_margin, 0.25),
    ("I27", ">= 0.6", TrackingConfig().min_score, 0.6),
    ("I27", "<= 5", TrackingConfig().max_photometric, 5.0),
    ("I27", "12^2", TrackingConfig().max_surprise, 12.0),
    ("I27", "5 % of the pixels", TrackingConfig().min_reading, 0.05),
    ("I28", ">= 0.7 ", ConfirmationConfig().min_correlation, 0.7),
    ("I28", "1.5 * 0.04", ConfirmationConfig().min_contrast, 1.5),
    ("I28", ">= 0.85 ", ConfirmationConfig().confirming_correlation, 0.85),
    ("I28", "+ 0.1 ", ConfirmationConfig().colour_margin, 0.1),
    ("I28", "> 4^2", TrackingConfig().max_unconfirmed, 4.0),
    ("I29", "+ 0.1", COLOUR_MARGIN, 0.1),
    ("I29", "{0.83, 0.91, 1, 1.1, 1.2}", DEPTH_SCALES, (0.83, 0.91, 1.0, 1.1, 1.2)),
    ("I30", "1 / 0.03^2", RecoveryConfig().max_std, 0.03),
    ("I31", "0.3 m and 0.26 rad", (KeyframeConfig().distance, KeyframeConfig().angle), (0.3, 0.26)),
    ("I32", ">= 0.65", RecoveryConfig().min_score, 0.65),
    ("I32", "min(4, 0.55 contrast", (RecoveryConfig().max_photometric, RecoveryConfig().max_unexplained), (4.0, 0.55)),
    ("I32", "rho >= 0.8,", RecoveryConfig().min_correlation, 0.8),
    ("I32", "0.1 m or rad", APART, 0.1),
    ("I32", "c(best) + 0.1", COLOUR_MARGIN, 0.1),
    ("I33", "c(T) + 0.1", COLOUR_MARGIN, 0.1),
    ("I33", "rho(T) - 0.02", CORRELATION_MARGIN, 0.02),
    ("I33", "0.1 <= |s| <= 0.6", (APART, FARTHEST_SHIFT), (0.1, 0.6)),
    ("I37", "100 steps", TRACKER_ADAM.steps, 100),
    ("T2", "low (3 deg, 0.1 b)", (NOISE_LEVELS["low"].turn, NOISE_LEVELS["low"].step), (math.radians(3.0), 0.02)),
    ("T2", "high (9 deg, 0.3 b)", (NOISE_LEVELS["high"].turn, NOISE_LEVELS["high"].step), (math.radians(9.0), 0.06)),
]


@pytest.mark.parametrize(("label", "text", "value", "stated"), STATED, ids=[f"{row[0]}-{row[1]}" for row in STATED])
def test_equations_state_the_values_of_the_code(label, text, value, stated):
    assert text in " ".join(entries()[label].split()) or text in entries()[label]
    assert value == pytest.approx(stated)


@pytest.mark.parametrize("folder", ["vssm_gym", "agents", "eval", "envs", "tests", "docs"])
def test_cited_equations_exist(folder):
    known = set(labels())
    paths = PAGES if folder == "docs" else [path for path in CODE if ids(path).startswith(f"{folder}/")]
    unknown = [
        f"{ids(path)}: {label}"
        for path in paths
        for cited in CITED.findall(path.read_text())
        for label in re.findall(LABEL, cited)
        if label not in known
    ]
    assert unknown == []


def folder_of(path: Path) -> str:
    """Return the folder that a file is counted under: two levels of the library, one of all else."""
    parts = path.relative_to(CHECKOUT).parts
    return "/".join(parts[: 2 if parts[0] == "vssm_gym" else 1]) if len(parts) > 1 else "."


CITING = {path: folder_of(path) for path in [*CODE, *PAGES, CHECKOUT / "Makefile", CHECKOUT / "pyproject.toml"]}


@pytest.mark.parametrize("folder", sorted(set(CITING.values())))
def test_nothing_private_is_cited(folder):
    found = [
        f"{ids(path)}:{number}: {match.group()}"
        for path, where in CITING.items()
        if where == folder and ids(path) not in KEEPS_THE_PATH
        for number, line in enumerate(path.read_text().splitlines(), start=1)
        for match in PRIVATE.finditer(line)
    ]
    assert found == []


def anchors(page: Path) -> set[str]:
    """Return the anchors of a page: its headings as GitHub spells them, and explicit ones."""
    found, text = set(re.findall(r'<a id="([\w-]+)">', page.read_text())), text_of(page)
    for heading in re.findall(r"^#+ +(.+?) *$", text, flags=re.MULTILINE):
        plain = re.sub(r"\[([^]]*)\]\([^)]*\)", r"\1", heading)
        slug = re.sub(r"[^\w\- ]", "", plain.lower()).replace(" ", "-")
        number = 0
        while (name := slug if not number else f"{slug}-{number}") in found:
            number += 1
        found.add(name)
    return found


@pytest.mark.parametrize("page", PAGES, ids=ids)
def test_links_lead_somewhere(page):
    for target in re.findall(r"\]\((?!https?://|mailto:)([^)\s]+)", text_of(page)):
        path, _, anchor = target.partition("#")
        linked = (page.parent / path).resolve() if path else page
        assert linked.exists(), f"{ids(page)} links to {target}"
        if anchor:
            assert anchor in anchors(linked), f"{ids(page)} links to {target}, which has no such heading"


@pytest.mark.parametrize("page", PAGES, ids=ids)
def test_a_page_has_one_title(page):
    titles = re.findall(r"^# +(.+)$", text_of(page), flags=re.MULTILINE)
    assert len(titles) == 1, f"{ids(page)} has the titles {titles}"


def test_the_index_names_every_page():
    folder = CHECKOUT / "docs"
    index = (folder / "index.md").read_text()
    missing = [ids(page) for page in folder.glob("**/*.md") if f"({page.relative_to(folder)})" not in index]
    assert sorted(set(missing) - {"docs/index.md"}) == []


@pytest.mark.parametrize("page", PAGES, ids=ids)
def test_python_of_the_pages_compiles_and_its_imports_resolve(page):
    for block in fences(page):
        tree = ast.parse(block)
        compile(tree, ids(page), "exec")
        names = [
            f"{node.module}.{alias.name}"
            for node in ast.walk(tree)
            if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] == "vssm_gym"
            for alias in node.names
        ]
        names += [a.name for node in ast.walk(tree) if isinstance(node, ast.Import) for a in node.names]
        assert [name for name in names if name.startswith("vssm_gym") and not resolves(name)] == []


def commands(page: Path) -> list[str]:
    """List the command lines of a page: in fences, continuation lines joined, and in backticks."""
    blocks = re.findall(r"^```(\w*)\n(.*?)^```", page.read_text(), flags=re.MULTILINE | re.DOTALL)
    fenced = [block for language, block in blocks if language in {"", "bash", "sh", "console"}]
    lines = re.findall(r"^(?:\S*/)?(vssm-gym .*(?:\n +\S.*)*)", "\n".join(fenced), flags=re.MULTILINE)
    return lines + [span for span in spans(page) if span.startswith("vssm-gym ")]


@functools.cache
def options(name: tuple[str, ...]) -> frozenset[str]:
    """Return the options of a command, read from its help."""
    import contextlib
    import io

    target = functools.reduce(lambda tree, part: tree[part], name, COMMANDS)
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), pytest.raises(SystemExit):
        build_app({"command": target, "other": target}).cli(prog="vssm-gym", args=["command", "--help"])
    return frozenset(re.findall(r"--[a-z][\w-]*", printed.getvalue()))


@pytest.mark.parametrize("page", PAGES, ids=ids)
def test_commands_of_the_pages_are_those_of_the_command_line(page):
    for line in commands(page):
        words = shlex.split(line.replace("[--", " --").replace("]", " "), comments=True)[1:]
        if PLACEHOLDER.search(words[0]) or words[0].startswith("--"):
            continue
        name, tree = [], COMMANDS
        while isinstance(tree, dict) and len(name) < len(words):
            word = words[len(name)].split("|")[0]
            if PLACEHOLDER.search(word):
                break
            assert word in tree, f"{ids(page)}: {line}"
            name, tree = [*name, word], tree[word]
        if isinstance(tree, str):
            known = options(tuple(name)) | {"--help"}
            files = [word for word in words if word.startswith(("eval/", "envs/", "agents/", "tests/"))]
            assert [file for file in files if not (CHECKOUT / file).exists()] == []
            unknown = {word.partition("=")[0] for word in words if word.startswith("--")} - known
            assert not unknown, f"{ids(page)}: {line}: {unknown}"


def self_contained(block: str) -> bool:
    """Return whether a block defines every name that it uses, reads no file and does not train for minutes."""
    tree = ast.parse(block)
    nodes = list(ast.walk(tree))
    named = {
        node.id: type(node.ctx) for node in nodes if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store)
    }
    bound = {*dir(builtins), *named, *(node.arg for node in nodes if isinstance(node, ast.arg))}
    bound |= {node.name for node in nodes if isinstance(node, ast.FunctionDef | ast.ClassDef)}
    for node in nodes:
        if isinstance(node, ast.Import | ast.ImportFrom):
            bound |= {(alias.asname or alias.name).partition(".")[0] for alias in node.names}
    used = {node.id for node in nodes if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Load)}
    texts = [node.value for node in nodes if isinstance(node, ast.Constant) and isinstance(node.value, str)]
    files = re.compile(r"\.(npz|json|yaml|txt|mp4)$|^rgbd_dataset|/$|^[A-Z]+$")
    return used <= bound and ".learn(" not in block and not any(files.search(text) for text in texts)


# tests/test_tutorials.py runs whole tutorials
RUNNABLE = [
    (page, i)
    for page in PAGES
    if page.parent.name != "tutorials"
    for i, block in enumerate(fences(page))
    if self_contained(block)
]


@pytest.mark.slow
@pytest.mark.parametrize(("page", "number"), RUNNABLE, ids=[f"{ids(page)}-{i}" for page, i in RUNNABLE])
def test_examples_run(page, number, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    exec(compile(fences(page)[number], ids(page), "exec"), {"__name__": "__main__"})
