"""Build the Blender extension as a zip: the graphs of a model, the wheel of onnxruntime, and the code beside this file.

    python extensions/blender/build.py -o build/mcdenoise-blender.zip

The zip is for the processor and system that it is built on, and for Blender from 4.2 on, whose Python is 3.11.
"""

import argparse
import copy
import platform
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

import torch
from torch import nn

from mcdenoise.data.files import atomic_path
from mcdenoise.export import export_model
from mcdenoise.frame import Frame
from mcdenoise.methods import parse_method
from mcdenoise.models import DEFAULT, Model, Needs, Output, State, create_model
from mcdenoise.models._layers import REST, closed, completed
from mcdenoise.models._wrapper import Wrapper, parts_of
from mcdenoise.models.accumulated import Accumulated
from mcdenoise.models.filtered import FILTERED, Filtered

HERE = Path(__file__).parent
SURFACES = ("color", "albedo", "normal", "depth")
BUFFERS = (*SURFACES, "motion")
WHEEL, PYTHON = "onnxruntime==1.22.0", "3.11"
PLATFORMS = {("Linux", "x86_64"): "linux-x64", ("Windows", "AMD64"): "windows-x64", ("Darwin", "arm64"): "macos-arm64"}


class Features(nn.Module):
    """The albedo, and behind it the normal, as an image."""

    needs = Needs(frozenset({"albedo", "normal", "depth"}), trainable=False)

    def forward(self, frame: Frame, state: State = None) -> tuple[Output, State]:
        """See :class:`mcdenoise.models.Model`."""
        return Output(torch.cat([getattr(frame, name) for name in FILTERED], 1)), None


class Denoised(nn.Module):
    """The image that is denoised already; a frame brings it as its diffuse light."""

    needs = Needs(frozenset({"diffuse"}), frozenset({"albedo", "normal", "depth"}), trainable=False)

    def forward(self, frame: Frame, state: State = None) -> tuple[Output, State]:
        """See :class:`mcdenoise.models.Model`."""
        assert frame.diffuse is not None
        return Output(frame.diffuse), None


class Light(Wrapper):
    """The part of a denoised image that is one light, with its history, as :class:`mcdenoise.Denoiser` splits it.

    A frame brings the noisy ``light``, and the ``total`` of all lights.

    Args:
        model: the method; what it does to accumulated radiance is left out.
    """

    def __init__(self, model: Model) -> None:
        model = copy.deepcopy(model)
        accumulated = next(parts_of(model, Accumulated), None)
        if accumulated is not None:
            accumulated.inner = Denoised()
        super().__init__(Denoised() if accumulated is None else model)

    def forward(self, frame: Frame, state: State = None) -> tuple[Output, State]:
        """See :class:`mcdenoise.models.Model`."""
        light, total = frame.extra["light"], frame.extra["total"]
        light = closed(frame.replace(layers={"light": light, "": total - light}), lambda *_: None).layers["light"]
        frame = frame.replace(layers={"light": light, REST: frame.color - light})
        output, state = self.inner(frame, state)
        return Output(completed(frame, output).layers["light"]), state


def main() -> None:
    """Build the zip that the arguments name."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--out", type=Path, required=True, help="the zip to write")
    parser.add_argument("--model", default=DEFAULT, help="a model with shipped weights, see `mcdenoise models`")
    asked = parser.parse_args()
    here = (platform.system(), platform.machine())
    if here not in PLATFORMS:
        sys.exit(f"build.py: expected one of {', '.join(map(' '.join, PLATFORMS))}, found {' '.join(here)}")
    asked.out.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as name, atomic_path(asked.out) as temporary:
        folder = Path(name)
        download = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--only-binary", ":all:"]
        subprocess.run([*download, "--python-version", PYTHON, "-d", folder, WHEEL], check=True)
        method = parse_method(asked.model)
        model = create_model(method.model, pretrained=True, **method.settings)
        export_model(Filtered(Features(), "noisy"), folder / "features.onnx", buffers=SURFACES)
        export_model(model, folder / "model.onnx", buffers=BUFFERS, name=method.name)
        export_model(Light(model), folder / "light.onnx", buffers=(*BUFFERS, "diffuse", "light", "total"))
        (wheel,) = folder.glob("*.whl")
        manifest = (HERE / "blender_manifest.toml").read_text()
        added = f'platforms = ["{PLATFORMS[here]}"]\nwheels = ["./wheels/{wheel.name}"]\n\n[permissions]'
        with zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED) as file:
            file.writestr("blender_manifest.toml", manifest.replace("[permissions]", added))
            file.write(wheel, f"wheels/{wheel.name}")
            for path in (*folder.glob("*.onnx"), HERE / "__init__.py", HERE / "frames.py"):
                file.write(path, path.name)
    print(f"{asked.out}: {asked.out.stat().st_size / 1e6:.0f} MB, for Blender on {PLATFORMS[here]}")


if __name__ == "__main__":
    main()
