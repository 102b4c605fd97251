"""Data flows one way: imports point backwards only, and bad input is met before jax is loaded."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import maxent_jax

PACKAGE = Path(maxent_jax.__file__).parent
# The reading order of the package, first to last.
ORDER = [
    *("types", "precision", "choices", "presets", "config", "convergence"),
    *("runs", "integrity", "headless", "machine", "runtime", "native"),
    *("runs.interruption", "runs.locks", "runs.sinks", "runs.display", "runs.clock", "runs.hosts"),
    *("density.histogram", "density.knn", "density.sharding"),
    *("density.entropy", "density.reservoir"),
    *("envs.physics", "envs.mjx_backend", "envs.mujoco_backend", "envs.torso", "envs.task"),
    *("envs.ant", "envs.walker2d", "envs.humanoid", "envs.pendulum", "envs.mountain_car"),
    *("envs", "envs.base", "rollout", "features"),
    *("rewards", "moments", "sac.networks", "sac.replay", "sac.losses", "sac.agent"),
    *("mixture", "methods"),
    *("bonuses.protocol", "bonuses.descent", "bonuses.particles"),
    *("bonuses.rnd", "bonuses.icm", "bonuses.ngu", "bonuses.re3", "bonuses.rise", "bonuses.vcse"),
    *("bonuses.kmeans", "bonuses.apt", "bonuses.histogram", "bonuses"),
    *("theory.bounds", "theory.mdps", "theory.tabular", "theory.optimum", "theory.loop"),
    *("theory.reference", "theory.peers", "theory.tabular_problems", "theory.tabular_studies"),
    *("parts", "occupancy", "experience", "training", "algorithm"),
    *("mepol.settings", "mepol.estimates", "mepol.ascent", "mepol"),
    *("official.settings", "official.reinforce", "official.rounds", "official"),
    *(
        "devices",
        "memory",
        "checkpoint",
        "dataset",
        "export",
        "analysis",
        "gymnasium_play",
        "plotting",
    ),
    *("theory.tabular_figures", "rendering", "film"),
    *("visual.figures", "visual.tables", "visual.video", "runs.stages", "runs.driver"),
    *("studies.statistics", "studies.protocol", "studies.raw", "studies.mepol_rows"),
    *("studies.classic_weights", "studies.paper_figures", "studies.reproduced"),
    *("commands.streams", "commands.cli", "commands.train", "commands.evaluate", "commands.render"),
    *("commands.report", "commands.verify", "commands.reproduce", "commands.theory"),
    *("commands", "__main__"),
]


def module_name(path):
    parts = path.relative_to(PACKAGE).with_suffix("").parts
    return ".".join(p for p in parts if p != "__init__")


def imported(path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("maxent_jax"):
            prefix = node.module.removeprefix("maxent_jax").lstrip(".")
            for alias in node.names:
                name = f"{prefix}.{alias.name}".lstrip(".")
                yield name if name in ORDER else prefix


@pytest.mark.parametrize("name", ORDER)
def test_a_module_imports_only_what_stands_before_it(name):
    path = PACKAGE / (name.replace(".", "/") + ".py")
    path = path if path.exists() else PACKAGE / name / "__init__.py"
    later = {m for m in imported(path) if m and ORDER.index(m) >= ORDER.index(name)}
    assert not later


def test_every_module_has_its_place_in_the_order():
    found = {module_name(path) for path in PACKAGE.rglob("*.py")}
    assert found - {"", "density", "sac", "studies", "theory", "visual"} == set(ORDER)


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
