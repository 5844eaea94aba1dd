"""The intact files: a shot in several layouts, weights, results, an interrupted training run, and so on."""

import importlib.util
import json
import shutil
import zipfile
from pathlib import Path

import numpy as np
import OpenEXR
import OpenImageIO as oiio
import torch
from planes import pixel_rays
from torch import Tensor

from mcdenoise.data.camera_matrices import CameraMatrices, write_camera_matrices
from mcdenoise.data.camera_path import Camera, view_projection
from mcdenoise.data.readers.bmfr import CLEAN, write_bmfr_frame, write_buffers
from mcdenoise.data.shards import write_shard
from mcdenoise.frame import Frame
from mcdenoise.models import create_model, save_weights
from mcdenoise.results import Cell, Machine, Method, Results, Scene, Spread
from mcdenoise.train import Progress, TrainConfig, train

WIDTH, HEIGHT, FRAMES = 16, 12, 2
MODEL = "wild_small"

RECIPE = """\
[train]
model = "wild_small"
steps = 3
frames = 2
crop = 64
credits = "nobody"

[[data]]
seeds = "0-1"
frames = 2
size = "64x64"

[[validation]]
seeds = "9"
frames = 2
size = "64x64"

[expected]
smape = 0.5
tolerance = 0.1
"""

FILM = """\
[every]
threads = 1
model = "joint_bilateral"

[[shot]]
name = "wall"
input = "shot"
alpha_min = 0.2
"""

SCENE = """\
<scene version="3.0.0">
  <shape type="rectangle"><bsdf type="diffuse"><rgb name="reflectance" value="0.5, 0.4, 0.3"/></bsdf></shape>
  <emitter type="constant"/>
</scene>
"""

# Options of `train` in addition to folders.
TRAINING = f"--model {MODEL} --steps 3 --crop 12 --frames 2 --batch 1 --checkpoint-every 1 --validation-frames 0"


def build(folder: Path) -> None:
    """Write all files except denoised images."""
    frames, cameras = rendered()
    for number, frame in enumerate(frames):
        write_bmfr_frame(folder / "shot/inputs", number, frame)
        write_layers(folder / f"layers/shot{number}.exr", frame)
    for suffix in (".hdr", ".pfm", ".tif", ".png"):
        image = oiio.ImageBuf(frames[0].color[0].permute(1, 2, 0).numpy().copy())
        assert image.write(str(folder / f"still{suffix}")), oiio.geterror()
    if importlib.util.find_spec("zarr"):
        write_zip(folder / "frame0.zip", frames[0])
    write_camera_matrices(folder / "shot/inputs/camera_matrices.h", cameras, "a wall")
    description = {"color_includes_albedo": True, "reference_noise": {"0": 0.01, "1": 0.02}}
    (folder / "shot/inputs/camera.json").write_text(json.dumps(description))
    weights = save_weights(create_model(MODEL, pretrained=True), MODEL, {}, {"licence": "Apache-2.0"})
    (folder / "weights.safetensors").write_bytes(weights)
    (folder / "recipe.toml").write_text(RECIPE)
    (folder / "film.toml").write_text(FILM)
    # The name of the scene is that of its folder.
    (folder / "scene").mkdir()
    (folder / "scene/scene.xml").write_text(SCENE)
    poses = [{"position": [0.1 * n, 0.2, 3], "look_at": [0, 0, 0]} for n in range(FRAMES)]
    (folder / "path.json").write_text(json.dumps({"fov": 40, "frames": poses}, indent=1))
    (folder / "results").mkdir()
    results().write(folder / "results")
    (folder / "run_times.json").write_text(json.dumps({"a machine": 12.5}))
    (folder / "precision.json").write_text(json.dumps({"a machine": 1.5}))
    (folder / "clean").mkdir()
    white = tensor(np.ones((WIDTH * HEIGHT, 3)))
    write_buffers(folder / "clean" / CLEAN, 0, {"albedo": white, "normal": white})
    colors = np.stack([frame.color[0].numpy() for frame in frames])
    write_shard(folder / "0.take.npz", {"number": 0, "credits": []}, {"color": colors, "reference": colors[-1:]})
    stop_a_training(folder)


def stop_a_training(folder: Path) -> None:
    """Write a run that was interrupted after two of three steps, with its cache."""
    config = TrainConfig(model=MODEL, steps=3, crop=12, frames=2, batch=1, validation_frames=0)
    whole = folder / "whole"

    def keep(progress: Progress) -> None:
        if progress.step == 2:
            shutil.copytree(whole, folder / "run")

    train(config, [folder / "shot"], whole, checkpoint_every=1, report=keep)
    shutil.rmtree(whole)


