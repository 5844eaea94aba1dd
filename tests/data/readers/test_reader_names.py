"""File names: which files a folder, a file or a pattern stands for, and which digits count the frames."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
from pictures import save
from refusals import refused

from mcdenoise.data import open_sequence
from mcdenoise.data.readers.names import find_files, group_files, pattern_of

SIZE = (8, 12)
D = Path("/d")


def groups(*names: str) -> dict[str, dict[int, str]]:
    return {
        pattern_of(group): {number: path.name for number, path in group.files.items()}
        for group in group_files([D / name for name in names])[0]
    }


@pytest.fixture
def image(tmp_path: Path) -> Callable[..., list[Path]]:
    """Write small pictures of red, green and blue; the red of each is its place among them."""

    def written(*names: str) -> list[Path]:
        return [
            save(tmp_path / name, {"R": np.full(SIZE, i + 1), "G": np.ones(SIZE), "B": np.ones(SIZE)})
            for i, name in enumerate(names)
        ]

    return written


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (["shot_0001", "shot_0002"], {"shot_####": [1, 2]}),
        (["a1", "a2", "a10"], {"a#": [1, 2, 10]}),
        (["7", "8"], {"#": [7, 8]}),
        (["frame.0099", "frame.0100"], {"frame.####": [99, 100]}),
        (["f999999", "f1000000"], {"f######": [999999, 1000000]}),
        (["render_1080p_0001", "render_1080p_0002"], {"render_1080p_####": [1, 2]}),
        (["render_0001_1080p", "render_0002_1080p"], {"render_####_1080p": [1, 2]}),
        (["2024-05-01_0001", "2024-05-01_0002"], {"2024-05-01_####": [1, 2]}),
        (["color_v1_0001", "color_v2_0001"], {"color_v#_0001": [1, 2]}),
        (["color_v1_0002", "color_v2_0002"], {"color_v#_0002": [1, 2]}),
        (["shot 1 (0003)", "shot 1 (0004)"], {"shot 1 (####)": [3, 4]}),
        (["bild_ä_٣_001", "bild_ä_٣_002"], {"bild_ä_٣_###": [1, 2]}),
        (["a[1]_01", "a[1]_02"], {"a[1]_##": [1, 2]}),
        (
            ["shot02_0012_albedo", "shot02_0013_albedo", "shot02_0012", "shot02_0013"],
            {"shot02_####_albedo": [12, 13], "shot02_####": [12, 13]},
        ),
        (["shot01_0001", "shot01_0002", "shot02_0001", "shot02_0002"], {"shot01_####": [1, 2], "shot02_####": [1, 2]}),
        (["color", "albedo"], {"color": [0], "albedo": [0]}),
        (["render_0007", "albedo"], {"render_0007": [7], "albedo": [7]}),
        (["render_0007", "albedo_0007", "normal"], {"render_0007": [7], "albedo_0007": [7], "normal": [7]}),
        (["kitchen2", "kitchenAlbedo2"], {"kitchen2": [2], "kitchenAlbedo2": [2]}),
        # Two stills are no buffers of each other.
        (["a_0005", "b_0006"], {"a_0005": [5], "b_0006": [6]}),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_which_digits_count_the_frames(names: list[str], expected: dict[str, list[int]]) -> None:
    found = groups(*[f"{name}.exr" for name in names])
    assert {pattern.removesuffix(".exr"): list(files) for pattern, files in found.items()} == expected
    assert sorted(name for files in found.values() for name in files.values()) == sorted(
        f"{name}.exr" for name in names
    )


def test_patterns_have_negative_numbers_too(image: Callable[..., list[Path]], tmp_path: Path) -> None:
    """`%04d` counts the minus sign as a digit, Blender does not."""
    names = ["shot.-0002.exr", "shot.-001.exr", "shot.0000.exr"]
    image(*names, "shot-0003.exr", "shot.-01.exr")
    for pattern in ("shot.####.exr", "shot.%04d.exr"):
        assert [path.name for path in find_files([tmp_path / pattern])] == names


def test_two_files_of_a_frame_are_refused() -> None:
    message = refused(group_files, [D / "shot_0001.exr", D / "shot_1.exr"])
    assert "shot_1.exr: expected one file a frame, found shot_0001.exr as well" in message


@pytest.mark.parametrize(
    ("pattern", "expected"),
    [
        ("shot_####.exr", ["shot_0001.exr", "shot_0002.exr", "shot_10003.exr"]),
        ("shot_%04d.exr", ["shot_0001.exr", "shot_0002.exr", "shot_10003.exr"]),
        ("shot_%d.exr", ["shot_0001.exr", "shot_0002.exr", "shot_10003.exr"]),
        ("shot_#####.exr", ["shot_10003.exr"]),
        ("shot_*.exr", ["shot_0001.exr", "shot_0001_mask.exr", "shot_0002.exr", "shot_10003.exr"]),
        ("shot_000[12].exr", ["shot_0001.exr", "shot_0002.exr"]),
        ("shot_000[!1].exr", ["shot_0002.exr"]),
        ("shot_000?.exr", ["shot_0001.exr", "shot_0002.exr"]),
        ("shot_????_mask.exr", ["shot_0001_mask.exr"]),
        ("*_####.exr", ["shot_0001.exr", "shot_0002.exr", "shot_10003.exr", "ä b_0001.exr", "x[1]_0001.exr"]),
        ("x[1]_0001.exr", ["x[1]_0001.exr"]),
        ("x[1]_####.exr", ["x[1]_0001.exr"]),
        ("ä b_%04d.exr", ["ä b_0001.exr"]),
        ("*", None),
    ],
)
def test_patterns(pattern: str, expected: list[str] | None, image: Callable[..., list[Path]], tmp_path: Path) -> None:
    names = ["shot_0001.exr", "shot_0001_mask.exr", "shot_0002.exr", "shot_10003.exr", "ä b_0001.exr", "x[1]_0001.exr"]
    folder = "a folder [2] #1"
    image(*[f"{folder}/{name}" for name in (*names, ".hidden_0001.exr")])
    (tmp_path / folder / "notes.txt").write_text("no image")
    assert {path.name for path in find_files([tmp_path / folder / pattern])} == set(
        names if expected is None else expected
    )
    assert {path.name for path in find_files([tmp_path / folder])} == set(names)


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        (["nowhere"], "no such folder or file"),
        (["nowhere/shot_####.exr"], "found no folder"),
        (["x_####.exr"], "found none; check the pattern"),
        (["*.hdr"], "found none; check the pattern"),
        (["empty"], "found none"),
        (["notes.txt"], "expected one of .exr"),
        (["dangling.exr"], "dangling.exr: expected an image, found: it is a link to nothing"),
        (["folder_with_dangling"], "dangling.exr: expected an image, found: it is a link to nothing"),
        (["a_0001.exr", "nowhere.exr"], "nowhere.exr"),
        ([f"{'x' * 300}.exr"], "no such folder or file"),
        ([f"{'x' * 300}_####.exr"], "found none"),
        ([], "found nothing"),
    ],
)
def test_paths_and_patterns_without_files(
    given: Sequence[str], expected: str, image: Callable[..., list[Path]], tmp_path: Path
) -> None:
    image("a_0001.exr")
    (tmp_path / "empty").mkdir()
    (tmp_path / "folder_with_dangling").mkdir()
    (tmp_path / "notes.txt").write_text("no image")
    for folder in (tmp_path, tmp_path / "folder_with_dangling"):
        (folder / "dangling.exr").symlink_to(tmp_path / "gone.exr")
    message = refused(open_sequence, [tmp_path / each for each in given])
    assert expected in message


def test_two_shots_are_refused_with_the_option_that_decides(image: Callable[..., list[Path]], tmp_path: Path) -> None:
    image(*[f"all/shot{shot:02d}_{number:04d}.exr" for shot in (1, 2) for number in (1, 2)])
    message = refused(open_sequence, tmp_path / "all")
    assert "found shot01_####.exr, shot02_####.exr; choose" in message
    assert "choose with --map color=shot01, or give only the files of one shot" in message
    for sequence in (
        open_sequence(tmp_path / "all", mapping=["color=shot02"]),
        open_sequence(tmp_path / "all" / "shot02_####.exr"),
    ):
        assert sequence.numbers == [1, 2]
        assert float(sequence.frame(1).color[0, 0, 0, 0]) == 3


@pytest.mark.parametrize(
    "names",
    [
        ["color.exr", "albedo.exr", "normal.exr"],
        ["render_0007.exr", "albedo.exr", "normal.exr"],
        ["render_0007.exr", "render_0007_albedo.exr", "render_0007_normal.exr"],
        ["kitchen.exr", "kitchenAlbedo.exr", "kitchenNormal.exr"],
        ["shot02_0012.exr", "shot02_0012_albedo.exr", "shot02_0012_normal.exr"],
        ["Küche 3.exr", "Küche 3 albedo.exr", "Küche 3 normal.exr"],
    ],
    ids=lambda names: names[0],
)
def test_buffers_of_a_still(names: list[str], image: Callable[..., list[Path]], tmp_path: Path) -> None:
    image(*[f"still/{name}" for name in names])
    sequence = open_sequence(tmp_path / "still")
    assert sequence.buffers == {"color", "albedo", "normal"}
    assert len(sequence) == 1
    taken = {row.buffer: row.source for row in sequence.table}
    assert taken == dict(zip(("color", "albedo", "normal"), names, strict=True))
    assert float(sequence.frame(sequence.numbers[0]).color[0, 0, 0, 0]) == 1


def test_a_folder_for_each_buffer(image: Callable[..., list[Path]], tmp_path: Path) -> None:
    image(*[f"{folder}/{number:04d}.exr" for folder in ("color", "albedo", "normal") for number in (1, 2)])
    sequence = open_sequence([tmp_path / folder for folder in ("albedo", "color", "normal")])
    assert open_sequence(tmp_path).table == sequence.table
    taken = {row.buffer: row.source for row in sequence.table}
    assert taken == {name: f"{name}/####.exr" for name in ("color", "albedo", "normal")}
    assert float(sequence.frame(2).color[0, 0, 0, 0]) == 2


def test_the_layout_of_oidn(image: Callable[..., list[Path]], tmp_path: Path) -> None:
    image(
        *[f"training/{name}_0008spp.{kind}.exr" for name in ("bath", "kitchen") for kind in ("hdr", "alb", "nrm")],
        "training/kitchen_4096spp.hdr.exr",
        "training/kitchen_0064spp.hdr.exr",
    )
    sequence = open_sequence(tmp_path / "training")
    # Each name is a still of its own.
    assert (sequence.layout, sequence.numbers, sequence.reference_numbers) == ("oidn", [0, 1], [1])
    assert sequence.buffers == {"color", "albedo", "normal"}
    frame = sequence.frame(1)
    # The fewest samples are denoised, the most are the reference.
    assert (float(frame.color[0, 0, 0, 0]), float(frame.reference[0, 0, 0, 0])) == (4, 7)
    (tmp_path / "out").mkdir()
    written = [sequence.write(tmp_path / "out", number, np.ones((*SIZE, 3), np.float32)).name for number in (0, 1)]
    assert written == ["bath_0008spp.hdr.exr", "kitchen_0008spp.hdr.exr"]
    alone = open_sequence(tmp_path / "training" / "bath_*.exr")
    assert (alone.layout, alone.numbers) == ("oidn", [0])


def test_a_buffer_that_some_frames_lack_is_told(image: Callable[..., list[Path]], tmp_path: Path) -> None:
    image("a_0001.exr", "a_0002.exr", "a_0003.exr", "a_albedo_0001.exr", "a_albedo_0003.exr")
    message = refused(open_sequence, tmp_path)
    assert "a_albedo_####.exr: expected buffer 'albedo' for every frame, found none for frame 2" in message
    assert "leave the buffer out with --map albedo=" in message
    assert open_sequence(tmp_path, mapping=["albedo="]).buffers == {"color"}
    assert open_sequence(tmp_path, "1,3").buffers == {"color", "albedo"}
