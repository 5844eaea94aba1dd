"""The methods in the tables, and the training scenes when one scene is held out.

The training settings of the methods are in `recipes/zoo.toml` and `recipes/ablations.toml`.
"""

from collections.abc import Iterable
from pathlib import Path
from typing import Literal

Split = Literal["grouped", "paper"]

RECIPES = Path(__file__).parents[2] / "recipes"
# Methods of Table 1 by name, with the names of their runs: those that the paper compares with, its own, and others.
RIVALS = {"NBGD": "nbgd", "RAE (for ONND)": "rae", "KP": "kp", "MRKP": "mrkp", "WSKP": "wskp"}
OWN = {"P+K": "cascaded"}
OTHERS = {"KPCN": "kpcn", "SBMC": "sbmc", "layered": "layered", "ANF": "anf", "NPPD": "nppd"}
# Methods without weights, with the names of their models.
FILTERS = {"SVGF": "svgf", "A-SVGF": "asvgf", "BMFR": "bmfr", "joint bilateral": "joint_bilateral", "guided": "guided"}
# Methods of this package that Table 1 shows beside them, trained on other scenes or not at all.
KEPT = {name: name for name in ("wild_small", "wild", "wild_large", "oidn_temporal")}
# Variants of Tables 3 and 4: BWA is the bilateral weight adjustment, TL the temporal loss.
ORDERS = ("K", "P", "K+P", "K+K", "P+K")
PARTS = {"P+K without BWA": "P+K-without-BWA", "P+K without TL": "P+K-without-TL", "P+K": "P+K"}


def geometry(scene: str, scenes: Iterable[str]) -> str:
    """The scene of which another one is a version: ``sponza`` for ``sponza-glossy``, if both exist.

    Example:
        >>> scenes = ("san-miguel", "sponza", "sponza-glossy")
        >>> geometry("sponza-glossy", scenes), geometry("san-miguel", scenes)
        ('sponza', 'san-miguel')
    """
    return min((other for other in scenes if scene == other or scene.startswith(f"{other}-")), key=len)


def training_scenes(held_out: str, scenes: Iterable[str], split: Split) -> list[str]:
    """The training scenes when a scene is held out.

    The paper holds out only the scene itself. Three of its six scenes show the same building, so the network is tested
    on walls of the training data; ``"grouped"`` holds out every version of the scene.

    Example:
        >>> training_scenes("sponza", ("san-miguel", "sponza", "sponza-glossy"), "grouped")
        ['san-miguel']
    """
    scenes = list(scenes)
    if split == "paper":
        return [scene for scene in scenes if scene != held_out]
    own = geometry(held_out, scenes)
    return [scene for scene in scenes if geometry(scene, scenes) != own]


def fold_folder(runs: Path, split: Split, held_out: str, scenes: Iterable[str]) -> Path:
    """Folder of the runs that were trained without a scene; versions that are held out together share a folder."""
    fold = held_out if split == "paper" else geometry(held_out, scenes)
    return runs / f"folds-{split}" / f"without-{fold}"


def scenes_of(dataset: Path) -> list[str]:
    """The scenes of a dataset, which are its folders."""
    return sorted(path.name for path in dataset.iterdir() if path.is_dir())
