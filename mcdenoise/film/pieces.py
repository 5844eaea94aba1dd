"""A shot in pieces: which frames one process makes, and how many it looks at before, for their history."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class Piece:
    """Frames that one process goes through, one after the other.

    Args:
        numbers: of all of them, ascending.
        wanted: of those that are written; the others give them their history.
    """

    numbers: tuple[int, ...]
    wanted: tuple[int, ...]

    @property
    def joint(self) -> int | None:
        """The frame before the first that is written, which another piece makes; ``None`` where a shot begins."""
        place = self.numbers.index(self.wanted[0])
        return self.numbers[place - 1] if place else None


def cut(numbers: Sequence[int], missing: Collection[int], length: int, overlap: int | None) -> list[Piece]:
    """Cut a shot into pieces of equal length, and take of each what is missing.

    Where the pieces lie depends on the shot alone, and not on what is missing or who makes them. Each begins
    ``overlap`` frames before the first frame that it writes. One that was begun goes on where it ended, with as many
    frames before that; or from its own beginning, with the very same result, where that is no more than twice as far.

    Args:
        numbers: of all frames of the shot, ascending.
        missing: those to be written.
        length: the most frames of a piece; 0 for shots that are not cut.
        overlap: see :func:`mcdenoise.models.frames_remembered`; of a method that remembers nobody knows what, ``None``,
            shots are not cut, and every frame is made after all frames before it.

    Returns:
        The pieces in order; none where nothing is missing.

    Example:
        >>> for piece in cut(range(12), range(3, 12), length=6, overlap=2):
        ...     print(piece.numbers, piece.wanted)
        (0, 1, 2, 3, 4, 5) (3, 4, 5)
        (4, 5, 6, 7, 8, 9, 10, 11) (6, 7, 8, 9, 10, 11)
    """
    numbers, missing = list(numbers), set(missing)
    count = 1 if overlap is None or length < 1 else -(-len(numbers) // length)
    ends = [len(numbers) * (part + 1) // count for part in range(count)]
    pieces: list[Piece] = []
    for first, end in zip([0, *ends], ends, strict=False):
        begin = 0 if overlap is None else max(0, first - overlap)
        own: list[range] = []
        for place in range(first, end):
            if numbers[place] not in missing:
                continue
            start = begin if overlap is None or place - begin <= 2 * overlap else place - overlap
            # To go on costs no more than to begin anew.
            if own and start <= own[-1].stop:
                start = own.pop().start
            own.append(range(start, place + 1))
        for places in own:
            gone = tuple(numbers[place] for place in places)
            pieces.append(Piece(gone, tuple(n for n in gone if n in missing and numbers[first] <= n)))
    return pieces
