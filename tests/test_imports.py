"""Data flows one way: imports point backwards only, and bad input is met before jax is loaded."""

import ast
import graphlib
import subprocess
import sys
from pathlib import Path

import pytest

import maxent_jax

PACKAGE = Path(maxent_jax.__file__).parent
# The reading order of the package's folders and single modules, first to last.
ORDER = (
    *("errors", "checks", "types", "precision", "moments", "config", "native", "density", "envs"),
    *("tasks", "rollout", "features", "rewards", "sac", "intrinsic", "components", "mixture"),
    *("algorithm", "baselines", "runs", "analysis", "visual", "training", "theory", "studies"),
    *("commands", "__main__"),
)


def module_name(path):
    parts = path.relative_to(PACKAGE).with_suffix("").parts
    return ".".join(p for p in parts if p != "__init__")


MODULES = {name: path for path in PACKAGE.rglob("*.py") if (name := module_name(path))}


def imported(name):
    """The modules of the package that a module imports."""
    for node in ast.walk(ast.parse(MODULES[name].read_text())):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("maxent_jax"):
            prefix = node.module.removeprefix("maxent_jax").lstrip(".")
            for alias in node.names:
                full = f"{prefix}.{alias.name}".lstrip(".")
                if found := full if full in MODULES else prefix:
                    yield found


def room(name):
    return ORDER.index(name.split(".")[0])


@pytest.mark.parametrize("name", MODULES)
def test_a_module_imports_no_folder_that_comes_later(name):
    assert not {other for other in imported(name) if room(other) > room(name)}


def test_imports_within_a_folder_form_no_cycle():
    graph = {name: {m for m in imported(name) if room(m) == room(name)} for name in MODULES}
    list(graphlib.TopologicalSorter(graph).static_order())


def test_the_order_names_every_folder_and_no_other():
    assert {name.split(".")[0] for name in MODULES} == set(ORDER)


def test_the_command_line_is_checked_without_jax():
    code = (
        "import sys; from maxent_jax.commands import train, evaluate, render, report\n"
        "train.read_arguments(['--preset', 'smoke', '--out', 'nowhere'])\n"
        "sys.exit('jax' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_no_unsafe_loading_anywhere():
    root = Path(__file__).parent.parent
    for folder in (PACKAGE, root / "experiments", root / "benchmarks"):
        for path in folder.rglob("*.py"):
            tree = ast.parse(path.read_text())
            names = {n.id for n in ast.walk(tree) if isinstance(n, ast.Name)}
            names |= {n.attr for n in ast.walk(tree) if isinstance(n, ast.Attribute)}
            assert not names & {"eval", "exec", "pickle", "allow_pickle"}, path
