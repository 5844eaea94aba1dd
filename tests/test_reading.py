"""Files that people name, or that lie where one looks for them: whatever they are, nothing waits for ever."""

import functools
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from refusals import put_no_file, refused

from mcdenoise.data import open_sequence
from mcdenoise.data.camera_matrices import read_camera_matrices
from mcdenoise.data.camera_path import load_camera_path
from mcdenoise.methods import parse_method
from mcdenoise.models import create_model, describe_weights
from mcdenoise.own import load_own
from mcdenoise.results import Results
from mcdenoise.train.recipe import Recipe
from mcdenoise.train.run_folder import RunFolder

# Whatever has a name, by that name. A new reader enters here.
READERS: dict[str, Callable[[Path], object]] = {
    "camera_matrices.h": read_camera_matrices,
    "path.json": load_camera_path,
    "recipe.toml": lambda path: Recipe.read(path, ()),
    "results.json": lambda path: Results.read(path.parent),
    "weights.safetensors": describe_weights,
    "given.safetensors": lambda path: create_model("cascaded", weights=path),
    "model.safetensors": lambda path: parse_method(str(path)),
    "archive.tza": lambda path: create_model("oidn_open", archive=str(path)),
    "model.py": lambda path: load_own(f"{path}:model", "model", "factory"),
    "log.jsonl": lambda path: RunFolder(path.parent).errors(),
    "checkpoint.pt": lambda path: RunFolder(path.parent).load(),
}
NO_FILES = ["pipe", "device", "terminal", "folder", "link", "loop", "huge"]


def check_refused(action: Callable[[], object], path: Path) -> None:
    message = refused(action)
    assert str(path) in message


@pytest.mark.timeout(30)
@pytest.mark.parametrize("what", NO_FILES)
@pytest.mark.parametrize("name", READERS)
def test_paths_that_are_no_files_are_refused_in_one_line(name: str, what: str, tmp_path: Path) -> None:
    path = tmp_path / name
    put_no_file(what, path)
    check_refused(functools.partial(READERS[name], path), path)


@pytest.mark.timeout(30)
@pytest.mark.parametrize("what", NO_FILES)
@pytest.mark.parametrize("name", ["camera_matrices.h", "camera.json"])
def test_paths_in_a_sequence_that_are_no_files_are_refused(name: str, what: str, small_sequence: Path) -> None:
    path = small_sequence / "inputs" / name
    put_no_file(what, path)
    check_refused(lambda: open_sequence(small_sequence), path)


HEADER = "camera_matrices[1][4][4] = {{{0,0,0,0},{0,0,0,0},{0,0,0,0},{0,0,0,0}}}; "
# Repeated to any length: texts at which one may look again and again.
PATTERNS = [
    *("camera_matrices[ ", "camera_matrices = ", "camera_matrices pixel_offsets ", "camera_matrices[;"),
    *("/* ", "/**/", "/", "//\n", "{", "{}", " ", '"', '\\"', "\\", ", ", "1", "1.", "+-", "1e", "_"),
    "\0",
]
STARTS = {
    "alone": "",
    "a value": "camera_matrices = {",
    "a number": "camera_matrices = 1",
    "a fraction": "camera_matrices = .1",
    "the last value": HEADER + "pixel_offsets[1][2] = ",
    "a text": '{"a": "',
    "a list": '{"to_world": [',
}
ENDS = ["", "x;", "};", '"}']


def seconds(read: Callable[[Path], object], path: Path, text: str) -> float:
    path.write_text(text)
    start = time.process_time()
    refused(read, path)
    return time.process_time() - start


@pytest.mark.timeout(120)
@pytest.mark.parametrize("read", [read_camera_matrices, load_camera_path])
@pytest.mark.parametrize(
    "start", [pytest.param(each, marks=[pytest.mark.slow] if i else []) for i, each in enumerate(STARTS)]
)
def test_the_time_to_read_a_text_is_that_of_its_length(
    start: str, read: Callable[[Path], object], tmp_path: Path
) -> None:
    path = tmp_path / "text.json"
    for pattern in PATTERNS:
        for end in ENDS:
            # A text that is looked at again at every place would take three seconds and more.
            text = STARTS[start] + pattern * (200_000 // len(pattern)) + end
            assert seconds(read, path, text) < 2, (pattern, end)


LINES = [b'{"first_step": 0}', b'{"step": 10, "validation": {"SMAPE": 0.5}}', b'{"step": 20}']
DAMAGE = [b'{"step": 5', b"\xff\xfe\x00", bytes(100), b'{"step": "\xe4"}', b"[" * 100_000, b"null", b'{"step": null}']


@pytest.mark.usefixtures("no_finalizers")
def test_a_log_goes_on_without_what_is_damaged_in_it(tmp_path: Path) -> None:
    path, run = tmp_path / "log.jsonl", RunFolder(tmp_path)
    for place in range(4):
        for damage in (*DAMAGE, b'{"step": 1e999}', b'{"step": ' + b"9" * 400 + b"}"):
            path.write_bytes(b"".join(line + b"\n" for line in [*LINES[:place], damage, *LINES[place:]]))
            run.rewind(10)
            assert path.read_bytes() == b"".join(line + b"\n" for line in LINES[:2])
            assert run.errors() == {"SMAPE": 0.5}
    for damage in DAMAGE[:-1]:
        path.write_bytes(damage)
        check_refused(run.errors, path)
