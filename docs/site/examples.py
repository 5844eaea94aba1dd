"""A page for each example: its docstring, and its source."""

from __future__ import annotations

import ast
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def pages() -> dict[str, str]:
    """Pages by their place in the site."""
    sources = sorted(path for path in (ROOT / "examples").rglob("*.py"))
    found, rows = {}, []
    for path in sources:
        name = path.relative_to(ROOT / "examples").as_posix()
        text = path.read_text(encoding="utf-8")
        about = ast.get_docstring(ast.parse(text)) or ""
        first = about.partition("\n\n")[0].replace("\n", " ")
        found[place_of(f"examples/{name}")] = f"# {name}\n\n{about}\n\n## Source\n\n```python\n{text}```\n"
        rows.append(f"| [`{name}`]({name.removesuffix('.py')}.md) | {first} |")
    table = "\n".join(["| example | what it does |", "|---|---|", *rows])
    scenes = "\n".join(
        f"- `examples/scenes/{scene.name}`"
        for scene in sorted((ROOT / "examples" / "scenes").iterdir())
        if scene.is_dir()
    )
    found["examples/index.md"] = (
        "# Examples\n\nEach is one page of Python in `examples/`, run by a test.\n\n"
        f"{table}\n\n## Scenes\n\nScenes for Mitsuba, with camera paths, that come with the project:\n\n{scenes}\n"
    )
    return found


def navigation() -> list[str]:
    """Pages of the examples."""
    return sorted(place for place in pages() if place != "examples/index.md")


def place_of(path: str) -> str:
    """The page of the site that stands for a file or folder in examples/."""
    return path.removesuffix(".py") + ".md" if path.endswith(".py") else "examples/index.md"