def rendered() -> tuple[list[Frame], CameraMatrices]:
    """Noisy frames of a wall with a pattern, and their cameras."""
    g, frames, matrices = np.random.default_rng(0), [], []
    for number in range(FRAMES):
        camera = Camera.look_at((0.3 + 0.05 * number, 0.2, 4), (0, 0, 0), 40)
        rays = pixel_rays(camera, WIDTH, HEIGHT)
        position = rays.origin - rays.origin[2] / rays.directions[:, 2:] * rays.directions
        matrices.append(view_projection(camera, WIDTH, HEIGHT, 0.01, 100))
        checker = (np.floor(position[:, 0] * 2) + np.floor(position[:, 1] * 2)) % 2
        albedo = np.where(checker[:, None] > 0, [0.8, 0.6, 0.4], [0.2, 0.3, 0.4])
        reference = albedo * (1 + 0.5 * np.cos(position[:, :1]))
        frame = Frame(
            color=tensor(reference * g.exponential(size=reference.shape)),
            albedo=tensor(albedo),
            normal=tensor(np.broadcast_to([0.0, 0.0, 1.0], position.shape)),
            position=tensor(position),
            motion=tensor(np.zeros((WIDTH * HEIGHT, 2))),
            reference=tensor(reference),
        )
        frames.append(frame)
    return frames, CameraMatrices(np.stack(matrices), np.full((FRAMES, 2), 0.5))


def tensor(values: np.ndarray) -> Tensor:
    image = torch.from_numpy(np.ascontiguousarray(values)).float()
    return image.reshape(HEIGHT, WIDTH, -1).permute(2, 0, 1)[None].contiguous()


def write_layers(path: Path, frame: Frame) -> None:
    """Write a file with all layers, like Blender."""
    path.parent.mkdir(exist_ok=True)
    names = {"Combined": "color", "Denoising Albedo": "albedo", "Denoising Normal": "normal"}
    channels = {}
    for layer, buffer in names.items():
        pixels = getattr(frame, buffer)[0].numpy().astype(np.float16)
        letters = "XYZ" if "Normal" in layer else "RGB"
        channels |= {f"View.{layer}.{each}": pixels[i].copy() for i, each in enumerate(letters)}
    channels["View.Combined.A"] = np.ones((HEIGHT, WIDTH), np.float16)
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, "owner": "somebody"}
    OpenEXR.File(header, channels).write(str(path))


def write_zip(path: Path, frame: Frame) -> None:
    """Write four samples per pixel like Noisebase: radiance of three bytes and an exponent, which is 2^0 here."""
    from numcodecs import Blosc

    shape = (HEIGHT, WIDTH, 4)
    g = np.random.default_rng(3)
    radiance, exponent = g.integers(0, 256, (3, *shape)), np.full((1, *shape), 255)
    arrays = {
        "color": np.concatenate([radiance, exponent]).astype(np.uint8),
        "exposure": np.array([-3, 0], np.float32),
        "reference": frame.reference[0].numpy(),
        "normal": np.broadcast_to(frame.normal[0, ..., None].numpy(), (3, *shape)).astype(np.float16),
        "diffuse": np.broadcast_to(frame.albedo[0, ..., None].numpy(), (3, *shape)).astype(np.float16),
    }
    codec = Blosc("lz4hc", 9)
    with zipfile.ZipFile(path, "w") as file:
        for name, values in arrays.items():
            about = {"zarr_format": 2, "shape": values.shape, "chunks": values.shape, "dtype": values.dtype.str}
            about |= {"order": "C", "fill_value": 0, "filters": None, "compressor": codec.get_config()}
            file.writestr(f"{name}/.zarray", json.dumps(about))
            file.writestr(f"{name}/{'.'.join('0' * values.ndim)}", codec.encode(np.ascontiguousarray(values)))


def results() -> Results:
    """Results of a benchmark of two methods on one scene."""
    spread = Spread(10.0, 9.0, 11.0, 3)
    cells = [
        Cell("wall", name, {"SMAPE": error, "PSNR": 30.0}, {"SMAPE": spread}, spread, {"network": spread}, 12.0)
        for name, error in ((MODEL, 0.05), ("noisy", 0.2))
    ]
    methods = [
        Method(MODEL, "trainable", MODEL, MODEL, {"width": 8}, parameters=1000),
        Method("noisy", "baseline", "noisy", "noisy"),
    ]
    scene = Scene("wall", WIDTH, HEIGHT, [0, 1], [0, 1])
    machine = Machine("a processor", 2, 4.0, "cpu", 1, "a system", {"torch": "2"})
    return Results("mcdenoise benchmark", "2026-01-01T00:00:00+00:00", machine, 1, [scene], methods, cells)
