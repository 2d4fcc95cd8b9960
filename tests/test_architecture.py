"""The layers hold: imports point downward only, and algorithm files only assemble parts."""

from __future__ import annotations

import ast
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("envs_jax", "emrld_jax", "bridges", "benchmarks", "examples", "docs")

# What each unit may import of this project, besides itself. A module belongs to the longest name
# here that it starts with; a module right in emrld_jax that is not named here is a command. No two
# units may import each other (a test below), so that "downward" has a meaning.
BASIS = {
    "emrld_jax.types",
    "emrld_jax.precision",
    "emrld_jax.policy",
    "emrld_jax.fields",
    "emrld_jax.settings",
}
PARTS = {*BASIS, "envs_jax", "emrld_jax.sampling", "emrld_jax.theory", "emrld_jax.meta"}
BELOW_RUNS = {*PARTS, "emrld_jax.demos", "emrld_jax.algorithms"}
BELOW_COMMANDS = {
    *BELOW_RUNS,
    "emrld_jax",
    "emrld_jax.runs",
    "emrld_jax.analysis",
    "emrld_jax.study",
}
MAY_IMPORT: dict[str, set[str]] = {
    "envs_jax": set(),
    "emrld_jax.types": set(),
    "emrld_jax.precision": set(),
    "emrld_jax.policy": {"emrld_jax.types", "emrld_jax.precision"},
    "emrld_jax.fields": set(),
    "emrld_jax.settings": BASIS - {"emrld_jax.settings"},
    "emrld_jax.sampling": {*BASIS, "envs_jax"},
    "emrld_jax.theory": set(),
    "emrld_jax.meta": {*BASIS, "emrld_jax.sampling", "emrld_jax.theory"},
    # Above meta, because experts learn by its outer optimizers. Meta takes demonstrations as plain
    # arrays (emrld_jax.types), so it has no need of this package.
    "emrld_jax.demos": PARTS,
    "emrld_jax.algorithms": PARTS,
    "emrld_jax.runs": {*BELOW_RUNS, "emrld_jax"},
    "emrld_jax.analysis": {*BELOW_RUNS, "emrld_jax", "emrld_jax.runs"},
    "emrld_jax.study": {*BELOW_RUNS, "emrld_jax", "emrld_jax.runs", "emrld_jax.analysis"},
    "bridges": BELOW_COMMANDS,
    "commands": {*BELOW_COMMANDS, "bridges"},
    "benchmarks": {*BELOW_COMMANDS, "bridges", "commands"},
    "examples": BELOW_COMMANDS,
    "docs": BELOW_COMMANDS,
    # The package itself, which may offer anything that is below runs.
    "emrld_jax": BELOW_RUNS,
}
HYDRA_MODULES = ("emrld_jax.runs.cli", "emrld_jax.runs.overrides")
HYDRA_UNITS = ("commands", "benchmarks")
NOT_IN_ALGORITHMS = {
    *("scan", "fori_loop", "while_loop", "grad", "value_and_grad", "vjp", "jvp", "jacfwd"),
    *("jacrev", "hessian", "linearize", "random"),
}


def module_name(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def source_files(*folders: str) -> list[Path]:
    return sorted(file for folder in folders for file in (ROOT / folder).rglob("*.py"))


def unit_of(module: str) -> str:
    """The unit that a module of this project belongs to."""
    parts = module.split(".")
    for length in range(len(parts), 0, -1):
        unit = ".".join(parts[:length])
        if unit == "emrld_jax" and length < len(parts):
            return "commands"
        if unit in MAY_IMPORT:
            return unit
    raise ValueError(f"{module} is in no layer")


def is_module(name: str) -> bool:
    path = ROOT.joinpath(*name.split("."))
    return path.is_dir() or path.with_suffix(".py").is_file()


def absolute(node: ast.ImportFrom, module: str, *, package: bool) -> str:
    """What an import-from names, a relative one resolved against the importing module."""
    if node.level == 0:
        return node.module or ""
    parts = module.split(".")
    base = parts[: len(parts) - node.level + int(package)]
    return ".".join([*base, *([node.module] if node.module else [])])


def imported(source: str, module: str, *, package: bool = False) -> set[str]:
    """Every module that the source imports, wherever the import stands."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = absolute(node, module, package=package)
            names = {f"{base}.{alias.name}" for alias in node.names}
            modules = {name for name in names if is_module(name)}
            found |= modules | ({base} if modules != names else set())
    return found


def imported_by(file: Path) -> set[str]:
    return imported(file.read_text(), module_name(file), package=file.name == "__init__.py")


def file_of(module: str) -> Path | None:
    """The file that importing a module of this project runs; None for others'."""
    path = ROOT.joinpath(*module.split("."))
    files = (path / "__init__.py", path.with_suffix(".py"))
    return next((file for file in files if file.is_file()), None)


def reached_from(module: str) -> tuple[set[str], set[str]]:
    """All that importing a module runs: modules of this project, and packages of others."""
    ours, others, waiting = set[str](), set[str](), {module}
    while waiting:
        name = waiting.pop()
        file = file_of(name)
        if file is None:
            others.add(name.split(".")[0])
        elif name not in ours:
            ours.add(name)
            parents = {".".join(name.split(".")[:i]) for i in range(1, name.count(".") + 1)}
            waiting |= imported_by(file) | parents
    return ours, others - sys.stdlib_module_names


def upward(module: str, imports: set[str]) -> list[str]:
    """The imports of this project's modules that do not point downward."""
    unit = unit_of(module)
    ours = sorted(name for name in imports if name.split(".")[0] in (*PACKAGES, "tests"))
    return [
        name
        for name in ours
        if name.startswith("tests") or unit_of(name) not in {unit, *MAY_IMPORT[unit]}
    ]


def forbidden_in_algorithm(source: str) -> list[str]:
    """Loops, and names that belong to the layers below, in an algorithm's source."""
    found = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.For | ast.While | ast.AsyncFor):
            found.append(f"a loop in line {node.lineno}")
        elif isinstance(node, ast.Attribute) and node.attr in NOT_IN_ALGORITHMS:
            found.append(f"{node.attr} in line {node.lineno}")
        elif isinstance(node, ast.Name) and node.id in NOT_IN_ALGORITHMS:
            found.append(f"{node.id} in line {node.lineno}")
        elif isinstance(node, ast.ImportFrom | ast.Import):
            names = {part for alias in node.names for part in alias.name.split(".")}
            names |= set((getattr(node, "module", "") or "").split("."))
            found += [f"{name} in line {node.lineno}" for name in names & NOT_IN_ALGORITHMS]
    return found


