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
import pytest
import torch
from commands import succeeds
from pictures import channels_of

from mcdenoise import Denoiser, Frame
from mcdenoise.data import open_sequence
from mcdenoise.models import create_model

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

    def denoise(buffers: dict[str, Any], lights: dict[str, Any]) -> Any:
        assert not lights
        seen.update(buffers)
        return 2 * buffers["color"], lights

    frames.denoise_frame(denoise, source, tmp_path / "out" / "new.exr", SHOTS[shot])
    for name, image in seen.items():
        expected = getattr(frame, name)[0].permute(1, 2, 0).numpy()
        np.testing.assert_allclose(image, expected, rtol=1e-6, atol=1e-6, err_msg=name)
    # Twice the noisy light, and everything else as it was.
    before, after = (channels_of(path) for path in (source, tmp_path / "out" / "new.exr"))
    assert before.keys() == after.keys()
    for name, image in before.items():
        place = "RGB".find(name[-1]) if ".Combined." in name else -1
        expected = image if place < 0 else 2 * seen["color"][..., place]
        np.testing.assert_array_equal(after[name], expected, err_msg=name)
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["new.exr"]


@pytest.mark.parametrize("shot", SHOTS)
def test_lights_are_read_as_by_the_package_and_replaced(shot: str, frames: Any, tmp_path: Path) -> None:
    source = sorted((RENDERED / shot).glob("*.exr"))[-1]
    seen: dict[str, Any] = {}

    def lights(path: Path, *mapping: str) -> dict[str, Any]:
        sequence = open_sequence(path, mapping=mapping, lights=("all",))
        layers = sequence.frame(sequence.numbers[0]).layers
        return {name.rpartition(".")[2]: layer[0].permute(1, 2, 0).numpy() for name, layer in layers.items()}

    def denoise(buffers: dict[str, Any], lights: dict[str, Any]) -> Any:
        seen.update(lights)
        return 2 * buffers["color"], {name: 2 * light for name, light in lights.items()}

    before = lights(source)
    frames.denoise_frame(denoise, source, tmp_path / source.name, SHOTS[shot], lights=True)
    assert seen.keys() == before.keys()
    assert len(before) > 4
    for name, light in before.items():
        np.testing.assert_allclose(seen[name], light, rtol=1e-6)
    after = lights(tmp_path / source.name, "color=Combined")
    assert after.keys() == before.keys()
    # Where a pass has no color, the others have its light.
    np.testing.assert_allclose(sum(after.values()), 2 * sum(before.values()), rtol=4e-3, atol=1e-4)


@torch.no_grad()
def test_a_light_is_split_as_by_the_denoiser() -> None:
    build, model, size = runpy.run_path(str(EXTENSION / "build.py")), create_model("wild_small"), (33, 47)
    split, denoiser = build["Light"](model).eval(), Denoiser(model, precision="float32")
    states: dict[str, Any] = {}
    for _ in range(3):
        # In places darker than the lights, in others with light of its own.
        lights = {name: torch.rand(1, 3, *size) ** 4 for name in ("a", "b", "c")}
        total = sum(lights.values(), torch.zeros(1, 3, *size))
        frame = Frame(
            total * torch.linspace(0.995, 1.5, size[1]),
            albedo=torch.rand(1, 3, *size),
            normal=torch.nn.functional.normalize(torch.randn(1, 3, *size), dim=1),
            depth=1 + torch.rand(1, 1, size[0], 1).expand(1, 1, *size),
            motion=torch.full((1, 2, *size), 0.3),
        )
        expected = denoiser.output(frame.replace(layers=lights))
        for name, light in lights.items():
            given = frame.replace(diffuse=expected.image, extra={"light": light, "total": total})
            output, states[name] = split(given, states.get(name))
            torch.testing.assert_close(output.image, expected.layers[name], rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize(
    ("name", "layer", "expected"),
    [("shot_0007.exr", "Another", "pass Combined"), ("shot_0009.exr", "Main Layer v1.2", "cannot be read")],
)
def test_what_cannot_be_denoised_is_said_in_one_line(
    name: str, layer: str, expected: str, frames: Any, tmp_path: Path
) -> None:
    with pytest.raises(frames.FrameError) as error:
        frames.denoise_frame(
            lambda buffers, lights: (buffers["color"], lights),
            *(RENDERED / "blender_filtered" / name, tmp_path / "x.exr", layer),
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
        graphs = {"features.onnx", "model.onnx", "light.onnx"}
        assert {"blender_manifest.toml", "__init__.py", "frames.py", *graphs} < set(file.namelist())
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
        found, expected = (
            channels_of(folder / f"shot_000{number}.exr") for folder in (shot / "denoised", tmp_path / "out")
        )
        passes = tuple(f"ViewLayer.{light}." for light in ("Combined", *frames.LIGHTS))
        lit = [name for name in found if name.startswith(passes) and name[-1] in "RGB"]
        assert len(lit) > 4
        for name in lit:
            error = np.abs(found[name] - expected[name]) / (np.abs(expected[name]) + expected[name].mean() + 1e-6)
            # Both were rounded to half floats.
            assert error.max() < 2e-3, (number, name)
            assert error.mean() < 1e-5, (number, name)
    assert "shot_0005.exr is not there" in run("5")[1]
