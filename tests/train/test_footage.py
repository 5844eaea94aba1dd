"""Shots of sequences and takes: what is cached is what the files hold, and it is never stale and never half made."""

import os
import time
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from refusals import full_disk
from toys import Watching

from mcdenoise.data import Sequence, open_sequence
from mcdenoise.data.exr import read_exr, write_exr
from mcdenoise.data.readers.bmfr import write_buffers
from mcdenoise.data.shards import Shard, open_shard, write_shard
from mcdenoise.errors import InputError
from mcdenoise.frame import Frame
from mcdenoise.models import Accumulated, Demodulated
from mcdenoise.ops import motion_from_position
from mcdenoise.train.clips import ClipSampler
from mcdenoise.train.config import TrainConfig
from mcdenoise.train.footage import features_of, shots_of
from mcdenoise.train.front import Front
from mcdenoise.train.shots import Shot

FEATURES = ("albedo", "normal", "depth")
FRONT = Front(((Demodulated, {}), (Accumulated, {})))


@pytest.fixture
def noisy(small_sequence: Path) -> Path:
    """The small sequence with two more noise seeds."""
    inputs = small_sequence / "inputs"
    for noise_seed in (1, 2):
        folder = inputs / f"noise_seed{noise_seed}"
        folder.mkdir()
        for number in range(4):
            torch.manual_seed(10 * noise_seed + number)
            write_buffers(folder, number, {"color": torch.rand(1, 3, 20, 24)})
    return small_sequence


@pytest.fixture
def noisy_features(noisy: Path) -> Path:
    """The same, with albedo and position of each noise seed's own samples; normals are the same for all."""
    inputs, positions = noisy / "inputs", [open_sequence(noisy).frame(number).position for number in range(4)]
    for noise_seed in (1, 2):
        for number, position in enumerate(positions):
            torch.manual_seed(100 * noise_seed + number)
            folder = inputs / f"noise_seed{noise_seed}"
            write_buffers(folder, number, {"albedo": 0.2 + 0.7 * torch.rand(1, 3, 20, 24)})
            write_buffers(folder, number, {"position": position + 0.01 * torch.rand(1, 3, 20, 24)})
    return noisy


@pytest.fixture
def reads(monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, int]]:
    read, seen = Sequence.frame, []

    def spy(sequence: Sequence, number: int, reference: bool = True, noise_seed: int = 0, **options: Any) -> Any:
        seen.append((number, noise_seed))
        return read(sequence, number, reference, noise_seed, **options)

    monkeypatch.setattr(Sequence, "frame", spy)
    return seen


def opened(path: Path, folder: Path, front: Front = FRONT, features: Iterable[str] = FEATURES) -> list[Shot]:
    return shots_of(open_sequence(path), front, frozenset(features), 2, folder, start_every=2)[0]


def digest(path: Path, folder: Path) -> str:
    return shots_of(open_sequence(path), FRONT, frozenset(FEATURES), 2, folder, start_every=2)[1]


def pixels(shots: list[Shot]) -> torch.Tensor:
    return torch.cat(list(shots[0].read().values()), 1)


def entries(folder: Path) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())


def test_shots_start_anew_and_are_accumulated(noisy: Path, tmp_path: Path) -> None:
    shots, sequence = opened(noisy, tmp_path / "cache"), open_sequence(noisy)
    assert [(len(shot), shot.noise_seeds, shot.size) for shot in shots] == [(4, 3, (20, 24)), (2, 3, (20, 24))]
    for first, shot in zip((0, 2), shots, strict=True):
        for noise_seed in range(3):
            clip = shot.read(noise_seed=noise_seed)
            watching, history = Watching(), None
            model = Demodulated(Accumulated(watching))
            for i, number in enumerate(sequence.numbers[first:]):
                frame = sequence.frame(number, noise_seed=noise_seed).validate()[0]
                _, history = model(frame, history)
                for name in ("color", "current", "length"):
                    assert torch.equal(clip[name][i], watching.frames[i].buffer(name)[0]), name
                for name in (*FEATURES, "reference"):
                    assert torch.equal(clip[name][i], frame.buffer(name)[0]), name
            assert (clip["length"][-1] > 1).any()


