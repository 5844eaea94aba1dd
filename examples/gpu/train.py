"""Train a run of a recipe on a device that holds all takes in its memory, for a given number of seconds.

    python examples/gpu/pack.py TAKES... -o packed
    python examples/gpu/pack.py UNSEEN... -o packed-unseen
    python examples/gpu/train.py packed -o OUT --recipe recipes/wild.toml --run base --validation packed-unseen

Parts may be added to the folder while it runs. Single frames with their history are drawn and augmented on the device,
many at once, as :class:`mcdenoise.train.ClipSampler` draws clips one by one, but each noise level (samples a pixel) as
often as the square root of its number of frames, and half of the frames without a history with less noise than they
were rendered with: most takes have one sample. The learning rate follows the clock. The loss of a frame is the
logarithm of its error, so that one with little noise counts as much as one with much: what is reported of a method is
the geometric mean of ratios. OUT has the averaged weights, the log and a checkpoint, which are written again at each
validation. The same command goes on where an interrupted run was; another one is refused.
"""

import argparse
import copy
import json
import math
import random
import time
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from pack import TILE
from torch import Tensor, nn

from mcdenoise.cli.train import options_of
from mcdenoise.commit import source_commit
from mcdenoise.data.files import atomic_path
from mcdenoise.errors import InputError, run_script
from mcdenoise.frame import Frame
from mcdenoise.metrics import psnr_srgb, smape_linear
from mcdenoise.models import save_weights
from mcdenoise.models._precision import fastest_precision
from mcdenoise.nn.inputs import auto_exposure
from mcdenoise.nn.oidn import oidn_exposure
from mcdenoise.ops import demodulate, remodulate
from mcdenoise.train import TrainConfig
from mcdenoise.train.config import cosine_rate
from mcdenoise.train.front import split
from mcdenoise.train.loop import begun, check_finite
from mcdenoise.train.losses import display_error
from mcdenoise.train.recipe import Recipe
from mcdenoise.train.run_folder import RunFolder, about_weights

LOOKS, LOOK = 20, 20.0  # validations, and looks for new parts; but at least that many seconds apart
RELATIVE = 0.01  # added to the error of a frame before its logarithm is taken
BARE = 0.06  # probability that a frame has no normal, and half that of one without albedo
YOUNG = 0.35  # probability that a frame has no history
CALM, CALMEST = 0.5, 1 / 16  # probability that such a frame has less noise than was rendered; the least part of it
FASTER = 8.0  # factor of the learning rate of layers that begin with random weights
KEPT = ("network", "average", "optimizer")
CHANNELS = {"current": 3, "albedo": 3, "normal": 3, "reference": 3}