def test_imports_point_downward() -> None:
    wrong = {
        module_name(file): found
        for file in source_files(*PACKAGES)
        if (found := upward(module_name(file), imported_by(file)))
    }

    assert not wrong


def test_only_entry_points_import_hydra() -> None:
    wrong = [
        module_name(file)
        for file in source_files(*PACKAGES)
        if any(name.split(".")[0] == "hydra" for name in imported_by(file))
        and module_name(file) not in HYDRA_MODULES
        and unit_of(module_name(file)) not in HYDRA_UNITS
    ]

    assert not wrong


def test_algorithms_assemble_and_do_nothing_else() -> None:
    wrong = {
        file.name: found
        for file in source_files("emrld_jax/algorithms")
        if (found := forbidden_in_algorithm(file.read_text()))
    }

    assert not wrong


def test_the_robots_policy_needs_numpy_alone() -> None:
    ours, others = reached_from("bridges.policy")

    assert {"bridges", "bridges.policy", "bridges.bundle"} <= ours
    assert {name.split(".")[0] for name in ours} == {"bridges"}
    assert others == {"numpy"}


def test_what_is_reached_is_seen() -> None:
    ours, others = reached_from("envs_jax.point2d")

    assert {"envs_jax", "envs_jax.goals", "envs_jax.physics.engine"} <= ours
    assert {"jax", "flax"} <= others


def test_the_layers_have_an_order() -> None:
    """No unit may import, over others, a unit that may import it."""
    placed: set[str] = set()
    while ready := {u for u, below in MAY_IMPORT.items() if u not in placed and below <= placed}:
        placed |= ready

    assert placed == set(MAY_IMPORT)


def test_the_files_are_found() -> None:
    names = {module_name(file) for file in source_files(*PACKAGES)}

    assert {"envs_jax", "envs_jax.point2d", "emrld_jax.types", "emrld_jax.policy"} <= names


@pytest.mark.parametrize(
    ("module", "source", "found"),
    [
        ("envs_jax.new", "import emrld_jax.types", ["emrld_jax.types"]),
        ("envs_jax.new", "from . import base\nfrom .base import State", []),
        ("emrld_jax.types", "from emrld_jax.policy import Policy", ["emrld_jax.policy"]),
        ("emrld_jax.types", "from .policy import Policy", ["emrld_jax.policy"]),
        ("emrld_jax.sampling.new", "from emrld_jax import meta", ["emrld_jax.meta"]),
        ("emrld_jax.sampling.new", "def f():\n    import emrld_jax.runs", ["emrld_jax.runs"]),
        ("emrld_jax.meta.new", "from ..sampling import rollouts", []),
        ("emrld_jax.meta.new", "from emrld_jax.demos import expert", ["emrld_jax.demos.expert"]),
        ("emrld_jax.algorithms.new", "from emrld_jax.train import x", ["emrld_jax.train"]),
        ("emrld_jax.runs.new", "from emrld_jax import algorithms, policy", []),
        ("emrld_jax.runs.new", "from emrld_jax.analysis import page", ["emrld_jax.analysis.page"]),
        ("emrld_jax.analysis.new", "from emrld_jax.report import x", ["emrld_jax.report"]),
        ("emrld_jax.runs.new", "import benchmarks.speed, bridges", ["benchmarks.speed", "bridges"]),
        ("emrld_jax.train", "from emrld_jax.runs.cli import x\nimport numpy", []),
        ("bridges.new", "import emrld_jax.train", ["emrld_jax.train"]),
        ("benchmarks.new", "import emrld_jax.train, tests.conftest", ["tests.conftest"]),
    ],
)
def test_the_check_sees_what_it_should(module: str, source: str, found: list[str]) -> None:
    assert upward(module, imported(source, module)) == found


@pytest.mark.parametrize(
    "source",
    [
        "import jax\njax.lax.scan(f, x, y)",
        "from jax.lax import scan",
        "from jax import value_and_grad as vg",
        "import jax.random as jr",
        "from jax.random import split",
        "import jax\nkey = jax.random.key(0)",
        "for x in y:\n    pass",
    ],
)
def test_the_algorithm_check_sees_what_it_should(source: str) -> None:
    assert forbidden_in_algorithm(source)
    assert not forbidden_in_algorithm("steps = tuple(step for step in make(settings))")
