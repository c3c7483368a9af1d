"""Cells for the tests of scripts/reproductions/cells.py."""

import os
from pathlib import Path


def squared(cell, extra):
    """Notes that it ran, and squares; refuses 3 while the file `extra` is there."""
    if cell["x"] == 3 and extra and Path(extra).exists():
        raise ValueError("no threes")
    return {"square": cell["x"] ** 2, "process": os.getpid()}


def dying(cell, extra):
    """Ends its process."""
    if cell["x"] == 3:
        os._exit(7)
    return {"square": cell["x"] ** 2}
