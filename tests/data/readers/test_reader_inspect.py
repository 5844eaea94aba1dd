"""`mcdenoise inspect` and `mcdenoise denoise` on what renderers wrote."""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import run
from pictures import channels_of


def test_inspect_tells_a_file_what_it_prints_and_writes_nothing(rendered: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(rendered / "blender", tmp_path / "shot")
    assert run("inspect", folder, "--json", tmp_path / "found.json")[::2] == (0, "")
    told = json.loads((tmp_path / "found.json").read_text())
    assert told["frames"] == [1, 2, 3, 4]
    assert told["unused"] == [f"shot_####.exr ViewLayer.{name}" for name in ("Normal.XYZ", "Denoising Depth.Z")]
    assert told["of_use_to"]["diffuse"] == ["kpcn"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["found.json", "shot"]
    assert len(list(folder.iterdir())) == 4


def test_inspect_warns_on_standard_error(others: Any, tmp_path: Path) -> None:
    others.write("vray", tmp_path, frames=(1, 2, 4))
    status, text, errors = run("inspect", tmp_path)
    assert status == 0
    gap, motion = errors.splitlines()
    assert gap.startswith("warning: frames: 3 missing; the history begins anew behind a gap")
    assert motion.startswith("warning: 'motion': read as current - previous, y down, pixels, since only so")
    assert "3 frames, 1 to 4, of 64x36" in text


@pytest.mark.parametrize("option", [("--output-layer", "Clean"), ("--full-float",)])
def test_a_shot_goes_in_and_comes_out(option: tuple[str, ...], rendered: Path, tmp_path: Path) -> None:
    out = tmp_path / "clean"
    status, text, errors = run(
        *("denoise", rendered / "blender" / "shot_####.exr", "-o", out, "--model", "accumulated", "--frames", "2-4"),
        *option,
    )
    assert (status, errors) == (0, "")
    assert text.rstrip().endswith(f"{out / 'shot_0002.exr'} to shot_0004.exr")
    assert sorted(path.name for path in out.iterdir()) == ["denoise.json", *(f"shot_000{i}.exr" for i in (2, 3, 4))]
    assert json.loads((out / "denoise.json").read_text())["read"][0]["buffer"] == "color"
    for number in (3, 4):
        old, new = (channels_of(folder / f"shot_000{number}.exr") for folder in (rendered / "blender", out))
        beauty = [f"ViewLayer.Combined.{each}" for each in "RGB"]
        replaced = [f"ViewLayer.Clean.{each}" for each in "RGB"] if "Clean" in option else beauty
        kept = set(old) - set(replaced)
        assert all(np.array_equal(new[name], old[name]) for name in kept)
        assert {new[name].dtype.name for name in replaced} == ({"float32"} if "--full-float" in option else {"float16"})
        # Less noise: neighbours differ by less.
        rough = [
            np.mean([np.abs(np.diff(np.log1p(each[name].astype(np.float32)), axis=1)).mean() for name in names])
            for each, names in ((new, replaced), (old, beauty))
        ]
        assert rough[0] < 0.95 * rough[1]