def test_motion_of_positions_and_cameras(noisy: Path, tmp_path: Path) -> None:
    sequence = open_sequence(noisy)
    assert features_of(sequence) == {*FEATURES, "position", "view_projection", "motion"}
    clip = opened(noisy, tmp_path / "cache", features=["motion", "view_projection"])[0].read()
    frames = [sequence.frame(number) for number in sequence.numbers]
    assert clip["motion"][0].isinf().all()
    for i in (1, 2, 3):
        expected = motion_from_position(frames[i].position, frames[i - 1].view_projection)
        assert torch.equal(clip["motion"][i], expected[0])
        assert torch.equal(clip["view_projection"][i], frames[i].view_projection[0])
    assert clip["motion"][1].abs().median() > 0.1
    inputs = noisy / "inputs"
    for number in sequence.numbers:
        write_buffers(inputs, number, {"motion": torch.full((1, 2, 20, 24), 1.5)})
    # The sequence's own comes first.
    own = opened(noisy, tmp_path / "cache", features=["motion"])[1].read()
    assert (own["motion"] == 1.5).all()


def test_cached_frames_are_not_decoded_again(noisy: Path, tmp_path: Path, reads: list[tuple[int, int]]) -> None:
    first = opened(noisy, tmp_path / "cache")
    assert sorted(reads) == [(number, noise_seed) for number in range(4) for noise_seed in range(3)]
    reads.clear()
    started = time.process_time()
    again = opened(noisy, tmp_path / "cache")
    assert time.process_time() - started < 0.5
    assert not reads
    assert torch.equal(again[1].read(noise_seed=2)["color"], first[1].read(noise_seed=2)["color"])


def test_features_with_noise_are_those_of_the_noise_seed(noisy_features: Path, tmp_path: Path) -> None:
    names = ("albedo", "normal", "depth", "motion")
    shots, sequence = opened(noisy_features, tmp_path / "cache", features=names), open_sequence(noisy_features)
    assert sequence.noisy >= {"color", "albedo", "position"}
    assert not sequence.noisy & {"normal", "reference", "view_projection"}
    whole = shots[0]
    for shot, first in ((whole, 0), (shots[1], 2), (whole.cut(slice(1, 3)), 1)):
        for noise_seed in range(3):
            clip = shot.read(noise_seed=noise_seed)
            for i in range(len(shot)):
                frame = sequence.frame(first + i, noise_seed=noise_seed).validate()[0].with_depth()
                for name in ("albedo", "normal", "depth"):
                    assert torch.equal(clip[name][i], dict(frame.items())[name][0])
                if first + i > 0:
                    camera = sequence.frame(first + i - 1).view_projection
                    moved = motion_from_position(frame.position, camera)
                    assert torch.equal(clip["motion"][i], moved[0])
    differ = [not torch.equal(whole.read()[name], whole.read(noise_seed=1)[name]) for name in names]
    assert differ[0]
    assert not differ[1]
    assert differ[3]
    files = entries(tmp_path / "cache")
    assert sum("normal" in name for name in files) == 1
    assert sum("albedo" in name for name in files) == 3


@pytest.mark.parametrize(
    "change",
    [
        lambda inputs: write_exr(inputs / "color1.exr", np.ones((20, 24, 3), np.float32), ["R", "G", "B"]),
        lambda inputs: os.utime(inputs / "noise_seed2" / "color3.exr", (1, 1)),
        lambda inputs: (inputs / "camera.json").write_text('{"color_includes_albedo": false}'),
        lambda inputs: (inputs / "noise_seed2" / "color3.exr").unlink(),
    ],
    ids=["content", "time of a noise seed", "description", "a noise seed less"],
)
def test_a_stale_cache_is_made_again(noisy: Path, tmp_path: Path, reads: list[tuple[int, int]], change: Any) -> None:
    folder = tmp_path / "cache"
    opened(noisy, folder)
    size, _ = len(entries(folder)), reads.clear()
    change(noisy / "inputs")
    fresh = opened(noisy, tmp_path / "elsewhere")
    again = opened(noisy, folder)
    assert len(reads) in (16, 24)  # twice four frames, two or three noise seeds
    assert digest(noisy, folder) == digest(noisy, tmp_path / "elsewhere")
    assert torch.equal(again[0].read()["color"], fresh[0].read()["color"])
    # It takes the place of what was stale.
    assert len(entries(folder)) <= size


