"""Create ``golden.safetensors`` again, and print by how much every image moved: ``python tests/golden/make.py``.

The images are computed in float64 by the reference implementations. The file also stores how much they change by
rounding: if every weight changes by a unit roundoff of the precision, and every input by one of float32, up or down,
and everything is computed in that precision. These are measured for new images, and with ``--bounds`` for all. Create
the file again only if the images of a method are meant to change; ``make.py NAME ...`` does so for some methods.
"""

import argparse
import json
import multiprocessing
import os
import tempfile
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path

import torch
from golden_cases import (
    ALLOWED,
    FILE,
    METHODS,
    PRECISIONS,
    WAYS,
    Digests,
    change,
    digests,
    golden,
    precision_of,
    ways_of,
)
from golden_commands import COMMANDS, FOLDERS, TEXTS, losses, said, written
from safetensors.torch import save_file
from torch import Tensor, nn

from mcdenoise import create_model

Changes = dict[str, dict[str, float]]
_FLOAT32 = torch.finfo(torch.float32).eps / 2


def moved(tensor: Tensor, unit: float, seed: int) -> Tensor:
    """Change a tensor relatively by ``unit``, up or down; the same numbers for the same seed."""
    signs = torch.randint(0, 2, tensor.shape, generator=torch.Generator().manual_seed(seed)) * 2 - 1
    return (tensor.double() * (1 + unit * signs)).to(tensor.dtype)


def changes(method: str, way: str, precision: str, units: int, expected: Digests) -> dict[str, dict[str, float]]:
    """How much every part changes by rounding in a precision, and by changes of so many unit roundoffs before."""
    unit = units * torch.finfo(PRECISIONS[precision]).eps / 2
    model = create_model(method, pretrained=True)
    if isinstance(model, nn.Module):
        with torch.no_grad():
            for index, each in enumerate((*model.parameters(), *model.buffers())):
                each.copy_(moved(each, unit, 100 * units + index))
        model.to(memory_format=torch.channels_last)
    # The same changes in every frame, so that static pixels stay static.
    found = digests(method, way, precision, model, lambda image: moved(image, units * _FLOAT32, image.shape[-3]))
    return {part: change(found[part], expected[part]) for part in expected}


def bounds(method: str, way: str, expected: Digests) -> dict[str, Changes]:
    """The changes of all parts in the precisions in which the shot is tested."""
    ways = [each for each in ways_of(method) if WAYS[each].shot is WAYS[way].shot]
    tested = {precision_of(method, each) for each in (ways if way in ("whole", "skipped") else [way])} - {"float64"}
    found: dict[str, Changes] = {part: {} for part in expected}
    for precision in sorted(tested):
        # Larger changes flip decisions that are near their limits, as another machine's rounding may.
        drawn = [
            changes(method, way, precision, units, expected) for units in ((1, 8) if precision == "float32" else (1,))
        ]
        for part in expected:
            found[part][precision] = {what: max(each[part][what] for each in drawn) for what in ALLOWED}
    return found


def of_method(method: str, known: set[str], again: bool) -> dict[str, tuple[Tensor, Changes | None]]:
    """The digests of a method, and their bounds if some are not known or are measured again."""
    torch.set_num_threads(1)
    found: dict[str, tuple[Tensor, Changes | None]] = {}
    for way in (way for way in ways_of(method) if WAYS[way].made):
        exact = digests(method, way, "float64")
        keys = {part: f"{method}: {WAYS[way].shot.name}: {part}" for part in exact}
        new = again or not known.issuperset(keys.values())
        allowed = bounds(method, way, exact) if new else {}
        for part, key in keys.items():
            found.setdefault(key, (exact[part].float(), allowed.get(part)))
    return found


def main() -> None:
    """Write the file."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help="methods, and commands for these; all by default")
    parser.add_argument("--bounds", action="store_true", help="measure all bounds again, and not only new ones")
    parser.add_argument("--workers", type=int, default=os.cpu_count(), help="number of processes")
    arguments = parser.parse_args()
    before, known = golden() if FILE.exists() else ({}, {})
    names = arguments.names or [*METHODS, COMMANDS]
    kept = {key: each for key, each in before.items() if arguments.names and key.partition(":")[0] not in names}
    allowed = {key: known[key] for key in kept}
    with ProcessPoolExecutor(arguments.workers, multiprocessing.get_context("spawn")) as pool:
        methods = [name for name in names if name != COMMANDS]
        waiting = [pool.submit(of_method, method, set(known), arguments.bounds) for method in methods]
        for future in as_completed(waiting):
            for key, (digest, new) in future.result().items():
                kept[key], allowed[key] = digest, known[key] if new is None else new
                print(f"{key}: {_moved_by(digest, before.get(key))}", _said(allowed[key]), flush=True)
    if COMMANDS in names:
        for name, digest in _of_commands().items():
            key = f"{COMMANDS}: {name}"
            kept[key], allowed[key] = digest, {}
            print(f"{key}: {_moved_by(digest, before.get(key))}")
    for key in before.keys() - kept.keys():
        print(f"{key}: gone")
    save_file(kept, FILE, {"changes": json.dumps(allowed)})
    FILE.chmod(0o644)
    print(f"{FILE}: {FILE.stat().st_size / 1000:.0f} kB")


def _of_commands() -> Digests:
    TEXTS.write_text("".join(f"# {folder.name}\n{said('inspect', folder)}\n" for folder in FOLDERS), encoding="utf-8")
    with tempfile.TemporaryDirectory() as place:
        found = {folder.name: written(folder, Path(place, folder.name)) for folder in FOLDERS}
        return {**found, "losses": losses(Path(place))}


def _moved_by(now: Tensor, before: Tensor | None) -> str:
    if before is None or before.shape != now.shape or not now.numel():
        return "new"
    moved = change(now, before)
    return f"moved by {moved['largest']:.2g} (rms {moved['rms']:.2g})"


def _said(changes: dict[str, dict[str, float]]) -> str:
    return ", ".join(f"{precision} {each['largest']:.2g}" for precision, each in changes.items())


if __name__ == "__main__":
    main()
