"""Reduce MJCF text to its static content: bodies, geoms, their defaults, materials and meshes.

The file is untrusted: elements come from a list of known ones, includes and meshes lie in the file's folder and are
read here within bounds, so that MuJoCo gets a text and some bytes and opens no file itself. Joints are dropped: every
body stays at its initial pose.
"""

import xml.etree.ElementTree as ET
from collections import Counter
from pathlib import Path

from vssm_gym.errors import InputError
from vssm_gym.files.json_file import read_bytes

XML_BYTES, MESH_BYTES, ALL_BYTES = 8 << 20, 32 << 20, 128 << 20  # largest text, mesh, and all files of a model
XML_LEVELS, XML_ELEMENTS, XML_INCLUDES, XML_GEOMS = 64, 50_000, 64, 10_000  # most of a model; nesting, then counts
COPIES = 5000  # made by nested replicates; MuJoCo needs a second for them, and four times as long for twice as many

_IN_BODY = {"body", "geom", "frame", "replicate"}
_KEPT = {
    "worldbody": _IN_BODY,
    **dict.fromkeys(_IN_BODY - {"geom"}, _IN_BODY),
    "default": {"default", "geom", "mesh", "material"},
    "asset": {"mesh", "material"},
}
_COMPILER = {"angle", "eulerseq"}
_MOVING = {"joint", "freejoint"}
_UNSEEN = {"site", "camera", "light", "inertial", "plugin"}  # nothing that a robot or a ray could hit
_SECTIONS = {"worldbody", "default", "asset"}


class _Builder(ET.TreeBuilder):
    """Build elements without document types (entities can grow without bound), of bounded number and nesting."""

    def __init__(self) -> None:
        super().__init__()
        self._level = self._count = 0

    def doctype(self, name: str, pubid: str | None, system: str | None) -> None:
        raise ValueError("a document type declaration is not allowed")

    def start(self, tag: str, attrs: dict[str, str]) -> ET.Element:
        self._level, self._count = self._level + 1, self._count + 1
        if self._level > XML_LEVELS or self._count > XML_ELEMENTS:
            raise ValueError(f"more than {XML_ELEMENTS:,} elements or {XML_LEVELS} levels")
        return super().start(tag, attrs)

    def end(self, tag: str) -> ET.Element:
        self._level -= 1
        return super().end(tag)


