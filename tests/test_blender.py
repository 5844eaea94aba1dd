"""The extension for Blender: it reads files as the package does, and its zip works in a Blender that is there."""

import os
import runpy
import subprocess
import sys
import types
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
import pytest
import torch
from commands import succeeds

from mcdenoise import Frame
from mcdenoise.data import open_sequence
from mcdenoise.models import _layers

ROOT = Path(__file__).resolve().parents[1]
EXTENSION = ROOT / "extensions" / "blender"
RENDERED = ROOT / "tests" / "data" / "renderers"
PYTHON = os.environ.get("BLENDER_PYTHON")
# Of two frames with all passes, in one part and in one for each pass.
SHOTS = {"blender": "ViewLayer", "blender5": "ViewLayer"}


@pytest.fixture(scope="module")
def frames() -> Any:
    return types.SimpleNamespace(**runpy.run_path(str(EXTENSION / "frames.py")))


@pytest.mark.parametrize("shot", SHOTS)
def test_buffers_are_read_as_by_the_package(shot: str, frames: Any, tmp_path: Path) -> None:
    source = sorted((RENDERED / shot).glob("*.exr"))[-1]
    sequence = open_sequence(RENDERED / shot)
    frame = sequence.frame(sequence.numbers[-1]).validate()[0]
    seen: dict[str, Any] = {}

    def denoise(buffers: dict[str, Any]) -> Any:
        seen.update(buffers)
        return 2 * buffers["color"]

    frames.denoise_frame(denoise, source, tmp_path / "out" / "new.exr", SHOTS[shot])
    for name, image in seen.items():
        expected = getattr(frame, name)[0].permute(1, 2, 0).numpy()
        np.testing.assert_allclose(image, expected, rtol=1e-6, atol=1e-6, err_msg=name)
    # Twice the noisy light, and everything else as it was.
    before, after = (parts(path) for path in (source, tmp_path / "out" / "new.exr"))
    assert before.keys() == after.keys()
    for name, image in before.items():
        place = "RGB".find(name[-1]) if ".Combined." in name else -1
        expected = image if place < 0 else 2 * seen["color"][..., place]
        np.testing.assert_array_equal(after[name], expected, err_msg=name)
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["new.exr"]


def parts(path: Path) -> dict[str, Any]:
    file, found = oiio.ImageInput.open(str(path)), {}
    while file.seek_subimage(file.current_subimage() + bool(found), 0):
        pixels = file.read_image(file.current_subimage(), 0, 0, file.spec().nchannels, "float")
        found |= {name: pixels[..., i] for i, name in enumerate(file.spec().channelnames)}
    return found


def test_layers_of_light_are_split_as_by_the_package(frames: Any) -> None:
    lights = {name: torch.rand(1, 3, 6, 8) for name in ("a", "b")}
    for light in lights.values():
        light[..., :2] = 0
    color, image = sum(lights.values()) * torch.linspace(0.995, 1.5, 8), torch.rand(1, 3, 6, 8)

    def numpy(images: dict[str, torch.Tensor]) -> list[Any]:
        return [each[0].permute(1, 2, 0).numpy() for each in images.values()]

    given = dict(zip(lights, numpy(lights), strict=True))
    noisy = _layers.closed(
        Frame(color, layers=lights), lambda excess, handle: handle(excess.reshape(1).tolist())
    ).layers
    found = frames.closed(*numpy({"": color}), given)
    np.testing.assert_allclose([*found.values()], numpy(dict(noisy)), rtol=1e-6)
    found = frames.in_proportion(*numpy({"": image}), found)
    np.testing.assert_allclose([*found.values()], numpy(_layers.split(image, noisy)), rtol=1e-6)
    np.testing.assert_allclose(sum(found.values()), numpy({"": image})[0], rtol=1e-6)


