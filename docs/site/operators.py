"""A page for each operator: its docstring, what it does to an image, and its time beside that of a copy."""

from __future__ import annotations

import csv
from pathlib import Path

import figures
from methods import PAPER, as_markdown

from mcdenoise.check.case import Op
from mcdenoise.check.cases import OPS

ROOT = Path(__file__).resolve().parents[2]


def pages() -> dict[str, str]:
    """Pages by their place in the site."""
    found = {f"operators/{op.name}.md": page(op) for op in OPS}
    return found | {"operators/index.md": index()}


def navigation() -> list[str]:
    """Pages in the order of the table of operators."""
    return [f"operators/{op.name}.md" for op in OPS]


def index() -> str:
    """All operators in a table."""
    rows = [f"| [`{op.name}`]({op.name}.md) | {summary(op)} | {module(op)} |" for op in OPS]
    return "\n".join(
        [
            "# Operators\n",
            "Functions of `mcdenoise.ops`: tensors in, tensors out, no weights and no files. Each is differentiable, "
            "to any order; half precision is summed in float32. [Kornia](../kornia.md) says what each stands on, and "
            "[For researchers](../for-researchers.md) puts them together. `mcdenoise models --ops` prints this list "
            "with errors.\n",
            "| operator | what it does | Module twin |",
            "|---|---|---|",
            *rows,
            "",
        ]
    )


def summary(op: Op) -> str:
    """First line of the docstring."""
    return as_markdown((op.function.__doc__ or "").strip().partition("\n\n")[0].replace("\n    ", " "))


def module(op: Op) -> str:
    """Name of the Module twin."""
    return "-" if op.module is None else f"`{op.module.__name__}`"


def page(op: Op) -> str:
    """One operator."""
    parts = [f"# {op.name}"]
    if op.name in figures.FIGURES:
        parts.append(
            f"![{figures.FIGURES[op.name].text}](figures/{op.name}.png){{ .pixels }}\n\n{figures.FIGURES[op.name].text}"
        )
    parts.append(
        f"::: {op.function.__module__}.{op.function.__name__}\n"
        "    options:\n      heading: Contract\n      toc_label: Contract\n      show_source: false"
    )
    if "the paper" in (op.function.__doc__ or ""):
        parts.append(PAPER)
    if op.module is not None:
        parts.append(f"The Module twin `mcdenoise.ops.{op.module.__name__}` stores the settings and calls it.")
    parts.append("## Cost\n\n" + cost(op.name))
    return "\n\n".join(parts) + "\n"


def cost(name: str) -> str:
    """The rows of an operator in the table of measured times."""
    with (ROOT / "benchmarks" / "ops-cpu.csv").open(encoding="utf-8", newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["op"] == name and not row["failure"]]
    if not rows:
        return "It was not measured; `mcdenoise benchmark --ops -o ops` measures every operator on your machine."
    first = rows[0]
    lines = [
        f"Beside a copy of the same bytes, {first['width']}x{first['height']}, {first['threads']} threads of an "
        f"{first['processor']}, without and with derivatives ([Benchmarks](../benchmarks.md) has the command):\n",
        "| backend | dtype | ms | times a copy | ms, with derivatives | times a copy |",
        "|---|---|--:|--:|--:|--:|",
    ]
    for row in rows:
        lines.append(
            f"| {row['backend']} | {row['dtype']} | {number(row['ms'])} | {number(row['over copy'])} "
            f"| {number(row['ms with derivatives'])} | {number(row['over copy with derivatives'])} |"
        )
    return "\n".join(lines)


def number(text: str) -> str:
    """One decimal; a dash where nothing was measured."""
    return f"{float(text):.1f}" if text else "-"
