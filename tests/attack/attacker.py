"""Runs attack cases: copies intact files, damages them, runs a command, and judges the result."""

import importlib.util
import os
import re
import shutil
import time
from collections import Counter
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mutations import DAMAGES, PLACES
from server import HUNG, Ended, Process, Server
from table import COMMANDS, FILM, GENERATION, KINDS, RENDERING, SHOWN, Command
from world import build

from mcdenoise.data.exr import read_exr
from mcdenoise.errors import InputError

# Files that commands write; all other files in the folder of a case must not change.
_WRITTEN = re.compile(
    r"(out|filmed|run|rendered|generated|compared|\.cache|\.config|\.triton)(/.*)?|results/(index\.html|plots(/.*)?)|model\.pt2|out\.safetensors|\.output.*"
)
_CHANGING = re.compile(
    r"run/(events\..*|cache/.*)|filmed/(\.film/.*|film_pictures/.*)|results/plots/.*|\.(cache|config|triton)(/.*)?",
    re.DOTALL,
)
_LEFTOVER = re.compile(r"\.mcdenoise-|\.tmp|\.copy\.exr|/building")


class Attacker:
    """Runs cases in folders of ``base``, and counts them and those that failed, by group."""

    def __init__(self, server: Server, base: Path, counts: Counter[tuple[str, str]]) -> None:
        self.server, self.base, self.counts = server, base, counts
        self.world = base / "world"
        self._expected: dict[str, tuple[object, set[str]]] = {}
        self._number = 0
        build(self.world)
        made = [SHOWN, FILM, *([RENDERING, GENERATION] if is_installed("mitsuba") else [])]
        for each in made:
            done = self.run(each.split(), self.world)
            assert done.status == 0, done
        shutil.rmtree(self.world / ".cache", ignore_errors=True)
        self.intact = {path: path.read_bytes() for path in sorted(self.world.rglob("*")) if path.is_file()}

    def run(self, command: list[str], folder: Path, **options: Any) -> Ended:
        (ended,) = self.server.run(Process(command, str(folder), **options))
        return ended

    def fresh(self, needs: tuple[str, ...]) -> Path:
        """A new folder with a copy of some of the world's files."""
        self._number += 1
        folder = self.base / f"case{self._number}"
        folder.mkdir()
        for name in needs:
            source = self.world / name
            if source.is_dir():
                shutil.copytree(source, folder / name)
            else:
                shutil.copy(source, folder / name)
        return folder

    def expected(self, name: str) -> tuple[object, set[str]]:
        """The result of a command on intact files, and the names of all files afterwards."""
        if name not in self._expected:
            command = COMMANDS[name]
            folder = self.fresh(command.needs)
            ended = self.run(command.command, folder, seconds=command.seconds)
            problem = of_lines(command, ended)
            assert ended.status == 0, (name, ended)
            assert not problem, (name, problem)
            assert "warning: " not in ended.err, (name, ended)
            self._expected[name] = command.result(folder, ended.out), names(folder)
            shutil.rmtree(folder)
        return self._expected[name]

    def damaged(self, kind: str, name: str, seeds: range, group: str) -> list[str]:
        """Run cases of a kind of file and a command; returns the failures. The first seeds replace the file."""
        target, command, failed = KINDS[kind], COMMANDS[name], []
        if not is_installed(command.requires):
            pytest.skip(f"{command.requires} is not installed")
        self.expected(name)
        source = min(path for path in self.intact if path.relative_to(self.world).match(target.path))
        place = source.relative_to(self.world)
        for seed in seeds:
            folder = self.fresh(command.needs)
            path = folder / place
            path.unlink()
            same: bool | Callable[[], bool]
            if seed < len(PLACES):
                what: Callable[..., object] = PLACES[seed]
                what(path)
                same = False
            else:
                what = DAMAGES[seed % len(DAMAGES)]
                content = self.intact[source]
                content = what(np.random.default_rng(seed), content)
                path.write_bytes(content)
                # Evaluated lazily, because not every library can read damaged files safely.
                same = partial(_alike, target.meaning, content, self.intact[source])
            ended = self.run(command.command, folder, seconds=command.seconds)
            problem = self.judge(name, folder, ended, same=same, besides=str(place))
            failed += self.count(group, problem, f"{kind}, {name}, seed {seed} ({what.__name__})", folder)
        return failed

    def count(self, group: str, problem: str, words: str, folder: Path) -> list[str]:
        """Count a case; returns a description if it failed."""
        self.counts[group, "cases"] += 1
        shutil.rmtree(folder, ignore_errors=True)
        if not problem:
            return []
        self.counts[group, "failed"] += 1
        return [f"{words}: {problem}"]

    def judge(
        self,
        name: str,
        folder: Path,
        ended: Ended,
        *,
        same: bool | Callable[[], bool],
        besides: str = "",
        needed: bool = False,
    ) -> str:
        """The problem of a case, or an empty string: the result is ``same`` as of intact files, or there is a warning.

        The file ``besides`` was damaged; where the command is ``needed``, it must succeed.
        """
        command, (result, after) = COMMANDS[name], self.expected(name)
        problem = of_lines(command, ended)
        if problem:
            return problem
        if needed and ended.status != 0:
            return f"status {ended.status}: {ended.err}"
        found = names(folder)
        if left := [each for each in found if _LEFTOVER.search(each)]:
            return f"left over: {left}"
        # Writing to a dangling link creates its target.
        followed = {besides, Path(besides).with_name("nothing").as_posix()} if besides else set()
        strange = {each for each in found - after - followed if not _CHANGING.fullmatch(each)}
        if ended.status == 0 and strange:
            return f"unexpected: {sorted(strange)}"
        if problem := self.touched(folder, command.needs, besides):
            return problem
        if problem := unreadable(folder / command.out, besides):
            return problem
        if ended.status == 0:
            try:
                made = command.result(folder, ended.out)
            except (InputError, OSError, ValueError, KeyError) as error:
                return f"status 0, and no result: {error}"
            if made != result and "warning: " not in ended.err and (same if isinstance(same, bool) else same()):
                return "another result, without a warning"
        return ""

    def touched(self, folder: Path, needs: tuple[str, ...], besides: str = "") -> str:
        """An input that was changed, or an empty string."""
        for path, content in self.intact.items():
            place = path.relative_to(self.world).as_posix()
            if place == besides or place.split("/")[0] not in needs or _WRITTEN.fullmatch(place):
                continue
            if not (folder / place).is_file() or (folder / place).read_bytes() != content:
                return f"{place} was changed"
        return ""


