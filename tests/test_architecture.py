"""Data flows one way: a room imports only from rooms to its left, and only two rooms know MuJoCo."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

import jaxbiped

PACKAGE = Path(jaxbiped.__file__).parent
PROJECT = PACKAGE.parent

# What stands left of each room. kinematics is left of planner: the ZMP of a plan needs its joint angles.
LEFT_OF: dict[str, set[str]] = {
    "files": set(),
    "checked": set(),
    "runtime": set(),
    "robot": set(),
    "kinematics": {"robot"},
    "planner": {"robot", "kinematics"},
    "adapt": {"robot", "kinematics", "planner"},
    "sim": {"robot", "kinematics", "planner", "adapt"},
    "score": {"robot", "kinematics", "planner", "adapt", "sim"},
    "batch": {"robot", "kinematics", "planner", "adapt", "sim", "score"},
    # tune is right of batch: what is tuned on, and what is held out, are experiments.
    "tune": {"robot", "kinematics", "planner", "adapt", "sim", "score", "batch"},
    "report": {"robot", "kinematics", "planner", "adapt", "sim", "score", "batch"},
    "commands": {"robot", "kinematics", "planner", "adapt", "sim", "score", "tune", "batch", "report"},
}
OPEN_TO_ALL = {
    "files",
    "checked",
    "runtime",
}  # leftmost: whole files, checked input, how JAX runs; they see no room
DOORS = {"__init__", "__main__", "cli"}  # the package's own front: may import any room
MAY_IMPORT_MUJOCO = {"sim", "report"}
NEVER_SEE_A_SCENARIO = {"planner", "adapt"}


def room_of(module: str) -> str:
    """The room of a module: `sim` of `jaxbiped.sim.model`, `__init__` of the package itself."""
    return [*module.split("."), "__init__"][1]


def imported_modules(tree: ast.AST, module: str, is_package: bool) -> Iterator[tuple[str, int]]:
    """Every module a source imports, wherever in it, as (name, line); `from a import b` gives `a.b`."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((alias.name, node.lineno) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = _absolute(node, module, is_package)
            yield from ((f"{base}.{alias.name}", node.lineno) for alias in node.names)
        elif isinstance(node, ast.Call) and _name(node.func) in {"import_module", "__import__"} and node.args:
            yield from (
                (str(arg.value), node.lineno) for arg in node.args[:1] if isinstance(arg, ast.Constant)
            )


def _absolute(node: ast.ImportFrom, module: str, is_package: bool) -> str:
    if not node.level:
        return node.module or ""
    parents = module.split(".")
    parents = parents[: len(parents) - node.level + is_package]
    return ".".join([*parents, *([node.module] if node.module else [])])


def _name(node: ast.AST) -> str:
    return getattr(node, "attr", None) or getattr(node, "id", "")


def names(tree: ast.AST) -> Iterator[tuple[str, int]]:
    """Every identifier of a source as (name, line): also in quoted annotations, not in docstrings."""
    docstrings = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    for node in ast.walk(tree):
        line = getattr(node, "lineno", 0)
        for field in ("id", "attr", "name", "asname", "arg"):
            value = getattr(node, field, None)
            if isinstance(value, str):
                yield from ((part, line) for part in value.split("."))
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in docstrings:
            yield from ((word, line) for word in re.findall(r"\w+", node.value))


def violations(source: str, module: str, is_package: bool = False) -> list[str]:
    """What in a module's source breaks the house rules, one line each; empty when nothing does."""
    tree, room, found = ast.parse(source), room_of(module), []

    def wrong(line: int, what: str) -> None:
        found.append(f"{module}:{line}: {what}")

    for name, line in imported_modules(tree, module, is_package):
        top, *rest = name.split(".")
        if name == "__future__.annotations":
            wrong(line, "from __future__ import annotations hides the shapes from jaxtyping")
        if top == "mujoco" and room not in MAY_IMPORT_MUJOCO:
            wrong(line, f"{room} imports mujoco")
        if top == "jaxbiped" and room not in DOORS:
            target = rest[0] if rest else "the whole package"
            if not _may_import(room, target):
                wrong(line, f"{room} imports {target}")
    if room in NEVER_SEE_A_SCENARIO:
        for name, line in names(tree):
            if name == "Scenario":
                wrong(line, f"{room} mentions Scenario")
    return found


