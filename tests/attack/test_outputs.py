"""Outputs that exist already or cannot be written to, and full disks."""

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from attacker import Attacker, names, of_lines, unreadable
from mutations import PLACES
from table import COMMANDS, SLOW

pytestmark = [pytest.mark.attack, pytest.mark.timeout(1800)]

NOBODY = 65534


def link_to(target: str) -> Callable[[Path], None]:
    def put(path: Path) -> None:
        path.symlink_to(os.path.relpath(path.parent.resolve().joinpath(target), path.parent.resolve()))

    put.__name__ = f"link_to_{target}"
    return put


def put_full(path: Path) -> None:
    path.symlink_to("/dev/full")


def put_text(path: Path) -> None:
    path.write_text("somebody's own")


# Paths of outputs, with what may exist there already.
STANDING = {
    "out": [link_to("shot/inputs"), link_to("shot"), link_to("layers"), put_full, put_text],
    "out/denoised0.exr": [
        link_to("../shot/inputs/color0.exr"),
        link_to("../shot/inputs/albedo0.exr"),
        put_full,
        put_text,
    ],
    "out/shot0.exr": [link_to("../layers/shot0.exr"), link_to("../layers/shot1.exr"), put_full, put_text],
    "out/denoise.json": [link_to("../shot/inputs/camera.json"), put_full, put_text],
    "out/preview": [link_to("../shot/inputs"), put_full, put_text],
    "out/preview.mp4": [link_to("../shot/inputs/color0.exr"), put_full, put_text],
    "figures.json": [link_to("shot/inputs/camera.json"), link_to("layers/shot0.exr"), put_full, put_text],
    "figures": [put_text],
}
LINES = {
    "denoise": "denoise shot -o out --model joint_bilateral --json figures.json --preview",
    "denoise layers": "denoise layers -o out --model joint_bilateral --json figures.json",
    "denoise, json in a folder": "denoise shot -o out --model joint_bilateral --json figures/figures.json",
    "inspect": "inspect shot --json figures.json",
    "inspect layers": "inspect layers --json figures.json",
    "evaluate": "evaluate shot done --json figures.json",
}


@pytest.mark.parametrize("command", LINES)
def test_existing_outputs(attacker: Attacker, command: str) -> None:
    """Inputs are never overwritten, under any name, and outputs are rejected before any frame is denoised."""
    failed, line = [], LINES[command].split()
    for place, own in STANDING.items():
        # Skip outputs that the command does not write.
        if not place.startswith(("figures", "out") if "-o" in line else "figures"):
            continue
        for put in [*PLACES, *own]:
            folder = attacker.fresh(("shot", "layers"))
            (folder / "done").symlink_to(attacker.world / "out")
            (folder / place).parent.mkdir(exist_ok=True)
            put(folder / place)
            ended = attacker.run(line, folder)
            problem = of_lines(COMMANDS[command.split(",")[0]], ended)
            problem = problem or attacker.touched(folder, tuple(line[1:2]))
            written = [name for name in names(folder) if name.startswith("out/") and name != place]
            if not problem and ended.status == 2 and place.startswith("figures") and written:
                problem = f"--json is rejected after the work: {written}"
            if not problem and ended.status == 0 and not (folder / place).is_symlink():
                problem = unreadable(folder / "out", place)
            failed += attacker.count("outputs", problem, f"{command}, {place}: {put.__name__}", folder)
    assert not failed, "\n".join(failed)


@pytest.mark.parametrize("name", ["denoise", "denoise layers", "denoise again", "film", "train"])
def test_full_disk(attacker: Attacker, name: str) -> None:
    """With a limited file size no incomplete files are left, and running again without the limit succeeds."""
    failed, command, g = [], COMMANDS[name], np.random.default_rng(0)
    attacker.expected(name)
    limits = g.integers(1, 400_000 if name == "train" else 2500, 4 if name in SLOW else 12)
    for limit in map(int, limits):
        folder = attacker.fresh(command.needs)
        # Discard the output, whose file has the same limit.
        ended = attacker.run(command.command, folder, largest_file=max(limit, 700), stdout="/dev/null")
        problem = attacker.judge(name, folder, ended, same=False)
        if not problem:
            again = attacker.run(command.command, folder)
            problem = attacker.judge(name, folder, again, same=True, needed=True)
        failed += attacker.count("outputs", problem, f"{name}, {limit} bytes", folder)
    assert not failed, "\n".join(failed)


@pytest.mark.skipif(os.geteuid() != 0, reason="takes the rights of another user")
@pytest.mark.parametrize("name", ["denoise", "denoise again", "denoise layers", "train", "report", "inspect"])
def test_a_folder_of_another_user(attacker: Attacker, name: str) -> None:
    failed, command = [], COMMANDS[name]
    for place in ("out", "run", "results", "shot/inputs", "layers", "."):
        for mode in (0o700, 0o755, 0o1777):
            folder = attacker.fresh(command.needs)
            folder.chmod(0o777)
            if not (folder / place).exists():
                (folder / place).mkdir(parents=True)
            (folder / place).chmod(mode)
            ended = attacker.run(command.command, folder, user=NOBODY)
            problem = attacker.judge(name, folder, ended, same=False)
            failed += attacker.count("outputs", problem, f"{name}, {place} of mode {mode:o}", folder)
    assert not failed, "\n".join(failed)
