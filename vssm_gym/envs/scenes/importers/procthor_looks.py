"""Map ProcTHOR's material and asset names to textures and colours, the same every time.

ProcTHOR files name Unity materials and meshes that are not part of them. A material's texture and colour are read from
the words in its name; an object's from its type, shaded by a hash of its asset, so that two chairs differ.
"""

import zlib
from typing import Literal

from vssm_gym.envs.scenes.apartment_parts import Material

RGB = tuple[float, float, float]

# Words in a material's name -> texture and scale in m; the first that occurs decides, so drywall precedes its tiles.
_WALLS: tuple[tuple[str, str, float], ...] = (
    ("panel_fabric", "fabric", 1.5),
    ("drywall", "plaster", 2.0),
    ("checker", "checker", 1.2),
    ("hextile", "hexagons", 1.2),
    ("subway", "subway", 1.2),
    ("smalltiles", "mosaic", 0.8),
    ("glasstiles", "mosaic", 0.8),
    ("shard", "mosaic", 1.0),
    ("fireplacebrick", "brick", 1.4),
    ("marble", "marble", 2.0),
    ("tile", "tiles", 1.2),
    ("brick", "brick", 1.4),
    ("granite", "granite", 1.0),
    ("concrete", "concrete", 2.0),
    ("wicker", "wicker", 1.0),
    ("wood", "wood", 1.5),
    ("kitchenfloor", "tiles", 1.5),
)
_FLOORS: tuple[tuple[str, str, float], ...] = (
    ("floorscross", "parquet", 2.0),
    ("slashhatch", "parquet", 2.0),
    ("carpet", "carpet", 1.5),
    ("greyfloor", "tiles", 2.0),
    ("wicker", "wicker", 1.5),
    *(
        entry
        for entry in _WALLS
        if entry[0] in ("checker", "hextile", "smalltiles", "marble", "tile", "brick", "granite")
    ),
    ("concrete", "concrete", 2.0),
)
_COLORS: tuple[tuple[str, RGB], ...] = (
    ("pureblack", (0.25, 0.23, 0.22)),
    ("red", (0.62, 0.30, 0.22)),
    ("orange", (0.80, 0.52, 0.28)),
    ("yellow", (0.90, 0.82, 0.55)),
    ("green", (0.62, 0.76, 0.60)),
    ("pink", (0.88, 0.70, 0.70)),
    ("eggshell", (0.93, 0.90, 0.82)),
    ("cream", (0.92, 0.86, 0.70)),
    ("beige", (0.86, 0.79, 0.66)),
    ("tan", (0.80, 0.68, 0.52)),
    ("off_white", (0.93, 0.92, 0.87)),
    ("white", (0.95, 0.95, 0.94)),
    ("brown", (0.58, 0.43, 0.30)),
    ("dark", (0.45, 0.36, 0.30)),
    ("grey", (0.70, 0.70, 0.70)),
    ("brick", (0.68, 0.40, 0.32)),
    ("light", (0.85, 0.72, 0.54)),
)
# RGB in [0, 1] of wood whose colour the asset does not name.
_WOODS: tuple[RGB, ...] = ((0.72, 0.52, 0.34), (0.80, 0.63, 0.43), (0.60, 0.42, 0.28), (0.68, 0.54, 0.40))


def _hash(name: str) -> int:
    return zlib.crc32(name.encode())


def surface_material(name: str, color: RGB | None, where: Literal["wall", "floor", "ceiling"]) -> Material:
    """Return the look of a wall, floor or ceiling; the file's own ``color`` wins over the name's.

    Unknown names are paint on walls and ceilings and wooden boards on floors.
    """
    words = name.lower().replace(" ", "")
    boards = ("planks", 1.6) if _hash(name) % 2 else ("laminate", 1.6)
    texture, scale = boards if where == "floor" else ("plaster", 2.0)
    for word, known, size in _FLOORS if where == "floor" else _WALLS:
        if word in words:
            texture, scale = known, size
            break
    named = next((shade for word, shade in _COLORS if word in words), None)
    if named is None:
        wooden = texture in ("planks", "laminate", "parquet", "wicker", "wood")
        named = _WOODS[_hash(name) % len(_WOODS)] if wooden else (0.88, 0.87, 0.84)
    return Material(color=named if color is None else color, texture=texture, scale=scale)