def _may_import(room: str, target: str) -> bool:
    """Private top-level modules (_versions), dunders (__version__) and OPEN_TO_ALL may be imported anywhere."""
    return target == room or target.startswith("_") or target in OPEN_TO_ALL | LEFT_OF.get(room, set())


def sources() -> list[tuple[Path, str, bool]]:
    """Every module of the package as (file, dotted name, whether it is a package's __init__)."""
    found = []
    for file in sorted(PACKAGE.rglob("*.py")):
        parts = ["jaxbiped", *file.relative_to(PACKAGE).with_suffix("").parts]
        is_package = parts[-1] == "__init__"
        found.append((file, ".".join(parts[:-1] if is_package else parts), is_package))
    return found


@pytest.mark.parametrize(
    ("file", "module", "is_package"), [pytest.param(*source, id=source[1]) for source in sources()]
)
def test_module_keeps_the_house_rules(file: Path, module: str, is_package: bool):
    assert violations(file.read_text(encoding="utf-8"), module, is_package) == []


def test_every_module_belongs_to_a_known_room():
    rooms = {room_of(module) for _, module, _ in sources()}
    assert {room for room in rooms if not room.startswith("_")} <= LEFT_OF.keys() | DOORS


def test_left_of_is_an_order():
    """If a room sees a second, it also may see all that the second sees; and no two see each other."""
    for room, left in LEFT_OF.items():
        assert room not in left
        for other in left:
            assert LEFT_OF[other] <= left


def test_no_file_of_the_project_postpones_its_annotations():
    folders = ("jaxbiped", "tests", "benchmarks", "sweeps")
    files = [file for folder in folders for file in sorted((PROJECT / folder).rglob("*.py"))]
    trees = {str(file): ast.parse(file.read_text(encoding="utf-8")) for file in files}
    postponed = [
        f for f, tree in trees.items() if "__future__.annotations" in dict(imported_modules(tree, "", False))
    ]
    assert postponed == []


@pytest.mark.parametrize(
    ("module", "source"),
    [
        ("jaxbiped.planner.gait", "from jaxbiped.robot import RobotParams"),
        ("jaxbiped.planner.zmp", "from jaxbiped import kinematics, robot"),
        ("jaxbiped.planner.zmp", "from .gait import at\nfrom . import fit\nfrom ..kinematics import leg"),
        ("jaxbiped.planner.gait", '"""A plan never sees a Scenario."""\n# nor a Scenario here'),
        ("jaxbiped.adapt.stage", "from jaxbiped import planner as p"),
        ("jaxbiped.sim.model", "import mujoco\nfrom mujoco import mjx\nfrom jaxbiped.adapt import Sensed"),
        ("jaxbiped.sim.model", "class Scenario: ..."),
        ("jaxbiped.report.replay", "import mujoco.viewer\nimport jaxbiped.batch.table"),
        ("jaxbiped.batch.key", "from jaxbiped import __version__"),
        ("jaxbiped.sim", "from jaxbiped._versions import check_installed"),
        ("jaxbiped.cli", "import jaxbiped\nfrom jaxbiped import batch, report, tune"),
        ("jaxbiped", "from jaxbiped import cli, sim\nfrom . import tune"),
        ("jaxbiped.robot.params", "import jaxbipedal\nimport mujoco_like\nfrom __future__ import division"),
    ],
)
def test_checker_lets_the_right_way_pass(module, source):
    assert violations(source, module, is_package=module.count(".") == 0) == []


