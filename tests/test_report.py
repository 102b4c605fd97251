"""The HTML page about runs: it parses, loads nothing, says what the metrics say, escapes names."""

import base64
import dataclasses
import json
import re
import shutil
import subprocess
import sys
import time
from html.parser import HTMLParser
from pathlib import Path

import pytest
import untrained
from PIL import Image

from maxent_jax.commands import report
from maxent_jax.config import preset
from maxent_jax.runs import files
from maxent_jax.visual import plotting, tables

ROOT = Path(__file__).parent.parent
NAME = '<script>alert(1)<b>&amp;"$x_{'  # markup, and mathematics that does not end
VOID = {"meta", "img"}


class Page(HTMLParser):
    """The tags of a page with their attributes, and its text; a tag left open is an error."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.text, self._open = [], "", []
        self.feed(text)
        self.close()
        assert not self._open

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self._open.append(tag)

    def handle_endtag(self, tag):
        assert self._open.pop() == tag

    def handle_data(self, data):
        self.text += data if self._open[-1:] != ["style"] else ""

    def attributes(self, name):
        return [attributes[name] for _, attributes in self.tags if name in attributes]


@pytest.fixture(scope="module")
def directory(two_seeds, tmp_path_factory):
    """Of a run of two seeds, with a strip of stills of the first alone."""
    path = Path(shutil.copytree(two_seeds, tmp_path_factory.mktemp("runs") / NAME))
    for i in range(2):
        (path / "videos" / f"seed_{i}").mkdir(parents=True)
    Image.new("RGB", (4, 4)).save(path / "videos" / "seed_0" / "mixture.png")
    (path / "videos" / "seed_1" / "mixture.png").write_text("root:x:0:0")
    return path


@pytest.fixture(scope="module")
def page(directory):
    report.main([str(directory), "--episodes", "1"])
    return Page((directory / "report.html").read_text())


def test_the_page_loads_nothing(page):
    assert not {"script", "link", "iframe", "base"} & {tag for tag, _ in page.tags}
    assert all(address.startswith("data:image/") for address in page.attributes("src"))
    assert all(address.startswith("#") for address in page.attributes("href"))
    assert not [name for _, attributes in page.tags for name in attributes if name.startswith("on")]
    assert not re.search(r"url\(|@import", str(page.attributes("style")))


def test_its_pictures_load_nothing_either(page):
    drawn = [each for each in page.attributes("src") if each.startswith("data:image/svg+xml")]
    assert len(drawn) == 1 + 2 * 3  # the comparison; curves, heat map and paths of each seed
    for address in drawn:
        svg = base64.b64decode(address.partition("base64,")[2]).decode()
        assert svg.rstrip().endswith("</svg>")
        links = re.findall(r'href="(.*?)"', svg, re.DOTALL)
        assert all(link.startswith(("#", "data:")) for link in links)


def test_the_page_holds_the_metrics_of_every_seed(page, directory):
    last = files.read_metrics(directory)[-1]
    for seed in range(2):
        for name in ("cumulative_coverage", "mixture_coverage", "random_coverage"):
            assert f"{last[name][seed]:,}" in page.text
        for name in ("cumulative_entropy", "mixture_entropy", "random_entropy"):
            assert f"{last[name][seed]:.2f}" in page.text
    mean = sum(last["cumulative_coverage"]) / 2
    assert f"{mean:,.0f}" in page.text
    assert f"{last['wall_seconds']:,.0f}" in page.text


def test_every_setting_and_every_departure_is_there(page, directory):
    config = files.read_config(directory)
    for name, value in config.flat().items():
        assert re.search(rf"\b{name}\s*{re.escape(str(value))}", page.text), name
    for why in config.deviations().values():
        assert why in page.text
    marked = [attributes for _, attributes in page.tags if attributes.get("class") == "departs"]
    assert len(marked) == len(config.deviations())


def test_names_and_files_of_others_are_text(page):
    assert NAME in page.text
    assert base64.b64encode(b"root:x").decode() not in str(page.attributes("src"))


def test_the_strip_of_stills_is_shown_where_it_is_a_picture(page):
    strips = [each for each in page.attributes("src") if each.startswith("data:image/png")]
    assert len(strips) == 1


@pytest.mark.slow
def test_the_same_run_gives_the_same_page(directory, page, tmp_path):
    report.main([str(directory), "--episodes", "1", "--out", str(tmp_path / "again.html")])
    assert (tmp_path / "again.html").read_bytes() == (directory / "report.html").read_bytes()
    assert [path.name for path in tmp_path.iterdir()] == ["again.html"]


@pytest.mark.slow
def test_several_runs_share_one_page(directory, page, tmp_path, monkeypatch):
    shutil.copytree(directory, tmp_path / "_other")
    monkeypatch.chdir(tmp_path)
    report.main([str(directory), "_other", "--episodes", "1"])
    both = Page((tmp_path / "report.html").read_text())
    assert both.attributes("href") == ["#run-1", "#run-2"]
    assert {"run-1", "run-2"} <= set(both.attributes("id"))
    assert both.text.count("All settings") == 2


@pytest.mark.slow
def test_a_run_without_a_complete_iteration_has_a_page():
    run = untrained.make_run(num_iterations=1)
    section = report._seed_section(run, 0, report.Arguments((Path("nowhere"),), episodes=1))
    assert section["curves"] is None and section["strip"] is None
    assert section["iterations"].rows == []
    assert len(section["policies"].rows) == 2
    assert {row[-1] for row in tables.budget(run, None).rows} == {tables.MISSING, "2"}
    (row,) = tables.results({"run": [run]}).rows
    assert row[3] == "0 of 1" and set(row[4:]) == {tables.MISSING}


def test_a_config_file_of_anothers_making_breaks_nothing(tmp_path):
    run = dataclasses.replace(untrained.make_run(num_iterations=1), path=tmp_path)
    content = {"machine": {"device": ["cpu"]}, "versions": ["jax"], "budget": "none"}
    (tmp_path / files.CONFIG).write_text(json.dumps(content))
    section = report._run_section("run", [run])
    assert section["machine"].rows == [["device", "['cpu']"]]
    assert section["versions"].rows == []
    assert section["budget"].rows[0] == ["env steps", tables.MISSING, tables.MISSING]


def test_numbers_that_are_none_are_missing():
    assert tables.number(1234.5678, ",.1f") == "1,234.6"
    for strange in (None, float("nan"), float("inf"), "<b>", [1]):
        assert tables.number(strange, ".2f") == tables.MISSING


def test_the_comparison_draws_every_seed_in_its_runs_colour():
    run = untrained.make_run(num_iterations=1)
    column = [3.0, 5.0]
    names = ("iteration", "env_steps", "wall_seconds", "cumulative_coverage", "mixture_entropy")
    run = dataclasses.replace(run, metrics={name: plotting.np.array(column) for name in names})
    figure = plotting.comparison({"one": [run, run], "two": [run]})
    lines = [line for ax in figure.axes for line in ax.lines]
    assert len(lines) == 3 * 2 * 3  # seeds, quantities, axes
    assert [line.get_color() for line in figure.axes[0].lines] == ["C0", "C0", "C1"]
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["one", "two"]
    assert figure.axes[0].get_ylim()[0] == 0 and figure.axes[0].get_ylim()[1] > 5


def test_a_users_name_with_the_sign_of_a_formula_is_drawn(tmp_path):
    run = untrained.make_run(num_iterations=1)
    task = "user:$\\lost$"
    names = (*(axis for axis, _ in plotting.COVERAGE_AXES), "task_return")
    metrics = {name: plotting.np.array([3.0, 5.0]) for name in names}
    run = dataclasses.replace(run, metrics=metrics, config=run.config.replace(task=task))
    plotting.save(plotting._finish(plotting.Figure(), run), tmp_path, "titled")
    plotting.save(plotting.comparison({task: [run]}), tmp_path, "compared")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((), "name the directory of one run"),
        (("{run}", "{run}"), "named twice"),
        (("{run}", "--episodes", "0"), "--episodes is 0, but must be at least 1"),
        (("{run}", "--out", "{run}"), "cannot write to"),
        (("{run}", "--out", "{run}/no/page.html"), "cannot write to"),
        (("{run}/nowhere",), "is not the directory of a run"),
        (("{run}", "--owt", "page.html"), "did you mean --out"),
    ],
)
def test_a_mistake_is_one_sentence_at_once(tmp_path, arguments, words):
    files.write_config(tmp_path, preset("smoke"), {}, {})
    line = [argument.format(run=tmp_path) for argument in arguments]
    started = time.monotonic()
    done = subprocess.run(
        [sys.executable, "-m", "experiments.report", *line],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert time.monotonic() - started < 3
    assert done.returncode == 2 and done.stdout == ""
    assert words in done.stderr and done.stderr.count("\n") == 1
