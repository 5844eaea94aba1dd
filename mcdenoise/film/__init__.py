"""Films: many shots, denoised by many processes, and nothing lost.

A film is planned, made and closed by tasks that any process on any machine can do (`work`): they read and write the
disks themselves, and keep a record of each finished frame beside the result (`record`). One process hands them out
(`driver`), through an engine (`engines`), and may be killed at any time: what is finished is found again.
"""

from mcdenoise.film.driver import Film, FilmResult, ShotResult, run_film
from mcdenoise.film.manifest import Shot, read_film
from mcdenoise.film.page import write_page

__all__ = [
    "Film",
    "FilmResult",
    "Shot",
    "ShotResult",
    "read_film",
    "run_film",
    "write_page",
]