class StillModel:
    """Read the file at ``path`` for `vssm_gym.envs.physics.static_geoms`: ``xml``, ``assets``, and ``notes``."""

    def __init__(self, path: Path) -> None:
        self._path, self._folder = path, path.parent.resolve()
        self._includes = 0
        self._bytes = 0
        self._geoms = 0
        self._left_out: Counter[str] = Counter()
        self.assets: dict[str, bytes] = {}
        root = self._parse(path)
        if root.tag != "mujoco":
            raise InputError(path, "file", f"the root element mujoco; found {root.tag[:40]!r}")
        sections = list(self._expanded(root, path, 0))
        directories = {k: v for s in sections if s.tag == "compiler" for k, v in s.attrib.items()}
        self._meshes = directories.get("meshdir", directories.get("assetdir", ""))
        self._strip = directories.get("strippath") == "true"
        still = ET.Element("mujoco")
        # Joints are gone, so nothing moves and nothing needs a mass.
        ET.SubElement(still, "compiler", {k: v for k, v in directories.items() if k in _COMPILER})
        for section in sections:
            if section.tag in _SECTIONS:
                still.append(self._kept(section, 1))
            elif section.tag in ("deformable", "extension"):
                self._left_out[section.tag] += 1
        self.xml = ET.tostring(still, encoding="unicode")

    @property
    def notes(self) -> list[str]:
        """Return sentences on the parts of the model that are not in the scene."""
        moving = sum(self._left_out[tag] for tag in _MOVING)
        notes = [f"{moving} joint{'s' * (moving > 1)} frozen: bodies stay at their initial pose"] if moving else []
        others = [f"{tag} ({n})" for tag, n in sorted(self._left_out.items()) if tag not in _MOVING | _UNSEEN]
        return notes + ([f"left out: {', '.join(others)}"] if others else [])

    def _refuse(self, field: str, expected: str) -> InputError:
        return InputError(self._path, field, expected)

    def _parse(self, path: Path) -> ET.Element:
        content = read_bytes(path, XML_BYTES)
        self._count_bytes(len(content))
        try:
            parser = ET.XMLParser(target=_Builder())
            parser.feed(content)
            return parser.close()
        except (ET.ParseError, ValueError, LookupError) as error:
            raise InputError(path, "file", f"XML ({error})") from error

    def _count_bytes(self, number: int) -> None:
        self._bytes += number
        if self._bytes > ALL_BYTES:
            raise self._refuse("file", f"at most {ALL_BYTES:,} bytes with all includes and meshes")

    def _inside(self, name: str, folder: Path, field: str) -> Path:
        """Return the file ``name`` in ``folder``, which must be the model's or below it."""
        try:
            path = (folder / name).resolve()
            found = not Path(name).is_absolute() and path.is_relative_to(self._folder) and path.is_file()
        except (OSError, ValueError):
            found = False
        if not found:
            raise self._refuse(field, f"an existing file inside the model's folder; found {name[:80]!r}")
        return path

    def _expanded(self, parent: ET.Element, path: Path, level: int) -> list[ET.Element]:
        """Return the children of an element, each include replaced by the content of its file."""
        children: list[ET.Element] = []
        for child in parent:
            if child.tag != "include":
                child[:] = self._expanded(child, path, level)
                children.append(child)
                continue
            self._includes += 1
            if level >= 8 or self._includes > XML_INCLUDES:
                raise self._refuse("include", f"at most {XML_INCLUDES} includes, 8 deep")
            name = child.get("file", "")
            near = (path.parent / name).is_file() if "\0" not in name else False
            included = self._inside(name, path.parent if near else self._folder, "include.file")
            children += self._expanded(self._parse(included), included, level + 1)
        return children

    def _kept(self, element: ET.Element, copies: int) -> ET.Element:
        """Copy a section or body with its known children; ``copies`` is how often replicates repeat it."""
        result = ET.Element(element.tag, element.attrib)
        result.attrib.pop("mocap", None)
        if element.tag == "replicate":
            count = element.get("count", "")
            if not (count.isascii() and count.isdigit() and int(count[:9]) * copies <= COPIES):
                expected = f"a whole number, all nested ones multiplied up to {COPIES:,}"
                raise self._refuse("replicate.count", f"{expected}; found {count[:40]!r}")
            copies *= int(count)
        for child in element:
            if child.tag not in _KEPT[element.tag]:
                if element.tag not in (
                    "asset",
                    "default",
                ):  # textures, and defaults of omitted elements, are not needed
                    self._left_out[child.tag] += copies
            elif child.tag in _KEPT:
                kept = self._kept(child, copies)
                if len(kept) or child.tag not in _IN_BODY:  # what holds no geom costs MuJoCo time and shows nothing
                    result.append(kept)
            else:
                result.append(self._leaf(child, element.tag, copies))
        return result

    def _leaf(self, element: ET.Element, parent: str, copies: int) -> ET.Element:
        attributes = dict(element.attrib)
        if element.tag == "geom" and parent != "default":
            self._geoms += copies
            if self._geoms > XML_GEOMS:
                raise self._refuse("worldbody", f"at most {XML_GEOMS:,} geoms")
        if element.tag == "material":
            attributes.pop("texture", None)
        if element.tag == "mesh":
            attributes["inertia"] = "shell"  # thin meshes have no volume, and no mass is needed
            if "builtin" in attributes:
                raise self._refuse("asset.mesh.builtin", "a mesh of a file or of vertices")
            if "file" in attributes:
                attributes |= self._mesh(attributes)
        return ET.Element(element.tag, attributes)

    def _mesh(self, attributes: dict[str, str]) -> dict[str, str]:
        """Add the mesh's file to the assets, under a name of ours; return its attributes."""
        name = attributes["file"]
        name = name.replace("\\", "/").rpartition("/")[2] if self._strip else name
        path = self._inside(name, self._folder / self._meshes, "asset.mesh.file")
        content = read_bytes(path, MESH_BYTES)
        self._count_bytes(len(content))
        asset = f"mesh_{len(self.assets)}{path.suffix.lower()}"
        self.assets[asset] = content
        return {"file": asset, "name": attributes.get("name", Path(name).stem)}