@pytest.mark.parametrize(
    ("name", "damage"),
    [
        ("from0-0/color.npy", "cut"),
        ("frames/albedo-0.npy", "removed"),
        ("frames/about.json", "other"),
        ("frames/normal-0.npy", "bit"),
    ],
)
def test_a_damaged_cache_is_made_again(
    small_sequence: Path, tmp_path: Path, reads: list[tuple[int, int]], name: str, damage: str
) -> None:
    whole = pixels(opened(small_sequence, tmp_path / "cache"))
    path, frames = next((tmp_path / "cache").glob(f"*/{name}")), len(reads)
    content = path.read_bytes()
    flipped = bytearray(content)
    flipped[-5] ^= 4
    if damage == "removed":
        path.unlink()
    else:
        path.write_bytes({"cut": content[:-20], "other": b"[1, 2, 3]", "bit": flipped}[damage])
    assert torch.equal(pixels(opened(small_sequence, tmp_path / "cache")), whole)
    assert len(reads) == frames * (2 if "frames" in name else 1)
    assert path.read_bytes() == content


def test_a_pickle_is_never_loaded(small_sequence: Path, tmp_path: Path) -> None:
    whole = pixels(opened(small_sequence, tmp_path / "cache"))
    path = next((tmp_path / "cache").rglob("depth-0.npy"))
    with path.open("wb") as file:
        # An array of Python objects; loading it would run what follows.
        np.lib.format.write_array_header_1_0(file, {"descr": "|O", "fortran_order": False, "shape": (4, 1, 20, 24)})
        file.write(b"cos\nabort\n(tR.")
    assert torch.equal(pixels(opened(small_sequence, tmp_path / "cache")), whole)


def test_a_damaged_frame_leaves_nothing_half_made(small_sequence: Path, tmp_path: Path) -> None:
    inputs = small_sequence / "inputs"
    image, channels, _ = read_exr(inputs / "albedo3.exr")
    image[4, 5] = np.nan
    write_exr(inputs / "albedo3.exr", image, channels)
    with pytest.raises(InputError, match=r"plane, frame 3: buffer 'albedo':"):
        opened(small_sequence, tmp_path / "cache")
    assert entries(tmp_path / "cache") == []


def test_a_full_disk_leaves_nothing_half_made(small_sequence: Path, tmp_path: Path) -> None:
    with full_disk(8192), pytest.raises(InputError, match="cannot be written"):
        opened(small_sequence, tmp_path / "cache")
    assert entries(tmp_path / "cache") == []
    assert len(opened(small_sequence, tmp_path / "cache")[0]) == 4


def test_two_at_once_fill_a_cache_once(small_sequence: Path, tmp_path: Path, reads: list[tuple[int, int]]) -> None:
    with ThreadPoolExecutor(2) as pool:
        found = list(pool.map(lambda folder: pixels(opened(small_sequence, folder)), [tmp_path / "cache"] * 2))
    assert len(reads) == 4
    assert torch.equal(*found)


def test_links_to_nothing_and_names_that_are_no_text_are_no_part_of_a_sequence(noisy: Path, tmp_path: Path) -> None:
    """Broken and circular links beside the frames do not prevent training on the frames."""
    first = digest(noisy, tmp_path / "cache")
    for folder in (noisy, noisy / "inputs", noisy / "inputs" / "noise_seed1"):
        for suffix in (".exr", ".json", ".h"):
            (folder / f"dangling{suffix}").symlink_to("nothing")
            (folder / f"loop{suffix}").symlink_to(f"loop{suffix}")
            Path(os.fsdecode(os.fsencode(folder) + b"/M\xfcller" + suffix.encode())).touch()
    assert digest(noisy, tmp_path / "other") == first


SIZE = (12, 20)
ALBEDO = frozenset({"albedo"})
HISTORY = Front(((Demodulated, {}), (Accumulated, {"alpha_min": 0.03})))


