"""`mcdenoise report`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from mcdenoise.cli._output import say
from mcdenoise.report import write_report


def report(folder: tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="FOLDER")]]) -> None:
    """Write FOLDER/index.html and FOLDER/plots/ from the results and pictures of a finished benchmark.

    Args:
        folder: folder of a finished `mcdenoise benchmark`, with results.json and images/.
    """
    say(write_report(folder))
