"""Train which history `wild` takes, the whole or the recent one, by the errors that are left with each.

    python examples/gpu/choice.py packed -o wild.safetensors --weights wild

The loss of the whole network hardly tells the two apart: most of it is noise. So the network denoises the last frame of
each shot with the recent history, with the mean of both, and with the whole one. A parabola through the three errors
tells the error of any choice in each block of pixels, and only the small network that chooses learns, in minutes on a
processor. All other weights stay as they are, and how much it trusts a history at all nearly so.
"""

import argparse
import copy
import json
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from train import Tiles, by_level, rate_of

from mcdenoise.commit import source_commit
from mcdenoise.data.files import atomic_path
from mcdenoise.errors import run_script
from mcdenoise.methods import parse_method
from mcdenoise.models import create_model, describe_weights, save_weights
from mcdenoise.models._weights import find_weights
from mcdenoise.models.wild import _BLOCK, _PACE, Trust
from mcdenoise.nn.oidn import oidn_exposure
from mcdenoise.train.front import split

LOGITS = (-40.0, 0.0, 40.0)  # of the recent history, of both, and of the whole one
BATCH, RATE, WARM_UP = 16, 1e-3, 50
STAYING = 0.05  # weight of the squared change of the logit of the trust


@torch.no_grad()
def tried(model: nn.Module, trust: Trust, tiles: Tiles) -> tuple[Tensor, Tensor, Tensor]:
    """What ``trust`` sees of each shot, the errors of the three choices in its blocks, and how often it is drawn."""
    seen, found, levels = list[Tensor](), list[Tensor](), list[int]()
    handle = trust.layers.register_forward_pre_hook(lambda _, given: seen.append(given[0]))
    for take in (take for take in tiles.takes if take["frames"] > 1):
        frames, references = tiles.frames(take)
        frame, reference = frames.map(lambda image: image[-1:]), references[-1:]
        scale, errors = oidn_exposure(reference), list[Tensor]()
        for logit in LOGITS:
            trust.last.weight[1], trust.last.bias[1] = 0, logit / _PACE
            image = model(frame)[0].image
            error = (image - reference).abs() / (image.abs() + reference + 0.01 / scale)
            errors.append(F.avg_pool2d(error.mean(1, keepdim=True), _BLOCK))
        # What it sees is the same each time; models see a border around the image.
        del seen[-2:]
        seen[-1] = _middle(seen[-1], errors[0].shape[-2:])
        found.append(torch.cat(errors, 1))
        levels.append(take["spp"])
    handle.remove()
    return torch.cat(seen), torch.cat(found), by_level(torch.tensor(levels), torch.ones(len(levels)))


def expected(errors: Tensor, whole: Tensor) -> Tensor:
    """The error of each shot with these weights of the whole history, relative to that of both histories alike."""
    recent, both, only = errors.split(1, 1)
    error = recent * (1 - whole) * (1 - 2 * whole) + 4 * both * whole * (1 - whole) + only * whole * (2 * whole - 1)
    return error.mean((1, 2, 3)) / both.mean((1, 2, 3))


def learn(trust: Trust, first: Trust, data: tuple[Tensor, Tensor, Tensor], steps: int) -> None:
    """Train the choice, and print the expected change of the error."""
    optimizer = torch.optim.Adam(trust.parameters(), RATE)
    for step in range(steps):
        for group in optimizer.param_groups:
            group["lr"] = RATE * rate_of(step, WARM_UP, step / steps)
        which = torch.multinomial(data[2], BATCH, replacement=True)
        seen, errors = data[0][which], data[1][which]
        trusted, whole = (_PACE * trust.last(trust.layers(seen))).split(1, 1)
        with torch.no_grad():
            before = _PACE * first.last(first.layers(seen))[:, :1]
        loss = expected(errors, whole.sigmoid()).log().mean() + STAYING * (trusted - before).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        if step % 100 == 99:
            print(step + 1, f"{loss.item():.4f}", flush=True)


def _middle(image: Tensor, size: torch.Size) -> Tensor:
    top, left = ((whole - part) // 2 for whole, part in zip(image.shape[-2:], size, strict=True))
    return image[..., top : top + size[0], left : left + size[1]]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("packed", type=Path, metavar="FOLDER")
    parser.add_argument("-o", "--out", type=Path, required=True, metavar="FILE.safetensors")
    parser.add_argument("--weights", default="wild", metavar="MODEL", help="name, or file of weights")
    parser.add_argument("--steps", type=int, default=1500)
    options = parser.parse_args()
    torch.manual_seed(0)
    spelling = parse_method(options.weights)
    about = describe_weights(spelling.weights or find_weights(spelling.model))
    model = create_model(spelling.model, pretrained=spelling.weights is None, weights=spelling.weights).eval()
    (trust,) = (part for part in model.modules() if isinstance(part, Trust))
    first = copy.deepcopy(trust)
    data = tried(split(model)[1], trust, Tiles(options.packed, torch.device("cpu")))
    trust.load_state_dict(first.state_dict())
    learn(trust.requires_grad_(), first, data, options.steps)
    about["choice"] = json.dumps({"steps": options.steps, "commit": source_commit()})
    architecture, settings = (about.pop(name) for name in ("architecture", "settings"))
    with atomic_path(options.out) as temporary:
        temporary.write_bytes(save_weights(model, architecture, settings, about))
    print(options.out)


if __name__ == "__main__":
    run_script(main)
