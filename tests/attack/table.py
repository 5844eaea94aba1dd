"""The tables of commands, readers and kinds of files; each new one needs an entry here."""

import hashlib
import importlib
import io
import json
import re
import sys
import tempfile
import tomllib
import zipfile
from collections.abc import Callable, Iterator
from contextlib import redirect_stdout
from dataclasses import dataclass, fields, is_dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from server import SECONDS
from world import MODEL, TRAINING

from mcdenoise.cli import COMMANDS as CLI
from mcdenoise.cli import load_command, main
from mcdenoise.data.exr import read_exr
from mcdenoise.data.readers.bmfr import read_clean_features
from mcdenoise.errors import InputError
from mcdenoise.models import describe_weights
from mcdenoise.results import Results

Meaning = Callable[[bytes], object]


@dataclass(frozen=True)
class Command:
    """A command, or a reader of the API, in a folder with copies of the world's files that it needs.

    Its result, of the folder and the printed text, is equal for equal input; its progress is a pattern of lines on
    stderr that are neither a warning nor an error; it writes images to the folder out.
    """

    arguments: str
    needs: tuple[str, ...]
    result: Callable[[Path, str], object]
    progress: str = r"(?!)"
    statuses: tuple[int, ...] = (0, 2)
    requires: str = ""
    seconds: float = SECONDS
    out: str = "out"

    @property
    def command(self) -> list[str]:
        return self.arguments.split()


def images(folder: Path, _: str) -> object:
    """Pixels of all images written, and their files in the report."""
    out = folder / "out"
    report = json.loads((out / "denoise.json").read_text())
    return exr_files(out), sorted(each["file"] for each in report["frames"].values())


def filmed(folder: Path, _: str) -> object:
    """Pixels of all shots, and whether they are complete."""
    about = json.loads((folder / "filmed/film.json").read_text())
    return about["complete"], {each["name"]: exr_files(folder / "filmed" / each["name"]) for each in about["shots"]}


def printed(_: Path, out: str) -> object:
    return hashlib.sha256(out.encode()).hexdigest()


def weights(folder: Path, _: str) -> object:
    return describe_weights(folder / f"run/{MODEL}.safetensors")["sha256"]


def page(folder: Path, _: str) -> object:
    return (folder / "results/index.html").read_text().rstrip().endswith("</html>")


def written(place: str) -> Callable[[Path, str], object]:
    return lambda folder, _: exr_files(folder / place)


def exr_files(folder: Path) -> dict[str, str]:
    return {path.name: digest(read_exr(path)[0]) for path in sorted(folder.glob("*.exr"))}


def pictures(folder: Path, _: str) -> object:
    import OpenImageIO as oiio

    written = (path for path in sorted((folder / "out").iterdir()) if path.suffix != ".json")
    return {path.name: of_image(oiio.ImageInput.open(str(path))) for path in written}


def errors(folder: Path, _: str) -> object:
    """Errors of each method, without run times, which vary."""
    cells = json.loads((folder / "compared/results.json").read_text())["cells"]
    return [(each["scene"], each["method"], each["errors"]) for each in cells]