_PAINTINGS = (
    "painting_mountains",
    "painting_blocks",
    "painting_circles",
    "painting_harbour",
    "painting_flowers",
    "painting_map",
)
_SOFT = ("fabric", "plaid", "leather")
_OBJECTS: dict[str, tuple[str, ...]] = {
    "Painting": _PAINTINGS,
    "Television": ("screen",),
    "Laptop": ("screen",),
    "Desktop": ("screen",),
    "Bed": ("plaid", "fabric"),
    "Sofa": _SOFT,
    "ArmChair": _SOFT,
    "Ottoman": _SOFT,
    "Footstool": _SOFT,
    "DogBed": ("carpet",),
    "Pillow": ("fabric", "plaid"),
    "TeddyBear": ("carpet",),
    "Towel": ("fabric",),
    "HandTowel": ("fabric",),
    "Cloth": ("fabric",),
    "LaundryHamper": ("wicker",),
    "ShelvingUnit": ("books",),
    "Book": ("stripes",),
    "Newspaper": ("stripes",),
    "Dresser": ("drawers",),
    "SideTable": ("drawers", "cabinet"),
    "TVStand": ("cabinet", "drawers"),
    "CounterTop": ("cabinet",),
    "Desk": ("wood", "planks"),
    "DiningTable": ("wood", "planks"),
    "CoffeeTable": ("wood", "planks"),
    "Chair": ("wood", "fabric"),
    "Stool": ("wood", "leather"),
    "Fridge": ("metal",),
    "GarbageCan": ("metal",),
    "Safe": ("metal",),
    "Microwave": ("oven",),
    "Toaster": ("metal",),
    "WashingMachine": ("oven",),
    "ClothesDryer": ("oven",),
    "HousePlant": ("leaves",),
    "Box": ("stripes", "concrete"),
    "Toilet": ("marble",),
    "Sink": ("marble",),
    "Blinds": ("stripes",),
    "ShowerCurtain": ("wallpaper",),
    "Statue": ("stucco",),
    "Vase": ("mosaic", "stucco"),
}
_OWN_COLORS = (*_PAINTINGS, "screen", "books", "leaves", "oven", "plaid")
_WOODEN = ("wood", "planks", "drawers", "cabinet", "wicker")
# RGB in [0, 1] of things whose colour the asset does not name.
_DYES: tuple[RGB, ...] = (
    (0.80, 0.78, 0.72),
    (0.45, 0.55, 0.72),
    (0.72, 0.40, 0.36),
    (0.50, 0.66, 0.48),
    (0.86, 0.72, 0.42),
    (0.55, 0.48, 0.62),
    (0.40, 0.40, 0.42),
    (0.85, 0.60, 0.50),
)


def object_material(asset: str, category: str, size: tuple[float, float, float]) -> Material:
    """Return the look of an object's box.

    ``category`` chooses textures, a hash of ``asset`` one of them and its colour.

    Pictures and furniture fronts repeat once across the widest side of the box (``size`` m).
    """
    number = _hash(asset)
    choices = _OBJECTS.get(category, ("fabric", "stucco", "wood"))
    texture = choices[number % len(choices)]
    fronts = (*_PAINTINGS, "screen", "drawers", "cabinet", "oven")
    scale = max(size) if texture in fronts else 0.6
    color: RGB = (1.0, 1.0, 1.0)
    if texture in _WOODEN:
        color = _WOODS[number // 8 % len(_WOODS)]
    elif texture == "metal":
        color = (0.80, 0.82, 0.85)
    elif texture not in _OWN_COLORS:
        color = _DYES[number // 8 % len(_DYES)]
    return Material(color=color, texture=texture, scale=scale)
