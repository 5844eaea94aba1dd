"""The pages of docs/ do what they say: their code runs, block after block, in an empty folder."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any

import pytest

from mcdenoise.cli import COMMANDS

DOCS = Path(__file__).resolve().parents[1] / "docs"
PAGES = ("bring-your-own-model.md", "bring-your-own-op.md")
FILES = {"bring-your-own-model.md": "mine", "bring-your-own-op.md": "my_ops"}


def blocks(page: str, language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", (DOCS / page).read_text(), re.DOTALL)


@pytest.mark.parametrize("page", PAGES)
def test_code_of_a_page_runs(page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    first, *others = blocks(page, "python")
    name = FILES[page]
    assert first.startswith(f"# {name}.py\n")
    (tmp_path / f"{name}.py").write_text(first)
    # A module of that name may be there from another test.
    monkeypatch.delitem(sys.modules, name, raising=False)
    assert others
    for number, block in enumerate(others):
        exec(compile(block, f"{page}, block {number + 1}", "exec"), {"__name__": "page"})
    sys.modules.pop(name, None)


def test_code_for_those_who_come_from_oidn_runs() -> None:
    pytest.importorskip("pyoidn", reason="Open Image Denoise is in the extra mcdenoise[oidn]")
    found: dict[str, Any] = {"__name__": "page"}
    steady, opened = blocks("from-oidn.md", "python")
    exec(compile(steady, "from-oidn.md", "exec"), found)
    assert found["clean"].shape == found["image"].shape == (72, 128, 3)
    exec(compile(opened, "from-oidn.md", "exec"), found)
    assert found["color"].grad.isfinite().all()


@pytest.mark.parametrize("page", [*PAGES, "from-oidn.md", "film.md"])
def test_commands_of_a_page_exist(page: str) -> None:
    lines = [line for block in blocks(page, "sh") for line in block.splitlines() if line.strip()]
    commands = [line.split()[1] for line in lines if not line.startswith("pip ")]
    assert commands
    assert set(commands) <= set(COMMANDS)


def test_the_file_of_twenty_lines_has_about_that_many() -> None:
    lines = [line for line in blocks("bring-your-own-model.md", "python")[0].splitlines() if line.strip()]
    assert len(lines) <= 20