SHOWN = "denoise shot -o out --model joint_bilateral"
NETWORK = "denoise shot -o out --weights weights.safetensors --precision float32"
RENDERING = (
    "render scene/scene.xml --camera-path path.json -o rendered --size 16x12 --reference-spp 4 --variant scalar_rgb"
)
GENERATION = (
    "generate -o generated --assets none --seeds 0 --frames 2 --size 16x12 --noise-seeds 1 --reference-spp 4"
    " --variant scalar_rgb"
)
FILM = "film film.toml -o filmed"
COMPARISON = "benchmark shot -o compared --models joint_bilateral --rounds 1 --sizes none --pictures 1 --threads 1"
COMMANDS = {
    "denoise": Command(SHOWN, ("shot",), images),
    "denoise layers": Command("denoise layers -o out --model joint_bilateral --alpha", ("layers",), images),
    "denoise hdr": Command("denoise still.hdr -o out --model joint_bilateral", ("still.hdr",), pictures),
    "denoise pfm": Command("denoise still.pfm -o out --model joint_bilateral", ("still.pfm",), pictures),
    "denoise tif": Command("denoise still.tif -o out --model joint_bilateral", ("still.tif",), pictures),
    "denoise zip": Command(
        "denoise frame0.zip -o out --model joint_bilateral", ("frame0.zip",), images, requires="zarr"
    ),
    "denoise network": Command(NETWORK, ("shot", "weights.safetensors"), images),
    "denoise again": Command(SHOWN, ("shot", "out"), images),
    # It says of each shot what failed in it, and ends with 1; its workers import all that they need.
    "film": Command(FILM, ("film.toml", "shot"), filmed, statuses=(0, 1, 2), seconds=300, out="filmed/wall"),
    "film again": Command(
        FILM, ("film.toml", "shot", "filmed"), filmed, statuses=(0, 1, 2), seconds=300, out="filmed/wall"
    ),
    "inspect": Command("inspect shot", ("shot",), printed),
    "inspect layers": Command("inspect layers", ("layers",), printed),
    "evaluate": Command("evaluate shot out", ("shot", "out"), printed),
    "evaluate model": Command("evaluate shot --model noisy", ("shot",), printed),
    "train": Command(f"train shot -o run {TRAINING}", ("shot", "run"), weights, r"step \d+  loss .*"),
    "report": Command("benchmark -o results", ("results",), page),
    "render": Command(RENDERING, ("scene", "path.json", "rendered"), written("rendered/inputs"), requires="mitsuba"),
    "generate": Command(GENERATION, ("generated",), written("generated/random0000/inputs"), requires="mitsuba"),
    # If methods fail, the benchmark lists the reasons and ends with status 1.
    "benchmark": Command(COMPARISON, ("shot",), errors, statuses=(0, 1, 2)),
}


# Times that each kind of damage is tried: once where a case takes seconds, twice for other commands, often for readers.
SLOW = {"film", "film again", "train", "render", "generate", "benchmark", "report"}


def rounds(name: str) -> int:
    """How often each kind of damage is tried with a command."""
    return 1 if name in SLOW else 4 if name.startswith("reader") else 2


# What readers of the API read that no command above does: the reader, where it has another name, and the file.
READ = {
    "png": "sequence still.png",
    "camera_path": "camera_path path.json",
    "recipe": "recipe recipe.toml",
    "film": "film film.toml",
    "results": "results results",
    "run": "run run",
    "run_times": "run_times run_times.json",
    "precision": "precision precision.json",
    "clean": "clean clean",
    "take": "take 0.take.npz",
}
for name, line in READ.items():
    needs = ("film.toml", "shot") if name == "film" else (line.split()[1].partition("/")[0],)
    COMMANDS[f"reader {name}"] = Command(f"reader {line}", needs, printed)


def of(module: str, name: str, then: Callable[[Any], object] = lambda found: found) -> Callable[[Path], object]:
    """Read a path with a function of a module, which is imported then."""
    return lambda path: then(getattr(importlib.import_module(f"mcdenoise.{module}"), name)(path))


def read_recipe(path: Path) -> object:
    from mcdenoise.cli.train import options_of
    from mcdenoise.train import Recipe

    recipe = Recipe.read(path, options_of("generate"))
    return [recipe.data, recipe.validation, recipe.credits, recipe.chosen([])]


def read_run(path: Path) -> object:
    from mcdenoise.train import RunFolder

    run = RunFolder(path)
    run.rewind(2)
    return run.errors()


READERS: dict[str, Callable[[Path], object]] = {
    "sequence": of("data", "open_sequence", lambda found: [dict(found.frame(n).items()) for n in found.numbers]),
    "camera_path": of("data.camera_path", "load_camera_path"),
    "recipe": read_recipe,
    "film": of("film", "read_film"),
    "results": Results.read,
    "run": read_run,
    "run_times": of("user_cache", "numbers_in"),
    "precision": of("user_cache", "numbers_in"),
    "clean": lambda path: read_clean_features(path, 0),
    "take": of(
        "data.shards",
        "open_shard",
        lambda shard: (dict(shard.header), {name: array.tobytes() for name, array in shard.read().items()}),
    ),
}


