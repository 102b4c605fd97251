"""The notebooks of docs/tutorials: they run, and they show what they printed."""

import ast
import importlib
import os
import re
import shutil
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

ROOT = Path(__file__).parent.parent
TUTORIALS = ROOT / "docs" / "tutorials"
FIGURES = {"train": 3, "environment": 2, "reward": 1, "analysis": 3}
MACHINE_PATH = re.compile(r"/(?:home|root|tmp|Users|var)/")


@pytest.fixture(params=FIGURES)
def name(request):
    return request.param


@pytest.fixture
def notebook(name):
    return nbformat.read(TUTORIALS / f"{name}.ipynb", as_version=4)


@pytest.mark.slow
def test_a_tutorial_runs(notebook, smoke_run, tmp_path):
    shutil.copytree(smoke_run, tmp_path / "runs" / "ant")  # which analysis.ipynb loads
    folder = tmp_path / "docs" / "tutorials"
    folder.mkdir(parents=True)
    client = NotebookClient(notebook, timeout=600, resources={"metadata": {"path": str(folder)}})
    paths = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    client.execute(env=os.environ | {"PYTHONPATH": paths})
    assert not any(is_error(o) for o in outputs(notebook))


def test_every_tutorial_is_tested():
    assert {path.stem for path in TUTORIALS.glob("*.ipynb")} == {*FIGURES}


def test_a_tutorial_shows_what_it_printed(name, notebook):
    code = code_cells(notebook)
    assert [cell.execution_count for cell in code] == [*range(1, len(code) + 1)]
    assert not any(is_error(o) for o in outputs(notebook))
    assert sum("image/png" in o.get("data", {}) for o in outputs(notebook)) >= FIGURES[name]
    assert (TUTORIALS / f"{name}.ipynb").stat().st_size < 400_000


def test_a_tutorial_does_not_depend_on_the_machine_that_executed_it(notebook):
    assert notebook.metadata == {
        "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
        "language_info": {"name": "python"},
    }
    assert not any(cell.metadata for cell in notebook.cells)  # no times of execution
    for output in outputs(notebook):
        texts = [output.get("text", ""), *output.get("data", {}).values()]
        shown = [text for text in texts if isinstance(text, str) and len(text) < 20_000]
        assert not any(MACHINE_PATH.search(text) for text in shown)


def test_what_a_tutorial_imports_exists(notebook):
    for cell in code_cells(notebook):
        source = re.sub(r"^%(?!%).*$", "", cell.source, flags=re.M)
        if source.startswith("%%writefile"):
            source = source.partition("\n")[2] if ".py" in source.split("\n")[0] else ""
        for node in ast.walk(ast.parse(source)):
            if isinstance(node, ast.ImportFrom) and node.module.startswith("maxent_jax"):
                module = importlib.import_module(node.module)
                for alias in node.names:
                    if not hasattr(module, alias.name):
                        importlib.import_module(f"{node.module}.{alias.name}")


def code_cells(notebook):
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


def outputs(notebook):
    return [o for cell in code_cells(notebook) for o in cell.outputs]


def is_error(output):
    return output.get("name") == "stderr" or "ename" in output
