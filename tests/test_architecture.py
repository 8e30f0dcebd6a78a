"""The tree's own rules: imports go one way, and help is instant."""

import ast
import subprocess
import sys
from pathlib import Path

import swimm3r

PACKAGE = Path(swimm3r.__file__).parent
ROWS = [  # a module sees only rows before its own
    {"errors", "progress"},
    {"settings"},
    {"medium", "memory", "geometry", "cameras", "weights", "devices", "filters", "settings_document"},
    {"io", "water_types", "raster", "open_water"},
    {"frame_settings", "frames", "run_folder"},
    {"prepare"},
    {"reconstruction"},
    {"ground_truth"},
    {"synthetic", "datasets"},
    {"sfm", "splat", "evaluate"},
    {"localization", "export", "viewer", "scale"},
    {"report"},
    {"renders"},
    {"held_out", "restored_scores"},
    {"summary"},
    {"presets"},
    {"inputs"},
    {"run_settings", "scoring"},
    {"run_record"},
    {"run"},
    {"bench", "batch"},
    {"cli"},
]
ROW_OF = {module: row for row, modules in enumerate(ROWS) for module in modules}


def imported_modules(tree: ast.AST, package: tuple[str, ...]) -> set[str]:
    """Top-level modules of swimm3r that a syntax tree imports, in any form; `package` holds the file's package."""
    found = set()
    for node in ast.walk(tree):
        paths: list[list[str]] = []
        if isinstance(node, ast.Import):
            paths = [alias.name.split(".") for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = list(package[: len(package) - node.level + 1]) if node.level else []
            base += node.module.split(".") if node.module else []
            paths = [[*base, alias.name] for alias in node.names]
        found |= {path[1] for path in paths if path[0] == "swimm3r" and len(path) > 1 and path[1] in ROW_OF}
    return found


def violations(path: Path, source: str) -> list[str]:
    relative = path.relative_to(PACKAGE).with_suffix("").parts
    if relative in (("__init__",), ("__main__",)):
        return []  # the public API and the command: lazy, and checked by the help test
    own = relative[0]
    package = ("swimm3r", *relative[:-1])
    return [
        f"{path.relative_to(PACKAGE)} imports {other}"
        for other in sorted(imported_modules(ast.parse(source), package))
        if other != own and ROW_OF[other] >= ROW_OF[own]
    ]


def test_imports_go_one_way():
    files = list(PACKAGE.rglob("*.py"))
    assert len(files) > 20
    assert [line for path in files for line in violations(path, path.read_text())] == []


def test_every_module_has_a_row():
    modules = {path.stem for path in PACKAGE.iterdir() if path.suffix == ".py" or (path / "__init__.py").is_file()}
    assert modules - {"__init__", "__main__"} <= set(ROW_OF)


def test_a_planted_violation_is_seen_in_every_form_of_import():
    path = PACKAGE / "io" / "planted.py"
    for line in (
        "import swimm3r.sfm.colmap.poses",
        "from swimm3r import run",
        "from swimm3r.scene.frames import Frames",
        "from ..report import page",
        "from .. import cli",
        "def f():\n    from swimm3r.sfm import tracks",
    ):
        assert violations(path, line), line


def imports_of(command: str) -> set[str]:
    """Modules loaded after running a Python snippet."""
    code = f"import sys\n{command}\nprint(*sys.modules)"
    return set(subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split())


def test_importing_the_package_loads_nothing_heavy():
    assert not imports_of("import swimm3r") & {"torch", "numpy", "pycolmap", "cv2", "numba"}


def test_help_loads_no_torch():
    commands = ["run", "demo", "sfm", "splat", "render", "export", "eval", "prepare", "doctor", "datasets"]
    commands += ["train-sfm", "bench", "bench render"]
    for command in ("", "weights get", *commands):
        snippet = (
            "from swimm3r.cli.main import main\n"
            f"try:\n    main([*'{command}'.split(), '--help'])\nexcept SystemExit as stop:\n    assert stop.code == 0"
        )
        loaded = imports_of(snippet)
        assert "tyro" in loaded
        assert not loaded & {"torch", "pycolmap", "cv2", "numba"}, command