def read(name: str, path: Path) -> int:
    """Print a checksum of the result of a reader, or its error message."""
    try:
        print(digest(READERS[name](path)))
    except InputError as error:
        print(f"mcdenoise reader: {error}", file=sys.stderr)
        return 2
    return 0


def pixels(content: bytes, suffix: str = ".exr") -> object:
    """The content of an image as read by OpenImageIO."""
    import OpenImageIO as oiio

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, f"image{suffix}")
        path.write_bytes(content)
        file = oiio.ImageInput.open(str(path))
        if file is None:
            return oiio.geterror()
        return of_image(file)


def of_image(file: Any) -> object:
    """The header and the pixels of an image."""
    import OpenImageIO as oiio

    spec = file.spec()
    size = (spec.width, spec.height, spec.nchannels)
    found = file.read_image(oiio.FLOAT) if spec.width * spec.height * spec.nchannels < 10**6 else None
    file.close()
    names = [*spec.channelnames, *((each.name, str(each.value)) for each in spec.extra_attribs)]
    return size, names, None if found is None else np.asarray(found).tobytes()


def entries(content: bytes) -> object:
    """The content of a zip file as read by Python's zipfile."""
    with zipfile.ZipFile(io.BytesIO(content)) as file:
        return {each.filename: file.read(each) for each in file.infolist()}


def anything(content: bytes) -> object:
    """The meaning of a text in which every character matters."""
    return content


def exactly(_: bytes) -> object:
    """The meaning of a file with a checksum: if it is damaged, it must be rejected or created again."""
    return None


def toml(content: bytes) -> object:
    return tomllib.loads(content.decode())


@dataclass(frozen=True)
class Kind:
    """A kind of file, by its path or a pattern, and the commands that read it.

    The results of commands depend on the meaning of its content alone.
    """

    path: str
    meaning: Meaning
    commands: tuple[str, ...]


