"""Create ``golden.safetensors`` again: ``python tests/golden/make.py``, three minutes.

The images are computed in float64. The file also stores their responses: how much they change if every weight changes
by a unit roundoff of the precision, and every input by one of float32, up or down; see ``golden_shots.ALLOWED``. Create
the file again only if the images of a model are meant to change.
"""

from __future__ import annotations

import json

import torch
from golden_shots import FILE, MODELS, PRECISIONS, SHOTS, Shot, change, kept_pixels
from safetensors.torch import save_file
from torch import Tensor

from mcdenoise import Frame, create_model
from mcdenoise.models import Journal, listening

_DRAWS = 3
_PROBE = 32
_FLOAT32 = torch.finfo(torch.float32).eps / 2


def moved(tensor: Tensor, unit: float, seed: int) -> Tensor:
    """Change a tensor relatively by ``unit``, up or down; the same numbers for the same seed."""
    signs = torch.randint(0, 2, tensor.shape, generator=torch.Generator().manual_seed(seed)) * 2 - 1
    return tensor.double() * (1 + unit * signs)


def images(shot: Shot, name: str, weights: float = 0.0, inputs: float = 0.0, seed: int = 0) -> list[Tensor]:
    """The stored images of a shot in float64, with relative changes of every weight and every input."""
    model = create_model(name, pretrained=True).double()
    with torch.no_grad():
        for index, parameter in enumerate(model.parameters()):
            parameter.copy_(moved(parameter, weights, 1000 * seed + 100 + index))
    found, state = [], None
    for number in range(shot.frames):
        # Use the same changes in every frame, so that static pixels stay static.
        buffers = {
            key: moved(value, inputs, 1000 * seed + index)
            for index, (key, value) in enumerate(shot.frame(number).items())
        }
        journal = Journal()
        with torch.no_grad(), listening(journal):
            output, state = model(Frame(**buffers), state)
        if number in shot.kept:
            found.append(kept_pixels(output.image))
            if not seed:
                stages = {stage.name: round(stage.skipped, 3) for stage in journal.stages.values() if stage.skipped}
                print(f"  frame {number}: skipped {stages}")
    return found


def responses(shot: Shot, name: str, unit: float, expected: list[Tensor]) -> list[dict[str, float]]:
    """The maximum responses to several random changes."""
    draws = [map(change, images(shot, name, unit, _FLOAT32, seed), expected) for seed in range(1, 1 + _DRAWS)]
    return [{key: max(draw[key] for draw in frame) for key in ("largest", "rms")} for frame in zip(*draws, strict=True)]


def main() -> None:
    """Write the file."""
    kept: dict[str, Tensor] = {}
    found: dict[str, list[dict[str, float]]] = {}
    for shot_name, shot in SHOTS.items():
        for model, name in MODELS.items():
            print(f"{shot_name}, {name}")
            exact = images(shot, name)
            kept |= {
                f"{shot_name}.{model}.{n}": image.float().contiguous()
                for n, image in zip(shot.kept, exact, strict=True)
            }
            for precision, dtype in PRECISIONS.items():
                unit = torch.finfo(dtype).eps / 2
                found[f"{shot_name}.{model}.{precision}"] = here = responses(shot, name, unit, exact)
                print(f"  {precision}: " + ", ".join(f"{r['largest']:.2g} (rms {r['rms']:.2g})" for r in here))
            # Larger changes would flip decisions that are near their limits, and the image would jump.
            far = map(change, images(shot, name, _PROBE * _FLOAT32, _PROBE * _FLOAT32, 1), exact)
            for linear, probe in zip(found[f"{shot_name}.{model}.float32"], far, strict=True):
                if probe["largest"] > 3 * _PROBE * max(linear["largest"], _FLOAT32):
                    raise SystemExit(f"a decision is near its limit: {probe} for {linear}")
    save_file(kept, FILE, {"responses": json.dumps(found)})
    print(f"{FILE}: {FILE.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
