"""The documents: what they link to is there, their commands exist, and their Python runs."""

import dataclasses
import importlib
import os
import pkgutil
import re
import shutil
from pathlib import Path

import pytest

from maxent_jax.config import DEFAULTS, preset

ROOT = Path(__file__).parent.parent
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
LINK = re.compile(r"\]\((?!https?:|#)([^)#]+)[^)]*\)")
FENCE = re.compile(r"^```(\w*)\n(.*?)^```", re.MULTILINE | re.DOTALL)
COMMAND = re.compile(
    r"(?:python -m (experiments|benchmarks)\.([\w.]+)|maxent-jax (\w+))([^\n#&|]*)"
)
NOT_RUN = re.compile(r"<!-- not run: [^>]+ -->\n+$")  # before a block, with the reason

every_page = pytest.mark.parametrize(
    "page", [pytest.param(page, id=page.relative_to(ROOT).as_posix()) for page in PAGES]
)


@every_page
def test_links_and_pictures_are_there(page):
    missing = [to for to in LINK.findall(page.read_text()) if not (page.parent / to).exists()]
    assert not missing


def test_the_site_lists_every_page_and_no_other():
    nav = (ROOT / "mkdocs.yml").read_text().split("\nnav:\n")[1]
    listed = set(re.findall(r"[\w/-]+\.(?:md|ipynb)", nav))
    pages = {p.relative_to(ROOT / "docs").as_posix() for p in (ROOT / "docs").rglob("*.*")}
    assert listed == {page for page in pages if page.endswith((".md", ".ipynb"))}


def test_the_readme_is_read_in_a_minute():
    assert len((ROOT / "README.md").read_text().splitlines()) <= 150


@every_page
def test_commands_exist_with_their_flags(page):
    for folder, name, ours, rest in COMMAND.findall(page.read_text()):
        if name == "NAME" or ours == "NAME":  # a placeholder
            continue
        if folder == "benchmarks":
            path = ROOT / "benchmarks" / name.replace(".", "/")
            files = path.glob("*.py") if path.is_dir() else [path.with_suffix(".py")]
            known = "".join(file.read_text() for file in files)
            known += (ROOT / "benchmarks" / "common.py").read_text()
            known = set(re.findall(r'"(--[\w-]+)"', known)) | {"--help"}
        elif (name or ours) == "measure_features":
            known = {"--env"}
        else:
            known = flags_of(importlib.import_module(f"maxent_jax.commands.{name or ours}"))
        used = set(re.findall(r"--[a-z][\w-]*", rest))
        assert used <= known, f"{name or ours} has no {used - known}"


def flags_of(command):
    fields = [field.name for field in dataclasses.fields(command.Arguments)]
    names = {name.replace("_", "-") for name in [*fields, *DEFAULTS]} | {"import", "from"}
    return {f"--{no}{name}" for name in names for no in ("", "no-")} | {"--help", "--help-all"}


def exists(name):
    """Whether the package has this file, function or setting."""
    if "/" in name or name.endswith(".py"):
        return (ROOT / "maxent_jax" / name).exists()
    try:
        pkgutil.resolve_name(f"maxent_jax.{name}")
    except (AttributeError, ModuleNotFoundError):
        group, _, setting = name.removeprefix("config.").partition(".")
        return setting in DEFAULTS and hasattr(getattr(preset("smoke"), group), setting)
    return True


def test_the_code_of_each_symbol_of_the_paper_is_there():
    page = (ROOT / "docs" / "paper-to-code.md").read_text()
    rows = re.findall(r"^\| (.+) \| (.+) \|$", page, re.MULTILINE)[1:]
    assert len(rows) > 20
    for symbol, code in rows:
        folder = module = ""  # of the name before, which the next may leave out
        for name in re.findall(r"`([\w./]+)`", code):
            if name.endswith(".py"):
                assert exists(name) or exists(folder + name), f"{symbol}: {name}"
                folder = name.rpartition("/")[0] + "/" if "/" in name else folder
            elif "." in name:
                assert exists(name), f"{symbol}: {name}"
                module = name.rpartition(".")[0]
            elif module:
                assert exists(f"{module}.{name}"), f"{symbol}: {name}"


def test_the_functions_of_the_reading_order_are_there():
    text = (ROOT / "docs" / "concepts" / "algorithm.md").read_text().split("## Reading order")[1]
    found = re.findall(r"`([\w/]+)\.py`:((?:,?\s+(?:and )?`[\w.]+`)+)", text)
    assert len(found) > 15
    for path, names in found:
        for name in re.findall(r"`([\w.]+)`", names):
            assert exists(f"{path.replace('/', '.')}.{name}"), f"{path}.py: {name}"


def blocks(page):
    """The Python of a page, but for blocks after a comment that says why they are not run."""
    text = page.read_text()
    return [
        found[2]
        for found in FENCE.finditer(text)
        if found[1] == "python" and not NOT_RUN.search(text[: found.start()])
    ]


@pytest.mark.parametrize(
    "page", [p for p in PAGES if blocks(p)], ids=lambda p: p.relative_to(ROOT).as_posix()
)
def test_the_python_of_a_page_runs(page, smoke_run, tmp_path, monkeypatch):
    shutil.copytree(smoke_run, tmp_path / "runs" / "ant")
    (tmp_path / "runs" / "ant-seeds").symlink_to("ant")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", os.environ.get("XDG_CACHE_HOME", str(tmp_path)))
    names = {"__name__": "page"}
    for block in blocks(page):
        exec(compile(block, str(page), "exec"), names)
