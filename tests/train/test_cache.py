"""The cache of decoded sequences: what it holds is what the files hold, and it is never stale and never half made."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from mcdenoise.data import cache, open_sequence
from mcdenoise.data.bmfr import write_buffer
from mcdenoise.data.cache import CachedSequence, open_cached
from mcdenoise.data.clips import Clip
from mcdenoise.data.exr import read_exr, write_exr
from mcdenoise.data.sequences import Sequence
from mcdenoise.errors import InputError
from mcdenoise.history import History
from mcdenoise.ops import Accumulate


@pytest.fixture
def noisy(small_sequence: Path) -> Path:
    """The small sequence with two more realisations of its noise."""
    inputs = small_sequence / "inputs"
    for realisation in (1, 2):
        folder = inputs / f"realisation{realisation}"
        folder.mkdir()
        for number in range(4):
            torch.manual_seed(10 * realisation + number)
            write_buffer(folder, number, "color", torch.rand(1, 3, 20, 24))
    return small_sequence


@pytest.fixture
def reads(monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, int]]:
    """Frame number and realisation of every frame that is decoded."""
    read, seen = Sequence.frame, []

    def spy(sequence: Sequence, number: int, reference: bool = True, realisation: int = 0) -> Any:
        seen.append((number, realisation))
        return read(sequence, number, reference, realisation)

    monkeypatch.setattr(Sequence, "frame", spy)
    return seen


def opened(path: Path, folder: Path, **changes: Any) -> CachedSequence:
    settings: dict[str, Any] = {"alpha_min": 0.1, "firsts": [0, 2], **changes}
    return open_cached(open_sequence(path), folder, **settings)


def entries(folder: Path) -> list[str]:
    """Every file of a cache, without the locks."""
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file() and path.name != "lock")


def test_shots_start_anew_and_are_accumulated(noisy: Path, tmp_path: Path) -> None:
    cached, sequence = opened(noisy, tmp_path / "cache"), open_sequence(noisy)
    assert [(len(shot), len(shot.colors), shot.size) for shot in cached.shots] == [(4, 3, (20, 24)), (2, 3, (20, 24))]
    for first, shot in zip((0, 2), cached.shots, strict=True):
        for realisation in range(3):
            clip = Clip.from_stack(shot.read(realisation=realisation)[None])
            history = History(Accumulate(0.1))
            for i, number in enumerate(sequence.numbers[first:]):
                frame = sequence.frame(number, realisation=realisation).validate()[0]
                assert torch.equal(clip.color[0, i], history.update(frame).color[0])
                for name in ("albedo", "normal", "depth", "reference"):
                    assert torch.equal(getattr(clip, name)[0, i], getattr(frame, name)[0]), name


def test_a_part_of_a_shot(noisy: Path, tmp_path: Path) -> None:
    shot = opened(noisy, tmp_path / "cache").shots[0]
    whole = shot.read(realisation=1)
    part = shot.read(slice(1, 3), slice(2, 9), slice(5, 24), realisation=1)
    assert torch.equal(part, whole[1:3, :, 2:9, 5:24])
    assert torch.equal(shot.read(channels=[9, 0], turn=lambda image: image[..., ::-1]), shot.read()[:, [9, 0]].flip(-1))
    assert torch.equal(shot.until(3).read(), shot.read()[:3])
    # The past stays: color was accumulated over the frames before.
    assert torch.equal(shot.last(1).read(), shot.read()[3:])


def test_features_are_kept_once_and_in_half_precision_where_nothing_is_lost(noisy: Path, tmp_path: Path) -> None:
    inputs = noisy / "inputs"
    image, channels, _ = read_exr(inputs / "albedo2.exr")
    write_exr(inputs / "albedo2.exr", image * 0.999 + 1e-5, channels, half=False)
    cached = opened(noisy, tmp_path / "cache")
    arrays = {path.name: np.load(path) for path in (tmp_path / "cache").rglob("*.npy")}
    kinds = {name: (array.dtype.name, array.shape[0]) for name, array in arrays.items()}
    colors = {f"color-{first}-{k}.npy": ("float32", 4 - first) for first in (0, 2) for k in range(3)}
    features = {"normal.npy": ("float16", 4), "reference.npy": ("float16", 4), "albedo.npy": ("float32", 4)}
    assert kinds == {**colors, **features, "depth.npy": ("float16", 4)}
    expected = open_sequence(noisy).frame(2).validate()[0].albedo
    assert expected is not None
    assert torch.equal(cached.shots[0].read()[2, 7:10], expected[0])


def test_what_is_cached_is_not_decoded_again(noisy: Path, tmp_path: Path, reads: list[tuple[int, int]]) -> None:
    first = opened(noisy, tmp_path / "cache")
    assert sorted(reads) == [(number, realisation) for number in range(4) for realisation in range(3)]
    reads.clear()
    started = time.process_time()
    again = opened(noisy, tmp_path / "cache")
    assert time.process_time() - started < 0.5
    assert not reads
    assert again.sha256 == first.sha256
    assert torch.equal(again.shots[1].read(realisation=2), first.shots[1].read(realisation=2))


def test_fewer_realisations(noisy: Path, tmp_path: Path, reads: list[tuple[int, int]]) -> None:
    assert len(opened(noisy, tmp_path / "cache", realisations=1).shots[0].colors) == 1
    assert {realisation for _, realisation in reads} == {0}
    assert len(opened(noisy, tmp_path / "cache", realisations=9).shots[0].colors) == 3


@pytest.mark.parametrize(
    "change",
    [
        lambda inputs: write_exr(inputs / "color1.exr", np.ones((20, 24, 3), np.float32), ["R", "G", "B"]),
        lambda inputs: os.utime(inputs / "reference0.exr", (1, 1)),
        lambda inputs: os.utime(inputs / "realisation2" / "color3.exr", (1, 1)),
        lambda inputs: (inputs / "camera.json").write_text('{"color_includes_albedo": false}'),
        lambda inputs: (inputs / "realisation2" / "color3.exr").unlink(),
    ],
    ids=["content", "time", "time of a realisation", "description", "a realisation less"],
)
def test_a_stale_cache_is_made_again(noisy: Path, tmp_path: Path, reads: list[tuple[int, int]], change: Any) -> None:
    folder = tmp_path / "cache"
    opened(noisy, folder)
    before, _ = entries(folder), reads.clear()
    change(noisy / "inputs")
    fresh = opened(noisy, tmp_path / "elsewhere")
    again = opened(noisy, folder)
    assert len(reads) in (16, 24)  # twice four frames, two or three realisations
    assert again.sha256 == fresh.sha256
    assert torch.equal(again.shots[0].read(), fresh.shots[0].read())
    # What is stale is removed.
    assert not set(entries(folder)) & set(before)


def test_every_nth_realisation_keeps_its_fireflies(noisy: Path, tmp_path: Path) -> None:
    for realisation in (0, 1):
        folder = noisy / "inputs" / (f"realisation{realisation}" if realisation else "")
        bright = np.ones((20, 24, 3), np.float32)
        bright[10, 10] = 1e4
        write_exr(folder / "color0.exr", bright, ["R", "G", "B"])
        write_exr(folder / "albedo0.exr", np.ones((20, 24, 3), np.float32), ["R", "G", "B"])
    brightest = [
        opened(noisy, tmp_path / "cache", keep_fireflies=n).shots[0].read(realisation=k)[0, :6].amax((1, 2)).tolist()
        for n in (0, 2)
        for k in (0, 1)
    ]
    assert brightest == [[15.0] * 6, [15.0] * 6, [15.0] * 6, [120.0] * 6]


@pytest.mark.parametrize("changes", [{"alpha_min": 0.2}, {"firsts": [0, 1]}, {"firsts": [0]}, {"keep_fireflies": 1}])
def test_other_settings_have_their_own_place(
    small_sequence: Path, tmp_path: Path, reads: list[tuple[int, int]], changes: dict[str, Any]
) -> None:
    opened(small_sequence, tmp_path / "cache")
    other = opened(small_sequence, tmp_path / "cache", **changes)
    assert torch.equal(other.shots[-1].read(), opened(small_sequence, tmp_path / "new", **changes).shots[-1].read())
    reads.clear()
    opened(small_sequence, tmp_path / "cache")
    assert not reads


def test_another_version_of_the_code_makes_it_again(
    small_sequence: Path, tmp_path: Path, reads: list[tuple[int, int]], monkeypatch: pytest.MonkeyPatch
) -> None:
    opened(small_sequence, tmp_path / "cache")
    reads.clear()
    monkeypatch.setattr(cache, "_code", lambda: b"another")
    opened(small_sequence, tmp_path / "cache")
    assert len(reads) == 4


@pytest.mark.parametrize("name", ["color-0-0.npy", "albedo.npy", "about.json"])
@pytest.mark.parametrize("damage", ["cut", "empty", "removed", "other"])
def test_a_damaged_cache_is_made_again(small_sequence: Path, tmp_path: Path, name: str, damage: str) -> None:
    whole = opened(small_sequence, tmp_path / "cache").shots[0].read()
    path = next((tmp_path / "cache").rglob(name))
    content = path.read_bytes()
    if damage == "removed":
        path.unlink()
    else:
        path.write_bytes({"cut": content[:-20], "empty": b"", "other": b"[1, 2, 3]"}[damage])
    assert torch.equal(opened(small_sequence, tmp_path / "cache").shots[0].read(), whole)
    assert path.read_bytes() == content


def test_a_pickle_is_never_loaded(small_sequence: Path, tmp_path: Path) -> None:
    whole = opened(small_sequence, tmp_path / "cache").shots[0].read()
    path = next((tmp_path / "cache").rglob("depth.npy"))
    with path.open("wb") as file:
        # An array of Python objects; loading it would run what follows.
        np.lib.format.write_array_header_1_0(file, {"descr": "|O", "fortran_order": False, "shape": (4, 1, 20, 24)})
        file.write(b"cos\nabort\n(tR.")
    assert torch.equal(opened(small_sequence, tmp_path / "cache").shots[0].read(), whole)


def test_a_damaged_frame_leaves_nothing_half_made(small_sequence: Path, tmp_path: Path) -> None:
    inputs = small_sequence / "inputs"
    image, channels, _ = read_exr(inputs / "albedo3.exr")
    image[4, 5] = np.nan
    write_exr(inputs / "albedo3.exr", image, channels)
    with pytest.raises(InputError, match=r"plane, frame 3: buffer 'albedo': expected finite values"):
        opened(small_sequence, tmp_path / "cache")
    assert entries(tmp_path / "cache") == []


def run_python(code: str, *arguments: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", textwrap.dedent(code), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def test_a_full_disk_leaves_nothing_half_made(small_sequence: Path, tmp_path: Path) -> None:
    # The system refuses files longer than 8 kB, as it refuses to write to a full disk.
    code = """
        import resource, sys
        from pathlib import Path
        from mcdenoise.data import open_sequence
        from mcdenoise.data.cache import open_cached
        from mcdenoise.errors import InputError
        resource.setrlimit(resource.RLIMIT_FSIZE, (8192, 8192))
        try:
            open_cached(open_sequence(Path(sys.argv[1])), Path(sys.argv[2]), alpha_min=0.1, firsts=[0])
        except InputError as error:
            print(error)
    """
    result = run_python(code, small_sequence, tmp_path / "cache")
    assert result.returncode == 0, result.stderr
    assert "the cache of decoded frames cannot be written (File too large)" in result.stdout
    assert result.stdout.count("\n") == 1
    assert entries(tmp_path / "cache") == []
    assert len(opened(small_sequence, tmp_path / "cache", firsts=[0]).shots[0]) == 4


def test_a_killed_process_leaves_nothing_that_is_taken_for_whole(small_sequence: Path, tmp_path: Path) -> None:
    code = """
        import os, signal, sys
        from pathlib import Path
        from mcdenoise.data import cache, open_sequence
        write = cache._smallest
        def killed(values):
            os.kill(os.getpid(), signal.SIGKILL)
        cache._smallest = killed
        cache.open_cached(open_sequence(Path(sys.argv[1])), Path(sys.argv[2]), alpha_min=0.1, firsts=[0, 2])
    """
    assert run_python(code, small_sequence, tmp_path / "cache").returncode == -signal.SIGKILL
    left = entries(tmp_path / "cache")
    assert left
    assert all("building" in name for name in left)
    whole = opened(small_sequence, tmp_path / "new").shots[0].read()
    assert torch.equal(opened(small_sequence, tmp_path / "cache").shots[0].read(), whole)
    assert not any("building" in name for name in entries(tmp_path / "cache"))


def test_two_processes_fill_a_cache_once(small_sequence: Path, tmp_path: Path) -> None:
    code = """
        import sys
        from pathlib import Path
        from mcdenoise.data import open_sequence
        from mcdenoise.data.cache import open_cached
        from mcdenoise.data.sequences import Sequence
        read, seen = Sequence.frame, []
        Sequence.frame = lambda *a, **k: seen.append(1) or read(*a, **k)
        cached = open_cached(open_sequence(Path(sys.argv[1])), Path(sys.argv[2]), alpha_min=0.1, firsts=[0, 2])
        print(len(seen), cached.sha256)
    """
    command = [sys.executable, "-c", textwrap.dedent(code), str(small_sequence), str(tmp_path / "cache")]
    running = [subprocess.Popen(command, stdout=subprocess.PIPE, text=True) for _ in range(2)]
    outputs = [process.communicate()[0].split() for process in running]
    assert sorted(int(count) for count, _ in outputs) == [0, 4]
    assert len({sha for _, sha in outputs}) == 1


def test_a_folder_that_cannot_be_written(small_sequence: Path, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(InputError, match="the cache of decoded frames cannot be written"):
        opened(small_sequence, tmp_path / "file" / "cache")


def test_the_checksum_is_that_of_the_images(small_sequence: Path, tmp_path: Path) -> None:
    """The same whatever the settings, so that it says which data a run saw and nothing else."""
    first = opened(small_sequence, tmp_path / "cache").sha256
    assert opened(small_sequence, tmp_path / "cache", alpha_min=0.5, firsts=[0]).sha256 == first
    about = json.loads(next((tmp_path / "cache").rglob("about.json")).read_text())
    assert about == {"sha256": first}
