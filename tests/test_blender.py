"""The add-on for Blender, where there is a Blender: the variable BLENDER_PYTHON names an interpreter with `bpy`."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import OpenImageIO
import pytest

ROOT = Path(__file__).resolve().parents[1]
ADDON = ROOT / "examples" / "blender" / "denoise_animation.py"
RENDERED = ROOT / "tests" / "data" / "renderers" / "blender_filtered"
PYTHON = os.environ.get("BLENDER_PYTHON")
# The command is a script in the folder of this interpreter.
PROGRAM = Path(sys.executable).with_name("mcdenoise")

SCRIPT = f"""
import importlib.util, os, sys
spec = importlib.util.spec_from_file_location("denoise_animation", {str(ADDON)!r})
addon = sys.modules["denoise_animation"] = importlib.util.module_from_spec(spec)
spec.loader.exec_module(addon)
import bpy
addon.register()
scene = bpy.context.scene
if bpy.app.version >= (5, 0):
    scene.render.image_settings.media_type = "MULTI_LAYER_IMAGE"
scene.render.image_settings.file_format = "OPEN_EXR_MULTILAYER"
scene.render.filepath, last = sys.argv[1], int(sys.argv[2])
scene.frame_start, scene.frame_end = 7, last
scene.denoise_animation.arguments = " ".join(sys.argv[3:])
print(addon.pattern(scene))
print(bpy.ops.render.denoise_animation())
addon.unregister()
"""


def run_addon(folder: Path, *arguments: str, program: Path = PROGRAM) -> subprocess.CompletedProcess[str]:
    if PYTHON is None:
        pytest.skip("no BLENDER_PYTHON")
    # Blender's interpreter has nothing to do with where mcdenoise is installed.
    command = [PYTHON, "-c", SCRIPT, str(folder / "shot_"), *arguments]
    environment = {**os.environ, "MCDENOISE": str(program)}
    return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300, check=False)


@pytest.fixture
def shot(tmp_path: Path) -> Path:
    return Path(shutil.copytree(RENDERED, tmp_path / "my shot"))


def test_addon_denoises_what_was_rendered(shot: Path) -> None:
    done = run_addon(shot, "8")
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.splitlines()[0] == "shot_####.exr"
    assert done.stdout.splitlines()[-1] == "{'FINISHED'}"
    for name in ("shot_0007.exr", "shot_0008.exr"):
        before, after = (OpenImageIO.ImageBuf(str(folder / name)) for folder in (shot, shot / "denoised"))
        assert after.spec().channelnames == before.spec().channelnames
        color = [image.get_pixels(OpenImageIO.FLOAT)[..., :3] for image in (before, after)]
        roughness = [np.mean(np.abs(np.diff(np.log1p(np.maximum(image, 0)), axis=1))) for image in color]
        assert roughness[1] < 0.9 * roughness[0]


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (("9",), "shot_0009.exr is not there; render the animation first, or change the frame range"),
        (("8", "--model", "nosuch"), "nosuch"),
    ],
)
def test_addon_says_in_one_line_what_is_wrong(shot: Path, arguments: tuple[str, ...], expected: str) -> None:
    done = run_addon(shot, *arguments)
    assert done.returncode != 0
    assert expected in done.stderr
    assert not (shot / "denoised").exists()


def test_addon_says_where_to_name_the_program(shot: Path) -> None:
    done = run_addon(shot, "8", program=shot / "nothing")
    assert "name mcdenoise in the preferences" in done.stderr