def take(folder: Path, frames: int = 8, references: int = 3, void: int = 0) -> Shard:
    draws = np.random.default_rng(frames)
    arrays = {name: draws.random((frames, 3, *SIZE)) for name in ("color", "albedo", "normal")}
    arrays |= {"motion": np.zeros((frames, 2, *SIZE)), "depth": np.ones((frames, 1, *SIZE))}
    arrays["reference"] = draws.random((references, 3, *SIZE))
    arrays["reference_error"] = draws.random((references, 3, *SIZE))
    if void:
        arrays["alpha"] = np.ones((frames, 1, *SIZE))
        for name in ("color", "albedo", "normal", "alpha", "reference"):
            arrays[name][..., :void] = 0
    path = folder / f"{frames}.take.npz"
    write_shard(path, {}, arrays)
    return open_shard(path)


def accumulated(shard: Shard, start: int) -> torch.Tensor:
    """The radiance of the last three frames with a history from this frame on."""
    step, found = HISTORY.begin(), []
    arrays = {name: array for name, array in shard.read().items() if len(array) == len(shard)}
    for t in range(start, len(shard)):
        images = {n: torch.from_numpy(array[t : t + 1].astype(np.float32)) for n, array in arrays.items()}
        found.append(step(Frame(**images).validate()[0]).color)
    return torch.cat(found[-3:])


def test_the_frames_that_are_kept_have_the_history_of_all(tmp_path: Path) -> None:
    shard = take(tmp_path)
    whole, later = shots_of(shard, HISTORY, ALBEDO, 3, tmp_path / "cache", start_every=2)[0]
    assert [len(whole), whole.references] == [3, 3]
    second = 11 - int(later.read()["length"].max()) - 3
    assert second in (2, 4)
    for shot, start in ((whole, 0), (later, second)):
        read = shot.read()
        assert set(read) == {"color", "current", "recent", "length", "albedo", "reference"}
        torch.testing.assert_close(read["color"], accumulated(shard, start), rtol=1e-3, atol=1e-3)
        part = shot.cut(slice(1, 3)).read(rows=slice(2, 9))
        assert all(torch.equal(part[name], read[name][1:, :, 2:9]) for name in read)
    assert float(whole.read()["length"].max()) == 8


def test_without_a_history_all_frames_are_handed(tmp_path: Path) -> None:
    (shot,) = shots_of(take(tmp_path), Front(), ALBEDO, 3, tmp_path / "cache", start_every=2)[0]
    read = shot.read()
    assert {name: len(images) for name, images in read.items()} == {"color": 8, "albedo": 8, "reference": 3}
    assert "reference" not in shot.cut(slice(2, 4)).read()


def test_a_reference_without_light_in_a_pixel_is_mended_as_a_color_is(tmp_path: Path) -> None:
    arrays = take(tmp_path).read()
    arrays["reference"][:, 1, 2, 3], arrays["color"][0, :, 4, 5] = np.nan, np.inf
    write_shard(tmp_path / "0.take.npz", {}, arrays)
    (shot,), _ = shots_of(open_shard(tmp_path / "0.take.npz"), Front(), frozenset(), 3, tmp_path)
    assert all(image.isfinite().all() for image in shot.read().values())


@pytest.mark.parametrize("front", [Front(), HISTORY], ids=["alone", "accumulated"])
def test_a_clip_of_a_still_has_as_many_parts_of_it(front: Front, tmp_path: Path) -> None:
    sources = take(tmp_path, 1, 1), take(tmp_path, 8, 3)
    shots = [shot for source in sources for shot in shots_of(source, front, ALBEDO, 3, tmp_path / "cache")[0]]
    clip = ClipSampler([shots[0]], TrainConfig(frames=3, crop=8)).draw([1, 2])
    assert clip["color"].shape == clip["reference"].shape == (2, 3, 3, 8, 8)
    assert not torch.equal(clip["color"][:, 0], clip["color"][:, 1])
    assert ClipSampler(shots, TrainConfig(frames=3, crop=8)).draw(range(6))["color"].shape == (6, 3, 3, 8, 8)


@pytest.mark.parametrize("front", [Front(), HISTORY], ids=["alone", "accumulated"])
def test_void_pixels_show_what_is_beside_them_also_in_references(front: Front, tmp_path: Path) -> None:
    """As in a denoiser, which fills them before a method sees a frame."""
    read = shots_of(take(tmp_path, void=6), front, ALBEDO, 3, tmp_path / "cache")[0][0].read()
    for images in (read.get("current", read["color"]), read["albedo"], read["reference"]):
        assert images[..., :6].any()
        assert torch.equal(images[..., :6].flip(-1), images[..., 6:12])
