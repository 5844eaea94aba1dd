"""Names that are difficult for terminals, tables, patterns and file systems, in arguments and in folders."""

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from attacker import Attacker
from table import COMMANDS, SLOW

pytestmark = [pytest.mark.attack, pytest.mark.timeout(1800)]

# Among them a user that there is not: ~ alone is the own folder.
NAMES = [
    *("with space", "line\nbreak", "\x1b[2J\x1b[31mred", "M\udcfcller", "\udcff\udcfe", "-o", "--json"),
    *("*", "?", "%04d", "####", "ä€𝄞", "\u202eabc", "'\"$(id)`", ".hidden", " ", "\x7f", "\x9b31m", "a\tb"),
    *("a:b", "~nobody of this name", "a\\b", "null", "1", "inputs", "color0.exr", "e\u0301", "\r", "#", "{}"),
    *("[a]", "[bold]", "%s%n", "=", ",", "n" * 240, "n" * 255),
]
# Names that are options on a command line, where such a folder must be written as `./-o`.
OPTIONS = {"-o", "--json"}
# Commands by the argument that is replaced by the name.
GIVEN = {
    "shot": ["denoise", "inspect", "evaluate", "train"],
    "layers": ["denoise layers", "inspect layers"],
    "filmed": ["film"],
    "film.toml": ["film"],
    "out": ["denoise", "denoise layers", "evaluate"],
    "weights.safetensors": ["denoise network"],
    "results": ["reader results"],
    "compared": ["benchmark"],
    "generated": ["generate"],
    "still.hdr": ["denoise hdr"],
    "frame0.zip": ["denoise zip"],
    "run": ["train"],
    "recipe.toml": ["reader recipe"],
    "path.json": ["reader camera_path"],
}
EVERY = [(part, command) for part, commands in GIVEN.items() for command in commands]


@pytest.mark.parametrize(("part", "name"), EVERY)
def test_names_on_the_command_line(attacker: Attacker, part: str, name: str) -> None:
    failed, command = [], COMMANDS[name]
    attacker.expected(name)
    # Images, zip files and manifests are recognized by their extension.
    suffix = Path(part).suffix if part.startswith(("still", "frame", "film.")) else ""
    # Slow commands read names as the others do: every third is enough.
    names = NAMES[:: 3 if name in SLOW else 1]
    for given in (each + suffix for each in names if len(os.fsencode(each + suffix)) <= 255):
        if part == "out" and given.endswith(".exr"):
            continue  # that is a file, not a folder
        folder = attacker.fresh(command.needs)
        if (folder / part).exists():
            (folder / part).rename(folder / given)
        if name == "train" and part == "shot":
            # A run stores the name of its data; started again, it ends with the same weights.
            shutil.rmtree(folder / "run")
        # Keep the name of the command or of the reader.
        kept = 2 if command.command[0] == "reader" else 1
        line = [*command.command[:kept], *(given if each == part else each for each in command.command[kept:])]
        ended = attacker.run(line, folder)
        # Rename the result to the expected name.
        if os.path.lexists(folder / given) and not os.path.lexists(folder / part):
            (folder / given).rename(folder / part)
        if suffix and ended.status == 0 and name != "film":
            (written,) = (path for path in (folder / "out").iterdir() if path.name != "denoise.json")
            written.rename(written.with_name(Path(part).stem + written.suffix))
        # The printed text, or the report of the written file, contains the name.
        same = name not in ("inspect", "inspect layers", "evaluate", "reader recipe") and not suffix
        problem = attacker.judge(
            name, folder, ended, same=same, needed=is_text(given) and given.removesuffix(suffix) not in OPTIONS
        )
        failed += attacker.count("hostile names", problem, f"{name}, {part} is {given!r}", folder)
    assert not failed, "\n".join(failed)


@pytest.mark.parametrize("name", ["denoise", "denoise layers", "inspect", "evaluate", "train"])
def test_names_that_are_found(attacker: Attacker, name: str) -> None:
    """Files, folders and links with such names, beside the files that are read."""
    failed, command = [], COMMANDS[name]
    attacker.expected(name)
    place = "layers" if "layers" in command.needs else "shot/inputs"
    made: list[Callable[[Path], object]] = [
        lambda path: path.touch(),
        lambda path: path.mkdir(),
        lambda path: path.symlink_to("nowhere"),
        lambda path: path.symlink_to(path.name),
    ]
    for number, given in enumerate(NAMES):
        given += ("", ".exr", ".json")[number % 3]
        if len(os.fsencode(given)) > 255 or os.path.lexists(attacker.world / place / given) or given == "inputs":
            continue
        folder = attacker.fresh(command.needs)
        path = folder / place / given
        made[number % len(made)](path)
        ended = attacker.run(command.command, folder)
        besides = path.relative_to(folder).as_posix()
        problem = attacker.judge(name, folder, ended, same=False, besides=besides)
        failed += attacker.count("hostile names", problem, f"{name}, beside {given!r} ({number})", folder)
    assert not failed, "\n".join(failed)


def is_text(name: str) -> bool:
    try:
        name.encode()
    except UnicodeEncodeError:
        return False
    return True