@pytest.mark.parametrize(
    ("module", "source", "what"),
    [
        ("jaxbiped.robot.params", "from jaxbiped.kinematics import leg", "robot imports kinematics"),
        ("jaxbiped.kinematics.leg", "from jaxbiped.planner import gait", "kinematics imports planner"),
        ("jaxbiped.planner.gait", "import jaxbiped.sim", "planner imports sim"),
        ("jaxbiped.planner.gait", "import numpy, jaxbiped.sim.model as m", "planner imports sim"),
        ("jaxbiped.planner.gait", "from jaxbiped import robot, adapt", "planner imports adapt"),
        ("jaxbiped.planner.gait", "from .. import adapt", "planner imports adapt"),
        ("jaxbiped.planner.gait", "from ..adapt.landing import step", "planner imports adapt"),
        ("jaxbiped.adapt.stages.reflex", "from ...sim import world", "adapt imports sim"),
        ("jaxbiped.adapt.stage", "def f():\n    from jaxbiped import score", "adapt imports score"),
        ("jaxbiped.adapt.stage", "if TYPE_CHECKING:\n    import jaxbiped.sim", "adapt imports sim"),
        ("jaxbiped.adapt.stage", "importlib.import_module('jaxbiped.sim')", "adapt imports sim"),
        ("jaxbiped.adapt.stage", "import jaxbiped as jb", "adapt imports the whole package"),
        ("jaxbiped.score.judge", "from jaxbiped.tune import loss", "score imports tune"),
        ("jaxbiped.batch.run", "from jaxbiped import tune", "batch imports tune"),
        ("jaxbiped.report.page", "from jaxbiped.cli import main", "report imports cli"),
        ("jaxbiped.report.page", "from jaxbiped.commands import walk", "report imports commands"),
        ("jaxbiped.commands.walk", "from jaxbiped.cli import main", "commands imports cli"),
        ("jaxbiped._versions", "from jaxbiped import sim", "_versions imports sim"),
        ("jaxbiped.planner.zmp", "import mujoco", "planner imports mujoco"),
        ("jaxbiped.score.judge", "from mujoco import mjx", "score imports mujoco"),
        ("jaxbiped.tune.descent", "import mujoco.mjx as mjx", "tune imports mujoco"),
        ("jaxbiped.cli", "def f():\n    from mujoco.mjx import step", "cli imports mujoco"),
        ("jaxbiped.sim.model", "from __future__ import annotations", "hides the shapes"),
        ("jaxbiped.planner.gait", "class Scenario: ...", "planner mentions Scenario"),
        ("jaxbiped.adapt.stage", "def step(scenario: Scenario): ...", "adapt mentions Scenario"),
        ("jaxbiped.adapt.stage", "def step(scenario: 'sim.Scenario | None'): ...", "adapt mentions Scenario"),
        ("jaxbiped.adapt.stage", "height = world.Scenario.flat()", "adapt mentions Scenario"),
        ("jaxbiped.adapt.stage", "from elsewhere import Scenario as S", "adapt mentions Scenario"),
    ],
)
def test_checker_catches(module, source, what):
    assert any(what in line for line in violations(source, module)), violations(source, module)


def test_checker_resolves_relative_imports_of_a_package():
    assert violations("from . import leg", "jaxbiped.kinematics", is_package=True) == []
    assert violations("from .. import planner", "jaxbiped.kinematics", is_package=True) != []


@pytest.mark.parametrize("folder", ["sweeps", "benchmarks"])
def test_scripts_import_the_package_or_its_settings_before_jax(folder: str):
    """XLA reads once, when JAX is imported, how much it is to say."""
    firsts = {"jaxbiped", "common", "jax", "equinox", "agreement", "tuned"}
    for file in sorted((PROJECT / folder).glob("*.py")):
        tree = ast.parse(file.read_text(encoding="utf-8"))
        names = [
            name.split(".")[0]
            for name, _ in sorted(
                imported_modules(tree, file.stem, is_package=False), key=lambda pair: pair[1]
            )
        ]
        first = next((name for name in names if name in firsts), "jaxbiped")
        assert first not in ("jax", "equinox"), f"{file.name} imports {first} first"