@pytest.mark.parametrize(
    ("name", "layer", "expected"),
    [("shot_0007.exr", "Another", "pass Combined"), ("shot_0009.exr", "Main Layer v1.2", "cannot be read")],
)
def test_what_cannot_be_denoised_is_said_in_one_line(
    name: str, layer: str, expected: str, frames: Any, tmp_path: Path
) -> None:
    with pytest.raises(frames.FrameError) as error:
        frames.denoise_frame(
            lambda buffers: buffers["color"], RENDERED / "blender_filtered" / name, tmp_path / "x.exr", layer
        )
    assert expected in str(error.value)
    assert "\n" not in str(error.value)
    assert not list(tmp_path.iterdir())


SCRIPT = """
import sys
from pathlib import Path
import bpy
# As a module, Blender does not look where its own packages are.
sys.path += map(str, Path(bpy.utils.resource_path("LOCAL")).glob("python/lib/python*/site-packages"))
archive, rendered, first, last, layer = sys.argv[1:]
bpy.ops.preferences.addon_enable(module="bl_pkg")
bpy.ops.extensions.package_install_files(filepath=archive, repo="user_default", enable_on_install=True)
scene = bpy.context.scene
for step in ("passes", "animation"):
    if step == "animation":
        bpy.context.view_layer.name = layer
        scene.render.filepath = rendered
        scene.frame_start, scene.frame_end = int(first), int(last)
        scene.denoise_animation.lights = True
    try:
        print(step, getattr(bpy.ops.render, f"denoise_{step}")())
    except RuntimeError as error:
        print(step, error)
bpy.ops.preferences.addon_disable(module="bl_ext.user_default.mcdenoise")
"""


@pytest.fixture(scope="module")
def archive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    if PYTHON is None:
        pytest.skip("no BLENDER_PYTHON")
    out = tmp_path_factory.mktemp("built") / "extension.zip"
    subprocess.run([sys.executable, EXTENSION / "build.py", "-o", out], check=True, timeout=1800)
    return out


@pytest.mark.slow
@pytest.mark.timeout(2400)
def test_the_zip_denoises_in_blender_as_the_command_does(frames: Any, archive: Path, tmp_path: Path) -> None:
    assert archive.stat().st_size < 60e6
    with zipfile.ZipFile(archive) as file:
        assert {"blender_manifest.toml", "__init__.py", "frames.py", "model.onnx", "smoother.onnx"} < set(
            file.namelist()
        )
    render = ROOT / "examples" / "blender" / "render.py"
    shot = tmp_path / "my shot"
    subprocess.run([PYTHON, render, "-o", shot, "--size", "96x64", "--frames", "4", "--samples", "2"], check=True)
    environment = {**os.environ, "BLENDER_USER_RESOURCES": str(tmp_path / "blender")}

    def run(last: str) -> list[str]:
        command = [str(PYTHON), "-c", SCRIPT, str(archive), str(shot / "shot_"), "1", last, "ViewLayer"]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300, check=False)
        return [line for line in done.stdout.splitlines() if line.startswith(("passes", "animation"))] or [done.stderr]

    assert run("4") == ["passes {'FINISHED'}", "animation {'FINISHED'}"]
    # The graph compares surfaces by their depth.
    same = ("--model", "wild", "--keep-all", "--map", "position=", "--layers", "all")
    succeeds("denoise", shot / "shot_####.exr", "-o", tmp_path / "out", *same)
    for number in range(1, 5):
        found, expected = (parts(folder / f"shot_000{number}.exr") for folder in (shot / "denoised", tmp_path / "out"))
        passes = tuple(f"ViewLayer.{light}." for light in ("Combined", *frames.LIGHTS))
        lit = [name for name in found if name.startswith(passes) and name[-1] in "RGB"]
        assert len(lit) > 4
        for name in lit:
            error = np.abs(found[name] - expected[name]) / (np.abs(expected[name]) + expected[name].mean() + 1e-6)
            # Both were rounded to half floats.
            assert error.max() < 2e-3, (number, name)
            assert error.mean() < 1e-5, (number, name)
    assert "shot_0005.exr is not there" in run("5")[1]
