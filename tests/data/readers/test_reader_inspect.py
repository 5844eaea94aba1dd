"""`mcdenoise inspect` and `mcdenoise denoise` on what renderers wrote."""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
from commands import run, succeeds
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


def test_frames_of_a_shot_come_out_in_full_floats(rendered: Path, tmp_path: Path) -> None:
    out, chosen = tmp_path / "clean", ("--frames", "2-4", "--model", "accumulated", "--full-float")
    text = succeeds("denoise", rendered / "blender" / "shot_####.exr", "-o", out, *chosen)
    assert text.rstrip().endswith(f"{out / 'shot_0002.exr'} to shot_0004.exr")
    assert sorted(path.name for path in out.iterdir()) == ["denoise.json", *(f"shot_000{i}.exr" for i in (2, 3, 4))]
    assert json.loads((out / "denoise.json").read_text())["read"][0]["buffer"] == "color"
    old, new = (channels_of(folder / "shot_0003.exr") for folder in (rendered / "blender", out))
    replaced = {f"ViewLayer.Combined.{each}" for each in "RGB"}
    assert {new[name].dtype.name for name in replaced} == {"float32"}
    assert all(np.array_equal(new[name], old[name]) for name in set(old) - replaced)
