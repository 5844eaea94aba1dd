"""docs/from-your-renderer.md and blender.md: code and commands do what they say, and rows of tables are true."""

import importlib.util
import re
import shlex
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
from commands import run

from mcdenoise.data import open_sequence
from mcdenoise.data.images import read_channels, read_image_header

PAGE = Path(__file__).resolve().parents[1] / "docs" / "from-your-renderer.md"
RENDERERS = Path(__file__).parent / "data" / "renderers"
sys.path.insert(0, str(RENDERERS))
import others  # noqa: E402

SECTIONS = dict(re.findall(r"^## (.*?)\n(.*?)(?=^## |\Z)", PAGE.read_text(), re.MULTILINE | re.DOTALL))
SECTIONS["Blender"] = PAGE.with_name("blender.md").read_text()
# The files of each row, and what stands for its columns where a name is of another buffer.
RENDERED = {
    "Blender 4.5": "blender",
    "Blender 4.5, denoised by it": "blender_denoised",
    "Blender 5.0, a part a pass": "blender5",
    "Mitsuba 3.9 (`aov`)": "mitsuba/frame.####.exr",
    "LuxCore 2.11, a file a buffer": "luxcore",
}
NAMED = {
    "pbrt-v4 (`gbuffer`)": "pbrt",
    "Arnold": "arnold",
    "RenderMan": "renderman",
    "V-Ray": "vray",
    "Redshift": "redshift",
    "Octane": "octane",
    "Falcor, a file a buffer": "falcor",
}


def blocks(section: str, language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", SECTIONS[section], re.DOTALL)


def rows(count: int) -> list[list[str]]:
    lines = [line.strip("| ").split("|") for line in PAGE.read_text().splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in line] for line in lines if len(line) == count]


def channel(path: Path, name: str) -> np.ndarray:
    (part,) = [i for i, part in enumerate(read_image_header(path).parts) if name in part.channels]
    return read_channels(path, {part: [name]})[part]


def test_every_row_has_its_test() -> None:
    names = [row[0] for row in rows(7)]
    assert [name for name in names if name not in ("files of", "names of") and set(name) != {"-"}] == [
        *RENDERED,
        *NAMED,
    ]


@pytest.mark.parametrize("row", [*RENDERED, *NAMED])
def test_a_row_is_what_is_read_and_written(row: str, tmp_path: Path) -> None:
    if row in RENDERED:
        given = RENDERERS / RENDERED[row]
    else:
        given = tmp_path / NAMED[row]
        others.write(NAMED[row], given)
    sequence = open_sequence(given)
    (cells,) = [cells for cells in rows(7) if cells[0] == row]
    sources = {each.buffer: each.source for each in sequence.table}
    _, color, albedo, normal, depth, history, written = cells
    expected = {"color": color, "albedo": albedo, "normal": normal, "depth": depth}
    for buffer, layer in expected.items():
        if buffer == "depth" and layer == "P":
            # The depth is computed from positions, along the axis of their camera.
            assert "depth" in sequence.buffers
        elif layer:
            assert _says(sources[buffer], layer), (buffer, sources[buffer])
        else:
            assert buffer not in sources
    follows = "motion" if "motion" in sources else "position" if "view_projection" in sources else ""
    assert _says(sources.get(follows, ""), history.partition(",")[0].partition(" with ")[0]) == bool(history)
    number = sequence.numbers[0]
    frame = sequence.frame(number)
    _, replaced = frame.validate()
    assert replaced == 0
    path = sequence.write(tmp_path, number, np.full((*sequence.size, 3), 0.25, np.float32))
    assert path.name in {each.name for each in (given.parent if "#" in given.name else given).iterdir()}
    names = [name for part in read_image_header(path).parts for name in part.channels]
    for layer in written.split(", "):
        own = layer.removesuffix("A") if set(layer) <= set("RGBA") else layer
        # A file of one picture has no layer of that name.
        red = [
            n
            for n in names
            if (n == "R" and own in ("RGB", "AccumulatePass.output")) or re.search(rf"(^|\.){own}\.[Rr]$", n)
        ]
        assert red, (layer, names)
        assert (channel(path, red[0]) == 0.25).all()


