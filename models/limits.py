"""States the bounds of what a file may hold: bytes, points, cells and the size of its numbers."""

LARGEST_BYTES = 2 * 1024**3
"""Bytes of any file."""
LARGEST_TEXT = 256 * 1024**2
"""Bytes of a text cloud."""
LARGEST_TABLE = 64 * 1024**2
"""Bytes of a CSV table: as rows by name it takes some twenty times as much memory."""
MOST_CELLS = 10_000_000
"""Cells of a CSV table."""
MOST_COLUMNS = 200
"""Columns of a CSV table."""
LARGEST_DOCUMENT = 16 * 1024**2
"""Bytes of a YAML or JSON file."""
MOST_NODES = 1_000_000
"""Values of a YAML or JSON file, each alias counted in full."""
DEEPEST = 50
"""Levels of a YAML or JSON file."""
MOST_POINTS = 50_000_000
"""Points of a cloud."""
MOST_ARRAYS = 1000
"""Arrays of an npz file."""
LARGEST_IMAGE = 128 * 1024**2
"""Bytes of an image."""
MOST_PIXELS = 100_000_000
"""Pixels of an image."""
LARGEST_NUMBER = 1e9
"""Size of any coordinate, in the unit of its file: squares and cubes of it are still far from overflow."""

_EXPANDED = 256 * 1024**2
_TIMES = 10


def expansion_limit(size: int) -> int:
    """Bytes to which a file of this size (bytes) may expand as double-precision numbers: 256 MiB, or ten times its size.

    The largest of today's area scanners (8 megapixels) takes 190 MB; a file that is not compressed never exceeds ten times.
    """
    return max(_EXPANDED, _TIMES * size)


MOST_POSES = 100_000
"""Poses of one list, and lines of a text that holds them: more take minutes to read, and no set of scans has so many."""