KINDS = {
    "color": Kind("shot/inputs/color0.exr", pixels, ("denoise", "inspect", "evaluate model", "train", "benchmark")),
    "color of the second frame": Kind(
        "shot/inputs/color1.exr", pixels, ("denoise", "denoise network", "film", "film again")
    ),
    "albedo": Kind("shot/inputs/albedo1.exr", pixels, ("denoise", "denoise network", "train")),
    "normal": Kind("shot/inputs/shading_normal0.exr", pixels, ("denoise",)),
    "position": Kind("shot/inputs/world_position1.exr", pixels, ("denoise", "evaluate model")),
    "motion": Kind("shot/inputs/motion1.exr", pixels, ("denoise", "inspect")),
    "reference": Kind("shot/inputs/reference0.exr", pixels, ("evaluate", "evaluate model", "train")),
    "image to evaluate": Kind("out/denoised0.exr", pixels, ("evaluate",)),
    "layers": Kind("layers/shot1.exr", pixels, ("denoise layers", "inspect layers")),
    "camera.json": Kind("shot/inputs/camera.json", json.loads, ("denoise", "inspect", "evaluate model", "train")),
    "camera_matrices.h": Kind("shot/inputs/camera_matrices.h", anything, ("denoise", "inspect")),
    "weights": Kind("weights.safetensors", exactly, ("denoise network",)),
    "hdr": Kind("still.hdr", partial(pixels, suffix=".hdr"), ("denoise hdr",)),
    "pfm": Kind("still.pfm", partial(pixels, suffix=".pfm"), ("denoise pfm",)),
    "tif": Kind("still.tif", partial(pixels, suffix=".tif"), ("denoise tif",)),
    "png": Kind("still.png", partial(pixels, suffix=".png"), ("reader png",)),
    "zip": Kind("frame0.zip", entries, ("denoise zip",)),
    "recipe": Kind("recipe.toml", toml, ("reader recipe",)),
    "film": Kind("film.toml", toml, ("reader film", "film")),
    "camera path": Kind("path.json", json.loads, ("reader camera_path",)),
    "results.json": Kind("results/results.json", json.loads, ("reader results", "report")),
    "earlier denoise.json": Kind("out/denoise.json", exactly, ("denoise again",)),
    "earlier image": Kind("out/denoised1.exr", exactly, ("denoise again",)),
    "record of a frame": Kind("filmed/.film/wall/*.json", exactly, ("film again",)),
    "earlier image of a film": Kind("filmed/wall/denoised0.exr", exactly, ("film again",)),
    "earlier film.json": Kind("filmed/film.json", exactly, ("film again",)),
    "checkpoint": Kind("run/checkpoint.pt", exactly, ("train",)),
    "log": Kind("run/log.jsonl", anything, ("train", "reader run")),
    "config of a run": Kind("run/config.json", exactly, ("train",)),
    "data of a run": Kind("run/data.json", exactly, ("train",)),
    "decoded cache": Kind("run/cache/*/*/*.npy", exactly, ("train",)),
    "metadata of the decoded cache": Kind("run/cache/*/*/about.json", exactly, ("train",)),
    "rendered color": Kind("rendered/inputs/color0.exr", pixels, ("render",)),
    "rendered feature": Kind("rendered/inputs/albedo1.exr", pixels, ("render",)),
    "rendered reference": Kind("rendered/inputs/reference1.exr", pixels, ("render",)),
    "metadata of a rendering": Kind("rendered/inputs/camera.json", json.loads, ("render",)),
    "generated color": Kind("generated/random0000/inputs/color0.exr", pixels, ("generate",)),
    "generated matrices": Kind("generated/random0000/inputs/camera_matrices.h", anything, ("generate",)),
    "metadata of generated frames": Kind("generated/random0000/inputs/camera.json", json.loads, ("generate",)),
    "scene": Kind("scene/scene.xml", anything, ("render",)),
    "precision.json": Kind("precision.json", json.loads, ("reader precision",)),
    "run_times.json": Kind("run_times.json", json.loads, ("reader run_times",)),
    "clean features": Kind("clean/clean/albedo0.exr", pixels, ("reader clean",)),
    "packed take": Kind("0.take.npz", entries, ("reader take",)),
}


def warm_up() -> None:
    """Import the modules that commands need, without starting threads."""
    import OpenImageIO as oiio

    oiio.attribute("threads", 1)
    for name in CLI:
        load_command(name)
    # Modules that are imported on first use.
    for name in ("torch.utils.tensorboard", "lightning_fabric", "kornia", "colour", "numba", "jinja2"):
        importlib.import_module(name)
    for command in ("models", "denoise --help"):
        with redirect_stdout(io.StringIO()):
            try:
                main(command.split())
            except SystemExit:
                continue


def digest(value: object) -> str:
    """Checksum of numbers, arrays, texts, and of containers of these."""
    sha256 = hashlib.sha256()
    for piece in pieces(value):
        sha256.update(piece)
    return sha256.hexdigest()


def pieces(value: Any) -> Iterator[bytes]:
    if is_dataclass(value) and not isinstance(value, type):
        value = {each.name: getattr(value, each.name) for each in fields(value)}
    if isinstance(value, torch.Tensor):
        value = value.detach().numpy()
    if isinstance(value, np.ndarray):
        yield str((value.shape, value.dtype)).encode()
        yield value.tobytes()
    elif isinstance(value, dict):
        for key in sorted(value, key=repr):
            yield repr(key).encode()
            yield from pieces(value[key])
    elif isinstance(value, list | tuple):
        yield b"["
        for each in value:
            yield from pieces(each)
        yield b"]"
    else:
        yield re.sub(r" at 0x[0-9a-f]+", "", repr(value)).encode(errors="surrogateescape")
