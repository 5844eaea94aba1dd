"""Hooks of `make docs`, which add generated pages to those of docs/, and keep links within the site.

A page for each method comes from the register of models, one for each operator from its docstring, one for each example
from its source, and those of the repository's root are pages of the site, too.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(Path(__file__).parent))

import figures  # noqa: E402
import methods  # noqa: E402
import operators  # noqa: E402
from mkdocs.structure.files import File, Files  # noqa: E402

import examples  # noqa: E402

# Pages that stand elsewhere in the repository.
MOVED = {
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
    "SECURITY.md": "security.md",
    "training/README.md": "training.md",
    "benchmarks/README.md": "benchmarks.md",
}
# Folders of source files, with the generated pages about them.
SOURCES = {"mcdenoise/models": "methods/index.md", "mcdenoise/ops": "operators/index.md"}


def on_config(config: Any) -> Any:
    """Put the generated pages into the navigation, behind those of their rooms that are named there."""
    rooms = {"Methods": methods.navigation(), "Operators": operators.navigation(), "Examples": examples.navigation()}
    _extend(config.nav, rooms)
    return config


def _extend(entries: list[Any], rooms: dict[str, list[Any]]) -> None:
    for entry in entries:
        for title, inside in entry.items() if isinstance(entry, dict) else ():
            if isinstance(inside, list):
                _extend(inside, rooms)
                inside.extend(rooms.get(title, []))


def on_files(files: Files, config: Any) -> Files:
    """Add the generated pages and pictures."""
    pages = {place: (ROOT / source).read_text(encoding="utf-8") for source, place in MOVED.items()}
    pages |= examples.pages() | methods.pages() | operators.pages()
    for place, text in pages.items():
        files.append(File.generated(config, place, content=text))
    for place, picture in figures.pictures().items():
        files.append(File.generated(config, place, content=picture))
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Files) -> str:
    """Lead links that leave docs/ to the pages that stand for their targets."""
    sources = {place: source for source, place in MOVED.items()}
    # Place of the text, relative to the root of the repository.
    own = Path(sources.get(page.file.src_uri, f"docs/{page.file.src_uri}"))

    def lead(match: re.Match[str]) -> str:
        return f"]({within_site(match[1], own, page.file.src_uri)}{match[2] or ''})"

    return re.sub(r"\]\(([^)#\s]+)(#[^)\s]*)?\)", lead, markdown)


def on_page_content(html: str, page: Any, config: Any, files: Files) -> str:
    """Let names such as `kornia.filters.filter2d` break behind their dots in tables, and not within words."""

    def breaking(code: re.Match[str]) -> str:
        return re.sub(r"\.(?=[A-Za-z_])", ".<wbr>", code[0])

    return re.sub(r"<td.*?</td>", lambda cell: re.sub("<code>[^<]*", breaking, cell[0]), html, flags=re.DOTALL)


def within_site(target: str, own: Path, page: str) -> str:
    """A link of a text at ``own`` in the repository as one of the page ``page`` of the site."""
    if "://" in target:
        return target
    parts: list[str] = []
    for part in (own.parent / target).parts:
        parts = parts[:-1] if part == ".." and parts else [*parts, part]
    place = "/".join(parts)
    if (page_about := (MOVED | SOURCES).get(place)) is not None:
        place = page_about
    elif place.startswith("docs/"):
        place = place.removeprefix("docs/")
    elif place.startswith("examples"):
        place = examples.place_of(place)
    else:
        return target
    return "../" * page.count("/") + place


def on_post_page(output: str, page: Any, config: Any) -> str:
    """Take the script that lets a page search from disk from the site itself, and not from a network."""
    return _with_own_search(output, page.url.count("/"))


def on_post_template(output: str, template_name: str, config: Any) -> str:
    """Likewise for the page of links that lead nowhere."""
    return _with_own_search(output, 0)


def _with_own_search(output: str, depth: int) -> str:
    own = f'"{"../" * depth}assets/offline_search.js"'
    return re.sub(r'"?https://unpkg\.com/iframe-worker/shim"?', own, output)
