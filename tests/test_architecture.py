"""What the shape of the package promises, beside the contracts of imports in ``pyproject.toml``."""

from __future__ import annotations

import ast
from collections import defaultdict
from pathlib import Path

import vgtm_qp

PACKAGE = Path(vgtm_qp.__file__).parent

# Names that two files still share: whoever renames one takes it off this list, and nobody adds to it.
SHARED: set[str] = set()


def test_a_class_name_stands_for_one_class() -> None:
    homes = defaultdict(list)
    for file in sorted(PACKAGE.rglob("*.py")):
        for node in ast.parse(file.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                homes[node.name].append(file.relative_to(PACKAGE).as_posix())
    shared = {name: files for name, files in homes.items() if len(files) > 1}
    assert set(shared) <= SHARED, {name: shared[name] for name in set(shared) - SHARED}