@dataclass
class Tiles:
    """All tiles of a folder of parts, on the device.

    Args:
        folder: of parts.
        device: that holds them.
    """

    folder: Path
    device: torch.device
    fixed: Tensor = field(init=False)
    history: Tensor = field(init=False)
    takes: list[dict[str, Any]] = field(default_factory=list)
    parts: dict[str, dict[str, Any]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.fixed = torch.empty(0, sum(CHANNELS.values()), *TILE, dtype=torch.float16, device=self.device)
        self.history = torch.empty(0, 7, *TILE, dtype=torch.float16, device=self.device)
        self.update()
        if not self.takes:
            raise InputError(f"{self.folder}: expected parts that pack.py has written, found none")

    @property
    def about(self) -> list[dict[str, Any]]:
        """What identifies the takes of each part, and whom they are owed to."""
        return [{"part": name, **about} for name, about in self.parts.items()]

    def update(self) -> None:
        """Read the parts that have come."""
        for path in sorted(path for path in self.folder.glob("*.npz") if path.name not in self.parts):
            with np.load(path, allow_pickle=False) as part:
                about = json.loads(part["about"].tobytes())
                fixed, history = (self._joined(part, name) for name in ("fixed", "history"))
            first, begun = len(self.fixed), len(self.history)
            for take in about.pop("index"):
                self.takes.append({**take, "first": first, "begun": begun})
                first, begun = first + take["frames"], begun + take["frames"] * take["histories"]
            self.fixed, self.history = torch.cat([self.fixed, fixed]), torch.cat([self.history, history])
            self.parts[path.name] = about
        rows = [[take[name] for name in ("first", "begun", "frames", "histories", "spp")] for take in self.takes]
        self.table = torch.tensor(rows, device=self.device)
        self.weights = by_level(self.table[:, 4], self.table[:, 2].float())

    def _joined(self, part: Any, name: str) -> Tensor:
        low, high = (torch.from_numpy(part[f"{name}.{byte}"]).to(self.device) for byte in (0, 1))
        return torch.stack([low, high], -1).view(torch.float16)[..., 0]

    def frames(self, take: dict[str, Any], history: int = 0) -> tuple[Frame, Tensor]:
        """The frames of a tile with one of its histories, by default the whole one, and their reference."""
        begun = take["begun"] + history * take["frames"]
        own, theirs = (slice(start, start + take["frames"]) for start in (take["first"], begun))
        return framed(self.fixed[own].float(), self.history[theirs].float())

    def draw(self, config: TrainConfig, clips: int) -> tuple[Frame, Tensor]:
        """Draw single frames as a batch, and their references."""
        rand = torch.rand(8, clips, device=self.device)
        drawn = torch.multinomial(self.weights, clips, replacement=True)
        first, begun, frames, histories, _ = self.table[drawn].unbind(1)
        t = (rand[0] * frames).long()
        when, which = first + t, begun + (rand[1] * histories).long() * frames + t
        sides = torch.arange(config.crop, device=self.device)
        top, left = (((side - config.crop + 1) * r).long() for side, r in zip(TILE, rand[2:4], strict=True))
        rows, columns = (start[:, None] + sides for start in (top, left))
        place = (when[:, None, None], slice(None), rows[:, :, None], columns[:, None, :])
        # Pixels come first: channels-last images.
        fixed, history = self.fixed[place], self.history[(which[:, None, None], *place[1:])]
        # One turn and flip for the whole batch.
        turns, flip = random.randrange(4), [1] * random.randrange(2)
        fixed, history = (
            images.rot90(turns, (1, 2)).flip(flip).permute(0, 3, 1, 2).float() for images in (fixed, history)
        )
        return augmented(fixed, history, rand[4:], config)


def by_level(spp: Tensor, frames: Tensor) -> Tensor:
    """How often each of several takes is drawn: a noise level by the square root of its number of frames."""
    levels = spp.unique(return_inverse=True)[1]
    return frames / torch.zeros_like(frames).index_add_(0, levels, frames)[levels].sqrt()


def framed(fixed: Tensor, history: Tensor) -> tuple[Frame, Tensor]:
    """Frames from their channels, and the reference."""
    current, albedo, normal, reference = fixed.split(list(CHANNELS.values()), 1)
    color, recent, length = history.split([3, 3, 1], 1)
    return Frame(color, current=current, recent=recent, length=length, albedo=albedo, normal=normal), reference


def augmented(fixed: Tensor, history: Tensor, rand: Tensor, config: TrainConfig) -> tuple[Frame, Tensor]:
    """Colors and axes permuted, light scaled, histories, features and a part of the noise dropped, lamps."""
    clips, device = len(fixed), fixed.device
    frame, reference = framed(fixed, history)
    order, axes = (torch.rand(clips, 3, device=device).argsort(1) for _ in range(2))

    def permuted(image: Tensor, by: Tensor) -> Tensor:
        return image.gather(1, by[:, :, None, None].expand_as(image))

    shown = (frame.current, frame.color, frame.recent, frame.albedo, reference)
    current, color, recent, albedo, reference = (permuted(image, order) for image in shown)
    signs = (torch.rand(clips, 3, device=device) > 0.5).float().mul(2).sub(1)
    normal = permuted(frame.normal, axes) * signs[:, :, None, None]
    stops = config.exposure * (2 * rand[0] - 1)[:, None] + config.tint * (2 * torch.rand(clips, 3, device=device) - 1)
    factor = torch.exp2(stops)[:, :, None, None]
    if config.key:
        factor = factor * auto_exposure(reference, config.key)
    current, color, recent, reference = (image * factor for image in (current, color, recent, reference))
    young = (rand[1] < YOUNG).reshape(-1, 1, 1, 1)
    color, recent = (torch.where(young, current, image) for image in (color, recent))
    length = torch.where(young, 1, frame.length)
    calm = young & (torch.rand_like(factor[:, :1]) < CALM)
    kept, light = CALMEST ** torch.where(calm, torch.rand_like(factor[:, :1]), 0), demodulate(reference, albedo)
    color, recent, current = (light.lerp(image, kept) for image in (color, recent, current))
    if config.lamps:
        inside, radiance, grey = lamps(reference, rand, config)
        albedo = torch.where(inside, grey, albedo)
        light = demodulate(radiance, grey.expand_as(radiance))
        color, recent, current = (torch.where(inside, light, image) for image in (color, recent, current))
        reference = torch.where(inside, radiance, reference)
    normal = normal * (rand[3] > BARE).reshape(-1, 1, 1, 1)
    bare = (rand[3] < BARE / 2).reshape(-1, 1, 1, 1)
    color, recent, current = (torch.where(bare, remodulate(image, albedo), image) for image in (color, recent, current))
    albedo = torch.where(bare, 1, albedo)
    frame = Frame(color, current=current, recent=recent, length=length, albedo=albedo, normal=normal)
    return frame.map(lambda image: image.contiguous(memory_format=torch.channels_last)), reference


def lamps(reference: Tensor, rand: Tensor, config: TrainConfig) -> tuple[Tensor, Tensor, Tensor]:
    """Where lamps are, their radiance and albedo.

    In half of the images it is one lamp, down to a single pixel; in the others single pixels all over it: stars, or the
    windows of a distant town.
    """
    clips, side = len(reference), torch.arange(config.crop, device=reference.device)
    own = torch.rand(8, clips, 1, 1, 1, device=reference.device)
    single = torch.rand(2, clips, 1, config.crop, config.crop, device=reference.device)
    sizes = (config.crop / 3) ** own[:2]
    starts = own[2:4] * (config.crop - sizes)
    rows, columns = ((side >= s) & (side < s + n) for s, n in zip(starts, sizes, strict=True))
    many, grey = own[4] < 0.5, own[6] * (own[7] > 0.5)
    inside = torch.where(many, single[0] < 0.03 * 0.01 ** own[5], rows.mT & columns)
    inside &= (rand[2] < config.lamps).reshape(-1, 1, 1, 1)
    brightness = torch.where(many, 1000.0 ** single[1], 30.0 ** own[5])
    tint = 0.7 + 0.6 * torch.rand(clips, 3, 1, 1, device=reference.device)
    return inside, reference.mean((1, 2, 3), keepdim=True) * brightness * tint, grey


def errors(image: Tensor, reference: Tensor, config: TrainConfig) -> Tensor:
    """The logarithm of the error of each frame."""
    return torch.log(
        smape_linear(image, reference) + config.display_weight * display_error(image, reference) + RELATIVE
    )


@torch.no_grad()
def validated(network: nn.Module, tiles: Tiles) -> dict[str, Any]:
    """Geometric means of SMAPE over takes of several frames, and over stills, and the mean PSNR of all."""
    found: dict[str, list[tuple[float, float, int]]] = {}
    network.eval()
    for take in tiles.takes:
        frame, reference = tiles.frames(take)
        scale = oidn_exposure(reference[-1:])
        image, reference = network(frame)[0].image * scale, reference * scale
        errors = smape_linear(image, reference).mean().item(), psnr_srgb(image, reference).mean().item()
        found.setdefault(take["take"], []).append((*errors, take["frames"]))
    network.train()
    means = {name: [sum(column) / len(rows) for column in zip(*rows, strict=True)] for name, rows in found.items()}
    row: dict[str, Any] = {"psnr": sum(psnr for _, psnr, _ in means.values()) / len(means)}
    for name, kind in (("moving", True), ("stills", False)):
        logs = [math.log(smape) for smape, _, frames in means.values() if (frames > 1) == kind]
        row[name] = math.exp(sum(logs) / max(len(logs), 1))
    return {name: round(value, 5) for name, value in row.items()} | {
        "takes": {name: round(smape, 5) for name, (smape, *_) in means.items()}
    }


@dataclass
class Run:
    """A network in training, and its average.

    Args:
        config: of the recipe.
        device: that trains.
        kept: part of the weights that it begins with, in those that it writes (Wortsman et al. 2022, "Robust
            fine-tuning of zero-shot models"): what few takes show is not forgotten.
    """

    config: TrainConfig
    device: torch.device
    kept: float = 0.0

    def __post_init__(self) -> None:
        config = self.config
        torch.manual_seed(config.seed)
        random.seed(config.seed)
        self.network, self.settings, self.start = begun(config)
        self.network.to(self.device, memory_format=torch.channels_last)
        self.average, self.first = (copy.deepcopy(self.network).requires_grad_(False) for _ in range(2))
        weights = dict(self.network.named_parameters())
        random_ones = [weights.pop(name) for name in list(weights) if ".trust." in name]
        groups = [{"params": list(weights.values()), "pace": 1.0}, {"params": random_ones, "pace": FASTER}]
        self.optimizer = torch.optim.Adam(groups, config.learning_rate)
        self.rest, self.averaged = split(self.network)[1], split(self.average)[1]
        self.rounded = fastest_precision(self.device).precision == "bfloat16"
        self.steps, self.passed, self.commits = 0, 0.0, list[dict[str, Any]]()

    def step(self, tiles: Tiles, clips: int, part: float) -> Tensor:
        """Make a step at a part of the time; return its loss and the norm of its gradient.

        Parts of the gradient that are not finite count as 0: a clip that overflows must not end the run.
        """
        config = self.config
        rate = cosine_rate(self.steps, part)
        for group in self.optimizer.param_groups:
            group["lr"] = config.learning_rate * rate * group["pace"]
        frame, reference = tiles.draw(config, clips)
        # Most CPUs emulate half precision.
        with torch.autocast(self.device.type, torch.bfloat16, enabled=self.rounded):
            image = self.rest(frame)[0].image
        loss = errors(image.float(), reference, config).mean()
        self.optimizer.zero_grad()
        loss.backward()
        slopes = [weight.grad for weight in self.network.parameters() if weight.grad is not None]
        norm = nn.utils.get_total_norm(slopes)
        for slope in slopes:
            slope.nan_to_num_(0.0, 0.0, 0.0)
        if config.gradient_norm:
            nn.utils.clip_grad_norm_(self.network.parameters(), config.gradient_norm)
        self.optimizer.step()
        self.steps += 1
        kept = min(config.ema, self.steps / (self.steps + 9))
        with torch.no_grad():
            torch._foreach_lerp_(list(self.average.parameters()), list(self.network.parameters()), 1 - kept)
        return torch.stack([loss.detach(), norm])

    def state_dict(self) -> dict[str, Any]:
        """What a checkpoint holds beside the number of steps and the commits."""
        return {"passed": self.passed} | {name: getattr(self, name).state_dict() for name in KEPT}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from such a state."""
        self.passed = state["passed"]
        for name in KEPT:
            getattr(self, name).load_state_dict(state[name])

    def resume(self, folder: RunFolder) -> None:
        """Go on from the checkpoint, with other draws, if there is one."""
        self.steps, self.commits = folder.load(self)
        folder.rewind(self.steps)
        self.commits.append({"first_step": self.steps, "commit": source_commit()})
        torch.manual_seed(self.config.seed + self.steps)
        random.seed(self.config.seed + self.steps)

    def save(self, path: Path, identity: dict[str, Any]) -> None:
        """Write the averaged weights, with a part of the first ones."""
        config = asdict(replace(self.config, steps=self.steps))
        identity = identity | {"initial_weights": self.start["sha256"]}
        about = about_weights(config, identity, self.steps, self.commits, self.start["data"])
        about |= {"kept": str(self.kept)}
        mean = copy.deepcopy(self.average)
        torch._foreach_lerp_(list(mean.parameters()), list(self.first.parameters()), self.kept)
        with atomic_path(path) as temporary:
            temporary.write_bytes(save_weights(mean, self.config.model, self.settings, about))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("packed", type=Path, metavar="FOLDER")
    parser.add_argument("-o", "--out", type=Path, required=True, metavar="OUT")
    parser.add_argument("--recipe", type=Path, required=True, metavar="FILE.toml")
    parser.add_argument("--run", default="", metavar="NAME", help="of the recipe; not needed where it has only one")
    parser.add_argument("--seconds", type=float, default=300.0, help="in all, from the start of the script on")
    parser.add_argument("--clips", type=int, default=32, help="single frames in a step, instead of the recipe's batch")
    parser.add_argument("--kept", type=float, default=0.0, metavar="PART", help="of the first weights, in the result")
    parser.add_argument("--validation", type=Path, metavar="FOLDER")
    parser.add_argument("--device", default="cuda", choices=("cuda", "cpu"))
    options = parser.parse_args()

    start, device = time.monotonic(), torch.device(options.device)
    torch.backends.cudnn.benchmark = True
    recipe = Recipe.read(options.recipe, options_of("generate"))
    (chosen,) = recipe.chosen([options.run] if options.run else [recipe.runs[0].name])
    config = replace(chosen.config, batch=options.clips, frames=1, temporal_weight=0.0)
    run, tiles = Run(config, device, options.kept), Tiles(options.packed, device)
    watched = Tiles(options.validation, device) if options.validation else None
    # A resumed run would mix two runs, or mix its weights with other first ones.
    own = {"kept": options.kept, "initial_weights": run.start["sha256"]}
    folder, weights = RunFolder(options.out), options.out / f"{config.model}.safetensors"
    folder.claim(config=asdict(config) | own)
    run.resume(folder)
    start, found, next_look = start - run.passed, list[Tensor](), 0.0
    while True:
        run.passed = time.monotonic() - start
        over = run.passed >= options.seconds and run.steps > 0
        if over or run.passed >= next_look:
            tiles.update()
            row = {"step": run.steps, "seconds": round(run.passed, 1), "tiles": len(tiles.takes), "loss": None}
            if found:
                steps = torch.stack(found).cpu()
                whole = steps[steps.isfinite().all(1)]
                # No number, and an error, if not one step was finite.
                loss = float(whole[:, 0].mean())
                check_finite(run.steps, {"loss": loss})
                row |= {"loss": round(loss, 4), "not_finite": len(steps) - len(whole)}
            row |= validated(run.averaged, watched) if watched else {}
            folder.log(row)
            print({name: value for name, value in row.items() if name != "takes"}, flush=True)
            run.save(weights, {"sequences": tiles.about, "credits": recipe.credits, "recipe": chosen.sha256})
            folder.save(run.steps, run.commits, run)
            found.clear()
            next_look = time.monotonic() - start + max(LOOK, options.seconds / LOOKS)
        if over:
            break
        found.append(run.step(tiles, options.clips, run.passed / options.seconds))
    print(weights)


if __name__ == "__main__":
    run_script(main)
