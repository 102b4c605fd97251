"""Studies: the runs that make up an experiment.

A study is a list of cells. A cell is a run of the command `train` in its own directory. All methods
of a study have the same env steps and gradient steps (METRA has its authors' gradient steps), and
are measured in the same projection. Loads no array library.
"""

from collections.abc import Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

from maxent_jax.config import Config, preset, tasks
from maxent_jax.config.registry import BASELINES, CLASSIC_ENVS, METRA, MUJOCO_ENVS, PLAIN
from maxent_jax.runs import files, source

SCALES = ("toy", "cpu", "paper")
ETAS = (0.1, 0.01, 0.001)
SCRATCH = "scratch"  # the method that does not explore before a task

Changes = dict[str, Any]


class Cell(NamedTuple):
    """One run of a study."""

    method: str  # its name in the figures
    config: Config  # on a task that starts from another cell, `source` is that cell's name
    source: "Cell | None" = None

    @property
    def name(self) -> str:
        """The name of the cell's directory."""
        words, task = [self.config.env, self.method], self.config.downstream.task
        if self.source:
            words.append(f"{self.config.downstream.source_iterations}")
        if task != tasks.NONE:
            words.append(task)
        first, last = self.config.seed, self.config.seed + self.config.num_seeds - 1
        words += [f"{first}"] + ([f"{last}"] if last > first else [])
        return "-".join(files.as_name(word) for word in words)


class Scale(NamedTuple):
    """The size of a study."""

    preset: str
    num_seeds: Mapping[str, int]  # by environment
    changes: Mapping[str, Any] = MappingProxyType({})  # to the preset, in every cell
    methods: Sequence[str] = ()  # of the study's; if empty, all
    then: Mapping[str, Sequence[str]] = MappingProxyType({})  # tasks to train on next, by env
    explored: Sequence[float] = (0.25, 1.0)  # shares of the exploration after which tasks follow


class Study(NamedTuple):
    """An experiment."""

    what: str
    methods: dict[str, Changes]  # changes to the preset, by name in the figures
    scales: dict[str, Scale]
    together: bool = False  # all seeds in one run, instead of one run per seed
    mepol: bool = False  # also runs MEPOL, at the same env steps
    along: str = ""  # the number in which the methods differ: see results.ALONG
    relabelled: Mapping[str, Sequence[str]] = MappingProxyType({})  # tasks of its data, by env


TOY = Scale("smoke", {"pendulum": 2})
ROBOT = {
    "toy": TOY,
    "cpu": Scale("quick", {"ant": 3}),
    "paper": Scale("paper", {"ant": 5}),
}
CLASSIC = {  # on two cores an iteration of ten seeds takes minutes, so "cpu" is small
    "toy": TOY,
    "cpu": Scale("quick", {"pendulum": 10}, {"num_iterations": 2}),
    "paper": Scale("paper", dict.fromkeys(CLASSIC_ENVS, 10)),
}
THREE: dict[str, Changes] = {
    "H": {"method": "h", "random_baseline": True},  # values.read takes the first method's
    "LA": {"method": "la"},
    "V": {"method": "v"},
}
# Ablations of what happens within an iteration need only four iterations.
ABLATION = ROBOT | {"cpu": Scale("quick", {"ant": 3}, {"num_iterations": 4})}
# A method's own period is not set again, so that equal runs have equal configs: see `home`.
REFRESHED: dict[str, Changes] = {
    "every 1": {"method": "la"},
    **{
        f"every {period or 'iteration'}": {"method": "la", "refresh_period": period}
        for period in (10, 100, 0)
    },
}

