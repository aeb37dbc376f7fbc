"""Tasks that end in every way a task can; processes import them by name."""

from __future__ import annotations

import logging
import os
import time
from pathlib import Path
from typing import Any


def double(value: int, **_: Any) -> dict[str, Any]:
    return {"double": 2 * value}


def warn(value: int, **_: Any) -> dict[str, Any]:
    logging.getLogger("vgtm_qp.study").warning("task of value %d is doubtful", value)
    return double(value)


def end(value: int, way: str = "", mark: str = "") -> dict[str, Any]:
    if way == "die":
        os._exit(3)
    if way == "die once" and not Path(mark).exists():
        Path(mark).touch()
        os._exit(3)
    if way == "hang":
        time.sleep(600)
    if way == "raise":
        raise ValueError(f"no {value}")
    return double(value)
