"""Writes one self-contained HTML page about one or several runs and all their seeds.

The page shows results, curves, heat maps, the paths of each policy, settings and budgets. It opens
offline and contains no script.
"""

import base64
import dataclasses
import io
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from maxent_jax import errors
from maxent_jax.checks import check_seed
from maxent_jax.commands import cli, render
from maxent_jax.runs import atomic, files, integrity, progress, runtime
from maxent_jax.visual import headless

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from maxent_jax.analysis import Run

    Seeds = Mapping[str, Sequence[Run]]  # of each run, by its name

TEMPLATE = Path(__file__).parent.parent / "visual" / "report.html.jinja"
PNG_SIGNATURE = b"\x89PNG\r\n"


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Write an HTML page about one or several runs."""

    directories: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """The runs' directories."""
    out: Path | None = None
    """File for the page; if left out, report.html in the run's directory (here for several)."""
    episodes: int = 5
    """Episodes rolled out per policy."""
    seed: int = 1
    """Seed of the rollouts; training evaluates with seed 0."""
    fallback: bool = False
    """If a run's last checkpoint is damaged, use the one before."""
    modules: cli.Modules = ()
    """Module, by name or path, that registers your environments, bonuses or methods."""


def main(argv: Sequence[str]) -> None:
    """Parses and checks the arguments, and only then loads jax."""
    cli.import_modules(argv)
    arguments = cli.parse(Arguments, argv, "report")
    configs = [files.read_config(directory) for directory in arguments.directories]
    path = _check(arguments)
    for config in configs:
        config.check_registered()
    for directory in arguments.directories:
        integrity.check_any(directory)
    headless.draw_nothing()
    runtime.start(any(config.simulates_in_jax for config in configs))
    page = make(arguments)
    with atomic.whole_file(path) as temporary:
        temporary.write_text(page, encoding="utf-8")
    print(f"{path}: {len(page.encode()) / 1e6:.1f} MB.")


def _check(arguments: Arguments) -> Path:
    """Returns the path of the page."""
    directories = arguments.directories
    if not directories:
        raise errors.UsageError("no run is given: name the directory of one run, or of several.")
    if len(set(directories)) < len(directories):
        raise errors.UsageError("a directory is named twice: name each run once.")
    cli.check_least("--episodes", arguments.episodes)
    check_seed("--seed", arguments.seed)
    here = directories[0] if len(directories) == 1 else Path()
    path = arguments.out or here / "report.html"
    if path.is_dir() or not path.parent.is_dir():
        raise errors.UsageError(
            f"cannot write to {path}: --out must name a file in an existing directory."
        )
    files.check_writable(path.parent)
    return path


def make(arguments: Arguments) -> str:
    """Returns the page as HTML.

    Raises:
      RunError: a run cannot be loaded.
    """
    import jinja2

    from maxent_jax import __version__
    from maxent_jax.visual import plotting, tables

    seeds = {
        str(directory): _load(directory, arguments.fallback) for directory in arguments.directories
    }
    sections: dict[str, list[dict[str, Any]]] = {name: [] for name in seeds}
    all_seeds = [(name, i) for name, of_run in seeds.items() for i in range(len(of_run))]
    for name, i in progress.track(all_seeds, "report"):
        sections[name].append(_seed_section(seeds[name][i], i, arguments))
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    return environment.from_string(TEMPLATE.read_text(encoding="utf-8")).render(
        version=__version__,
        results=tables.results(seeds),
        comparison=_svg(plotting.comparison(seeds)) if len(all_seeds) > 1 else None,
        runs=[_run_section(name, seeds[name]) | {"seeds": sections[name]} for name in seeds],
    )


def _load(directory: Path, fallback: bool) -> list["Run"]:
    from maxent_jax import analysis

    num_seeds = files.read_config(directory).num_seeds
    return [analysis.load_run(directory, i, fallback) for i in range(num_seeds)]


def _run_section(name: str, seeds: Sequence["Run"]) -> dict[str, Any]:
    """What all seeds of a run share."""
    from maxent_jax.visual import tables

    config = seeds[0].config
    content = json.loads((seeds[0].path / files.CONFIG).read_text(encoding="utf-8"))
    return {
        "name": name,
        "config": config,
        "settings": config.flat(),
        "headline": tables.headline(seeds),
        "departures": tables.departures(config),
        "budget": tables.budget(seeds[0], content.get("budget")),
        "versions": tables.pairs(content.get("versions")),
        "machine": tables.pairs(content.get("machine")),
    }


def _seed_section(run: "Run", seed_index: int, arguments: Arguments) -> dict[str, Any]:
    from maxent_jax import analysis
    from maxent_jax.visual import plotting, tables

    visited, by_policy = run.occupancies(arguments.episodes, arguments.seed)
    return {
        "seed": run.seed,
        "curves": _svg(plotting.curves(run)) if run.metrics else None,
        "occupancy": _svg(plotting.occupancy_map(run, run.mixture_cells(visited))),
        "fireworks": _svg(plotting.fireworks(run, analysis.paths(by_policy))),
        "strip": _strip(run, seed_index),
        "iterations": tables.iterations(run),
        "policies": tables.policies(run, by_policy, arguments.seed),
        "measures": tables.measures(run.measures(visited, arguments.seed)),
        "episodes": arguments.episodes,
    }


def _strip(run: "Run", seed_index: int) -> str | None:
    """The stills that `render` has made, if any."""
    folder = render.folder(run.path, run.config.num_seeds, seed_index)
    try:
        content = (folder / "mixture.png").read_bytes()
    except OSError:
        return None
    return _data_uri("image/png", content) if content.startswith(PNG_SIGNATURE) else None


def _svg(figure: "Figure") -> str:
    """The figure as an image in a data URI, without the text that the page has itself."""
    import matplotlib

    figure.suptitle("")
    figure.supxlabel("")
    buffer = io.BytesIO()
    with matplotlib.rc_context({"svg.hashsalt": "maxent_jax"}):  # the same page from the same run
        figure.savefig(buffer, format="svg", bbox_inches="tight", metadata={"Date": None})
    return _data_uri("image/svg+xml", buffer.getvalue())


def _data_uri(kind: str, content: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"