def is_installed(module: str) -> bool:
    return not module or importlib.util.find_spec(module) is not None


def names(folder: Path) -> set[str]:
    """All files of a folder, including links."""
    found = set()
    for place, _, files in os.walk(folder):
        found |= {(Path(place) / file).relative_to(folder).as_posix() for file in files}
    return {name for name in found if not name.startswith(".output")}


def unreadable(out: Path, besides: str = "") -> str:
    """An image under a final name that is incomplete or not finite, or an empty string."""
    if not out.is_dir():
        return ""
    for path in sorted(out.glob("[!.]*.exr")):
        if besides.endswith(f"{out.name}/{path.name}"):
            continue
        try:
            image = read_exr(path)[0]
        except InputError as error:
            return f"under a final name: {error}"
        if not np.isfinite(image).all():
            return f"{path.name} is not finite"
    return ""


def of_lines(command: Command, ended: Ended) -> str:
    """The problem with the exit status and the output of a command, or an empty string."""
    if ended.status == HUNG:
        return f"hung; {ended.err[-500:]}"
    lines = [line for line in ended.err.splitlines() if not re.fullmatch(command.progress, line)]
    told = [line for line in lines if not line.startswith("warning: ")]
    shown = ended.err[-1500:]
    if "Traceback" in ended.err or ended.status not in command.statuses:
        return f"status {ended.status}: {shown}"
    if len(told) != (ended.status == 2):
        return f"status {ended.status} and {len(told)} lines on stderr: {shown}"
    if told and not re.match(r"mcdenoise( [a-z]+)?: .", told[0]):
        return f"an unusual line: {shown}"
    for text in (ended.err, ended.out):
        if not all(line.isprintable() for line in text.split("\n")):
            return f"not printable: {text!r}"
    return ""


def _alike(meaning: Callable[[bytes], object], one: bytes, other: bytes) -> bool:
    return _meaning(meaning, one) == _meaning(meaning, other)


def _meaning(meaning: Callable[[bytes], object], content: bytes) -> object:
    try:
        return repr(meaning(content))
    except Exception as error:
        return f"none: {type(error).__name__}"


def aged(folder: Path) -> None:
    """Set the times of all files in a folder to an hour ago, as when a user restarts a command later."""
    for path in folder.rglob("*"):
        os.utime(path, (time.time() - 3600,) * 2, follow_symlinks=False)
