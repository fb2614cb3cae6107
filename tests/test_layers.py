"""STYLE 1: web -> server -> calib_core, one direction; heavy packages are imported where they are used."""

import ast
import subprocess
import sys

import pytest
from shared import ROOT

ALLOWED_IN_CORE = {
    "numpy", "scipy", "filterpy", "pyarrow", "calib_core", "__future__", "collections", "dataclasses", "enum",
    "functools", "itertools", "math", "typing", "types", "abc", "re", "json", "csv", "io", "gzip", "zlib",
    "hashlib", "struct", "importlib", "contextlib", "bisect", "operator", "string", "statistics", "decimal",
    "fractions", "numbers", "copy", "pkgutil", "ast", "inspect", "array",
}  # fmt: skip
LAZY = {
    "scipy",
    "filterpy",
    "pyarrow",
    "typst",
    "dask",
    "distributed",
    "dynamixel_sdk",
    "nidaqmx",
    "grpc",
    "cryptography",
    "sqlite_utils",
    "pydantic.v1.main",
    "calib_core.effects",
    "calib_core.experiment",
    "calib_core.gap",
}
SOURCES = sorted([*ROOT.glob("calib_core/**/*.py"), *ROOT.glob("server/**/*.py")])


def imports(tree: ast.AST) -> list[tuple[int, str, bool]]:
    """Line, top-level package and whether the import runs when the module is imported."""
    found: list[tuple[int, str, bool]] = []

    def walk(node: ast.AST, eager: bool) -> None:
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.Import):
                found.extend((child.lineno, name.name.split(".")[0], eager) for name in child.names)
            elif isinstance(child, ast.ImportFrom) and child.level == 0:
                found.append((child.lineno, (child.module or "").split(".")[0], eager))
            type_checking = isinstance(child, ast.If) and "TYPE_CHECKING" in ast.unparse(child.test)
            inside_function = isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda)
            walk(child, eager and not type_checking and not inside_function)

    walk(tree, True)
    return found


def test_every_source_keeps_to_its_layer() -> None:
    wrong = []
    for path in SOURCES:
        room = path.relative_to(ROOT)
        for line, package, eager in imports(ast.parse(path.read_text(encoding="utf-8"))):
            if room.parts[0] == "calib_core" and package not in ALLOWED_IN_CORE:
                wrong.append(f"{room}:{line} imports {package}: arithmetic needs no outside; pass the value in")
            if package == "web":
                wrong.append(f"{room}:{line} imports web: pages are read as files by server/texts.py and server/app.py")
            if eager and package in LAZY:
                wrong.append(f"{room}:{line} imports {package} at import time: move it into the function that needs it")
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize("module", ["calib_core.recording", "server.app"])
def test_start_up_leaves_heavy_packages_alone(module: str) -> None:
    script = f"import sys, {module}; print(sorted(set(sys.modules) & {LAZY!r}))"
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, cwd=ROOT, check=True)
    assert result.stdout.strip() == "[]"