def _says(source: str, layer: str) -> bool:
    """Whether the words for where a buffer is taken from name a layer."""
    words = re.split(r"[ .]", source.removesuffix(".exr"))
    return bool(layer) and (layer in source and (layer.split(".")[-1].split(" ")[-1] in words or f"{layer}_" in source))


def test_the_motion_of_blender_for_arrays() -> None:
    assert "`vector[..., :2] * np.float32([1, -1])`" in SECTIONS["numpy"]
    path = RENDERERS / "blender" / "shot_0002.exr"
    vector = np.concatenate([channel(path, f"ViewLayer.Vector.{each}") for each in "XYZW"], -1)
    motion = vector[..., :2] * np.float32([1, -1])
    assert abs(motion[..., 1]).max() > 0.1
    motion[channel(path, "ViewLayer.Depth.Z")[..., 0] == 1e10] = np.inf
    read = open_sequence(RENDERERS / "blender").frame(2).motion
    np.testing.assert_array_equal(read[0].permute(1, 2, 0).numpy(), motion)


@pytest.mark.parametrize(("section", "files"), [("Blender", "blender"), ("Mitsuba", "mitsuba"), ("pbrt", "pbrt")])
def test_commands_of_a_section_run(section: str, files: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if files == "pbrt":
        others.write(files, tmp_path)
    else:
        for path in (RENDERERS / files).glob("*.0*.exr" if files == "mitsuba" else "*.exr"):
            shutil.copy(path, tmp_path)
    pytest.importorskip("av") if section == "Blender" else None
    monkeypatch.chdir(tmp_path)
    commands = [line for block in blocks(section, "sh") for line in block.splitlines()]
    assert commands
    for command in commands:
        program, *arguments = shlex.split(command)
        assert program == "mcdenoise"
        # The smallest model: what is tested here is files.
        status, _, said = run(*arguments, *(["--model", "wild_small"] if arguments[0] == "denoise" else []))
        assert status == 0, said
        assert "warning" not in said
    if section == "Blender":
        _check_blender(tmp_path)


def _check_blender(folder: Path) -> None:
    name = "ViewLayer.{}.R"
    noisy, clean = (channel(each / "shot_0001.exr", name.format("Combined")) for each in (folder, folder / "clean"))
    assert np.abs(np.diff(clean, axis=1)).mean() < 0.5 * np.abs(np.diff(noisy, axis=1)).mean()
    assert (folder / "clean" / "preview.mp4").is_file()
    still = folder / "still" / "shot_0001.exr"
    assert (channel(still, name.format("Combined")) == noisy).all()
    assert (channel(still, name.format("Denoised")) != noisy).any()
    path = folder / "layers" / "shot_0002.exr"
    total = sum(
        channel(path, name.format(f"{kind}Col"))
        * (channel(path, name.format(f"{kind}Dir")) + channel(path, name.format(f"{kind}Ind")))
        for kind in ("Diff", "Gloss", "Trans")
    )
    total += channel(path, name.format("Emit")) + channel(path, name.format("Env"))
    combined = channel(path, name.format("Combined"))
    # Each of eight layers, of the three colors and Combined is rounded to 11 bits.
    assert np.all(np.abs(total - combined) <= 4 * 2**-11 * combined + 12 * 2**-14)


def test_code_of_numpy_runs(capsys: pytest.CaptureFixture[str]) -> None:
    names: dict[str, object] = {"__name__": "page"}
    for number, block in enumerate(blocks("numpy", "python")):
        exec(compile(block, f"numpy, block {number + 1}", "exec"), names)
    noisy, clean, streamed = map(float, capsys.readouterr().out.split())
    assert clean < 0.5 * noisy
    assert streamed < 0.5 * noisy


@pytest.mark.skipif(importlib.util.find_spec("bpy") is None, reason="needs bpy, Blender as a module: pip install bpy")
def test_code_for_blender_runs() -> None:
    (code,) = blocks("Blender", "blender")
    exec(compile(code, "Blender", "exec"), {"__name__": "page"})
