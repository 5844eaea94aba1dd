"""Build the Blender extension as a zip: the graph of a model, the wheel of onnxruntime, and the code beside this file.

    python extensions/blender/build.py -o build/mcdenoise-blender.zip

The zip is for the processor and system that it is built on, and for Blender from 4.2 on, whose Python is 3.11.
"""

import argparse
import platform
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

from torch import nn

from mcdenoise.data.files import atomic_path
from mcdenoise.export import export_model
from mcdenoise.frame import Frame
from mcdenoise.methods import parse_method
from mcdenoise.models import DEFAULT, Needs, Output, State, create_model
from mcdenoise.models._layers import fractions

HERE = Path(__file__).parent
BUFFERS = ("color", "albedo", "normal", "depth", "motion")
WHEEL, PYTHON = "onnxruntime==1.22.0", "3.11"
PLATFORMS = {("Linux", "x86_64"): "linux-x64", ("Windows", "AMD64"): "windows-x64", ("Darwin", "arm64"): "macos-arm64"}


class Smoother(nn.Module):
    """Smooths a layer of light as :class:`mcdenoise.Denoiser` does; a frame brings it as its diffuse light.

    ``frame.current`` is the denoised image.
    """

    needs = Needs(frozenset({"diffuse", "current"}), frozenset({"albedo", "normal", "depth"}), trainable=False)

    def forward(self, frame: Frame, state: State = None) -> tuple[Output, State]:
        """See :class:`mcdenoise.models.Model`."""
        assert frame.diffuse is not None
        assert frame.current is not None
        return Output(fractions(frame.replace(layers={"light": frame.diffuse}), frame.current)["light"]), None


def main() -> None:
    """Build the zip that the arguments name."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--out", type=Path, required=True, help="the zip to write")
    # A graph does not look whether features have noise; those of Cycles have.
    noisy = f"{DEFAULT}(features=noisy)"
    parser.add_argument("--model", default=noisy, help="a model with shipped weights, see `mcdenoise models`")
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
        export_model(model, folder / "model.onnx", buffers=BUFFERS, name=method.name)
        lit = ("color", "albedo", "normal", "depth", "diffuse", "current")
        export_model(Smoother(), folder / "smoother.onnx", buffers=lit)
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
