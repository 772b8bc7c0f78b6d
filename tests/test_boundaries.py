"""What may import what, and how long a file may be."""

from __future__ import annotations

import ast
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("graphs", "sfm_calib", "experiments")
MATHS = {"numpy", "scipy", "numba", "threadpoolctl", "gtsam", "gtsam_unstable", "graphs"}
MOST_LINES = 400


def sources(package: str) -> list[Path]:
    found = sorted((ROOT / package).rglob("*.py"))
    assert found, package
    return found


def imported(path: Path) -> Iterator[str]:
    """Every module that a file imports, wherever in it; also by importlib and __import__."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: a relative import"
            yield node.module or ""
        elif isinstance(node, ast.Call) and node.args and isinstance(node.args[0], ast.Constant):
            called = ast.unparse(node.func)
            if called in ("__import__", "import_module", "importlib.import_module"):
                yield str(node.args[0].value)


def top(modules: Iterator[str]) -> set[str]:
    return {module.split(".")[0] for module in modules}


@pytest.mark.parametrize("path", sources("graphs"), ids=lambda path: path.name)
def test_the_maths_imports_only_numerics(path: Path) -> None:
    assert top(imported(path)) <= MATHS | set(sys.stdlib_module_names)


@pytest.mark.parametrize("path", sources("sfm_calib"), ids=lambda path: path.name)
def test_the_product_does_not_know_the_studies(path: Path) -> None:
    assert "experiments" not in top(imported(path))


def test_two_modules_of_the_product_know_colmap() -> None:
    knows = {
        str(path.relative_to(ROOT))
        for package in ("graphs", "sfm_calib")
        for path in sources(package)
        if "pycolmap" in top(imported(path))
    }
    assert knows == {"sfm_calib/colmap.py", "sfm_calib/colmap_matches.py"}


@pytest.mark.parametrize("package", [*PACKAGES, "tests"])
def test_files_are_short(package: str) -> None:
    long = {
        str(path.relative_to(ROOT)): count
        for path in sources(package)
        if (count := len(path.read_text(encoding="utf-8").splitlines())) > MOST_LINES
    }
    assert not long


def test_imports_are_found_wherever_they_hide(tmp_path: Path) -> None:
    """The walk above would see them."""
    hidden = tmp_path / "hidden.py"
    hidden.write_text(
        "def f():\n    import a.b as c\n    from d.e import g\n    __import__('h')\n"
        "    import importlib\n    importlib.import_module('i.j')\n"
    )
    assert top(imported(hidden)) == {"a", "d", "h", "i", "importlib"}