STUDIES: dict[str, Study] = {
    "fig4": Study(
        "H, LA and V, with a random policy",
        THREE,
        {
            "toy": TOY,
            # A process for each core trains cells side by side: a lag would gain nothing.
            "cpu": Scale("quick", {"ant": 5, "walker2d": 5, "humanoid": 3}, {"policy_lag": 0}),
            "paper": Scale("paper", dict.fromkeys(MUJOCO_ENVS, 5)),
        },
    ),
    "weights": Study(
        "V with other weights of the mixture",
        {
            "uniform": {},
            **{f"η = {eta}": {"weights": "geometric", "eta": eta} for eta in ETAS},
            "fully corrective": {"weights": "fully_corrective"},
        },
        ROBOT,
    ),
    "refresh": Study(
        "steps between refreshes of LA's reward", REFRESHED, ROBOT, along="refresh_period"
    ),
    "refresh_classic": Study(
        "steps between refreshes of LA's reward",
        REFRESHED,
        CLASSIC,
        together=True,
        along="refresh_period",
    ),
    "start": Study(
        "the agent that V's iterations start from",
        {"best": {}, "last": {"start": "last"}, "scratch": {"start": "scratch"}},
        ROBOT,
    ),
    "episodic": Study(
        "weight of the episodic term",
        {f"λ = {weight}": {"episodic_weight": weight} for weight in (0.0, 0.01, 0.1, 1.0)},
        ABLATION,
        along="episodic_weight",
    ),
    "form": Study(
        "form of the reward",
        {form: {"reward": form} for form in ("log1p", "linear", "log", "paper")},
        ABLATION,
    ),
    "stale": Study(
        "stored rewards: recomputed for the current reference, or stale",
        {"recomputed": {}, "stale": {"stale_rewards": True}},
        ABLATION,
    ),
    "termination": Study(
        "conditions that end an episode",
        {
            "health and flips": {"end_flipped": True},
            "health": {"end_flipped": False},
            "nothing": {"end_flipped": False, "end_unhealthy": False},
        },
        ABLATION | {"toy": TOY._replace(num_seeds={"ant": 2})},
    ),
    "published": Study(
        "H and LA as published and as the paper reads them, with the same plain learner",
        {
            **{name: changes | PLAIN for name, changes in THREE.items()},
            "H, official": {"method": "h-official"},
            "APT": {"method": "apt"},
        },
        ABLATION,
    ),
    "rivals": Study(
        "unit cells under METRA's protocol",
        {
            "V": {"method": "v", "torque_limit": 1.0},
            "METRA": {"method": "metra"},
            "APT": {"method": "apt", "torque_limit": 1.0},
            "RND": {"method": "rnd", "torque_limit": 1.0},
        },
        {
            "toy": TOY._replace(num_seeds={"ant": 2}, changes={"protocol": "metra"}),
            "cpu": Scale(
                "quick",
                {"ant": 3},
                {
                    "protocol": "metra",
                    "policy_lag": 0,
                    "num_iterations": 20,
                    "steps_per_iteration": 240_000,
                },
            ),
            "paper": Scale("paper", {"ant": 5, "humanoid": 5}, {"protocol": "metra"}),
        },
    ),
    "downstream": Study(
        "tasks, after exploring by each method and from scratch",
        {
            "V": THREE["V"],
            **THREE,
            **{name: {"method": name} for name in ("apt", "rnd", "icm", "proto")},
        },
        {
            "toy": TOY._replace(then={"pendulum": ("gymnasium",)}),
            "cpu": Scale(  # a night on two cores
                "quick",
                {"ant": 5, "walker2d": 5},
                {"policy_lag": 0},
                methods=("V", "LA"),
                then={
                    "ant": ("run:0", "goal:15,0", "goal:0,-15"),
                    "walker2d": ("forward", "backward", "flip"),
                },
                explored=(1.0,),
            ),
            "paper": Scale(
                "paper",
                dict.fromkeys(MUJOCO_ENVS, 10),
                then={
                    "ant": ("run:0", "run:90", "run:180", "run:270", "goal:15,0", "goal:0,-15"),
                    "walker2d": ("forward", "backward", "flip", "stand"),
                    "humanoid": ("forward", "stand"),
                },
            ),
        },
    ),
    "offline": Study(
        "return of TD3+BC, by what made its dataset",
        THREE,
        {
            "toy": TOY,
            "cpu": Scale("quick", {"ant": 3}, {"policy_lag": 0}),
            "paper": Scale("paper", {"ant": 5}),
        },
        relabelled={"pendulum": ("gymnasium",), "ant": ("run:0", "reach:10,0", "goal:10,0")},
    ),
    "baselines": Study(
        "baselines with one policy each, and V",
        {
            "V": {"method": "v"} | PLAIN,
            # METRA has a learner of its own: see the study `rivals`.
            **{name: {"method": name} for name in BASELINES if name != METRA},
        },
        CLASSIC,
        together=True,
        mepol=True,
    ),
}


def make(study: str, scale: str, num_seeds: int | None = None) -> list[Cell]:
    """Returns the cells of a study at a scale: all methods of a seed, then the next seed.

    A seed's cells on tasks follow those that they start from.
    """
    chosen = STUDIES[study]
    at = chosen.scales[scale]
    seeds = at.num_seeds if num_seeds is None else dict.fromkeys(at.num_seeds, num_seeds)
    methods = {name: chosen.methods[name] for name in at.methods or chosen.methods}
    widths = seeds if chosen.together else dict.fromkeys(seeds, 1)
    cells: list[Cell] = []
    for seed in range(max(seeds.values())):
        explore = [
            Cell(
                method,
                preset(
                    at.preset,
                    **{"env": env, "seed": seed, "num_seeds": widths[env], **at.changes, **changes},
                ),
            )
            for env in seeds
            if seed in range(0, seeds[env], widths[env])
            for method, changes in methods.items()
        ]
        cells += [*explore, *_on_tasks(explore, at)]
    return cells


def _on_tasks(explore: Sequence[Cell], scale: Scale) -> Iterator[Cell]:
    """The cells on tasks that start from each cell, and from scratch."""
    for cell in explore:
        config, first = cell.config, cell.method == explore[0].method
        for task in scale.then.get(config.env, ()):
            if first:  # from scratch once, with the settings of the first method
                yield Cell(SCRATCH, _from_scratch(config, task))
            for part in scale.explored:
                iterations = max(1, round(part * config.budget.num_iterations))
                own = source.on_task(config, cell.name, task, source_iterations=iterations)
                yield Cell(cell.method, own, cell)


def _from_scratch(explored: Config, task: str) -> Config:
    """At least as many env steps as a run on the task that starts from policies, which play."""
    played = source.on_task(explored, "there", task).downstream.first_episodes
    played *= explored.archive_size * explored.environment.episode_length
    own = source.on_task(explored, "", task, SCRATCH)
    more = -(-played // own.budget.steps_per_iteration)
    return own.replace(num_iterations=own.budget.num_iterations + more)


def share(cells: Sequence[Cell], index: int, count: int) -> list[Cell]:
    """Returns one of `count` shares of the cells; those that start from a cell go where it goes."""
    own = {cell.name for cell in [c for c in cells if c.source is None][index::count]}
    return [cell for cell in cells if (cell.source or cell).name in own]
