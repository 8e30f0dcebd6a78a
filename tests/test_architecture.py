"""The tree's own rules: imports go one way at every level, rooms are small, and help is instant."""

import ast
import subprocess
import sys
from pathlib import Path

from tests.conftest import FIRST_FILES

import swimm3r

PACKAGE = Path(swimm3r.__file__).parent
ROWS = {  # by package: a room or module imports only rooms of rows before its own; "a.b" is a part in a row of its own
    "swimm3r": [
        {"errors", "progress", "notebook", "rounding"},
        {"io.files", "lamp"},
        {"medium", "geometry", "cameras", "sim3", "appearance"},
        {"settings", "water_types", "devices", "memory", "evaluate", "weights"},
        {"settings_document", "io", "raster", "refraction", "tasks"},
        {"scene"},
        {"imaging", "prepare", "datasets", "synthetic"},
        {"sfm", "splat"},
        {"products"},
        {"localization", "export", "report", "scale", "selftest"},
        {"pipeline", "visits"},
        {"batch", "bench", "viewer"},
        {"cli"},
    ],
    "swimm3r.io": [
        {"files", "view_names"},
        {"cameras_json", "depth", "medium_json", "colmap", "image_header", "ply", "trajectory", "video"},
        {"images", "raw"},
        {"image_folder", "imports"},
        {"calibration"},
        {"bags"},
        {"navigation", "telemetry"},
    ],
    "swimm3r.sfm": [
        {"mast3r", "tracks", "imported", "rig_poses"},
        {"features.settings", "plane_sweep.settings", "colmap.settings", "medium.settings"},
        {"settings"},
        {"rectified"},
        {"features", "lens", "plane_sweep"},
        {"alignment", "student", "colmap"},
        {"mast3r_sfm"},
        {"moving", "between"},
        {"medium"},
        {"backends", "distillation"},
    ],
    "swimm3r.splat": [
        {"optimizer", "shared_settings"},
        {"gaussian_settings", "pose_mlp"},
        {"training_poses"},
        {"settings"},
        {"appearance", "ground"},
        {"views", "primitives"},
        {"projection"},
        {"medium", "block_store"},
        {"rendering"},
        {"pose_refinement", "densify", "training"},
        {"dynamic"},
        {"recipes"},
        {"map_file", "blocks"},
        {"train_map"},
    ],
    "swimm3r.raster": [{"records"}, {"pairmath", "reference"}, {"cpu", "cuda"}],
    "swimm3r.bench": [
        {"inputs", "memory", "images", "reference", "scores", "settings"},
        {"cells", "revisit_dives", "sfm_methods"},
        {"map_scores", "runs", "statistics"},
        {"tables"},
        {"protocols"},
    ],
    "swimm3r.cli": [{"terminal"}, {"*"}, {"main"}],
}
FLAT = 15  # files in one folder


def row_of(package: str, child: str) -> int | None:
    rows = ROWS[package]
    named = [k for k, row in enumerate(rows) if child in row]
    return named[0] if named else next((k for k, row in enumerate(rows) if "*" in row), None)


def child_of(package: str, module: str) -> str:
    """The child of a package that a module is or is in, or its part where that has a row of its own."""
    parts = module.removeprefix(f"{package}.").split(".")
    part = ".".join(parts[:2])
    return part if any(part in row for row in ROWS[package]) else parts[0]


def module_name(path: Path) -> str:
    return ".".join(("swimm3r", *path.relative_to(PACKAGE).with_suffix("").parts)).removesuffix(".__init__")


MODULES = {module_name(path): path for path in PACKAGE.rglob("*.py")}


def imported_modules(tree: ast.AST, package: str) -> set[str]:
    """Modules of swimm3r that a syntax tree of this package imports, in any form."""
    found = set()
    for node in ast.walk(tree):
        names: list[str] = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            above = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
            base = ".".join([*above, *([node.module] if node.module else [])])
            names = [f"{base}.{alias.name}" for alias in node.names]
        found |= {name for name in (_module(name) for name in names) if name}
    return found


def _module(name: str) -> str | None:
    """The module that a dotted name is, or is in."""
    while name not in MODULES:
        name, dot, _ = name.rpartition(".")
        if not dot:
            return None
    return name


