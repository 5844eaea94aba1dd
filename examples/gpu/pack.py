"""Pack takes for training on a GPU: small parts with the frames that have references, as the network sees them.

    python examples/gpu/pack.py TAKES... -o FOLDER --model wild

Each take has passed the wrappers in front of the network: the radiance of its last frames is accumulated, once with the
whole history and once with a shorter one. Values keep six bits of mantissa, so that a part has some fifty takes in 60
MB. A part that the same takes and code have made already is not written again.
"""

import argparse
import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mcdenoise.data.files import atomic_path
from mcdenoise.data.shards import Shard, find_shards
from mcdenoise.errors import InputError, run_script
from mcdenoise.frame import Frame
from mcdenoise.models import create_model
from mcdenoise.models.wild import background_of
from mcdenoise.train.cache import checksum_of, checksum_of_code
from mcdenoise.train.data import describe_takes, open_takes
from mcdenoise.train.footage import shots_of
from mcdenoise.train.front import Front, split

FEATURES = frozenset({"albedo", "normal", "depth"})
FIXED = ("current", "albedo", "normal", "reference")
HISTORY = ("color", "recent", "length")
# The last bits of a half float that are dropped.
DROPPED = 4
# Height and width of a tile; all images are cut into tiles, so that they fit into one tensor.
TILE = (128, 192)


def rounded(values: NDArray[np.float16]) -> NDArray[np.uint16]:
    """The bits of half floats, to the nearest with fewer bits of mantissa."""
    bits = np.clip(values, -6e4, 6e4).view(np.uint16)
    return ((bits + (1 << DROPPED >> 1)) >> DROPPED << DROPPED).astype(np.uint16)


def planes(name: str, arrays: list[NDArray[np.float16]]) -> dict[str, NDArray[np.uint8]]:
    """The two bytes of half floats apart, which compresses better."""
    both = rounded(np.concatenate(arrays)).astype("<u2")
    both = both.view(np.uint8).reshape(*both.shape, 2)
    return {f"{name}.{byte}": np.ascontiguousarray(both[..., byte]) for byte in (0, 1)}


def tiles(size: tuple[int, int]) -> Iterator[tuple[slice, slice]]:
    """The places of the tiles of an image; what is left over at its end is dropped."""
    for top in range(0, size[0] - TILE[0] + 1, TILE[0]):
        for left in range(0, size[1] - TILE[1] + 1, TILE[1]):
            yield slice(top, top + TILE[0]), slice(left, left + TILE[1])


def seen(shot: dict[str, Tensor]) -> dict[str, Tensor]:
    """The frames as `wild` sees them where nothing is: without a history. The depth, which tells it, is not packed."""
    behind = background_of(Frame(shot["color"], albedo=shot["albedo"], depth=shot.get("depth")))
    if behind is None:
        return shot
    alone = {"color": shot["current"], "recent": shot["current"], "length": torch.ones(())}
    return shot | {name: torch.where(behind, image, shot[name]) for name, image in alone.items()}


def part_of(shot: dict[str, Tensor], names: tuple[str, ...], place: tuple[slice, slice]) -> NDArray[np.float16]:
    """A tile of these buffers, together ``(T, C, H, W)``."""
    return np.concatenate([shot[name][:, :, *place].numpy() for name in names], 1, dtype=np.float16)


def written(shards: list[Shard], front: Front, path: Path, key: str) -> None:
    """Write a part."""
    fixed, history, index = list[NDArray[np.float16]](), list[NDArray[np.float16]](), list[dict[str, object]]()
    for shard in shards:
        handed = front.of(shard.shapes), FEATURES, shard.references, path.parent
        shots = [seen(shot.read()) for shot in shots_of(shard, *handed, start_every=1)[0]]
        name, spp = shard.path.name.partition(".")[0], shard.header["spp"]
        about = {"take": name, "frames": shard.references, "histories": len(shots), "spp": spp}
        places = [*tiles(shard.size)]
        if not places:
            raise InputError(f"{shard.path}: expected height and width of at least {TILE} pixels, found {shard.size}")
        for place in places:
            index.append(about)
            fixed.append(part_of(shots[0], FIXED, place))
            history += [part_of(shot, HISTORY, place) for shot in shots]
    text = np.frombuffer(json.dumps({"index": index, **describe_takes(shards)}).encode(), np.uint8)
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, about=text, key=np.array(key), **planes("fixed", fixed), **planes("history", history))
    print(f"{path}: {len(shards)} takes, {path.stat().st_size / 1e6:.1f} MB", flush=True)


def key_of(path: Path) -> str:
    """What a part was made from; empty if it does not say so."""
    with np.load(path, allow_pickle=False) as part:
        return str(part["key"]) if "key" in part.files else ""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("takes", nargs="+", type=Path, metavar="TAKES")
    parser.add_argument("-o", "--out", type=Path, required=True, metavar="FOLDER")
    parser.add_argument("--model", default="wild", help="whose wrappers the takes pass")
    parser.add_argument("--size", type=int, default=45, help="takes in a part")
    options = parser.parse_args()
    front, _ = split(create_model(options.model))
    options.out.mkdir(parents=True, exist_ok=True)
    for folder in (folder for folder in options.takes if not find_shards(folder)):
        raise InputError(f"{folder}: expected takes, found none")
    shards, made = open_takes(options.takes), [front.settings, checksum_of_code(), Path(__file__).read_text("utf-8")]
    parts = {
        options.out / f"part-{first // options.size:02}.npz": shards[first : first + options.size]
        for first in range(0, len(shards), options.size)
    }
    for path in sorted(set(options.out.glob("part-*.npz")) - parts.keys()):
        raise InputError(f"{path}: expected no part beside those of these takes, found it; remove it")
    for path, own in parts.items():
        key = checksum_of([*made, describe_takes(own)])
        if not (path.exists() and key_of(path) == key):
            written(own, front, path, key)


if __name__ == "__main__":
    run_script(main)
