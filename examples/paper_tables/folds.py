"""The methods of the tables, and the training scenes for each held-out scene.

The methods and the budget that all of them are trained with are in `recipes/zoo.toml` and `recipes/ablations.toml`.
"""

from collections.abc import Iterable
from pathlib import Path
from typing import Literal

Split = Literal["grouped", "paper"]

RECIPES = Path(__file__).parents[2] / "recipes"
# Names in Table 1 with the names of their runs: the paper's baselines, its own method, and others.
RIVALS = {"NBGD": "nbgd", "RAE (for ONND)": "rae", "KP": "kp", "MRKP": "mrkp", "WSKP": "wskp"}
OWN = {"P+K": "cascaded"}
OTHERS = {"KPCN": "kpcn", "SBMC": "sbmc", "layered": "layered", "ANF": "anf", "NPPD": "nppd"}
# Without weights, so their names are those of the methods.
FILTERS = {"SVGF": "svgf", "A-SVGF": "asvgf", "BMFR": "bmfr", "joint bilateral": "joint_bilateral"}
# Tables 3 and 4: BWA is the bilateral weight adjustment, TL the temporal loss.
ORDERS = ("K", "P", "K+P", "K+K", "P+K")
PARTS = {"P+K without BWA": "P+K-without-BWA", "P+K without TL": "P+K-without-TL", "P+K": "P+K"}


def geometry(scene: str, scenes: Iterable[str]) -> str:
    """The scene that another one is a version of: ``sponza`` of ``sponza-glossy``, if both are there.

    Example:
        >>> scenes = ("san-miguel", "sponza", "sponza-glossy")
        >>> geometry("sponza-glossy", scenes), geometry("san-miguel", scenes)
        ('sponza', 'san-miguel')
    """
    return min((other for other in scenes if scene == other or scene.startswith(f"{other}-")), key=len)


def training_scenes(held_out: str, scenes: Iterable[str], split: Split) -> list[str]:
    """The scenes to train on when one is held out.

    The paper holds out only the scene. Three of its six scenes show the same building, so that a network is tested on
    walls from its training data; ``"grouped"`` holds out every version of the scene.

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
    """Folder of the runs that were not trained on a scene; versions that are held out together have a common folder."""
    fold = held_out if split == "paper" else geometry(held_out, scenes)
    return runs / f"folds-{split}" / f"without-{fold}"


def scenes_of(dataset: Path) -> list[str]:
    """The folders of a dataset, each a scene."""
    return sorted(path.name for path in dataset.iterdir() if path.is_dir())
