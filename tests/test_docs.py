"""The pages of docs/, and the README, do what they say: code runs in an empty folder, commands are understood."""

import importlib
import re
import shlex
import sys
from pathlib import Path
from typing import Any

import pytest

from mcdenoise.check.cases import OPS
from mcdenoise.cli import COMMANDS, parse

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
TEXTS = [*sorted(DOCS.glob("*.md")), *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "training/README.md"))]
# Run by tests of their own, with the files that they need.
ELSEWHERE = {"blender.md", "from-your-renderer.md", "from-oidn.md", "mitsuba.md", "performance.md"}
# Pages with blocks that are files, which later blocks import: their first line is a comment with the file's name.
FILES = {
    "bring-your-own-model.md": ["mine"],
    "bring-your-own-op.md": ["my_ops", "fog", "smooth"],
    # Run by tests/test_export.py, with a graph.
    "for-engines.md": ["run_graph"],
}
# Names that stand for what a reader puts there.
STANDS_FOR = {"SCENE.xml": "scene.xml", "...": "", "N": "1"}


def blocks(page: Path | str, language: str) -> list[str]:
    text = (DOCS / page).read_text(encoding="utf-8")
    return re.findall(rf"^```{language}\n(.*?)^```", text, re.DOTALL | re.MULTILINE)


def commands(path: Path) -> list[str]:
    shell = blocks(path, "(?:sh)?")
    lines = [line.strip() for block in shell for line in block.replace("\\\n", "").splitlines()]
    return [line for line in lines if line.startswith("mcdenoise ")]


CODE = [path for path in TEXTS if blocks(path, "python") and path.name not in ELSEWHERE]
COMMAND_LINES = [(path.name, line) for path in TEXTS for line in commands(path)]


def test_no_page_with_code_is_forgotten() -> None:
    assert {path.name for path in CODE} >= {
        "README.md",
        "for-engines.md",
        "for-researchers.md",
        "layers.md",
        "kornia.md",
        *FILES,
    }
    assert {path.name for path in TEXTS} >= ELSEWHERE


@pytest.mark.parametrize("path", CODE, ids=[path.name for path in CODE])
def test_code_of_a_page_runs(path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    written = []
    for number, block in enumerate(blocks(path, "python")):
        if named := re.match(r"# (\w+)\.py\n", block):
            name = named[1]
            (tmp_path / f"{name}.py").write_text(block)
            # A module of that name may be there from another test.
            monkeypatch.delitem(sys.modules, name, raising=False)
            written.append(name)
        else:
            exec(compile(block, f"{path.name}, block {number + 1}", "exec"), {"__name__": "page"})
    for name in written:
        sys.modules.pop(name, None)
    assert written == FILES.get(path.name, [])


def test_code_for_those_who_come_from_oidn_runs() -> None:
    pytest.importorskip("pyoidn", reason="Open Image Denoise is in the extra mcdenoise[oidn]")
    found: dict[str, Any] = {"__name__": "page"}
    steady, opened = blocks("from-oidn.md", "python")
    exec(compile(steady, "from-oidn.md", "exec"), found)
    assert found["clean"].shape == found["image"].shape == (72, 128, 3)
    exec(compile(opened, "from-oidn.md", "exec"), found)
    assert found["color"].grad.isfinite().all()


def test_code_about_threads_runs_before_torch() -> None:
    """The code runs in a process of its own, since torch is here already."""
    import subprocess

    (code,) = blocks("performance.md", "python")
    subprocess.run([sys.executable, "-c", code], check=True, timeout=300)


@pytest.mark.parametrize(
    ("page", "line"), COMMAND_LINES, ids=[f"{page}-{i}" for i, (page, _) in enumerate(COMMAND_LINES)]
)
def test_a_command_is_understood(page: str, line: str) -> None:
    words = [STANDS_FOR.get(word, word) for word in shlex.split(line, comments=True)]
    _, name, *arguments = [word.removesuffix("...") for word in words if word]
    assert name in COMMANDS, (page, line)
    parse(name, arguments)


def test_every_command_is_in_the_table() -> None:
    named = set(re.findall(r"^\| `mcdenoise ([a-z]+)", (DOCS / "commands.md").read_text(), re.MULTILINE))
    assert named == set(COMMANDS)


@pytest.mark.parametrize("path", TEXTS, ids=[path.name for path in TEXTS])
def test_every_local_link_exists(path: Path) -> None:
    text = re.sub(r"^```.*?^```", "", path.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
    targets = [target for target in re.findall(r"\]\(([^)#\s]+)(?:#[^)\s]*)?\)", text) if "://" not in target]
    assert [target for target in targets if not (path.parent / target).exists()] == []


def test_pages_are_short_enough_to_be_read() -> None:
    words = {path.name: len(path.read_text(encoding="utf-8").split()) for path in DOCS.glob("*.md")}
    assert sum(words.values()) <= 20_000
    assert max(words[f"for-{who}.md"] for who in ("artists", "engines", "researchers")) <= 900
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= 110


def test_every_picture_is_shown() -> None:
    shown = "".join(path.read_text(encoding="utf-8") for path in TEXTS)
    pictures = [path.name for kind in ("png", "svg", "csv") for path in DOCS.rglob(f"*.{kind}")]
    # The errors beside the close-ups are read by the pages of methods.
    assert [name for name in pictures if name not in shown and name != "errors.csv"] == []


def test_every_operator_is_in_the_table_of_kornia_and_every_function_there_exists() -> None:
    text = (DOCS / "kornia.md").read_text()
    rows = [line.strip("| ").split(" | ") for line in text.splitlines() if line.startswith("| `")]
    assert sorted(row[0].strip("`") for row in rows) == sorted(op.name for op in OPS)
    for row in rows:
        for name in re.findall(r"`((?:kornia|torch)\.[\w.]+)`", " ".join(row)):
            module, _, function = name.rpartition(".")
            assert hasattr(importlib.import_module(module), function), name


def test_each_version_of_the_changelog_has_its_sections_once_and_in_order() -> None:
    text = (ROOT / "CHANGELOG.md").read_text()
    versions = re.split(r"^## ", text, flags=re.MULTILINE)[1:]
    assert versions[0].startswith("[Unreleased]")
    for version in versions:
        sections = re.findall(r"^### (\w+)$", version, re.MULTILINE)
        assert sections == [name for name in ("Added", "Changed", "Fixed", "Removed", "Security") if name in sections]
