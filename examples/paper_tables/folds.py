"""Which scenes are trained on when one is held out, and which variants of the network the paper compares."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

Split = Literal["grouped", "paper"]

SCENES = ("classroom", "living-room", "san-miguel", "sponza", "sponza-glossy", "sponza-moving-light")


MODEL = "cascaded"


@dataclass(frozen=True)
class Variant:
    """A network of the paper's tables and how it is trained: all with the accumulation of ``cascaded``.

    Args:
        settings: of the constructor of ``cascaded``.
        temporal_loss: whether it is trained with the temporal loss.
    """

    settings: str
    temporal_loss: bool = True

    @property
    def folder(self) -> str:
        """Where its runs are."""
        name = self.settings.replace("=", "-").replace(",", "-")
        return name if self.temporal_loss else f"{name}-without-temporal-loss"


# By the names of the paper's Tables 3 and 4: BWA is the bilateral weight adjustment, TL the temporal loss. One network
# alone is wider, and so about as large as two.
VARIANTS = {
    "K": Variant("cascade=K,width=64"),
    "P": Variant("cascade=P,width=64"),
    "K+P": Variant("cascade=K+P"),
    "K+K": Variant("cascade=K+K"),
    "P+K": Variant("cascade=P+K"),
    "P+K without BWA": Variant("cascade=P+K,bilateral=false"),
    "P+K without TL": Variant("cascade=P+K", temporal_loss=False),
}


def geometry(scene: str, scenes: Iterable[str]) -> str:
    """The scene that another one is a version of: ``sponza`` of ``sponza-glossy``, if both are there.

    Example:
        >>> geometry("sponza-glossy", SCENES), geometry("san-miguel", SCENES)
        ('sponza', 'san-miguel')
    """
    return min((other for other in scenes if scene == other or scene.startswith(f"{other}-")), key=len)


def training_scenes(held_out: str, scenes: Iterable[str], split: Split) -> list[str]:
    """What is trained on when a scene is held out.

    The paper holds out the scene alone. Three of its six scenes are one building, so that a network is then tested on
    walls it has seen; ``"grouped"`` holds out every version of the scene.

    Example:
        >>> training_scenes("sponza", SCENES, "grouped")
        ['classroom', 'living-room', 'san-miguel']
    """
    scenes = list(scenes)
    if split == "paper":
        return [scene for scene in scenes if scene != held_out]
    own = geometry(held_out, scenes)
    return [scene for scene in scenes if geometry(scene, scenes) != own]


def run_folder(runs: Path, split: Split, variant: Variant, held_out: str, scenes: Iterable[str]) -> Path:
    """Where the run is whose weights have not seen a scene; versions that are held out together share one."""
    fold = held_out if split == "paper" else geometry(held_out, scenes)
    return runs / split / variant.folder / f"without-{fold}"