def violations(module: str, source: str, is_package: bool = False) -> list[str]:
    """Imports of a module that go up a row, in any package that both ends share; a room's own files see each other."""
    found = []
    for other in sorted(imported_modules(ast.parse(source), module if is_package else module.rpartition(".")[0])):
        for package in ROWS:
            if not (module.startswith(f"{package}.") and other.startswith(f"{package}.")):
                continue
            own, seen = (child_of(package, name) for name in (module, other))
            first, second = row_of(package, own), row_of(package, seen)
            if own == seen or first is None or second is None:
                continue
            if second >= first and "*" not in ROWS[package][first]:
                found.append(f"{module} imports {other}")
    return found


def test_imports_go_one_way():
    assert len(MODULES) > 200
    skipped = {"swimm3r", "swimm3r.__main__", *ROWS}  # the lazy front doors: the help test checks them
    lines = [
        line
        for module, path in MODULES.items()
        if module not in skipped
        for line in violations(module, path.read_text(), path.stem == "__init__")
    ]
    assert lines == []


def test_every_module_has_a_row_and_every_row_its_modules():
    for package, rows in ROWS.items():
        children = {m.removeprefix(f"{package}.").split(".")[0] for m in MODULES if m.startswith(f"{package}.")}
        named = set().union(*rows) - {"*"}
        assert {f"{package}.{name}" for name in named} <= set(MODULES), package
        rooms = {name for name in named if "." not in name}
        assert any("*" in row for row in rows) or children - {"__main__"} == rooms, package


def test_no_module_imports_itself_through_others():
    below = {
        m: imported_modules(ast.parse(p.read_text()), m if p.stem == "__init__" else m.rpartition(".")[0])
        for m, p in MODULES.items()
    }
    for package in ("swimm3r", *ROWS):  # front doors name what they load on use
        below.pop(package, None)
    state: dict[str, int] = {}

    def visit(module: str, path: tuple[str, ...]) -> None:
        if module not in below or state.get(module) == 2:
            return
        assert state.get(module) != 1, f"circle: {' -> '.join((*path, module))}"
        state[module] = 1
        for other in below[module] - {module}:
            visit(other, (*path, module))
        state[module] = 2

    for module in below:
        visit(module, ())


def test_files_that_are_started_first_exist():
    assert [name for name in FIRST_FILES if not (Path(__file__).parent / name).is_file()] == []


def test_no_folder_is_a_heap():
    for folder in {path.parent for path in MODULES.values()} - {PACKAGE}:
        assert len(list(folder.glob("*.py"))) - 1 <= FLAT, folder
    assert len(list(PACKAGE.glob("*.py"))) - 2 <= FLAT


def test_every_room_says_its_purpose_in_one_sentence():
    for folder in {path.parent for path in MODULES.values()}:
        text = ast.get_docstring(ast.parse((folder / "__init__.py").read_text()))
        assert text, folder
        assert text.splitlines()[0].endswith("."), folder


def test_a_planted_violation_is_seen_in_every_form_of_import():
    for module, line in (
        ("swimm3r.io.planted", "import swimm3r.sfm.colmap.poses"),
        ("swimm3r.io.planted", "from swimm3r import pipeline"),
        ("swimm3r.io.planted", "from swimm3r.scene.frames import Frames"),
        ("swimm3r.io.planted", "from ..report import page"),
        ("swimm3r.medium", "from swimm3r.io import images"),
        ("swimm3r.io.files.planted", "from swimm3r import cameras"),
        ("swimm3r.io.files.planted", "from ... import cli"),
        ("swimm3r.io.files.planted", "from .. import images"),
        ("swimm3r.splat.views", "from swimm3r.splat.training import loop"),
        ("swimm3r.sfm.colmap.poses", "def f():\n    from swimm3r.sfm.medium import apply"),
    ):
        assert violations(module, line), line


def imports_of(command: str) -> set[str]:
    """Modules loaded after running a Python snippet."""
    code = f"import sys\n{command}\nprint(*sys.modules)"
    return set(subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split())


def test_importing_the_package_loads_nothing_heavy():
    assert not imports_of("import swimm3r") & {"torch", "numpy", "pycolmap", "cv2", "numba"}


def test_help_loads_no_torch():
    commands = ["run", "demo", "sfm", "splat", "render", "export", "eval", "prepare", "doctor", "datasets"]
    commands += ["view", "train-sfm", "batch", "bench", "bench render"]
    snippet = (  # in one process: each would take a second to start
        "from swimm3r.cli.main import main\n"
        f"for command in {['', 'weights get', *commands]}:\n"
        "    try:\n        main([*command.split(), '--help'])\n"
        "    except SystemExit as stop:\n        assert stop.code == 0\n"
        "    assert not {'torch', 'pycolmap', 'cv2', 'numba'} & {*sys.modules}, command"
    )
    assert "tyro" in imports_of(snippet)
