"""Train which history `wild` takes, and how much of it, by the errors that are left with each.

    python examples/gpu/choice.py packed -o OUT --weights wild wild_small wild_large

The loss of the whole network hardly tells histories apart: most of it is noise. So the first network denoises the last
frame of each shot nine times: with the frame alone, the accumulated radiance, and the mean of both; and each of these
with the recent history, the whole one, and the mean of both. A parabola through three errors in each direction tells
the error of any choice in each block of pixels, and only the small network that chooses learns, in minutes on a
processor. The others get the same, since it sees nothing that depends on their size. All other weights stay.
"""

import argparse
import copy
import itertools
import json
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from train import Tiles, by_level

from mcdenoise.commit import source_commit
from mcdenoise.data.files import atomic_path
from mcdenoise.errors import run_script
from mcdenoise.methods import parse_method
from mcdenoise.models import create_model, describe_weights, save_weights
from mcdenoise.models._weights import find_weights
from mcdenoise.models.wild import _PACE, Trust
from mcdenoise.nn.oidn import oidn_exposure
from mcdenoise.ops._constants import BLOCK
from mcdenoise.train.config import cosine_rate
from mcdenoise.train.front import split

LOGITS = (-40.0, 0.0, 40.0)  # of none, half, and all
BATCH, RATE, WARM_UP = 16, 1e-3, 50
YOUNG = 0.5  # how often a shorter history is drawn, beside the whole one


@torch.no_grad()
def tried(model: nn.Module, trust: Trust, tiles: Tiles) -> tuple[Tensor, Tensor, Tensor]:
    """What ``trust`` sees of each shot, the errors of the nine choices in its blocks, and how often it is drawn."""
    seen, found, rows = list[Tensor](), list[Tensor](), list[tuple[int, float]]()
    handle = trust.layers.register_forward_pre_hook(lambda _, given: seen.append(given[0]))
    first = copy.deepcopy(trust.state_dict())
    trust.last.weight.zero_()
    for take in (take for take in tiles.takes if take["frames"] > 1):
        for history in range(take["histories"]):
            frames, references = tiles.frames(take, history)
            frame, reference = frames.map(lambda image: image[-1:]), references[-1:]
            scale, errors = oidn_exposure(reference), list[Tensor]()
            for logits in itertools.product(LOGITS, repeat=2):
                trust.last.bias.copy_(torch.tensor(logits) / _PACE)
                image = model(frame)[0].image
                error = (image - reference).abs() / (image.abs() + reference + 0.01 / scale)
                errors.append(F.avg_pool2d(error.mean(1, keepdim=True), BLOCK))
            # What it sees is the same each time; models see a border around the image.
            del seen[1 - len(errors) :]
            seen[-1] = _middle(seen[-1], errors[0].shape[-2:])
            found.append(torch.cat(errors, 1))
            rows.append((take["spp"], YOUNG if history else 1.0))
    handle.remove()
    trust.load_state_dict(first)
    levels, often = torch.tensor(rows).unbind(1)
    return torch.cat(seen), torch.cat(found), by_level(levels, often)


def expected(errors: Tensor, trusted: Tensor, whole: Tensor) -> Tensor:
    """The error of each shot with these weights of the history and of all its frames, relative to that of half of each.

    Args:
        errors: ``(B, 9, H, W)`` in the order of :func:`tried`.
        trusted: ``(B, 1, H, W)`` weight of the accumulated radiance, in [0, 1].
        whole: likewise, of the whole history in it.
    """
    rows = errors.unflatten(1, (3, 3))
    error = (rows * _parabola(trusted)[:, :, None] * _parabola(whole)[:, None]).sum((1, 2))
    return error.mean((1, 2)) / rows[:, 1, 1].mean((1, 2))


def learn(trust: Trust, data: tuple[Tensor, Tensor, Tensor], steps: int) -> None:
    """Train the choice, and print the expected change of the error."""
    optimizer, found = torch.optim.Adam(trust.parameters(), RATE), list[float]()
    for step in range(steps):
        for group in optimizer.param_groups:
            group["lr"] = RATE * cosine_rate(step, step / steps, WARM_UP)
        which = torch.multinomial(data[2], BATCH, replacement=True)
        weights = (_PACE * trust.last(trust.layers(data[0][which]))).sigmoid().split(1, 1)
        loss = expected(data[1][which], *weights).log().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        found.append(loss.item())
        if step % 100 == 99:
            print(step + 1, f"{sum(found[-100:]) / 100:.4f}", flush=True)


def _parabola(weight: Tensor) -> Tensor:
    """The weights of the values at 0, 1/2 and 1 in the parabola through them, at another place."""
    return torch.cat([(1 - weight) * (1 - 2 * weight), 4 * weight * (1 - weight), weight * (2 * weight - 1)], 1)


def _middle(image: Tensor, size: torch.Size) -> Tensor:
    top, left = ((whole - part) // 2 for whole, part in zip(image.shape[-2:], size, strict=True))
    return image[..., top : top + size[0], left : left + size[1]]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("packed", type=Path, metavar="FOLDER")
    parser.add_argument("-o", "--out", type=Path, required=True, metavar="OUT", help="for MODEL.safetensors of each")
    parser.add_argument("--weights", nargs="+", default=["wild"], metavar="MODEL", help="names, or files of weights")
    parser.add_argument("--steps", type=int, default=2000)
    options = parser.parse_args()
    torch.manual_seed(0)
    options.out.mkdir(parents=True, exist_ok=True)
    chosen: Trust | None = None
    for spelling in map(parse_method, options.weights):
        about = describe_weights(spelling.weights or find_weights(spelling.model))
        model = create_model(spelling.model, pretrained=spelling.weights is None, weights=spelling.weights).eval()
        (trust,) = (part for part in model.modules() if isinstance(part, Trust))
        if chosen is None:
            tiles = Tiles(options.packed, torch.device("cpu"))
            data = tried(split(model)[1], trust, tiles)
            learn(trust.requires_grad_(), data, options.steps)
            chosen = trust
        trust.load_state_dict(chosen.state_dict())
        earlier = json.loads(about.get("data", "[]"))
        about["data"] = json.dumps(earlier + [each for each in tiles.about if each not in earlier])
        about["choice"] = json.dumps({"steps": options.steps, "commit": source_commit()})
        architecture, settings = (about.pop(name) for name in ("architecture", "settings"))
        path = options.out / f"{spelling.model}.safetensors"
        with atomic_path(path) as temporary:
            temporary.write_bytes(save_weights(model, architecture, settings, about))
        print(path)


if __name__ == "__main__":
    run_script(main)
